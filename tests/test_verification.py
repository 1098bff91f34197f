"""The check of a pose against free space, against plain NumPy and on cases whose shares are known."""

from __future__ import annotations

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, frame_of, plane_depth, rendered
from scanweld.datasets.synthetic import NOISE_MODELS, degrade_depth
from scanweld.geometry import se3
from scanweld.geometry.depth import intrinsics_array
from scanweld.registration import kernels
from scanweld.registration.verification import SAMPLES, check_against_depth, noise_directions
from scanweld.tracking.two_frames import surface_points


def wall(depth_m: float, normal: tuple[float, ...] = (0, 0, 1)) -> sw.SurfacePyramid:
    return sw.build_pyramid(frame_of(plane_depth(normal, depth_m)))


@pytest.mark.parametrize(
    ("depth_m", "expected"),
    [(1.5, (0, 1, 0)), (2.0, (1, 0, 0)), (2.5, (0, 0, 1)), (1.96, (0, 0, 0)), (2.04, (0, 0, 0))],
)
def test_wall_before_on_and_behind_another(depth_m: float, expected: tuple[float, ...]) -> None:
    """At 2 m four standard deviations are 4 (0.0012 + 0.0019 * 1.6^2) = 24 mm and six 36 mm, so the 5 cm floor
    holds: 4 cm off is neither agreement nor conflict."""
    result = check_against_depth(*surface_points(wall(depth_m)), np.eye(4), wall(2.0).levels[0])
    assert (result.agree, result.conflict, result.hidden) == expected
    assert result.compared > 0.8 * CAMERA.width * CAMERA.height / 4


def test_turned_away_surface_does_not_agree() -> None:
    """Points in the right place whose normals are more than 60 degrees off are another surface."""
    positions, normals = surface_points(wall(2.0))
    level = wall(2.0).levels[0]
    for angle, expected in ((59, 1.0), (61, 0.0), (180, 0.0)):
        leaning = np.array([np.sin(np.radians(angle)), 0, -np.cos(np.radians(angle))], np.float32)
        turned = np.tile(leaning[:, None], normals.shape[1])
        assert check_against_depth(positions, turned, np.eye(4), level).agree == expected


def test_nothing_to_compare() -> None:
    positions, normals = surface_points(wall(2.0))
    behind = se3.exp([0, 0, -9, 0, 0, 0])
    none = np.zeros((3, 0), np.float32)
    for arguments in (
        (positions, normals, behind, wall(2.0).levels[0]),
        (none, none, np.eye(4), wall(2.0).levels[0]),
        (positions, normals, np.eye(4), sw.build_pyramid(frame_of(np.zeros(CAMERA.shape))).levels[0]),
    ):
        result = check_against_depth(*arguments)
        assert (result.compared, result.agree, result.conflict, result.hidden) == (0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_matches_numpy_on_a_rendered_pair(seed: int) -> None:
    frames = rendered(count=40).frames
    source, target = sw.build_pyramid(frames[0]), sw.build_pyramid(frames[30]).levels[0]
    positions, normals = surface_points(source)
    T = se3.exp(np.random.default_rng(seed).uniform(-0.3, 0.3, 6))
    result = check_against_depth(positions, normals, T, target)
    stride = max(1, positions.shape[1] // SAMPLES)
    compared = agree = conflict = hidden = 0
    for x, n in zip(positions.T[::stride].astype(float), normals.T[::stride].astype(float), strict=True):
        p = T[:3, :3] @ x + T[:3, 3]
        (u, v), inside = CAMERA.project(p)
        if not inside:
            continue
        row = target.surface[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))].astype(float)
        if row[6] == 0:
            continue
        compared += 1
        gap = row[2] - p[2]
        if abs(row[3:6] @ (p - row[:3])) * row[6] < 4 and abs(gap) < 0.1 and row[3:6] @ T[:3, :3] @ n > 0.5:
            agree += 1
        elif abs(gap) > max(0.05, 6 / row[6]):
            conflict, hidden = conflict + (gap > 0), hidden + (gap < 0)
    assert compared > 1000
    assert result.compared == pytest.approx(compared, abs=2)
    for mine, theirs in ((agree, result.agree), (conflict, result.conflict), (hidden, result.hidden)):
        assert theirs == pytest.approx(mine / compared, abs=2 / compared)


def test_true_pose_of_a_rendered_pair_has_no_conflict() -> None:
    sequence = rendered(count=40)
    a, b = sw.build_pyramid(sequence.frames[0]), sw.build_pyramid(sequence.frames[39])
    G = sequence.ground_truth.T_world_camera
    result = check_against_depth(*surface_points(a), se3.inverse(G[39]) @ G[0], b.levels[0])
    assert result.agree > 0.8
    assert result.conflict < 0.03


class TestNoiseDirections:
    """A flat wall is flat however noisy its image is; relief is relief although noise lies over it."""

    @staticmethod
    def free_of(depth_m: np.ndarray, noise: str | None, camera: sw.PinholeCamera = CAMERA) -> np.ndarray:
        """Free directions between two images of the same surface with noise of their own."""
        sides = []
        for seed in (1, 2):
            model = None if noise is None else NOISE_MODELS[noise]
            image = depth_m if model is None else degrade_depth(depth_m, camera, model, np.random.default_rng(seed))
            sides.append(sw.build_pyramid(frame_of(image, camera=camera)))
        positions, normals = surface_points(sides[0])
        centroid = positions.mean(axis=1).astype(np.float64)
        radius = float(np.sqrt(((positions.T - centroid) ** 2).sum(axis=1).mean()))
        return noise_directions(positions, normals, np.eye(4), sides[1].levels[0], centroid, radius)

    @pytest.mark.parametrize("noise", [None, "kinect", "realsense"])
    @pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.1, 1)])
    @pytest.mark.parametrize("distance_m", [1.0, 2.0])
    def test_wall_leaves_three(self, noise: str | None, normal: tuple[float, ...], distance_m: float) -> None:
        free = self.free_of(plane_depth(normal, distance_m), noise)
        assert free.shape == (6, 3)
        np.testing.assert_allclose(free.T @ free, np.eye(3), atol=1e-9)
        # Two translations in the wall and the turn about its normal n: the projector onto the span is known.
        n = np.array(normal) / np.linalg.norm(normal)
        expected = np.zeros((6, 6))
        expected[:3, :3] = np.eye(3) - np.outer(n, n)
        expected[3:, 3:] = np.outer(n, n)
        np.testing.assert_allclose(free @ free.T, expected, atol=0.1)

    @pytest.mark.parametrize("noise", [None, "kinect", "realsense"])
    def test_room_leaves_none(self, noise: str | None) -> None:
        depth = rendered(count=40).frames[0].depth_m
        assert self.free_of(depth, noise).shape == (6, 0)

    @pytest.mark.parametrize("noise", [None, "kinect"])
    def test_edge_of_two_walls_leaves_the_slide_along_it(self, noise: str | None) -> None:
        depth = np.minimum(plane_depth((0.6, 0, 1), 1.5), plane_depth((-0.6, 0, 1), 1.5))
        free = self.free_of(depth, noise)
        assert free.shape == (6, 1)
        assert abs(free[1, 0]) > 0.99

    def test_slopes_of_both_sides(self) -> None:
        """A point at (0.2, 0, 1) with normal (0, 0, -1) before a wall at 1.05 m whose normal is (0.6, 0, -0.8); the arm
        from (0, 0, 1) over the radius 0.5 is (0.4, 0, 0), so the turns are a x n = (0, 0.4, 0) and (0, 0.32, 0). One at
        0.8 m is too far in front, one behind the camera is not seen."""
        surface = np.zeros((*CAMERA.shape, 8), np.float32)
        surface[..., 2], surface[..., 3:6], surface[..., 6] = 1.05, [0.6, 0, -0.8], 20
        points = np.array([[0, 0, 0.8], [0.2, 0, 1], [0.2, 0, -1]], np.float32).T.copy()
        normals = np.array([[0, 0, -1]] * 3, np.float32).T.copy()
        pairs = np.full((13, 4), np.nan, np.float32)
        found = kernels.slope_pairs(
            points, normals, np.eye(4, dtype=np.float32)[:3], surface.reshape(-1, 8), intrinsics_array(CAMERA),
            CAMERA.width, CAMERA.height, np.array([0, 0, 1], np.float32), np.float32(2), np.float32(0.1), pairs,
        )  # fmt: skip
        assert found == 1
        expected = [0, 0, -1, 0, 0.4, 0, 0.6, 0, -0.8, 0, 0.32, 0, 400]
        np.testing.assert_allclose(pairs[:, 0], expected, rtol=1e-5, atol=1e-6)

    def test_nothing_to_compare_constrains_nothing(self) -> None:
        none = np.zeros((3, 0), np.float32)
        free = noise_directions(none, none, np.eye(4), wall(2.0).levels[0], np.zeros(3), 1.0)
        np.testing.assert_array_equal(free, np.eye(6))
