"""Brightness beside geometry: its kernel, when it is believed, what it fills, and the turns it proposes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, pose_error, rendered
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.geometry.depth import luminance
from scanweld.registration.photometric.refinement import dispersion
from scanweld.registration.photometric.residuals import (
    FREEDOM,
    Brightness,
    LitPoints,
    LitTarget,
    eliminate_brightness,
    estimate_brightness,
    half_grey,
    photometric_sums,
    reference_rows,
    seen_points,
    sightings,
)
from scanweld.tracking.rotation import find_turns, thumbnails
from walls import wall_frame

GATE_M, MIN_COSINE = 0.05, 0.7


def smooth_grey(shape: tuple[int, int]) -> np.ndarray:
    v, u = np.mgrid[: shape[0], : shape[1]]
    return (120 + 40 * np.sin(u / 7.0) + 30 * np.cos(v / 5.0 + u / 11.0)).astype(np.float32)


@lru_cache(maxsize=1)
def lit_room() -> tuple[LitPoints, LitTarget]:
    """The points of one frame of the room, two noises of brightness, and the frame as the target."""
    pyramid = sw.build_pyramid(rendered(count=40).frames[3])
    level = pyramid.levels[0]
    rows = level.surface.reshape(-1, 8)
    kept = np.flatnonzero(rows[:, 6] > 0)
    grey = smooth_grey(CAMERA.shape)
    rng = np.random.default_rng(0)
    values = (grey.ravel()[kept] + 3 * rng.standard_normal(len(kept))).astype(np.float32)
    points = LitPoints(rows[kept, :3].T.copy(), rows[kept, 3:6].T.copy(), values)
    return points, LitTarget(level, grey)


NEAR = se3.exp([0.004, -0.003, 0.002, 0.003, -0.002, 0.004])
LIGHT = Brightness(1.1, -7.0, 4.0)


def seen_room() -> LitPoints:
    """Those points of `lit_room` that its frame sees from `NEAR`."""
    return seen_points(*lit_room(), NEAR, GATE_M, MIN_COSINE)[0]


def map_of(sequence: object, stop: int) -> sw.SurfelMapper:
    mapper = sw.SurfelMapper()
    for k in range(stop):
        mapper.fuse(sw.build_pyramid(sequence.frames[k]), sequence.ground_truth.T_world_camera[k])
    return mapper


class TestResiduals:
    def test_luminance(self) -> None:
        """ITU-R BT.601: 0.299 R + 0.587 G + 0.114 B."""
        color = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [10, 20, 30]]], np.uint8)
        expected = [[76.245, 149.685], [29.07, 0.299 * 10 + 0.587 * 20 + 0.114 * 30]]
        np.testing.assert_allclose(luminance(color), expected, rtol=1e-6)

    def test_half_grey_drops_an_odd_row(self) -> None:
        grey = np.arange(15, dtype=np.float32).reshape(5, 3)
        np.testing.assert_array_equal(half_grey(grey), [[(0 + 1 + 3 + 4) / 4], [(6 + 7 + 9 + 10) / 4]])

    @pytest.mark.parametrize("parts", [1, 3, 8])
    def test_kernel_sums_what_numpy_sums(self, parts: int) -> None:
        points, target = lit_room()
        sums = photometric_sums(seen_room(), target, NEAR, LIGHT, parts)
        rows = reference_rows(points, target, NEAR, LIGHT, GATE_M, MIN_COSINE)
        A, r = rows.jacobian / LIGHT.scale, rows.residuals / LIGHT.scale
        weights = (FREEDOM + 1) / (FREEDOM + r**2)
        assert int(sums.matched.sum()) == pytest.approx(len(r), abs=3)  # a pixel's border, in single precision
        total = sums.information.sum(axis=0)
        expected = (A * weights[:, None]).T @ A
        size = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(total / size / size[:, None], expected / size / size[:, None], atol=2e-3)
        pull = A.T @ (weights * r)
        np.testing.assert_allclose(sums.gradient.sum(axis=0) / size, pull / size, atol=3e-3 * np.sqrt(len(r)))

    def test_jacobian_is_the_derivative(self) -> None:
        """Central differences of r(exp(xi) T) and of gain and offset, where no step crosses a pixel's border."""
        points, target = lit_room()
        few = points.every(37)
        rows = reference_rows(few, target, NEAR, LIGHT, GATE_M, MIN_COSINE)
        step = 1e-6
        checked = 0
        for axis in range(8):
            sides = []
            for sign in (1, -1):
                change = sign * step * np.eye(8)[axis]
                light = replace(LIGHT, gain=LIGHT.gain + change[6], offset=LIGHT.offset + change[7])
                sides.append(reference_rows(few, target, se3.exp(change[:6]) @ NEAR, light, GATE_M, MIN_COSINE))
            both = sides[0].seen & sides[1].seen & rows.seen
            where = [both[side.seen] for side in (*sides, rows)]
            slope = (sides[0].residuals[where[0]] - sides[1].residuals[where[1]]) / (2 * step)
            error = np.abs(slope - rows.jacobian[where[2], axis])
            smooth = error < 1e-3 * np.abs(rows.jacobian[:, axis]).max()
            assert smooth.mean() > 0.99, axis  # the others lie on a border, where the slope jumps
            checked += int(smooth.sum())
        assert checked > 2000

    def test_kernel_lists_what_numpy_sees(self) -> None:
        """Of 1000 points from a pose that puts some of them outside: the same points, brightness within rounding."""
        points, target = lit_room()
        few, T = points.every(len(points) // 1000), se3.exp([0.01, 0, 0, 0, 0.2, 0])
        at = sightings(few, target, T, GATE_M, MIN_COSINE)
        seen, frame = seen_points(few, target, T, GATE_M, MIN_COSINE)
        assert 50 < len(seen) < len(few)
        np.testing.assert_array_equal(seen.positions_m, few.positions_m[:, at.seen])
        np.testing.assert_array_equal(seen.normals, few.normals[:, at.seen])
        np.testing.assert_array_equal(seen.intensities, at.model)
        np.testing.assert_allclose(frame, at.frame, atol=2e-2)

    def test_brightness_is_found(self) -> None:
        """A frame with 1.3 times the brightness, 12 levels darker, and noise of 3 levels; 5 % are something else."""
        points, target = lit_room()
        rng = np.random.default_rng(1)
        grey = (1.3 * target.grey - 12).astype(np.float32)
        grey[rng.random(grey.shape) < 0.05] = 255
        found = estimate_brightness(points, replace(target, grey=grey), np.eye(4), GATE_M, MIN_COSINE)
        assert found is not None
        assert found.gain == pytest.approx(1.3, abs=0.02)
        assert found.offset == pytest.approx(-12, abs=2.5)
        assert found.scale == pytest.approx(1.3 * 3, rel=0.2)

    def test_nothing_seen_has_no_brightness(self) -> None:
        points, target = lit_room()
        away = se3.exp([0, 0, 0, 0, np.pi, 0])
        assert estimate_brightness(points, target, away, GATE_M, MIN_COSINE) is None

    def test_elimination_solves_for_motion_and_brightness_together(self) -> None:
        """The Schur complement's step is that of the system of eight, with the prior on the gain."""
        _, target = lit_room()
        sums = photometric_sums(seen_room(), target, NEAR, LIGHT, 4)
        eliminated = eliminate_brightness(sums, LIGHT)
        H, g = sums.information.sum(axis=0), sums.gradient.sum(axis=0)
        H = H + np.diag([0] * 6 + [1 / 0.3**2, 1e-9])
        g = g + np.array([0] * 6 + [(LIGHT.gain - 1) / 0.3**2, 0])
        together = -np.linalg.solve(H, g)
        alone = -np.linalg.solve(eliminated.information, eliminated.gradient)
        np.testing.assert_allclose(alone, together[:6], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(eliminated.scores_at(alone).sum(axis=0), 0, atol=1e-6 * np.abs(g).max())
        after = eliminated.brightness_at(alone)
        assert after.gain == pytest.approx(LIGHT.gain + together[6])
        assert after.offset == pytest.approx(LIGHT.offset + together[7])

    def test_dispersion_counts_repeated_measurements(self) -> None:
        """Every measurement entered nine times: information 9 times too large, scores 9 times too large, so their
        scatter, 81 times that of one, is 9 times the information."""
        rng = np.random.default_rng(2)
        A = rng.standard_normal((400, 25, 6))
        scores = np.einsum("kij,ki->kj", A, rng.standard_normal((400, 25)))
        information = np.einsum("kij,kil->jl", A, A)
        assert dispersion(information, scores) == pytest.approx(1.0, abs=0.1)
        assert dispersion(9 * information, 9 * scores) == pytest.approx(9.0, rel=0.1)

    def test_same_bytes_at_any_number_of_threads(self) -> None:
        from scanweld.parallel import limited_threads

        _, target = lit_room()
        answers = set()
        for threads in (1, 2, 5):
            with limited_threads(threads):
                sums = photometric_sums(seen_room(), target, NEAR, LIGHT, 8)
            answers.add(sums.information.tobytes() + sums.gradient.tobytes())
        assert len(answers) == 1


class TestWeighing:
    @staticmethod
    def track(
        mode: str, change: object = None, scene: str = "room", noise: str = "kinect"
    ) -> tuple[object, np.ndarray]:
        sequence = rendered(scene, noise=noise, count=40)
        mapper, true = map_of(sequence, 10), sequence.ground_truth.T_world_camera[10]
        guess = true @ se3.exp([0.01, -0.01, 0.005, 0.004, 0.006, -0.004])
        frame = sequence.frames[10]
        if change is not None:
            frame = replace(frame, color=change(frame.color))
        tracker = sw.FrameToModelTracker(sw.TrackingConfig(photometry=mode))
        return tracker.track(sw.build_pyramid(frame), mapper.view(guess, CAMERA), guess), true

    def test_helps_where_depth_is_noisy(self) -> None:
        (off, true), (on, _) = self.track("off"), self.track("auto")
        assert on.status is sw.Status.CONVERGED
        assert pose_error(on.T_target_source, true)[0] < pose_error(off.T_target_source, true)[0]
        gained = np.linalg.eigvalsh(on.information - off.information)
        assert gained.min() > -1e-6 * gained.max()

    def test_exposure_jump_does_not_matter(self) -> None:
        """0.6 times as bright and 30 levels up: the same pose to a fraction of the noise."""
        (plain, true), (dim, _) = (
            self.track("auto", change)
            for change in (None, lambda color: np.rint(0.6 * color.astype(np.float64) + 30).astype(np.uint8))
        )
        shift, turn = pose_error(dim.T_target_source, plain.T_target_source)
        assert shift < 1e-3
        assert turn < 0.05
        assert pose_error(dim.T_target_source, true)[0] < 4e-3

    @pytest.mark.parametrize(
        "change",
        [
            lambda color: np.roll(color, 9, axis=1),
            lambda color: np.random.default_rng(0).integers(0, 256, color.shape, np.uint8),
            lambda color: np.full_like(color, 80),
        ],
        ids=["shifted", "noise", "constant"],
    )
    def test_brightness_that_contradicts_depth_changes_nothing(self, change: object) -> None:
        """Colour 9 pixels beside the depth, random colour, none at all: the result without it, byte for byte."""
        (off, _), (on, _) = self.track("off", change), self.track("auto", change)
        for name in ("T_target_source", "information"):
            assert getattr(on, name).tobytes() == getattr(off, name).tobytes(), name
        assert (on.status, on.note, on.rmse_m, on.num_inliers) == (off.status, off.note, off.rmse_m, off.num_inliers)

    def test_without_colour_there_is_no_photometry(self) -> None:
        (off, _), (on, _) = (self.track(mode, lambda color: None) for mode in ("off", "auto"))
        assert on.T_target_source.tobytes() == off.T_target_source.tobytes()

    def test_unknown_mode(self) -> None:
        with pytest.raises(ConfigError, match="photometry"):
            sw.TrackingConfig(photometry="sometimes")
        assert not sw.TrackingConfig(photometry=False).uses_photometry
        assert sw.TrackingConfig(photometry=True).uses_photometry


STEP = np.array([0.006, 0.003, 0.0, 0.001, -0.002, 0.004])


def along_wall(
    count: int, step: np.ndarray = STEP, mode: str = "auto", first_seed: int = 0, **wall: object
) -> tuple[list[object], list[np.ndarray]]:
    """Track `count` frames of a camera that moves by a twist a frame before a wall; results and true poses."""
    slam = sw.build_slam(CAMERA, sw.SlamConfig(tracking=sw.TrackingConfig(photometry=mode)))
    truth, T = [], np.eye(4)
    for k in range(count):
        swing = wall.get("gain_swing", 0.0) * np.sin(k / 3)
        options = {name: value for name, value in wall.items() if name != "gain_swing"}
        slam.process(
            wall_frame(T, timestamp_s=k / 30, seed=first_seed + k, gain=1 + swing, offset=-20 * swing, **options)
        )
        truth.append(T)
        T = T @ se3.exp(step)
    return slam.results, truth


class TestWalls:
    @pytest.mark.parametrize("swing", [0.0, 0.3])
    def test_texture_holds_what_a_flat_wall_leaves_free(self, swing: float) -> None:
        """19 steps of 7 mm and 0.3 degrees, 12 cm in all, exposure as it likes: within 1.5 mm of the truth."""
        results, truth = along_wall(20, textured=True, gain_swing=swing)
        for result, T in zip(results[1:], truth[1:], strict=True):
            assert result.status == "converged", result.note
            shift, turn = pose_error(result.T_world_camera, T)
            assert shift < 1.5e-3
            assert turn < 0.06
            assert "3 of 3 free directions from brightness" in result.note

    def test_blank_wall_is_degenerate_and_stays_at_the_prediction(self) -> None:
        """Nothing tells the slide of 5 cm: the first pose is the prediction, so are all others but for the noise of the
        tilt, 0.2 mrad or 0.3 mm at the wall. After 11 steps that is 2 mm, root mean square of 50 noises. Brightness
        changes no byte of it."""
        slide, drifts_m = np.array([0.005, 0, 0, 0, 0, 0]), []
        for seed in (0, 40, 80, 120):
            runs = [along_wall(12, slide, mode, seed, textured=False)[0] for mode in ("auto", "off")]
            for on, off in zip(runs[0][1:], runs[1][1:], strict=True):
                assert on.status == "degenerate"
                assert on.note.count("translation along") == 2
                assert on.note.count("rotation about") == 1
                assert on.note == off.note
                assert on.T_world_camera.tobytes() == off.T_world_camera.tobytes()
            drifts_m.append(np.linalg.norm(runs[0][-1].T_world_camera[:2, 3]))
        assert np.sqrt(np.mean(np.square(drifts_m))) < 3e-3

    def test_light_on_a_plain_wall_is_a_hint(self) -> None:
        """19 steps of 7 mm, 13 cm in all, from a first pose at rest: DEGENERATE all the while, and within 6 mm of the
        truth on average over noises, where without brightness the camera seems to stand still."""
        furthest_m = []
        for seed in (0, 40, 80, 120):
            results, truth = along_wall(20, first_seed=seed, textured=False, lit=True)
            assert {result.status for result in results[1:]} == {"degenerate"}
            furthest_m.append(
                max(pose_error(r.T_world_camera, T)[0] for r, T in zip(results[1:], truth[1:], strict=True))
            )
        assert np.mean(furthest_m) < 0.006
        blind, _ = along_wall(20, mode="off", textured=False, lit=True)
        assert pose_error(blind[-1].T_world_camera, truth[-1])[0] > 0.1

    def test_a_hint_knows_its_worth(self) -> None:
        """Errors along the wall in units of what the information says: 1 on average, for 12 noises of the frame. The
        map's own noise, which all of them share, is three times smaller after 10 frames."""
        mapper = sw.SurfelMapper()
        for k in range(10):
            mapper.fuse(sw.build_pyramid(wall_frame(np.eye(4), textured=False, lit=True, seed=k)), np.eye(4))
        view, true = mapper.view(np.eye(4), CAMERA), se3.exp([0.01, -0.006, 0, 0, 0, 0])
        squares = []
        for seed in range(50, 62):
            frame = wall_frame(true, textured=False, lit=True, seed=seed)
            result = sw.FrameToModelTracker().track(sw.build_pyramid(frame), view, np.eye(4))
            assert result.status is sw.Status.DEGENERATE
            error = se3.log(result.T_target_source @ np.linalg.inv(true))
            squares.append(error @ result.information @ error / 6)
        assert 0.4 < np.mean(squares) < 2.5

    def test_stripes_leave_one_direction_free(self) -> None:
        """Vertical stripes hold the slide across them and the turn, not the slide along them."""
        mapper = sw.SurfelMapper()
        for k in range(5):
            still = wall_frame(np.eye(4), textured=True, stripes=True, seed=k)
            mapper.fuse(sw.build_pyramid(still), np.eye(4))
        true = se3.exp([0.008, 0.006, 0, 0, 0, 0.005])
        frame = wall_frame(true, textured=True, stripes=True, seed=50)
        result = sw.FrameToModelTracker().track(sw.build_pyramid(frame), mapper.view(np.eye(4), CAMERA), np.eye(4))
        assert result.status is sw.Status.DEGENERATE
        (free,) = result.unobservable
        assert abs(free.vector[1]) / np.linalg.norm(free.vector) > 0.99
        assert "2 of 3 free directions from brightness" in result.note
        error = np.linalg.inv(result.T_target_source) @ true
        assert abs(error[0, 3]) < 1e-3  # across the stripes
        assert abs(result.T_target_source[1, 3]) < 1e-3  # along them: the prediction
        assert np.degrees(abs(se3.log(error)[5])) < 0.1

    def test_geometry_keeps_what_it_observes(self) -> None:
        """Brightness fills the slide; the distance and the tilt are those of geometry alone, to a fraction of their
        noise."""
        mapper = sw.SurfelMapper()
        for k in range(5):
            mapper.fuse(sw.build_pyramid(wall_frame(np.eye(4), textured=True, seed=k)), np.eye(4))
        frame = wall_frame(se3.exp([0.01, 0.004, 0.003, 0, 0, 0.006]), textured=True, seed=50)
        view, pyramid = mapper.view(np.eye(4), CAMERA), sw.build_pyramid(frame)
        on = sw.FrameToModelTracker().track(pyramid, view, np.eye(4))
        off = sw.FrameToModelTracker(sw.TrackingConfig(photometry="off")).track(pyramid, view, np.eye(4))
        assert (on.status, off.status) == (sw.Status.CONVERGED, sw.Status.DEGENERATE)
        assert len(off.unobservable) == 3
        # The wall's plane in the camera's frame: n . x = d with n = R^T e_z and d = 1.5 - t_z.
        np.testing.assert_allclose(on.T_target_source[2, :3], off.T_target_source[2, :3], atol=4e-4)
        assert on.T_target_source[2, 3] == pytest.approx(off.T_target_source[2, 3], abs=4e-4)
        # Information appears along the slide, where there was next to none.
        assert on.information[0, 0] > 2 * off.information[0, 0]


class TestTurns:
    @pytest.mark.parametrize(("axis", "degrees"), [(0, 5), (0, -15), (1, 5), (1, 15), (1, -25), (2, 5), (2, -12)])
    def test_turn_between_two_views_of_a_wall(self, axis: int, degrees: float) -> None:
        """A pure turn R of the camera: points of camera a are at R^T of camera b."""
        turn = se3.exp([0, 0, 0, *np.radians(degrees) * np.eye(3)[axis]])
        full = np.ones(CAMERA.shape, np.bool_)
        a, b = (
            thumbnails(luminance(wall_frame(T, textured=True, shortest_m=0.2, seed=k).color), full, CAMERA)
            for k, T in enumerate((np.eye(4), turn))
        )
        best = find_turns(a, b)[0]
        error = np.eye(4)
        error[:3, :3] = best.rotation @ turn[:3, :3]
        assert np.degrees(se3.rotation_angle_rad(error)) < 0.5
        assert best.correlation > 0.9

    def test_nothing_to_compare(self) -> None:
        full = np.ones(CAMERA.shape, np.bool_)
        blank = thumbnails(np.full(CAMERA.shape, 9, np.float32), full, CAMERA)
        assert thumbnails(np.zeros((6, 6), np.float32), np.ones((6, 6), np.bool_), CAMERA) == []
        assert find_turns([], []) == []
        assert find_turns(blank, blank) == []
        nowhere = thumbnails(np.zeros(CAMERA.shape, np.float32), ~full, CAMERA)
        assert find_turns(nowhere, nowhere) == []

    @pytest.mark.parametrize("scene", ["room", "corridor"])
    def test_prediction_20_degrees_off(self, scene: str) -> None:
        """Found from small images where geometry alone loses most of them."""
        sequence = rendered(scene, noise="kinect", count=40)
        mapper, true = map_of(sequence, 10), sequence.ground_truth.T_world_camera[10]
        pyramid = sw.build_pyramid(sequence.frames[10])
        found = {"auto": 0, "off": 0}
        for axis in np.array([[0, 1, 0], [0, -1, 0], [1, 0, 0], [-0.6, 0.8, 0]]):
            guess = true @ se3.exp([0.02, 0, -0.02, *np.radians(20) * axis])
            for mode in found:
                tracker = sw.FrameToModelTracker(sw.TrackingConfig(photometry=mode))
                result = tracker.track(pyramid, mapper.view(guess, CAMERA), guess)
                shift, turn = pose_error(result.T_target_source, true)
                found[mode] += result.status.has_pose and shift < 0.01 and turn < 0.5
        assert found["auto"] == 4
        assert found["off"] < 4
