"""The projective step in plain NumPy and double precision; see :class:`~.backends.ProjectiveBackend`."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scanweld.arrays import Float32, Float64, Int64
from scanweld.geometry.depth import SurfaceLevel


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
    parts = [
        _sums(positions_m[:, a:b], normals[:, a:b], T_target_source, target, gate_m, min_cosine, robust_sigma)
        for a, b in pairwise(bounds.tolist())
    ]
    return np.array(parts).reshape(len(parts), 32)


def _sums(
    positions_m: Float32,
    normals: Float32,
    T_target_source: Float64,
    target: SurfaceLevel,
    gate_m: float,
    min_cosine: float,
    robust_sigma: float,
) -> Float64:
    """Return the sums (32,) of one part."""
    camera, R = target.camera, T_target_source[:3, :3]
    p = R @ positions_m + T_target_source[:3, 3:]
    m = R @ normals
    p, m = p[:, p[2] > 1e-3], m[:, p[2] > 1e-3]
    u = np.floor(camera.fx * p[0] / p[2] + camera.cx + 0.5)
    v = np.floor(camera.fy * p[1] / p[2] + camera.cy + 0.5)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    p, m = p[:, inside], m[:, inside]
    seen = target.surface[v[inside].astype(int), u[inside].astype(int)].T.astype(np.float64)
    q, n, inverse_sigma = seen[0:3], seen[3:6], seen[6]
    near = np.linalg.norm(p - q, axis=0) < gate_m
    matched = (inverse_sigma > 0) & near & ((n * m).sum(axis=0) > min_cosine)
    p, q, n, inverse_sigma = p[:, matched], q[:, matched], n[:, matched], inverse_sigma[matched]

    r = inverse_sigma * (n * (p - q)).sum(axis=0)
    rows = np.concatenate([inverse_sigma * n, inverse_sigma * np.cross(p, n, axis=0), r[None]])
    size = np.abs(r)
    inlier = size <= robust_sigma
    weights = np.where(inlier, 1.0, robust_sigma / np.maximum(size, robust_sigma))
    loss = np.where(inlier, r * r / 2, robust_sigma * (size - robust_sigma / 2))
    products = (weights * rows) @ rows.T
    counts = inlier.sum(), matched.sum(), inside.sum()
    return np.concatenate([products[np.triu_indices(7)], [loss.sum()], counts])
