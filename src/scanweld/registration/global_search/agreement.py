"""How well two scans agree at a motion: what they share, how closely, and what stands in the other's free space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float64, Int64
from scanweld.geometry import se3
from scanweld.registration.global_search.scan import Scan

CONTACT = 1.2
"""Voxels within which a point lies on the other scan's surface, when the normals agree, too."""

NEAR = 4.0
"""Voxels within which there should be contact."""

MIN_COSINE = 0.85

_CELLS = 60  # of the depth map along a face of the cube: 1.5 degrees
_BEYOND = 3.0  # voxels, and ...
_BEYOND_SHARE = 0.05  # ... share of the distance, that a surface must be behind a point to conflict with it


@dataclass(frozen=True, slots=True)
class SurfaceAgreement:
    """What two scans make of each other at a motion; the worse of both directions.

    Attributes
    ----------
    touching : (2,), number of source points in contact with the target, and of target points with the source
    contact : share of the points near the other scan that are in contact with it
    conflict : share of the points within the other scan's view that stand in its free space; 0 where no viewpoint is
        known
    """

    touching: tuple[int, int]
    contact: float
    conflict: float


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Distances of a scan's surfaces from its viewpoint, on the faces of a cube.

    Attributes
    ----------
    nearest : (6 * _CELLS^2,), inf where nothing was seen; the nearest within a cell and its neighbours
    viewpoint : (3,)
    """

    nearest: Float64
    viewpoint: Float64


def depth_map(points: Float64, viewpoint: Float64) -> DepthMap:
    """Draw points (N, 3), as dense as there are, around a viewpoint."""
    cells, distances = _cells(points - viewpoint)
    nearest = np.full(6 * _CELLS * _CELLS, np.inf)
    np.minimum.at(nearest, cells, distances)
    faces = nearest.reshape(6, _CELLS, _CELLS)
    seen = np.isfinite(faces)
    widened, complete = faces.copy(), seen.copy()
    for axis in (1, 2):
        for step in (-1, 1):
            shifted, known = np.roll(faces, step, axis), np.roll(seen, step, axis)
            widened, complete = np.minimum(widened, shifted), complete & known
    # Only cells amid others are trusted: at the rim of what was seen, anything may be.
    return DepthMap(np.where(complete, widened, np.inf).ravel(), viewpoint)


def conflict(points: Float64, seen: DepthMap, voxel_m: float) -> float:
    """Return the share of points (N, 3), in the map's frame and within its view, that stand in its free space.

    Points behind what was seen are hidden, which occlusion allows.
    """
    cells, distances = _cells(points - seen.viewpoint)
    surface = seen.nearest[cells]
    judged = np.isfinite(surface)
    if not judged.any():
        return 0.0
    allowed = _BEYOND * voxel_m + _BEYOND_SHARE * surface[judged]
    return float((surface[judged] - distances[judged] > allowed).mean())


def contacts(source: Scan, target: Scan, T: Float64, scale: float) -> tuple[Bool, Bool]:
    """Masks (N,) of the source's points that are near the target, and of those in contact with it."""
    voxel = target.voxel_m
    distances, partners = target.index.nearest(se3.transform_points(T, scale * source.points), NEAR * voxel)
    near = np.isfinite(distances)
    cosine = np.zeros(len(near))
    turned = source.normals[near] @ T[:3, :3].T
    cosine[near] = np.einsum("nd,nd->n", turned, target.normals[partners[near]])
    if not source.oriented:
        cosine = np.abs(cosine)
    return near, near & (distances < CONTACT * voxel) & (cosine > MIN_COSINE)


def assess(
    source: Scan,
    target: Scan,
    T: Float64,
    scale: float = 1.0,
    source_view: DepthMap | None = None,
    target_view: DepthMap | None = None,
) -> SurfaceAgreement:
    """Compare two scans at x_target = scale R x + t, in both directions."""
    T_back = se3.inverse(T)
    T_back[:3, 3] /= scale
    ways = ((source, target, T, scale, target_view), (target, source, T_back, 1 / scale, source_view))
    touching, contact, before = [], [], [0.0]
    for a, b, motion, ratio, view in ways:
        near, touches = contacts(a, b, motion, ratio)
        touching.append(int(touches.sum()))
        contact.append(float(touches.sum() / max(near.sum(), 1)))
        if view is not None:
            before.append(conflict(se3.transform_points(motion, ratio * a.points), view, b.voxel_m))
    return SurfaceAgreement((touching[0], touching[1]), min(contact), max(before))


def _cells(offsets: Float64) -> tuple[Int64, Float64]:
    """Return the cell of each direction (N, 3) on a cube around the origin, and the distance."""
    distances = np.linalg.norm(offsets, axis=1)
    axis = np.abs(offsets).argmax(axis=1)
    rows = np.arange(len(offsets))
    largest = offsets[rows, axis]
    size = np.where(largest == 0, 1.0, np.abs(largest))
    u, v = offsets[rows, (axis + 1) % 3] / size, offsets[rows, (axis + 2) % 3] / size
    face = 2 * axis + (largest < 0)
    iu, iv = (np.clip(((w + 1) / 2 * _CELLS).astype(np.int64), 0, _CELLS - 1) for w in (u, v))
    return np.asarray((face * _CELLS + iu) * _CELLS + iv), distances
