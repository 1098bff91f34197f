"""A cloud as global registration works on it: thinned about its own centre, with oriented normals and features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry.neighbours import NeighbourIndex, build_index
from scanweld.geometry.normals import fit_surfaces
from scanweld.geometry.point_cloud import PointCloud, median_spacing, voxel_downsample
from scanweld.registration.features.fpfh import compute_fpfh
from scanweld.registration.global_search.viewpoint import estimate_viewpoint

FEATURE_RADII = (4.0, 8.0)
"""Radii of the features in voxels: small ones keep what stands alone, large ones tell alike places apart."""

NORMAL_NEIGHBOURS = 20

_VOXELS_PER_RADIUS = 30.0  # voxels to the median distance from the centre: 5 cm in a room
_SPACINGS_PER_VOXEL = 1.5
_MOST_POINTS = 12_000  # a thinned cloud with more is thinned further
_GROWTH = 1.15
_PLANE_SAMPLE, _PLANE_BLOCK = 1500, 2000  # points that stand for all, and points looked at together
_PLANE_THICKNESS, _PLANE_COSINE = 1.5, 0.97  # voxels, and cosine of the normals, within which points are in one plane


@dataclass(frozen=True, slots=True)
class Scan:
    """A thinned cloud; N points in a frame at its own centre.

    Attributes
    ----------
    points : (N, 3) [m]
    normals : (N, 3), towards the viewpoint where that is known for both scans, else of any sign
    features : (N, F), histograms
    index : of the points
    viewpoint : (3,), or None
    voxel_m : side of the voxels
    weights : (N,), mean 1: what a point tells; those of large planes, which fit many places, tell less
    """

    points: Float64
    normals: Float64
    features: Float64
    index: NeighbourIndex
    viewpoint: Float64 | None
    voxel_m: float
    weights: Float64

    @property
    def oriented(self) -> bool:
        """Whether the sign of the normals means something."""
        return self.viewpoint is not None


def choose_voxel(points: Float64) -> float:
    """Return the side of voxels [m] for a cloud (N, 3): fine enough for its shape, coarse enough for its spacing."""
    radius = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    voxel = max(radius / _VOXELS_PER_RADIUS, _SPACINGS_PER_VOXEL * median_spacing(points))
    while voxel > 0 and len(voxel_downsample(PointCloud(points), voxel)) > _MOST_POINTS:
        voxel *= _GROWTH
    return voxel


def find_viewpoint(points: Float64) -> Float64 | None:
    """Return where a cloud (N, 3) was seen from; see :func:`~.viewpoint.estimate_viewpoint`."""
    return estimate_viewpoint(points, build_index(points))


def prepare_scan(points: Float64, voxel_m: float, viewpoint: Float64 | None) -> Scan:
    """Thin a cloud (N, 3), fit its normals, turn them to the viewpoint if there is one, and compute features."""
    thinned = voxel_downsample(PointCloud(points), voxel_m).points_m
    index = build_index(thinned)
    normals = fit_surfaces(thinned, neighbours=min(NORMAL_NEIGHBOURS, len(thinned)), index=index).normals
    if viewpoint is not None:
        away = np.einsum("nd,nd->n", normals, thinned - viewpoint) > 0
        normals = np.where(away[:, None], -normals, normals)
    features = [
        compute_fpfh(thinned, normals, radius * voxel_m, oriented=viewpoint is not None, index=index)
        for radius in FEATURE_RADII
    ]
    weights = _plane_shares(thinned, normals, voxel_m) ** -0.5
    return Scan(
        thinned, np.ascontiguousarray(normals), np.hstack(features), index, viewpoint, voxel_m, weights / weights.mean()
    )


def _plane_shares(points: Float64, normals: Float64, voxel_m: float) -> Float64:
    """Share (N,) of the points (N, 3) that lie in the plane of each point."""
    some = slice(None, None, -(-len(points) // _PLANE_SAMPLE))
    others, facing = points[some], normals[some]
    shares = np.empty(len(points))
    for start in range(0, len(points), _PLANE_BLOCK):
        rows = slice(start, start + _PLANE_BLOCK)
        across = (points[rows] * normals[rows]).sum(axis=1)[:, None] - normals[rows] @ others.T
        flush = (np.abs(across) < _PLANE_THICKNESS * voxel_m) & (np.abs(normals[rows] @ facing.T) > _PLANE_COSINE)
        shares[rows] = flush.mean(axis=1)
    return np.maximum(shares, 1 / len(others))
