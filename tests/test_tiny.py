"""Whole chains on images of some hundred pixels and clouds of some hundred points.

They are small enough to run with kernels as plain Python (`NUMBA_DISABLE_JIT=1`, see scripts/coverage), where an index
beyond the end of an array is an error; compiled code does not notice.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import frame_of, plane_depth, pose_error
from scanweld.geometry import se3
from scanweld.geometry.neighbours import KdTree
from scanweld.geometry.neighbours.grid import HashGrid
from scanweld.geometry.normals import estimate_normals
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser
from scanweld.mapping import kernels as map_kernels
from scanweld.mapping.rendering import render_picture
from scanweld.mapping.storage.pages import MapConfig
from scanweld.meshing.config import MeshConfig
from scanweld.meshing.extraction import extract_mesh
from scanweld.meshing.fuse import mesh_from_frames
from scanweld.meshing.rendering import render_mesh
from scanweld.meshing.volume import TsdfVolume
from scanweld.refinement.config import RefinementConfig
from scanweld.registration.local.config import METHODS
from scanweld.registration.robust_pairs import align_pairs_robustly
from scanweld.tracking import kernels as tracking_kernels
from scanweld.tracking.dynamics import DynamicsConfig

CAMERA = sw.PinholeCamera(32.8, 32.8, 19.5, 14.5, 40, 30)
"""Of a 16th of the usual width."""


@lru_cache
def tiny_room() -> tuple[list[sw.Frame], np.ndarray]:
    """Six frames of the furnished room, and T_world_camera."""
    sequence = sw.SyntheticSequence(sw.RenderConfig(width=CAMERA.width, height=CAMERA.height))
    steps = range(0, 12, 2)
    return [replace(sequence.read(k), timestamp_s=k / 30) for k in steps], sequence.ground_truth.T_world_camera[steps]


def tiny_slam(**stages: object) -> sw.Slam:
    frames, poses = tiny_room()
    config = sw.SlamConfig(surfaces=sw.SurfaceConfig(bilateral=True, levels=2))
    slam = sw.build_slam(frames[0].camera, config, T_world_first=poses[0], **stages)
    for frame in frames:
        slam.process(frame)
    return slam


def test_a_camera_is_tracked() -> None:
    slam, (_, poses) = tiny_slam(), tiny_room()
    posed = [result for result in slam.results if result.state is not sw.FrameState.LOST]
    assert len(posed) >= 4
    for result in posed:
        assert pose_error(result.T_world_camera, poses[result.index])[0] < 0.03


def test_a_map_is_corrected_merged_thinned_and_drawn() -> None:
    frames, poses = tiny_room()
    mapper = sw.SurfelMapper(sw.FusionConfig(unstable_frames=2, clean_interval=2))
    for k, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        mapper.fuse(sw.build_pyramid(frame), T, keyframe=20 * (k // 3))
    before = len(mapper.map)
    shift = np.tile(np.eye(4), (2, 1, 1))
    shift[1, :3, 3] = [0.004, 0.0, 0.004]
    mapper.apply(MapCorrection(np.array([0, 20], np.int32), shift))
    mapper.finish()
    assert 0.3 * before < len(mapper.map) <= before
    picture = render_picture(mapper.map, poses[0], frames[0].camera)
    depth = frames[0].depth_m
    seen = np.isfinite(picture.depth_m) & (depth > 0)
    assert seen.mean() > 0.8
    assert np.median(np.abs(picture.depth_m - depth)[seen]) < 0.02


def test_a_map_beyond_memory_is_the_same() -> None:
    frames, poses = tiny_room()
    maps = []
    for budget_mb in (0, 1):
        mapper = sw.SurfelMapper(storage=MapConfig(memory_budget_mb=budget_mb))
        for frame, T in zip(frames[:3], poses, strict=False):
            mapper.fuse(sw.build_pyramid(frame), T)
        maps.append(mapper.map.columns())
    for name, column in maps[0].items():
        np.testing.assert_array_equal(column, maps[1][name])


def test_a_board_that_passes_does_not_carry_the_camera_off() -> None:
    """A board before a wall and its steps goes to the right, 3 pixels a frame."""
    slam = sw.Slam(
        tracker=sw.FrameToModelTracker(), mapper=sw.SurfelMapper(), loop_closer=sw.NoLoopCloser(),
        dynamics=DynamicsConfig(),
    )  # fmt: skip
    wall = plane_depth((0.3, 0.2, 1), 2.0, CAMERA)
    wall[:, :8] -= 0.5
    wall[20:] -= 0.3
    for k in range(4):
        depth = wall.copy()
        depth[6:16, 10 + 3 * k : 18 + 3 * k] = 1.0
        slam.process(frame_of(depth, k / 30, CAMERA))
    for result in slam.results:
        if result.state is sw.FrameState.TRACKING:
            assert pose_error(result.T_world_camera, np.eye(4))[0] < 0.05
    assert slam.results[0].state is sw.FrameState.TRACKING


@pytest.mark.parametrize("axis", range(3))
def test_a_surfel_agrees_along_every_axis(axis: int) -> None:
    """Of a measurement with its normal along an axis: within the gate of 1 cm along it, within 3 cm in all, and facing
    the same way within 60 degrees."""
    n, beside = np.eye(3)[axis], np.eye(3)[axis - 1]
    for d, normal, expected in (
        (0.009 * n, n, True), (0.011 * n, n, False), (-0.011 * n, n, False), (0.029 * beside, n, True),
        (-0.031 * beside, n, False), (0.02 * beside + 0.02 * np.eye(3)[axis - 2], n, True),
        (0.022 * beside + 0.022 * np.eye(3)[axis - 2], n, False), (0 * n, -n, False),
        (0 * n, 0.6 * n + 0.8 * beside, True), (0 * n, 0.4 * n + 0.9 * beside, False),
    ):  # fmt: skip
        assert map_kernels.agrees(*d, *normal, *n, 0.01, 0.03, 0.5) == expected


def test_regions_grow_from_their_seeds() -> None:
    """A wall 1 m away, whose columns from 6 on are at 2 m; pixels are 1 cm wide there, and growth ends after 2.5 cm.

    From the square of four seeds the pixels up to two steps away: 8 are one step away, 12 are two, but two of these lie
    on the farther wall. A seed alone is noise where two are asked for.
    """
    surface = np.zeros((9, 12, 8), np.float32)
    surface[..., 2] = np.where(np.arange(12) < 6, 1, 2)
    surface[..., 5], surface[..., 6] = -1, 500
    state = np.full((9, 12), tracking_kernels.OPEN, np.uint8)
    state[3:5, 3:5] = state[0, 9] = tracking_kernels.SEED
    moving, queue, distance = np.zeros((9, 12), np.bool_), np.empty(108, np.int32), np.empty((9, 12), np.float32)
    limits = (np.float32(0.01), np.float32(0.02), np.float32(4.0), np.float32(0.5), 2, np.float32(0.025))
    assert tracking_kernels.grow_regions(surface, state, *limits, queue, distance, moving) == 22
    rows, columns = np.indices((9, 12))
    steps = np.maximum(3 - rows, rows - 4).clip(0) + np.maximum(3 - columns, columns - 4).clip(0)
    np.testing.assert_array_equal(moving, (steps <= 2) & (columns < 6))
    assert state[0, 9] == tracking_kernels.CLOSED


def test_a_mask_is_refined_by_depth() -> None:
    """Of four coarse pixels the first moves: it and the next are four fine ones, of which one is at another depth."""
    depth = np.ones((1, 8), np.float32)
    depth[0, 1] = 1.5
    mask = np.empty((1, 8), np.bool_)
    coarse = np.array([[True, False, False, False]])
    tracking_kernels.refine_rows(0, 1, depth, coarse, np.ones((1, 4), np.float32), 2, np.float32(0.02), mask)
    np.testing.assert_array_equal(mask, [[True, False, True, True, False, False, False, False]])


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_normals_of_a_wall_are_its_own(radius: int) -> None:
    normal = np.array([0.2, -0.1, 1]) / np.linalg.norm([0.2, -0.1, 1])
    frame = frame_of(plane_depth(normal, 1.5, CAMERA), camera=CAMERA)
    level = sw.build_pyramid(frame, sw.SurfaceConfig(normal_radius=radius)).levels[0]
    valid = level.surface[..., 6] > 0
    assert valid.mean() > 0.5
    np.testing.assert_allclose(level.normals[valid] @ normal, -1, atol=1e-3)


def test_normals_of_a_cloud_are_its_own() -> None:
    x, y = np.random.default_rng(0).uniform(0, 1, (2, 600))
    normals = estimate_normals(np.stack([x, y, 0.3 * x - 0.2 * y], axis=1), neighbours=8)
    np.testing.assert_allclose(np.abs(normals @ [-0.3, 0.2, 1]) / np.linalg.norm([-0.3, 0.2, 1]), 1, atol=1e-6)


def test_surfels_become_a_mesh() -> None:
    """A disc of surfels 2 cm apart, in the plane z = 1."""
    x, y = (side.ravel() for side in np.meshgrid(np.arange(-7, 8) * 0.02, np.arange(-7, 8) * 0.02))
    surfels = {"x": x, "y": y, "z": np.ones(225), "nx": 0 * x, "ny": 0 * x, "nz": -np.ones(225),
               "radius": np.full(225, 0.015), "confidence": np.full(225, 10.0)}  # fmt: skip
    surfels |= {name: np.full(225, 90, np.uint8) for name in ("red", "green", "blue")}
    volume = TsdfVolume(0.05)
    volume.integrate_surfels(surfels)
    mesh = extract_mesh(volume)
    assert len(mesh) > 20
    assert np.abs(mesh.vertices_m[:, 2] - 1).max() < 0.02


def test_a_place_is_known_again() -> None:
    """With keyframes of so few pixels nothing may be found, but nothing wrong either."""
    frames, poses = tiny_room()
    closer = KeyframeLoopCloser(sw.LoopClosingConfig(lag_frames=0, min_gap=1))
    for k, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        closer.process(
            sw.build_pyramid(frame),
            sw.FrameResult(index=k, timestamp_s=k / 30, state=sw.FrameState.TRACKING, T_world_camera=T),
        )
    result = closer.relocalise(sw.build_pyramid(frames[1]))
    assert not result.status.success or pose_error(result.T_target_source, poses[1])[0] < 0.05


@pytest.mark.parametrize("scene", ["room", "wall"])
@pytest.mark.parametrize("noise", ["kinect", "realsense"])
def test_scenes_are_rendered(scene: str, noise: str) -> None:
    config = sw.RenderConfig(scene=scene, noise=noise, width=16, height=16)
    frame = sw.SyntheticSequence(config).read(3)
    exact = sw.SyntheticSequence(replace(config, noise="none")).read(3)
    both = (frame.depth_m > 0) & (exact.depth_m > 0)
    assert both.mean() > 0.25
    assert np.median(np.abs(frame.depth_m - exact.depth_m)[both] / exact.depth_m[both]) < 0.02


def test_a_wall_becomes_a_mesh() -> None:
    camera = sw.PinholeCamera(20.0, 20.0, 11.5, 8.5, 24, 18)
    normal = np.array([0.2, 0.1, 1]) / np.linalg.norm([0.2, 0.1, 1])
    frame = frame_of(plane_depth(normal, 1.0, camera), camera=camera)
    config = MeshConfig(least_component=0, fill_holes_m=0.3)
    mesh = mesh_from_frames([(frame, np.eye(4)), (frame, se3.exp([0.01, 0, 0, 0, 0, 0]))], voxel_m=0.05, config=config)
    assert len(mesh) > 100
    assert np.median(np.abs(mesh.vertices_m @ normal - 1)) < 0.01
    picture = render_mesh(mesh, np.eye(4), camera)
    seen = np.isfinite(picture.depth_m)
    assert np.median(np.abs(picture.depth_m - frame.depth_m)[seen]) < 0.02


def bumps(count: int, seed: int, dimension: int = 3) -> np.ndarray:
    """Points on a bumpy patch a metre wide, or on a wavy line of the plane."""
    x, y = np.random.default_rng(seed).uniform(0, 1, (2, count))
    z = 0.15 * np.sin(5 * x) * np.cos(4 * y) + 0.1 * x * y
    return np.stack([x, y, z], axis=1) if dimension == 3 else np.stack([x, 0.2 * np.sin(6 * x)], axis=1)


MOTION = se3.exp([0.02, -0.01, 0.015, 0.02, -0.03, 0.02])


@pytest.mark.parametrize("method", METHODS)
def test_clouds_are_aligned(method: str) -> None:
    points = bumps(250, 0)
    colors = np.clip(127 + 120 * np.sin(9 * points), 0, 255).astype(np.uint8)
    target = sw.PointCloud(points, colors=colors)
    source = target.transformed(se3.inverse(MOTION))
    for changes in ({}, {"kernel": "huber"}, {"kernel": "trimmed", "pairing": "mutual"}):
        config = sw.IcpConfig(method=method, **changes)
        result = sw.icp(source, target, config=config)
        assert result.status.has_pose
        assert pose_error(result.T_target_source, MOTION)[0] < 0.01


def test_lines_of_the_plane_are_aligned() -> None:
    target = bumps(120, 0, dimension=2)
    T = np.array([[np.cos(0.03), -np.sin(0.03), 0.01], [np.sin(0.03), np.cos(0.03), -0.01], [0, 0, 1]])
    source = (target - T[:2, 2]) @ T[:2, :2]
    for method in ("point-to-point", "point-to-plane", "gicp"):
        result = sw.icp(source, target, config=sw.IcpConfig(method=method))
        np.testing.assert_allclose(result.T_target_source, T, atol=5e-3)


def test_a_cloud_is_found_without_a_guess() -> None:
    target = bumps(200, 0)
    T = se3.exp([0.5, -0.3, 0.2, 0.4, 0.3, 1.0])
    result = sw.register_global(se3.transform_points(se3.inverse(T), target[20:]), target)
    assert not result.status.success or pose_error(result.T_target_source, T)[0] < 0.02


def test_pairs_are_told_from_chance() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(-1, 1, (40, 3))
    b = se3.transform_points(MOTION, a)
    b[:20] = rng.uniform(-1, 1, (20, 3))
    for scale in (False, True):
        found = align_pairs_robustly(a, b, 0.01, scale=scale)
        assert found.result.status.success
        assert pose_error(found.result.T_target_source, MOTION)[0] < 0.01
        np.testing.assert_array_equal(np.flatnonzero(found.inliers), np.arange(20, 40))


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_grid_answers_as_a_tree(dimension: int) -> None:
    points = np.random.default_rng(1).normal(size=(90, dimension))
    points[60:] = points[:30]
    queries = np.concatenate([points[::9], points[::7] + 0.05, 5 * points[:3]])
    tree = KdTree(points)
    for cell_m in (0.05, 0.4, 3.0):
        grid = HashGrid(points, cell_m=cell_m)
        for reach in (np.inf, 0.3):
            for one, other in zip(grid.nearest(queries, reach), tree.nearest(queries, reach), strict=True):
                np.testing.assert_array_equal(one, other)
            for one, other in zip(grid.k_nearest(queries, 5, reach), tree.k_nearest(queries, 5, reach), strict=True):
                np.testing.assert_array_equal(one, other)
        for one, other in zip(grid.within(queries, 0.4), tree.within(queries, 0.4), strict=True):
            np.testing.assert_array_equal(one, other)


def test_keyframes_are_refined(tmp_path: Path) -> None:
    frames, poses = tiny_room()
    closer = KeyframeLoopCloser()
    for k, (frame, T) in enumerate(zip(frames[:4], poses, strict=False)):
        sighting = closer.database.sight(sw.build_pyramid(frame))
        moved = T @ se3.exp(0.004 * np.random.default_rng(k).normal(size=6)) if k else T
        closer.database.add(sighting, moved, frame_index=k)
    refined = sw.refine_keyframes(closer.database.keyframes, frames[0].camera, RefinementConfig())
    assert np.isfinite(refined.T_world_camera).all()
    np.testing.assert_allclose(refined.T_world_camera[0], poses[0], atol=1e-9)
