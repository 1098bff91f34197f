"""Surfaces that two passes left as two layers are fused again, once a correction has brought the layers together.

What faces the same way and lies within a few centimetres along the normal, exactly before or behind, is one surface:
nobody has seen a surface through another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int64
from scanweld.config import check_ranges, setting
from scanweld.mapping.merging import kernels
from scanweld.mapping.surfel_map import SurfelMap

_COSINE = 0.7
_RADIUS_CLASS = 1.5  # surfels within this factor are equally fine; Keller et al. 2013 refine by the same factor
_BITS = 21  # of a cell's number along an axis
_AREA_M = 0.25  # cells in which surfels that moved in different ways are looked for
_MOVED_M = 0.002  # apart: less than this and the layers lie as they lay before


@dataclass(frozen=True, slots=True, kw_only=True)
class MergingConfig:
    """When two layers are one surface."""

    distance_m: float = setting(
        0.04,
        "layers of two passes this near to each other become one surface when a loop is closed [m], 0 leaves them; "
        "raise where walls stay doubled, lower where thin things grow together",
        low=0.0,
    )
    gap: int = setting(5, "keyframes between two passes over a place, at least; lower it for quick returns", low=1)

    def __post_init__(self) -> None:
        check_ranges(self)


def merge_doubled(surfels: SurfelMap, moved_m: Float32, most: float, config: MergingConfig | None = None) -> int:
    """Fuse the layers that different passes left of a surface; the map is changed, returns how many surfels went.

    The finer surfels of the two layers stay, moved along their normals to the mean that the confidences weigh.

    Parameters
    ----------
    surfels : the map
    moved_m : (3, N), how far the correction has moved each surfel [m]; where all moved alike nothing is looked for
    most : largest confidence of a surfel
    config : when layers are one surface
    """
    config = config or MergingConfig()
    if config.distance_m == 0:
        return 0
    rows = np.flatnonzero(_brought_together(surfels, moved_m, config.gap))
    if len(rows) == 0:
        return 0
    positions = surfels.positions_m[:, rows].astype(np.float64)
    side = max(config.distance_m, float(surfels.radii_m[rows].max()))
    keys = _cells(positions, side)
    order = np.argsort(keys, kind="stable")
    rows, keys = rows[order], keys[order]
    cells, cell_of = np.unique(keys, return_inverse=True)
    table = surfels.table()
    p, n, c, r, weights = (
        np.ascontiguousarray(table[name][..., rows])
        for name in ("positions_m", "normals", "colors", "radii_m", "confidences")
    )
    fineness = np.floor(np.log(np.maximum(r, 1e-6)) / np.log(_RADIUS_CLASS))
    ranking = np.lexsort((-weights, fineness)).astype(np.int64)
    rank = np.empty_like(ranking)
    rank[ranking] = np.arange(len(ranking))
    taken: Bool = np.zeros(len(rows), np.bool_)
    limits = np.array([config.distance_m, _COSINE, most], np.float32)
    kernels.merge_layers(
        ranking, rank, cell_of.astype(np.int64).ravel(), _around(cells, keys), p, n, c, r, weights,
        table["anchors"][rows], config.gap, limits, taken,
    )  # fmt: skip
    table["positions_m"][:, rows], table["normals"][:, rows], table["colors"][:, rows] = p, n, c
    table["confidences"][rows] = weights
    kept = np.ones(len(surfels), np.bool_)
    kept[rows[taken]] = False
    surfels.replace({name: column[..., kept] for name, column in table.items()})
    return int(np.count_nonzero(taken))


def _brought_together(surfels: SurfelMap, moved_m: Float32, gap: int) -> Bool:
    """Whether a surfel (N,) is in an area whose surfels are of more than one pass and moved in different ways."""
    anchors = surfels.anchors
    if len(surfels) == 0 or int(np.ptp(anchors)) < gap:
        return np.zeros(len(surfels), np.bool_)
    keys = _cells(surfels.positions_m.astype(np.float64), _AREA_M)
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    together = _range_within(anchors[order], first) >= gap
    apart = np.max([_range_within(row[order], first) for row in moved_m], axis=0)
    chosen = np.repeat(together & (apart > _MOVED_M), np.diff(first, append=len(keys)))
    result: Bool = np.empty(len(keys), np.bool_)
    result[order] = chosen
    return result


def _range_within(values: Array, first: Int64) -> Array:
    """Return the largest minus the smallest value of each group; groups begin at `first`."""
    return np.asarray(np.maximum.reduceat(values, first) - np.minimum.reduceat(values, first))


def _cells(positions_m: Float64, side_m: float) -> Int64:
    """Return the number of each position's (3, N) cell; neighbours along x have neighbouring numbers."""
    lattice = np.floor(positions_m / side_m).astype(np.int64)
    lattice -= lattice.min(axis=1, keepdims=True) - 1
    lattice = np.minimum(lattice, (1 << _BITS) - 2)
    return np.asarray(lattice[0] | lattice[1] << _BITS | lattice[2] << 2 * _BITS)


def _around(cells: Int64, keys: Int64) -> Int64:
    """Return the places (C, 9, 2) in the sorted `keys` (M,) of the nine rows of three cells around each cell."""
    ranges: Array = np.empty((len(cells), 9, 2), np.int64)
    row = 0
    for dz in (-1, 0, 1):
        for dy in (-1, 0, 1):
            middle = cells + (dy << _BITS) + (dz << 2 * _BITS)
            ranges[:, row, 0] = np.searchsorted(keys, middle - 1, side="left")
            ranges[:, row, 1] = np.searchsorted(keys, middle + 1, side="right")
            row += 1
    return ranges
