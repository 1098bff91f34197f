"""Registration with no initial guess, on scans rendered from one room, and on what has no answer."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from scanweld.datasets.synthetic import build_scene
from scanweld.datasets.synthetic.casting import cast_rays
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.neighbours import build_index
from scanweld.geometry.point_cloud import voxel_downsample
from scanweld.registration.global_registration import GlobalConfig, register_global
from scanweld.registration.global_search.agreement import conflict, depth_map
from scanweld.registration.global_search.viewpoint import estimate_viewpoint
from scanweld.registration.result import Status

CAMERA = sw.PinholeCamera(210.0, 210.0, 127.5, 95.5, 256, 192)


@lru_cache(maxsize=16)
def view(x: float, z: float, yaw_deg: float, scene: str = "room") -> tuple[np.ndarray, np.ndarray]:
    """What a depth camera at 1.4 m with 3 mm of noise sees: points in the camera's frame, and T_world_camera."""
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3([0, np.deg2rad(yaw_deg), 0]) @ se3.exp_so3([np.deg2rad(-14), 0, 0])
    T[:3, 3] = x, -1.4, z
    rays = CAMERA.rays().reshape(-1, 3)
    distance, hit = cast_rays(build_scene(scene, 0), T[:3, 3], rays @ T[:3, :3].T)
    depth = distance + np.random.default_rng(0).normal(0, 0.003, len(distance))
    return rays[hit >= 0] * depth[hit >= 0, None], T


SOURCE, TARGET = (1.2, 0.6, 170.0), (1.5, 0.2, 205.0)
TOWARDS_SHELVES, TOWARDS_SOFA = (1.0, 0.0, 60.0), (1.2, 0.6, 180.0)


def random_motion(seed: int, reach_m: float = 5.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.from_quaternion_xyzw(rng.standard_normal(4), rng.uniform(-reach_m, reach_m, 3))


def pair(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source in a random pose, target, T_target_source."""
    (a, T_world_a), (b, T_world_b) = view(*SOURCE), view(*TARGET)
    T_moved_a = random_motion(seed)
    return se3.transform_points(T_moved_a, a), b, se3.inverse(T_world_b) @ T_world_a @ se3.inverse(T_moved_a)


def errors(T: np.ndarray, T_true: np.ndarray, source: np.ndarray) -> tuple[float, float]:
    """How far off the source's centre is [m], and the rotation [deg]."""
    center = source.mean(axis=0)
    shift = se3.transform_points(T, center) - se3.transform_points(T_true, center)
    angle = se3.rotation_angle_rad(T_true[:3, :3].T @ T[:3, :3])
    return float(np.linalg.norm(shift)), float(np.degrees(angle))


@pytest.mark.parametrize("seed", [0])
def test_rendered_pair_from_any_pose(seed: int) -> None:
    source, target, T_true = pair(seed)
    before = source.copy(), target.copy()
    result = register_global(source, target)
    shift, angle = errors(result.T_target_source, T_true, source)
    assert result.status is Status.CONVERGED, result.note
    assert shift < 0.02
    assert angle < 0.5
    assert result.scale == 1
    assert 0.2 < result.overlap <= 1
    np.testing.assert_array_equal(source, before[0])
    np.testing.assert_array_equal(target, before[1])


def test_without_viewpoints_it_works_or_says_that_it_does_not() -> None:
    source, target, T_true = pair(2)
    result = register_global(source, target, config=GlobalConfig(viewpoints="none"))
    shift, angle = errors(result.T_target_source, T_true, source)
    assert (shift < 0.03 and angle < 1) or not result.status.success


def test_unrelated_views_are_no_success() -> None:
    a, _ = view(*TOWARDS_SHELVES)
    b, _ = view(*TOWARDS_SOFA)
    hall, _ = view(-1.0, 0.0, 90.0, "corridor")
    for source, target in ((a, b), (a, hall)):
        result = register_global(se3.transform_points(random_motion(3), source), target)
        assert not result.status.success
        assert result.note


def test_same_bytes_at_any_thread_count() -> None:
    source, target, _ = pair(0)
    source, target = source[::3], target[::3]
    results = [register_global(source, target, num_threads=n) for n in (1, 8)]
    assert len({r.T_target_source.tobytes() + r.information.tobytes() + r.status.name.encode() for r in results}) == 1


def test_scale_of_a_whole_object_is_found() -> None:
    """The same cloud 2.5 times as large, moved, each side with noise of its own and its own half of the points."""
    room, _ = view(*SOURCE)
    rng = np.random.default_rng(4)
    order = rng.permutation(len(room))
    half = len(room) // 2
    T = random_motion(5)
    source = room[order[:half]] + rng.normal(0, 0.002, (half, 3))
    target = se3.transform_points(T, 2.5 * room[order[half:]]) + rng.normal(0, 0.005, (len(room) - half, 3))
    result = register_global(source, target, scale=True)
    assert result.status is Status.CONVERGED, result.note
    assert abs(result.scale / 2.5 - 1) < 0.01
    assert np.degrees(se3.rotation_angle_rad(T[:3, :3].T @ result.T_target_source[:3, :3])) < 0.5


def test_symmetric_things_are_no_success() -> None:
    """A box of 3 x 2 x 1 m looks the same after half a turn about any of its axes; points of its own on each side."""

    def box(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        points = rng.uniform(-1, 1, (12000, 3))
        points[np.arange(12000), rng.integers(0, 3, 12000)] = rng.choice([-1.0, 1.0], 12000)
        return points * [1.5, 1.0, 0.5]

    result = register_global(se3.transform_points(random_motion(6), box(0)), box(1))
    assert not result.status.success
    assert result.note


def test_plane_is_no_success() -> None:
    rng = np.random.default_rng(7)
    plane = rng.uniform(-2, 2, (2, 8000, 3)) * [1, 1, 0]
    assert not register_global(se3.transform_points(random_motion(8), plane[0]), plane[1]).status.success


def test_random_points_are_no_success() -> None:
    rng = np.random.default_rng(9)
    a, b = rng.uniform(-1, 1, (2, 4000, 3))
    assert not register_global(a, b).status.success


def test_utm_coordinates_and_bad_rows() -> None:
    source, target, T_true = pair(1)
    source = np.concatenate([[[np.nan, 0, 0]], source + [4e5, 5e6, 100]])
    shifted = T_true.copy()
    shifted[:3, 3] -= T_true[:3, :3] @ [4e5, 5e6, 100]
    result = register_global(source, target)
    assert result.status.success
    assert "1 points were not finite" in result.note
    shift, angle = errors(result.T_target_source, shifted, source[1:])
    assert shift < 0.02
    assert angle < 0.5


@pytest.mark.parametrize("count", [0, 1, 50])
def test_too_few_points(count: int) -> None:
    result = register_global(np.zeros((count, 3)), np.random.default_rng(0).random((500, 3)))
    assert result.status is Status.TOO_FEW_CORRESPONDENCES


def test_points_in_one_place_or_on_a_line() -> None:
    spread = np.random.default_rng(0).random((500, 3))
    assert register_global(np.ones((500, 3)), np.ones((500, 3))).status is Status.DEGENERATE
    for cloud in (np.ones((500, 3)), np.linspace(0, 1, 500)[:, None] * [1.0, 2.0, 3.0]):
        for source, target in ((cloud, spread), (spread, cloud), (cloud, cloud)):
            result = register_global(source, target)
            assert not result.status.success
            assert np.isfinite(result.T_target_source).all()


def test_bad_input() -> None:
    with pytest.raises(InvalidInputError, match="needs points in 3-D"):
        register_global(np.zeros((200, 2)), np.zeros((200, 2)))
    with pytest.raises(ConfigError, match="viewpoints"):
        GlobalConfig(viewpoints="sometimes")
    with pytest.raises(ConfigError, match="hypotheses"):
        GlobalConfig(hypotheses=0)


@pytest.mark.parametrize("place", [SOURCE, TARGET, TOWARDS_SHELVES])
def test_viewpoint_is_told_by_the_density(place: tuple[float, float, float]) -> None:
    """The camera is at the origin of its points, wherever they are moved to; 2 m is what it sees on average."""
    points, _ = view(*place)
    T = random_motion(10)
    moved = se3.transform_points(T, points)
    viewpoint = estimate_viewpoint(moved, build_index(moved))
    assert viewpoint is not None
    assert np.linalg.norm(viewpoint - T[:3, 3]) < 0.4


def test_evenly_spread_points_have_no_viewpoint() -> None:
    points, _ = view(*SOURCE)
    thinned = voxel_downsample(sw.PointCloud(points), 0.05).points_m
    sphere = np.random.default_rng(0).standard_normal((8000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    for cloud in (thinned, sphere):
        assert estimate_viewpoint(cloud, build_index(cloud)) is None


def test_free_space_of_a_wall() -> None:
    """A wall at z = 2 seen from the origin, 2 m to either side. Points on it and behind it are no conflict, points a
    metre before it are; those out of view are not judged."""
    x, y = np.meshgrid(np.linspace(-2, 2, 300), np.linspace(-2, 2, 300))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    seen = depth_map(wall, np.zeros(3))
    spots = np.random.default_rng(0).uniform(-0.8, 0.8, (100, 2))

    def at(depth: float) -> np.ndarray:
        return np.column_stack([spots * depth / 2, np.full(100, depth)])

    assert conflict(at(2.0), seen, 0.05) == 0
    assert conflict(at(3.0), seen, 0.05) == 0
    assert conflict(at(1.0), seen, 0.05) == 1
    assert conflict(at(-1.0), seen, 0.05) == 0
    assert conflict(np.concatenate([at(2.0), at(1.0), at(-1.0)]), seen, 0.05) == 0.5


def test_car_clouds_from_a_random_pose(shared_data: Path) -> None:
    """The reference is another library's result: local ICP ends 8 cm and 0.4 degrees from it."""
    folder = shared_data / "registration" / "car_clouds"
    if not folder.is_dir():
        pytest.skip(f"no car_clouds in {folder}")
    source, target = (sw.read_points(folder / f"car_cloud{k}.csv").points_m for k in (400, 401))
    reference = np.vstack([np.loadtxt(folder / "T_400_to_401_reference.txt")[:3], [0, 0, 0, 1]])
    T = random_motion(11, 50.0)
    result = register_global(se3.transform_points(T, source), target)
    assert result.status is Status.CONVERGED, result.note
    shift, angle = errors(result.T_target_source @ T, reference, source)
    assert shift < 0.15
    assert angle < 0.6
