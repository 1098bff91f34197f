"""The projective aligner: its sums, its answers on rendered frames, its honesty; plain NumPy is in test_backends."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

import scanweld as sw
from rendered import CAMERA, frame_of, plane_depth, pose_error, rendered
from scanweld.datasets.synthetic import NOISE_MODELS, degrade_depth
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceLevel, surface_image
from scanweld.registration.gauss_newton import NormalEquations, solve, spectrum
from scanweld.registration.projective import (
    ProjectiveConfig,
    ProjectiveStep,
    _largest_shift,
    align_projective,
    projective_step,
)
from scanweld.tracking.two_frames import surface_points

SMALL = sw.PinholeCamera(40.0, 41.0, 19.3, 14.8, 40, 30)


def random_target(seed: int) -> SurfaceLevel:
    """A surface image of random vertices, normals and noise; a fifth has no normal."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.0, 1.3, SMALL.shape).astype(np.float32)
    normals = rng.standard_normal((*SMALL.shape, 3)) * 0.4 - [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    inverse_sigma = rng.uniform(50, 400, SMALL.shape)
    inverse_sigma[rng.random(SMALL.shape) < 0.2] = 0
    surface = np.concatenate(
        [SMALL.rays() * depth[..., None], normals, inverse_sigma[..., None], np.zeros((*SMALL.shape, 1))], -1
    ).astype(np.float32)
    return SurfaceLevel(SMALL, depth, surface)


def random_source(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in front of, beside and behind the camera of `random_target`, normals about towards it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.9, -0.7, 0.9], [0.9, 0.7, 1.4], (count, 3))
    points[: count // 10, 2] *= -1
    normals = rng.standard_normal((count, 3)) * 0.4 - [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points.T.astype(np.float32).copy(), normals.T.astype(np.float32).copy()


def step_at(
    T: np.ndarray, source: tuple[np.ndarray, np.ndarray], target: SurfaceLevel, gate: float, **changes: float
) -> ProjectiveStep:
    return projective_step(*source, T, target, gate, ProjectiveConfig(**changes), np.zeros(3), 1.0)


class TestSums:
    def test_in_plane_offset_has_no_residual(self) -> None:
        """n = (1, 1, 0) / sqrt 2, offset (1, -1, 0): the residual is 0 (golden 1)."""
        surface = np.zeros((*SMALL.shape, 8), np.float32)
        surface[..., 0:3], surface[..., 3:6], surface[..., 6] = [-1, 1, 5], [0.5**0.5, 0.5**0.5, 0], 1
        point = np.array([[0], [0], [5]], np.float32)
        normal = np.array([[0.5**0.5], [0.5**0.5], [0]], np.float32)
        step = step_at(np.eye(4), (point, normal), SurfaceLevel(SMALL, surface[..., 2], surface), 10.0)
        assert step.num_matched == 1
        assert step.loss == pytest.approx(0, abs=1e-12)

    def test_each_gate_alone(self) -> None:
        """One point 4 cm in front of a wall: a gate of 3 cm, a normal at 60 degrees, and no normal refuse it."""
        wall = surface_image(plane_depth((0, 0, 1), 1.0, SMALL), SMALL, sw.SurfaceConfig())
        level = SurfaceLevel(SMALL, wall[..., 2], wall)
        point = np.array([[0.0], [0.0], [0.96]], np.float32)
        straight = np.array([[0.0], [0.0], [-1.0]], np.float32)
        tilted = np.array([[np.sin(np.pi / 3)], [0.0], [-0.5]], np.float32)
        assert step_at(np.eye(4), (point, straight), level, 0.05, min_cosine=0.6).num_matched == 1
        assert step_at(np.eye(4), (point, straight), level, 0.03, min_cosine=0.6).num_matched == 0
        assert step_at(np.eye(4), (point, tilted), level, 0.05, min_cosine=0.6).num_matched == 0
        assert step_at(np.eye(4), (point, tilted), level, 0.05, min_cosine=0.4).num_matched == 1
        blank = SurfaceLevel(SMALL, wall[..., 2], np.where(np.arange(8) > 2, 0, wall).astype(np.float32))
        assert step_at(np.eye(4), (point, straight), blank, 0.05).num_matched == 0

    def test_shares_are_those_of_equal_parts_in_order(self) -> None:
        """1000 points in 4 shares: points 0 to 249, 250 to 499, .. alone, and together all of them."""
        source, target, T = random_source(5, 1000), random_target(6), se3.exp([0.03, -0.02, 0.05, 0.1, -0.05, 0.2])
        config = ProjectiveConfig(min_cosine=0.0)
        step = projective_step(*source, T, target, 0.15, config, np.zeros(3), 1.0, parts=4)
        assert step.num_matched > 100
        quarters = [
            projective_step(*(a[:, k : k + 250].copy() for a in source), T, target, 0.15, config, np.zeros(3), 1.0)
            for k in range(0, 1000, 250)
        ]
        H, g = (np.stack([getattr(one.equations, name) for one in quarters]) for name in ("information", "gradient"))
        np.testing.assert_allclose(step.shares.information, H, rtol=1e-5, atol=1e-5 * H.max())
        np.testing.assert_allclose(step.shares.gradient, g, rtol=1e-5, atol=1e-5 * np.abs(g).max())
        np.testing.assert_allclose(step.equations.information, H.sum(axis=0), rtol=1e-5, atol=1e-5 * H.max())

    @pytest.mark.parametrize(("u", "v", "inside"), [
        (-0.49, 3, True), (-0.51, 3, False), (39.49, 3, True), (39.51, 3, False),
        (3, -0.49, True), (3, -0.51, False), (3, 29.49, True), (3, 29.51, False),
    ])  # fmt: skip
    def test_image_spans_half_a_pixel_around_its_centres(self, u: float, v: float, inside: bool) -> None:
        point = np.array([[(u - SMALL.cx) / SMALL.fx], [(v - SMALL.cy) / SMALL.fy], [1.0]], np.float32)
        step = step_at(np.eye(4), (point, -np.eye(3, 1, -2, dtype=np.float32)), random_target(3), 1.0)
        assert step.num_projected == inside

    def test_gradient_and_information_are_derivatives_for_left_perturbations(self) -> None:
        """On a plane r does not depend on which pixel is matched, so the cost is smooth: with T <- exp(xi) T its
        first derivative is g, and the change of g is H xi."""
        wall = surface_image(plane_depth((0.3, -0.2, 1), 1.5), CAMERA, sw.SurfaceConfig(noise_growth=0))
        level = SurfaceLevel(CAMERA, wall[..., 2], wall)
        rng = np.random.default_rng(4)
        points = (CAMERA.rays()[20:100:3, 20:140:3].reshape(-1, 3) * rng.uniform(1.3, 1.7, (40 * 27, 1))).T
        normals = np.tile(np.array([[-0.3], [0.2], [-1]]) / np.sqrt(1.13), points.shape[1])
        source = points.astype(np.float32).copy(), normals.astype(np.float32).copy()
        T = se3.exp([0.01, 0.02, -0.01, 0.02, 0.01, -0.03])

        def at(xi: np.ndarray) -> ProjectiveStep:
            return step_at(se3.exp(xi) @ T, source, level, 10.0, robust_sigma=1e6)

        def cost(xi: np.ndarray) -> float:
            step = at(xi)
            return step.loss * step.num_matched

        here, h = at(np.zeros(6)), 1e-3
        assert here.num_matched == points.shape[1]
        slopes = [(cost(h * e) - cost(-h * e)) / (2 * h) for e in np.eye(6)]
        np.testing.assert_allclose(here.equations.gradient, slopes, rtol=2e-3, atol=1e-3 * np.abs(slopes).max())
        # r is linear in the translation, so there Gauss-Newton's Hessian is the true one.
        curvature = [(at(h * e).equations.gradient - at(-h * e).equations.gradient) / (2 * h) for e in np.eye(6)[:3]]
        H = here.equations.information
        np.testing.assert_allclose(np.array(curvature)[:, :3], H[:3, :3], atol=1e-3 * np.abs(H[:3, :3]).max())


@lru_cache(maxsize=1)
def room_points() -> tuple[tuple[SurfaceLevel, ...], np.ndarray, np.ndarray]:
    pyramid = sw.build_pyramid(rendered(count=40).frames[0])
    return (pyramid.levels, *surface_points(pyramid))


twists = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)


class TestAnswers:
    @settings(max_examples=25)
    @given(twists)
    def test_recovers_small_motions_of_a_rendered_frame(self, direction: np.ndarray) -> None:
        """The frame against its own points from up to 6 cm and 4 degrees off: nothing but rounding is left."""
        levels, positions, normals = room_points()
        start = se3.exp(direction * [0.06, 0.06, 0.06, 0.07, 0.07, 0.07])
        result = align_projective(positions, normals, levels, start, ProjectiveConfig(iterations=40, step_m=1e-5))
        assert result.status is sw.Status.CONVERGED
        shift, turn = pose_error(result.T_target_source, np.eye(4))
        assert shift < 2e-4
        assert turn < 0.01
        assert result.overlap > 0.95
        assert result.unobservable == ()

    @settings(max_examples=10)
    @given(twists, twists)
    def test_moving_the_source_frame_moves_the_answer(self, frame: np.ndarray, direction: np.ndarray) -> None:
        levels, positions, normals = room_points()
        T_source_new = se3.exp(frame)
        moved = se3.transform_points(se3.inverse(T_source_new), positions.T).T.astype(np.float32).copy()
        turned = (T_source_new[:3, :3].T @ normals).astype(np.float32).copy()
        start = se3.exp(0.02 * direction)
        plain = align_projective(positions, normals, levels, start)
        shifted = align_projective(moved, turned, levels, start @ T_source_new)
        shift, turn = pose_error(shifted.T_target_source, plain.T_target_source @ T_source_new)
        assert shift < 1e-4
        assert turn < 0.01
        assert shifted.status is plain.status

    def test_history_and_arguments(self) -> None:
        levels, positions, normals = room_points()
        start = se3.exp([0.02, 0, 0, 0, 0.02, 0])
        before = positions.copy(), normals.copy(), start.copy(), levels[0].surface.copy()
        result = align_projective(positions, normals, levels, start, keep_history=True)
        assert len(result.history) == result.num_iterations
        assert [step.level for step in result.history] == sorted((s.level for s in result.history), reverse=True)
        assert result.history[-1].rmse_m < result.history[0].rmse_m
        for then, now in zip(before, (positions, normals, start, levels[0].surface), strict=True):
            np.testing.assert_array_equal(then, now)
        assert align_projective(positions, normals, levels, start).history == ()

    def test_same_bytes_at_any_number_of_threads(self) -> None:
        from scanweld.parallel import get_num_threads

        levels, positions, normals = room_points()
        many = np.tile(positions, 3), np.tile(normals, 3)
        usual, answers = get_num_threads(), set()
        try:
            for threads in (1, 2, 3, 8):
                sw.set_num_threads(threads)
                result = align_projective(*many, levels, se3.exp([0.02] * 6))
                answers.add(result.T_target_source.tobytes() + result.information.tobytes())
        finally:
            sw.set_num_threads(usual)
        assert len(answers) == 1


class TestHonesty:
    @pytest.mark.parametrize("normal", [(0, 0, 1), (0.4, -0.2, 1)])
    def test_wall_slid_in_itself_is_degenerate(self, normal: tuple[float, ...]) -> None:
        """A plane leaves two translations in it and the rotation about its normal free; they stay at the guess."""
        frame = frame_of(plane_depth(normal, 1.5))
        pyramid = sw.build_pyramid(frame)
        n = np.array(normal) / np.linalg.norm(normal)
        along = np.cross(n, [0, 1, 0])
        start = np.eye(4)
        start[:3, 3] = 0.15 * along / np.linalg.norm(along)
        result = align_projective(*surface_points(pyramid), pyramid.levels, start)
        assert result.status is sw.Status.DEGENERATE
        words = [direction.words for direction in result.unobservable]
        assert len(words) == 3
        assert [text.split()[0] for text in words] == ["translation", "translation", "rotation"]
        for direction in result.unobservable[:2]:
            assert abs(direction.vector[:3] @ n) < 0.02
        turn = result.unobservable[2].vector[3:]
        assert abs(turn @ n) / np.linalg.norm(turn) > 0.999
        assert all(text in result.note for text in words)
        np.testing.assert_allclose(result.T_target_source, start, atol=1e-3)

    @pytest.mark.parametrize("noise", ["kinect", "realsense"])
    @pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.1, 1)])
    def test_noisy_wall_is_degenerate_too(self, normal: tuple[float, ...], noise: str) -> None:
        """The scatter of noisy normals is no relief: two looks at a blank wall, 15 cm apart, say nothing about the
        slide, which stays at the guess to a few standard deviations of a pixel (3 to 6 mm at 1.5 m)."""
        depth = plane_depth(normal, 1.5)
        sides = [degrade_depth(depth, CAMERA, NOISE_MODELS[noise], np.random.default_rng(seed)) for seed in (1, 2)]
        source, target = (sw.build_pyramid(frame_of(side)) for side in sides)
        along = np.cross(normal, [0, 1, 0])
        start = np.eye(4)
        start[:3, 3] = 0.15 * along / np.linalg.norm(along)
        result = align_projective(*surface_points(source), target.levels, start)
        assert result.status is sw.Status.DEGENERATE
        assert len(result.unobservable) == 3
        shift, turn = pose_error(result.T_target_source, start)
        assert shift < 5e-3
        assert turn < 0.5

    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_held_directions_do_not_move(self, count: int) -> None:
        """The step stays orthogonal to them and solves the normal equations in the rest."""
        rng = np.random.default_rng(count)
        J = rng.standard_normal((50, 6))
        centroid, radius = np.array([0.3, -0.2, 1.5]), 0.7
        equations = NormalEquations(J.T @ J, J.T @ rng.standard_normal(50), 50.0, centroid, radius)
        held = np.linalg.qr(rng.standard_normal((6, count)))[0]
        parts = spectrum(equations, held=held)
        assert parts.observable.sum() == 6 - count
        xi = solve(equations, parts)
        at_centroid = np.concatenate([xi[:3] + np.cross(xi[3:], centroid), xi[3:] * radius])
        np.testing.assert_allclose(held.T @ at_centroid, 0, atol=1e-12)
        to_origin = np.eye(6)
        to_origin[:3, 3:] = -np.cross(np.eye(3), centroid).T
        to_origin[:, 3:] /= radius
        others = to_origin @ np.linalg.svd(held)[0][:, count:]
        np.testing.assert_allclose(others.T @ (equations.information @ xi + equations.gradient), 0, atol=1e-9)

    def test_edge_of_two_walls_leaves_one_direction_free(self) -> None:
        """Two walls that meet in a vertical edge: only the translation along the edge is free."""
        left, right = plane_depth((0.6, 0, 1), 1.5), plane_depth((-0.6, 0, 1), 1.5)
        pyramid = sw.build_pyramid(frame_of(np.minimum(left, right)))
        result = align_projective(*surface_points(pyramid), pyramid.levels, se3.exp([0.01, 0.05, 0.01, 0, 0, 0]))
        assert result.status is sw.Status.DEGENERATE
        assert [direction.words for direction in result.unobservable] == ["translation along (0.00, 1.00, 0.00)"]
        np.testing.assert_allclose(result.T_target_source[:3, 3], [0, 0.05, 0], atol=2e-3)

    def test_a_single_point_is_too_few(self) -> None:
        target = sw.build_pyramid(frame_of(np.ones(CAMERA.shape, np.float32)))
        point = np.array([[0], [0], [1]], np.float32)
        result = align_projective(point, -point, target.levels, np.eye(4))
        assert result.status is sw.Status.TOO_FEW_CORRESPONDENCES
        assert np.isfinite(result.T_target_source).all()

    def test_no_depth_is_too_few(self) -> None:
        levels, positions, normals = room_points()
        empty = sw.build_pyramid(frame_of(np.zeros(CAMERA.shape)))
        for result in (
            align_projective(positions, normals, empty.levels, np.eye(4)),
            align_projective(*surface_points(empty), levels, np.eye(4)),
            align_projective(positions[:, :100].copy(), normals[:, :100].copy(), levels, np.eye(4)),
        ):
            assert result.status is sw.Status.TOO_FEW_CORRESPONDENCES
            assert "fewer than" in result.note
            assert np.isfinite(result.T_target_source).all()

    def test_wrong_start_never_ends_in_a_wrong_converged(self) -> None:
        """Starts from 0.1 to 1 m and from 5 to 90 degrees off: every CONVERGED answer is right."""
        levels, positions, normals = room_points()
        right = wrong = 0
        rng = np.random.default_rng(5)
        for shift_m, turn_deg in [(0.1, 0), (0.3, 0), (1.0, 0), (0, 10), (0, 30), (0, 90), (0.3, 20), (1.0, 60)]:
            for _ in range(6):
                axes = rng.standard_normal((2, 3))
                axes /= np.linalg.norm(axes, axis=1, keepdims=True)
                start = se3.exp([0, 0, 0, *np.radians(turn_deg) * axes[0]])
                start[:3, 3] = shift_m * axes[1]
                result = align_projective(positions, normals, levels, start)
                assert np.isfinite(result.T_target_source).all()
                if result.status is sw.Status.CONVERGED:
                    shift, turn = pose_error(result.T_target_source, np.eye(4))
                    assert max(shift / 0.01, turn / 0.5) < 1, (shift_m, turn_deg, start, result)
                    right += 1
                else:
                    assert result.note
                    wrong += 1
        assert right >= 6  # the near starts do arrive
        assert wrong >= 12  # and the far ones say that they did not

    def test_no_iterations_left_says_so(self) -> None:
        levels, positions, normals = room_points()
        config = replace(ProjectiveConfig(iterations=1), step_m=1e-7)
        result = align_projective(positions, normals, levels, se3.exp([0.03, 0, 0, 0, 0, 0]), config)
        assert result.status is sw.Status.MAX_ITERATIONS
        assert "still moving after 3 iterations" in result.note


def test_largest_shift_is_that_of_the_centroid_and_of_a_turn_about_it() -> None:
    """A point at c moves by rho + phi x c, one at a distance of r from it by r |phi| more at most."""
    rng = np.random.default_rng(0)
    for xi, centroid, radius in zip(
        rng.normal(size=(5, 6)), rng.normal(size=(5, 3)), rng.uniform(0, 2, 5), strict=True
    ):
        expected = np.linalg.norm(xi[:3] + np.cross(xi[3:], centroid)) + radius * np.linalg.norm(xi[3:])
        assert _largest_shift(xi, centroid, radius) == pytest.approx(expected)
