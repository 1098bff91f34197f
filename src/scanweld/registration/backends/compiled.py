"""The projective step by compiled kernels, over all threads; see :class:`~.backends.ProjectiveBackend`."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float32, Float64, Int64
from scanweld.geometry.depth import SurfaceLevel, intrinsics_array
from scanweld.parallel import run_ranges
from scanweld.registration import kernels


def point_to_plane_sums(
    positions_m: Float32,
    normals: Float32,
    T_target_source: Float64,
    target: SurfaceLevel,
    bounds: Int64,
    gate_m: float,
    min_cosine: float,
    robust_sigma: float,
) -> Float64:
    """Sum the point-to-plane normal equations of each part of the points."""
    partials = np.empty((len(bounds) - 1, kernels.SUMS))
    transform, intrinsics = T_target_source[:3].astype(np.float32), intrinsics_array(target.camera)
    height, width = target.camera.shape
    surface = target.surface.reshape(-1, 8)
    limits = np.float32(gate_m), np.float32(min_cosine), np.float32(robust_sigma)

    def body(start: int, stop: int) -> None:
        kernels.point_to_plane_sums(
            start, stop, bounds, positions_m, normals, transform, surface, intrinsics, width, height, *limits, partials
        )

    run_ranges(len(partials), body)
    return partials
