"""Surfaces that two passes left as two layers are fused again, once a correction has brought the layers together.

What faces the same way and lies within a few centimetres along the normal, exactly before or behind, is one surface:
nobody has seen a surface through another one. Pages follow a correction when they are next looked at
(:mod:`~scanweld.mapping.storage.corrections`); so layers, too, are fused cell by cell, some with each frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float32, Int64
from scanweld.config import check_ranges, setting
from scanweld.mapping.merging import kernels
from scanweld.mapping.storage.pages import NEVER, PagePool
from scanweld.mapping.surfel_map import SurfelMap

_COSINE = 0.7
_RADIUS_CLASS = 1.5  # surfels within this factor are equally fine; Keller et al. 2013 refine by the same factor
_MOVED_M = 0.002  # apart: less than this and the layers lie as they lay before
_SAME_PLACE_M, _SAME_PLACE_SHARE = 0.02, 0.5  # along the normal, and of the larger of two radii
_CROWDED = 16  # surfels that have come to a page
_SIDE_M = 0.015  # of the small cells in which a surfel looks for others
_MOST_SIDES = 64  # of these in a row


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


def merge_doubled(surfels: SurfelMap, most: float, config: MergingConfig | None = None, *, at_most: int = 0) -> int:
    """Fuse layers of different passes where corrections brought them together; returns how many surfels went.

    The finer surfels of two layers stay, moved along their normals to the mean that the confidences weigh. Only cells
    are looked at of which pages have followed a correction, and where these did not all move alike.

    Parameters
    ----------
    surfels : the map, which is changed
    most : largest confidence of a surfel
    config : when layers are one surface
    at_most : end with the cell that makes so many pages looked at, the other cells are for the next call; 0: do all
    """
    config = config or MergingConfig()
    meetings = surfels.pages.corrections.meetings
    if config.distance_m == 0 or not meetings.fresh.any():
        return 0
    looked_at, gone = 0, 0
    while len(cells := meetings.among(config.gap, _MOVED_M)):
        for cell in cells.tolist():
            meetings.dealt_with(cell)  # before: pages around it may follow only now, into this cell or another
            limits = (config.distance_m, _COSINE, most, 1.0)
            num, fewer = _merge_cell(surfels.pages, cell, config.gap, limits)
            looked_at, gone = looked_at + num, gone + fewer
            if 0 < at_most <= looked_at:
                return gone
    return gone


def merge_maps(surfels: SurfelMap, most: float, config: MergingConfig | None = None) -> int:
    """Fuse the layers of several maps in one, whose surfels have the number of their map as anchor; returns who went.

    Every cell is looked at; parameters are those of :func:`merge_doubled`.
    """
    config = config or MergingConfig()
    if config.distance_m == 0:
        return 0
    pages, gone = surfels.pages, 0
    for cell in np.unique(pages.cells[pages.live]).tolist():
        gone += _merge_cell(pages, cell, 1, (config.distance_m, _COSINE, most, 1.0))[1]
    return gone


def thin_crowded(surfels: SurfelMap, most: float) -> int:
    """Fuse surfels that share a place, in the cell where most have come since it was looked at; returns who went.

    Noise adds surfels to surfaces that are known, again and again; without this a map grows with the time, not with the
    places. Only pages without anything unstable are looked at: most of what is new does not last anyway.
    """
    pages = surfels.pages
    settled = (pages.probation == NEVER) & (pages.cells >= 0)  # a page that has still to move is of no cell
    more = np.where(settled, pages.counts - pages.thinned, 0)
    slot = int(more.argmax())
    if more[slot] < _CROWDED:
        return 0
    cell = int(pages.cells[slot])
    _, gone = _merge_cell(pages, cell, 0, (_SAME_PLACE_M, _COSINE, most, _SAME_PLACE_SHARE))
    mine = pages.cells == cell
    pages.thinned[mine] = pages.counts[mine]
    return gone


def _merge_cell(pages: PagePool, cell: int, gap: int, limits: tuple[float, float, float, float]) -> tuple[int, int]:
    """Let the surfels of a cell take in others, also of cells around it; returns the pages looked at, and who went.

    `limits` : distance along the normal [m], cosine of the normals, largest confidence, share of the larger disc
    """
    distance_m, cosine, most, share = limits
    mine = np.flatnonzero(pages.cells == cell)
    if len(mine) == 0:
        return 0, 0
    pages.use(mine)
    own, rows = pages.numbers_in(mine), pages.rows_in(mine)
    count, reach = len(own), np.float32(distance_m + share * rows[7].max())
    slots, others, around = _within(pages, mine, rows[0:3].min(axis=1) - reach, rows[0:3].max(axis=1) + reach)
    numbers, rows = np.concatenate([own, others]), np.concatenate([rows, around], axis=1)
    p, n, c, r, weights = rows[0:3], rows[3:6], rows[8:11], rows[7], rows[6]
    fineness = np.floor(np.log(np.maximum(r, 1e-6)) / np.log(_RADIUS_CLASS))
    ranking = np.lexsort((-weights, fineness)).astype(np.int64)
    place = np.empty_like(ranking)
    place[ranking] = np.arange(len(ranking))
    origin = p.min(axis=1)
    side = np.float32(max(_SIDE_M, float((p.max(axis=1) - origin).max()) / _MOST_SIDES))
    starts, members, lattice = _by_cells(p - origin[:, None], side)
    changed: Bool = np.zeros(len(numbers), np.bool_)
    taken: Bool = np.zeros(len(numbers), np.bool_)
    values = np.array([distance_m, cosine, most, r.max(), share], np.float32)
    kernels.merge_layers(
        ranking[ranking < count], place, starts, members, lattice, origin, p, n, c, r, weights, rows[13].view(np.int32),
        gap, values, side, changed, taken,
    )  # fmt: skip
    pages.put(numbers[changed], rows[:, changed])
    pages.fit_boxes(mine)
    pages.drop(numbers[taken])
    return len(mine) + len(slots), int(np.count_nonzero(taken))


def _within(pages: PagePool, mine: Int64, low: Float32, high: Float32) -> tuple[Int64, Int64, Float32]:
    """Return other pages than `mine` and their surfels between two corners: numbers (N,), rows (ROWS, N)."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    slots = np.setdiff1d(pages.cull(np.column_stack([faces, np.concatenate([-low, high])])), mine)
    pages.use(slots)
    numbers, rows = pages.numbers_in(slots), pages.rows_in(slots)
    inside = ((rows[0:3] >= low[:, None]) & (rows[0:3] <= high[:, None])).all(axis=0)
    return slots, numbers[inside], rows[:, inside]


def _by_cells(positions_m: Float32, side_m: np.float32) -> tuple[Int64, Int64, Int64]:
    """Sort positions (3, M), none of them negative, into the cells of a lattice.

    Returns where the members of each cell start (cells + 1,), the members (M,), and the cells along each axis (3,).
    """
    indices = (positions_m / side_m).astype(np.int64)
    lattice = indices.max(axis=1) + 1
    flat = (indices[0] * lattice[1] + indices[1]) * lattice[2] + indices[2]
    starts = np.zeros(int(lattice.prod()) + 1, np.int64)
    np.cumsum(np.bincount(flat, minlength=len(starts) - 1), out=starts[1:])
    return starts, np.argsort(flat, kind="stable"), lattice
