"""Pairs of scans with exact truth: two noisy depth images of a furnished room, at a wanted overlap.

    python benchmarks/rendered_pairs.py --count 10 --overlap 0.3 --out pairs        # pairs/0000.npz, ...

    from rendered_pairs import rendered_pair
    pair = rendered_pair(seed=0, overlap=0.3)
    pair.source, pair.target, pair.T_target_source, pair.overlap

Every seed has a room, two viewpoints, noise and a motion of its own, and gives the same pair at any number of
threads.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import scanweld as sw
from furnished_rooms import FurnishedRoom, furnished_room, living_room
from scanweld.datasets.synthetic import NOISE_MODELS, degrade_depth
from scanweld.datasets.synthetic.casting import cast_rays
from scanweld.geometry import se3

CAMERA = sw.PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480).scaled(0.5)
SKETCH = CAMERA.scaled(0.25)  # enough to tell the overlap of two viewpoints before they are rendered

OVERLAP_DISTANCE_M = 0.1
"""A point overlaps with the other scan if that has a point within this distance at the true pose; the noise at 4 m is
2.6 cm and the pixels of the sketch are 6 cm apart there."""

TOLERANCE = 0.04
"""Accepted distance from the wanted overlap."""

FURNITURE = 0.25
"""Least share of furniture in what both cameras see: a bare corner of a room fits every other corner of it."""


@dataclass(frozen=True, slots=True)
class RenderedPair:
    """Two scans of one room and how they belong together.

    Attributes
    ----------
    source, target : (N, 3), (M, 3) float64 [m]. The target is in its camera's frame, the source was moved away
    T_target_source : (4, 4), truth
    overlap : share of the source's points within `OVERLAP_DISTANCE_M` of a target point at the truth
    overlap_back : the same share of the target's points
    T_world_target : (4, 4), pose of the target's camera in the room
    """

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    overlap: float
    overlap_back: float
    T_world_target: np.ndarray


def rendered_pair(
    seed: int,
    overlap: float = 0.3,
    *,
    scene: str = "furnished",
    noise: str = "kinect",
    voxel_m: float = 0.0,
    moved: bool = True,
) -> RenderedPair:
    """Render the pair of a seed.

    Parameters
    ----------
    seed : of the room, the viewpoints, the noise and the motion
    overlap : wanted share of the points that both scans hold, met within `TOLERANCE` from the source's side and
        within a factor of two from the target's
    scene : "furnished", another room for every seed; or "room", the one of `scanweld render`
    noise : "none", "kinect" or "realsense"
    voxel_m : thin both scans to one point a voxel; 0 leaves every pixel
    moved : move the source by a random rotation (uniform) and up to 2 m along each axis; otherwise both are in the
        target camera's frame, and the truth is the identity
    """
    if not 0.1 <= overlap <= 0.95:
        raise ValueError(f"overlap: viewpoints are found for 0.1 to 0.95, got {overlap}")
    rng = np.random.default_rng([seed, 4])
    room = living_room() if scene == "room" else _room(seed)
    while True:
        T_world_target, T_world_source = _viewpoints(room, overlap, rng)
        target = scan(room, T_world_target, noise, rng)
        source = scan(room, T_world_source, noise, rng)
        T_target_camera = se3.inverse(T_world_target) @ T_world_source
        share, back = _overlaps(_thinned(source), _thinned(target), T_target_camera)
        if abs(share - overlap) <= TOLERANCE and 0.5 < back / overlap < 2:
            break
    if voxel_m > 0:
        source, target = _thinned(source, voxel_m), _thinned(target, voxel_m)
    T_target_source = random_motion(rng) if moved else np.eye(4)
    source = se3.transform_points(se3.inverse(T_target_source) @ T_target_camera, source)
    return RenderedPair(source, target, T_target_source, share, back, T_world_target)


def unrelated_pair(seed: int, *, noise: str = "kinect", voxel_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Render a source and a target of two different rooms."""
    rng = np.random.default_rng([seed, 5])
    rooms = _room(seed), _room(seed + 1_000_000)
    clouds = []
    for room in rooms:
        T_world_camera = _free_viewpoint(room, rng.uniform(-np.pi, np.pi), rng)
        cloud = scan(room, T_world_camera, noise, rng)
        clouds.append(_thinned(cloud, voxel_m) if voxel_m > 0 else cloud)
    return se3.transform_points(random_motion(rng), clouds[0]), clouds[1]


def scan(room: FurnishedRoom, T_world_camera: np.ndarray, noise: str, rng: np.random.Generator) -> np.ndarray:
    """Return what a depth camera sees: (N, 3) points [m, camera frame]."""
    depth_m = _depth(room, CAMERA, T_world_camera)
    model = NOISE_MODELS[noise]
    if model is not None:
        depth_m = degrade_depth(depth_m, CAMERA, model, rng)
    return _points(depth_m, CAMERA)


def random_motion(rng: np.random.Generator, reach_m: float = 2.0) -> np.ndarray:
    """Return (4, 4) of a rotation uniform over all rotations and a translation up to `reach_m` along each axis."""
    return se3.from_quaternion_xyzw(rng.standard_normal(4), rng.uniform(-reach_m, reach_m, 3))


def random_offset(angle_deg: float, distance_m: float, center_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (4, 4) that turns by an angle about a point, around a random axis, and shifts in a random direction."""
    axis, direction = rng.standard_normal((2, 3))
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis))
    T[:3, 3] = center_m - T[:3, :3] @ center_m + distance_m * direction / np.linalg.norm(direction)
    return T


def motion_error(T_target_source: np.ndarray, T_true: np.ndarray, center_m: np.ndarray) -> tuple[float, float]:
    """Return how far off an answer is: translation of the source's centre [m], rotation [deg].

    A transform that is not finite is infinitely far off.
    """
    if not np.isfinite(T_target_source).all():
        return float("inf"), float("inf")
    shift = se3.transform_points(T_target_source, center_m) - se3.transform_points(T_true, center_m)
    angle = se3.rotation_angle_rad(T_true[:3, :3].T @ T_target_source[:3, :3])
    return float(np.linalg.norm(shift)), float(np.degrees(angle))


@lru_cache(maxsize=4)
def _room(seed: int) -> FurnishedRoom:
    return furnished_room(seed)


def _viewpoints(room: FurnishedRoom, overlap: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw two viewpoints until they share about as much as is wanted."""
    while True:
        target_yaw = rng.uniform(-np.pi, np.pi)
        T_world_target = _free_viewpoint(room, target_yaw, rng)
        target = _sketch(room, T_world_target)
        for _ in range(20):
            yaw = target_yaw + rng.uniform(-2, 2) * (1 - overlap)  # more of a turn leaves less
            T_world_source = _free_viewpoint(room, yaw, rng)
            source = _sketch(room, T_world_source)
            share, back = _overlaps(source, target, se3.inverse(T_world_target) @ T_world_source)
            if abs(share - overlap) < TOLERANCE and 1 / 1.6 < back / overlap < 1.6:
                T_target_source = se3.inverse(T_world_target) @ T_world_source
                common = source[_near(se3.transform_points(T_target_source, source), target)]
                furniture = ~room.on_shell(se3.transform_points(T_world_source, common))
                if furniture.mean() > FURNITURE:
                    return T_world_target, T_world_source


def _sketch(room: FurnishedRoom, T_world_camera: np.ndarray) -> np.ndarray:
    return _thinned(_points(_depth(room, SKETCH, T_world_camera), SKETCH))


def _free_viewpoint(room: FurnishedRoom, yaw: float, rng: np.random.Generator) -> np.ndarray:
    """Draw T_world_camera of a camera held at 0.9 to 1.8 m, with nothing close before it and enough to see."""
    low, high = np.add(room.low_m, 0.5), np.subtract(room.high_m, 0.5)
    while True:
        x, _, z = rng.uniform(low, high)
        pitch, roll = np.deg2rad(rng.normal(-14, 8)), np.deg2rad(rng.normal(0, 4))
        T = np.eye(4)
        T[:3, :3] = se3.exp_so3([0, yaw, 0]) @ se3.exp_so3([pitch, 0, 0]) @ se3.exp_so3([0, 0, roll])
        T[:3, 3] = x, -rng.uniform(0.9, 1.8), z
        seen = _depth(room, SKETCH, T)
        near, middle = np.quantile(seen[seen > 0], (0.02, 0.5)) if (seen > 0).any() else (0.0, 0.0)
        if near > 0.6 and middle > 1.5:
            return T


def _depth(room: FurnishedRoom, camera: sw.PinholeCamera, T_world_camera: np.ndarray) -> np.ndarray:
    """Exact depth (H, W) float32 [m], 0 where nothing is hit or the hit is beyond 10 m (out of a doorway)."""
    directions = camera.rays().reshape(-1, 3) @ T_world_camera[:3, :3].T  # 1 along the optical axis: t is the depth
    distance, hit = cast_rays(room.scene, T_world_camera[:3, 3], directions)
    return np.where((hit >= 0) & (distance < 10), distance, 0.0).astype(np.float32).reshape(camera.shape)


def _points(depth_m: np.ndarray, camera: sw.PinholeCamera) -> np.ndarray:
    return np.asarray(camera.back_project(depth_m)[depth_m > 0], dtype=np.float64)


def _thinned(points_m: np.ndarray, voxel_m: float = OVERLAP_DISTANCE_M / 2) -> np.ndarray:
    """One point a voxel: shares are those of surface, not of pixels."""
    thinned: np.ndarray = sw.voxel_downsample(sw.PointCloud(points_m), voxel_m).points_m
    return thinned


def _overlaps(source: np.ndarray, target: np.ndarray, T_target_source: np.ndarray) -> tuple[float, float]:
    """Share of either cloud's points that have a point of the other nearby."""
    moved = se3.transform_points(T_target_source, source)
    return float(_near(moved, target).mean()), float(_near(target, moved).mean())


def _near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    distances, _ = cKDTree(others).query(points, distance_upper_bound=OVERLAP_DISTANCE_M)
    return np.asarray(np.isfinite(distances))


def main() -> None:
    """Write pairs to files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the first pair")
    parser.add_argument("--overlap", type=float, default=0.3)
    parser.add_argument("--noise", choices=sorted(NOISE_MODELS), default="kinect")
    parser.add_argument("--voxel", type=float, default=0.0, help="thin both scans [m]")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for seed in range(arguments.seed, arguments.seed + arguments.count):
        pair = rendered_pair(seed, arguments.overlap, noise=arguments.noise, voxel_m=arguments.voxel)
        file = arguments.out / f"{seed:04d}.npz"
        np.savez_compressed(
            file, source=pair.source, target=pair.target, T_target_source=pair.T_target_source, overlap=pair.overlap
        )
        print(f"{file}: {len(pair.source)} and {len(pair.target)} points, overlap {pair.overlap:.0%}")


if __name__ == "__main__":
    main()
