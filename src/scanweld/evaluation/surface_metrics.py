"""How near a map is to the true surface (accuracy), and how much of it the map covers (completeness).

Distances go to the nearest point, so they are never below half the spacing of the reference: compare with a
reference that is denser than the error that matters. Queries run in chunks, memory does not grow with their
number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Float64, as_points, finite_rows
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.frame import Frame

THRESHOLDS_M = (0.01, 0.05)
CHUNK = 1 << 16
"""Points in one query of the tree."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceDistances:
    """Distances from a set of points to the nearest point of another.

    Attributes
    ----------
    num_points : how many distances
    mean_m, rmse_m : [m]
    median_m : [m], exact up to two million points, from an evenly spread sample beyond
    within : {threshold [m]: share of the points within it, 0..1}
    """

    num_points: int
    mean_m: float
    rmse_m: float
    median_m: float
    within: dict[float, float]


def surface_accuracy(
    points_m: npt.ArrayLike,
    reference_m: npt.ArrayLike,
    *,
    thresholds_m: tuple[float, ...] = THRESHOLDS_M,
    num_threads: int = 1,
) -> SurfaceDistances:
    """Measure how far the points of a map (N, 3) are from a reference (M, 3), in one world frame [m].

    Raises
    ------
    InvalidInputError
        When one of the sets is empty or not (N, 3).
    """
    return _distances([_finite(points_m, "points")], _tree(reference_m, "reference"), thresholds_m, num_threads)


def surface_completeness(
    points_m: npt.ArrayLike,
    reference_m: npt.ArrayLike,
    *,
    thresholds_m: tuple[float, ...] = THRESHOLDS_M,
    num_threads: int = 1,
) -> SurfaceDistances:
    """Measure how far the points of a reference (M, 3) are from a map (N, 3); `within` is the covered share.

    Raises
    ------
    InvalidInputError
        When one of the sets is empty or not (N, 3).
    """
    return surface_accuracy(reference_m, points_m, thresholds_m=thresholds_m, num_threads=num_threads)


def depth_completeness(
    map_points_m: npt.ArrayLike,
    posed_frames: Iterable[tuple[Frame, npt.ArrayLike]],
    *,
    stride: int = 1,
    thresholds_m: tuple[float, ...] = THRESHOLDS_M,
    num_threads: int = 1,
) -> SurfaceDistances:
    """Measure how far the valid depth of frames is from a map: the share of the input that the map keeps.

    Parameters
    ----------
    map_points_m : (N, 3), world frame [m]
    posed_frames : (frame, T_world_camera) pairs, read once and one at a time
    stride : take every n-th row and column
    thresholds_m : distances at which to count [m]
    num_threads : threads of the nearest-neighbour search; the result does not depend on it

    Raises
    ------
    InvalidInputError
        When the map is empty, or the frames hold no valid depth.
    """
    if stride < 1:
        raise InvalidInputError(f"stride: expected at least 1, got {stride}")
    clouds = (frame_points(frame, T_world_camera, stride=stride) for frame, T_world_camera in posed_frames)
    return _distances(clouds, _tree(map_points_m, "map points"), thresholds_m, num_threads)


def frame_points(frame: Frame, T_world_camera: npt.ArrayLike, *, stride: int = 1) -> Float64:
    """Return the valid depth of a frame as points (K, 3) in the world frame [m]."""
    vertices = frame.camera.back_project(frame.depth_m)[::stride, ::stride]
    valid = frame.depth_m[::stride, ::stride] > 0
    return se3.transform_points(T_world_camera, vertices[valid])


def compression_ratio(num_points_input: int, num_surfels: int) -> float:
    """Return how many valid depth measurements one surfel stands for; 0 for an empty map."""
    return num_points_input / num_surfels if num_surfels else 0.0


_MEDIAN_SAMPLE = 2_000_000


def _distances(
    clouds: Iterable[Float64], tree: cKDTree, thresholds_m: tuple[float, ...], num_threads: int
) -> SurfaceDistances:
    count, total, total_squared = 0, 0.0, 0.0
    inside = np.zeros(len(thresholds_m), dtype=np.int64)
    kept: list[Float64] = []
    spacing, num_kept = 1, 0  # every spacing-th distance is kept for the median
    for chunk in _chunks(clouds):
        distances, _ = tree.query(chunk, workers=num_threads)
        total += float(distances.sum())
        total_squared += float(np.square(distances).sum())
        inside += [(distances <= threshold).sum() for threshold in thresholds_m]
        sample = distances[-count % spacing :: spacing]
        count += len(distances)
        kept.append(sample)
        num_kept += len(sample)
        if num_kept > _MEDIAN_SAMPLE:
            kept = [np.concatenate(kept)[::2]]
            spacing, num_kept = spacing * 2, len(kept[0])
    if count == 0:
        raise InvalidInputError("there is no point to measure from; is there any valid depth?")
    return SurfaceDistances(
        num_points=count,
        mean_m=total / count,
        rmse_m=float(np.sqrt(total_squared / count)),
        median_m=float(np.median(np.concatenate(kept))),
        within={t: float(n) / count for t, n in zip(thresholds_m, inside, strict=True)},
    )


def _chunks(clouds: Iterable[Float64]) -> Iterator[Float64]:
    for cloud in clouds:
        for start in range(0, len(cloud), CHUNK):
            yield cloud[start : start + CHUNK]


def _finite(points_m: npt.ArrayLike, name: str) -> Float64:
    points = as_points(points_m, name, dimensions=(3,))
    return points[finite_rows(points)]


def _tree(points_m: npt.ArrayLike, name: str) -> cKDTree:
    points = _finite(points_m, name)
    if len(points) == 0:
        raise InvalidInputError(f"{name}: the set is empty")
    return cKDTree(points)
