"""The graph of pairwise consistency: a rigid motion keeps the distance of any two points.

Source: H. Yang, J. Shi, L. Carlone, "TEASER: Fast and certifiable point cloud registration", T-RO 2021, section 6.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.parallel import run_ranges
from scanweld.registration.consistency.kernels import WORD, consistency_rows

UInt64 = npt.NDArray[np.uint64]


def consistency_graph(
    source: Float64,
    target: Float64,
    bounds_m: Float64,
    *,
    normals: tuple[Float64, Float64] | None = None,
    oriented: bool = False,
    max_turn: float = 1.0,
    scale: float = 1.0,
    slack: float = 0.0,
    min_length_m: float = 0.0,
) -> UInt64:
    """Return the bit matrix (N, ceil(N / 64)) of pairs that can be right together.

    Parameters
    ----------
    source, target : (N, D), D = 2 or 3; row i of one is believed to belong to row i of the other [m]
    bounds_m : (N,), how far each target point may be from its place [m]
    normals : of source and target (N, 3) each; angles must then agree, too
    oriented : whether the signs of the normals mean something
    max_turn : by how much the cosines of those angles may differ
    scale, slack : of the source, and how far from it a ratio of lengths may be, relative
    min_length_m : pairs that are closer than this in both sets say nothing about each other, and are not joined
    """
    count = len(source)
    adjacency = np.zeros((count, -(-count // WORD)), np.uint64)
    if count == 0:
        return adjacency
    a, b = (_rows(points - points.mean(axis=0)) for points in (source, target))
    n = np.empty((6, 0)) if normals is None else np.concatenate([_rows(side) for side in normals])
    bounds = np.ascontiguousarray(bounds_m)

    def fill(start: int, stop: int) -> None:
        consistency_rows(start, stop, a, b, bounds, n, oriented, scale, slack, min_length_m, max_turn, adjacency)

    run_ranges(count, fill)
    return adjacency


def _rows(points: Float64) -> Float64:
    """Return points (N, 2 or 3) as contiguous coordinates (3, N)."""
    rows = np.zeros((3, len(points)))
    rows[: points.shape[1]] = points.T
    return rows
