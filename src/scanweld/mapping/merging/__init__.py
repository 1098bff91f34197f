"""Surfaces that two passes left as two layers are fused again, once a correction has brought the layers together.

What faces the same way and lies within a few centimetres along the normal, exactly before or behind, is one surface:
nobody has seen a surface through another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int64
from scanweld.config import check_ranges, setting
from scanweld.geometry import se3
from scanweld.geometry.views import MapCorrection
from scanweld.mapping.merging import kernels
from scanweld.mapping.surfel_map import SurfelMap, motions

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


def merge_doubled(
    surfels: SurfelMap, correction: MapCorrection, most: float, config: MergingConfig | None = None
) -> int:
    """Fuse the layers that different passes left of a surface; the map is changed, returns how many surfels went.

    The finer surfels of the two layers stay, moved along their normals to the mean that the confidences weigh.

    Parameters
    ----------
    surfels : the map, after the correction
    correction : what it was moved by; where all moved alike nothing is looked for
    most : largest confidence of a surfel
    config : when layers are one surface
    """
    config = config or MergingConfig()
    if config.distance_m == 0:
        return 0
    pages, numbers = surfels.pages, _brought_together(surfels, correction, config.gap)
    if len(numbers) == 0:
        return 0
    rows = pages.rows(numbers)
    side = max(config.distance_m, float(rows[7].max()))
    keys = _cells(rows[:3].astype(np.float64), side)
    order = np.argsort(keys, kind="stable")
    numbers, keys, rows = numbers[order], keys[order], rows[:, order]
    begins = np.diff(keys, prepend=-1) != 0
    cells, cell_of = keys[begins], np.cumsum(begins) - 1
    p, n, c, r, weights = rows[0:3], rows[3:6], rows[8:11], rows[7], rows[6]
    fineness = np.floor(np.log(np.maximum(r, 1e-6)) / np.log(_RADIUS_CLASS))
    ranking = np.lexsort((-weights, fineness)).astype(np.int64)
    rank = np.empty_like(ranking)
    rank[ranking] = np.arange(len(ranking))
    taken: Bool = np.zeros(len(numbers), np.bool_)
    limits = np.array([config.distance_m, _COSINE, most], np.float32)
    kernels.merge_layers(
        ranking, rank, cell_of, _around(cells, keys), p, n, c, r, weights,
        rows[13].view(np.int32), config.gap, limits, taken,
    )  # fmt: skip
    slots = pages.slots_of(numbers)
    pages.use(slots)
    pages.put(numbers, rows)
    pages.fit_boxes(slots)
    pages.settle(slots)
    pages.drop(numbers[taken])
    return int(np.count_nonzero(taken))


def _brought_together(surfels: SurfelMap, correction: MapCorrection, gap: int) -> Int64:
    """Return the numbers of the surfels in areas that more than one pass saw, and that moved in different ways."""
    pages, T_old_new = surfels.pages, se3.inverse(motions(correction))

    # Of each area (A,), from all batches: its key, and the least and the largest anchor and motion (4, A) there.
    found: tuple[Int64, Float64, Float64] = np.empty(0, np.int64), np.empty((4, 0)), np.empty((4, 0))
    for slots in pages.batches():
        positions, anchors = pages.rows_in(slots, slice(0, 3)), pages.rows_in(slots, slice(13, 14))[0].view(np.int32)
        T = T_old_new[np.minimum(anchors, len(T_old_new) - 1)]
        moved = positions - np.einsum("nij,jn->in", T[:, :3, :3], positions) - T[:, :3, 3].T
        values = np.concatenate([anchors[None], moved])
        keys, least, largest = _by_area(_areas(positions), values, values)
        found = _by_area(
            np.concatenate([found[0], keys]),
            np.concatenate([found[1], least], axis=1),
            np.concatenate([found[2], largest], axis=1),
        )
    areas, least, largest = found
    apart = (largest - least)[1:].max(axis=0, initial=0.0)
    areas = areas[((largest - least)[0] >= gap) & (apart > _MOVED_M)]
    chosen = [np.empty(0, np.int64)]
    for slots in pages.batches() if len(areas) else ():
        keys = _areas(pages.rows_in(slots, slice(0, 3)))
        near = np.minimum(np.searchsorted(areas, keys), len(areas) - 1)
        chosen.append(pages.numbers_in(slots)[areas[near] == keys])
    return np.concatenate(chosen)


def _by_area(keys: Int64, least: Float64, largest: Float64) -> tuple[Int64, Float64, Float64]:
    """Return each key once, with the least of the least values (R, N) and the largest of the largest."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    if len(first) == 0:
        return keys, least, largest
    return (
        keys[first],
        np.minimum.reduceat(least[:, order], first, axis=1),
        np.maximum.reduceat(largest[:, order], first, axis=1),
    )


def _areas(positions_m: Float32) -> Int64:
    """Return the key of the area of each position (3, N), the same in every batch."""
    lattice = np.floor(positions_m.astype(np.float64) / _AREA_M).astype(np.int64) + (1 << _BITS - 1)
    return np.asarray(lattice[0] | lattice[1] << _BITS | lattice[2] << 2 * _BITS)


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
