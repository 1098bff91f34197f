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

_USUAL_CONFLICT = 0.004  # share of conflict that true motions hardly reach

_CELLS = 60  # of the depth map along a face of the cube: 1.5 degrees
ROUGH = (3.0, 0.05)
"""Voxels and share of the distance that a surface must be behind a point to conflict with it, at a rough motion."""

FINE = (1.0, 0.01)
"""The same at a refined motion: wrong ones often conflict by little."""


@dataclass(frozen=True, slots=True)
class SurfaceAgreement:
    """What two scans make of each other at a motion; the worse of both directions.

    Attributes
    ----------
    touching : (2,), number of source points in contact with the target, and of target points with the source
    contact : share of the points near the other scan that are in contact with it
    meeting : sum of the weights of the points in contact
    conflict : share of the points within the other scan's view that stand in its free space; 0 where no viewpoint is
        known
    """

    touching: tuple[int, int]
    contact: float
    meeting: float
    conflict: float

    @property
    def belief(self) -> float:
        """1 where nothing stands in free space; true motions have next to none of it."""
        return float(np.exp(-self.conflict / _USUAL_CONFLICT))


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


def conflict(points: Float64, seen: DepthMap, voxel_m: float, margin: tuple[float, float] = ROUGH) -> float:
    """Return the share of points (N, 3), in the map's frame and within its view, that stand in its free space.

    Points behind what was seen are hidden, which occlusion allows.
    """
    judged, before = _before_surfaces(points, seen, margin[0] * voxel_m, margin[1])
    return float(before.sum() / max(judged.sum(), 1))


def in_free_space(points: Float64, seen: DepthMap, margin_m: float) -> Bool:
    """Mask (N,) of the points (N, 3) that the scan looked through; `margin_m` is left before its surfaces."""
    return _before_surfaces(points, seen, margin_m, ROUGH[1])[1]


def _before_surfaces(points: Float64, seen: DepthMap, margin_m: float, share: float) -> tuple[Bool, Bool]:
    """Masks (N,) of the points (N, 3) in directions that were seen, and of those well before what was seen there."""
    cells, distances = _cells(points - seen.viewpoint)
    surface = seen.nearest[cells]
    judged = np.isfinite(surface)
    before = judged.copy()
    before[judged] = surface[judged] - distances[judged] > margin_m + share * surface[judged]
    return judged, before


def contacts(source: Scan, target: Scan, T: Float64, scale: float, every: int = 1) -> tuple[Bool, Bool]:
    """Masks (N,) of the source's points that are near the target, and of those in contact with it.

    With `every` = k only each k-th point is looked at.
    """
    voxel = target.voxel_m
    distances, partners = target.index.nearest(se3.transform_points(T, scale * source.points[::every]), NEAR * voxel)
    near = np.isfinite(distances)
    cosine = np.zeros(len(near))
    turned = source.normals[::every][near] @ T[:3, :3].T
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
    every: tuple[int, int] = (1, 1),
    margin: tuple[float, float] = FINE,
) -> SurfaceAgreement:
    """Compare two scans at x_target = scale R x + t, in both directions.

    With `every` = (k, l) only each k-th point of the source and each l-th of the target are looked at.
    """
    T_back = se3.inverse(T)
    T_back[:3, 3] /= scale
    ways = (
        (source, target, T, scale, target_view, every[0]),
        (target, source, T_back, 1 / scale, source_view, every[1]),
    )
    touching, contact, meeting, before = [], [], [], [0.0]
    for a, b, motion, ratio, view, step in ways:
        near, touches = contacts(a, b, motion, ratio, step)
        touching.append(step * int(touches.sum()))
        contact.append(float(touches.sum() / max(near.sum(), 1)))
        meeting.append(step * float(a.weights[::step][touches].sum()))
        if view is not None:
            before.append(conflict(se3.transform_points(motion, ratio * a.points[::step]), view, b.voxel_m, margin))
    return SurfaceAgreement((touching[0], touching[1]), min(contact), min(meeting), max(before))


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
