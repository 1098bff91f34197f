"""The growing map in pieces: which of them changed since they were shown, and a copy of those.

A piece is a group of neighbouring pages of the map's storage. What changed is told from counts and boxes of pages, and
from where the camera looked: no surfel is read for it, so that a million of them are looked through in a fraction of a
millisecond, and none that waits on disk is fetched.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.mapping.storage.kernels import ROWS, SHELF, STRIDE
from scanweld.mapping.storage.pages import PagePool
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.viewer.coloring import Coloring, age_colors, confidence_colors, normal_colors

GROUP = SHELF
"""Pages of a piece, which are in memory together: what a piece costs is the message, more than what is in it."""

MOVED_M = 0.005
"""A page whose box moved by more than this is shown anew at once; a move of less waits for its turn."""

MUCH = 1 / 16
"""A piece is shown anew at once when this share of its surfels came, went or moved; with less it waits for its turn."""

REFRESH_S = 2.0
"""Pieces that changed by less, or were only looked at, which gains them confidence, are shown anew this often."""

_ROWS_OF = {
    Coloring.RGB: (0, 1, 2, 8, 9, 10),
    Coloring.NORMAL: (0, 1, 2, 3, 4, 5),
    Coloring.CONFIDENCE: (0, 1, 2, 6),
    Coloring.AGE: (0, 1, 2, 11),
}
"""Rows of a page that a colouring needs, see `scanweld.mapping.storage.kernels`."""

_LAST_SEEN = 12


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of the map as it is drawn.

    Attributes
    ----------
    number : a later piece of the same number takes its place
    positions_m : (N, 3) float32, world frame; N is 0 where nothing is left
    colors : (N, 3) uint8 RGB
    """

    number: int
    positions_m: Float32
    colors: UInt8


@dataclass(frozen=True, slots=True)
class CopiedPages:
    """Pages as they were at one moment; what becomes of them takes no look at the map any more.

    Attributes
    ----------
    numbers : (K,) pieces that the pages belong to, those without any pages included
    piece : (P,) number of the piece of each page
    counts : (P,) surfels of each page
    rows : (P, R, STRIDE), those that `coloring` needs
    stride : every so many surfels are shown
    newest : number of the newest frame that saw any surfel that was shown so far
    """

    numbers: Int64
    piece: Int64
    counts: Int32
    rows: Float32
    coloring: Coloring
    stride: int
    newest: int

    def pieces(self) -> list[Piece]:
        """Return what is to be drawn."""
        counts, stride = self.counts.tolist(), self.stride
        pages = [page[:, :count:stride] for page, count in zip(self.rows, counts, strict=True)]
        columns = np.concatenate([np.empty((self.rows.shape[1], 0), np.float32), *pages], axis=1)
        ends = np.cumsum(np.bincount(self.piece, -(-self.counts // stride), int(self.numbers.max()) + 1))
        ends = ends.astype(np.int64)
        positions, colors = np.ascontiguousarray(columns[:3].T), self._colors(columns[3:])
        made = []
        for number in self.numbers.tolist():
            part = slice(int(ends[number - 1]) if number else 0, int(ends[number]))
            made.append(Piece(number, positions[part], colors[part]))
        return made

    def _colors(self, columns: Float32) -> UInt8:
        if self.coloring is Coloring.RGB:
            rgb: UInt8 = np.clip(columns.T + np.float32(0.5), 0, 255).astype(np.uint8)
            return rgb
        if self.coloring is Coloring.NORMAL:
            return normal_colors(columns.T)
        if self.coloring is Coloring.CONFIDENCE:
            return confidence_colors(columns[0])
        return age_colors(columns[0].view(np.int32).astype(np.float32), self.newest)


class MapChanges:
    """What of a map was shown already, and what is to be shown next.

    Parameters
    ----------
    max_points : of a larger map every second, third, .. surfel is shown
    """

    def __init__(self, max_points: int) -> None:
        self.max_points = max_points
        self.stride = 1
        self._pages: object = None
        self._newest = 0
        self._counts: Int32 = np.zeros(0, np.int32)
        self._boxes: Float32 = np.zeros((0, 6), np.float32)
        self._looked_at: Bool = np.zeros(0, np.bool_)
        self._again: Bool = np.zeros(0, np.bool_)
        self._shown_at_s: Float64 = np.zeros(0)

    def forget(self) -> None:
        """Show everything again; pieces that are empty by now are shown as empty, once."""
        self._again = _by_group(self._counts, len(self._again)) > 0
        self._shown_at_s[:] = -np.inf

    def take(
        self,
        surfels: SurfelMap,
        coloring: Coloring,
        num_points: int,
        planes: Float64 | None = None,
        *,
        in_memory: bool = False,
    ) -> CopiedPages | None:
        """Copy pages that changed, those shown longest ago first, of about `num_points` surfels; None without any.

        To be called while nothing changes the map.

        Parameters
        ----------
        surfels, coloring, num_points : what is to be shown, in which colours, and how much of it at a time
        planes : around what the camera sees (6, 4), n . x + d >= 0 is inside: where confidences grow
        in_memory : leave out what waits on disk
        """
        pages, now_s = surfels.pages, time.monotonic()
        stride = max(1, -(-len(surfels) // self.max_points))
        if pages is not self._pages or stride != self.stride:
            self.forget()
            self._pages, self.stride, self._newest = pages, stride, 0
        size, groups = pages.capacity, len(pages.shelves)
        self._grow(groups)
        if planes is not None:
            self._looked_at[pages.cull(planes)] = True
        urgent, stale = self._due(pages, groups, now_s)
        if in_memory:
            urgent, stale = urgent & pages.in_memory, stale & pages.in_memory
        chosen = self._first_of(urgent, stale, _by_group(pages.counts, groups), num_points)
        if len(chosen) == 0:
            return None
        self._shown_at_s[chosen], self._again[chosen] = now_s, False
        among = (chosen[:, None] * GROUP + np.arange(GROUP)).ravel()
        among = among[among < size]
        self._counts[among], self._boxes[among] = pages.counts[among], pages.boxes[among]
        self._looked_at[among] = False
        slots = among[pages.counts[among] > 0]
        rows = np.array(_ROWS_OF[coloring])
        copied = pages.pool.reshape(-1, ROWS, STRIDE)[slots[:, None], rows]
        seen = pages.whole.reshape(-1, ROWS, STRIDE)[slots, _LAST_SEEN, 0]
        self._newest = max(self._newest, int(seen.max(initial=0)))
        return CopiedPages(
            chosen, slots // GROUP, pages.counts[slots], copied, coloring, self.stride, self._newest
        )  # fmt: skip

    def _due(self, pages: PagePool, groups: int, now_s: float) -> tuple[Bool, Bool]:
        """Return the pieces (G,) that are to be shown anew at once, and those whose turn it is after some time."""
        counts, size = pages.counts, pages.capacity
        changed = np.abs(counts - self._counts[:size])
        moved = (np.abs(pages.boxes - self._boxes[:size]) > MOVED_M).any(axis=1)
        changed[moved] = counts[moved]
        num_changed = _by_group(changed, groups)
        urgent = self._again | ((num_changed > 0) & (num_changed >= MUCH * _by_group(counts, groups)))
        touched = (num_changed > 0) | (_by_group(self._looked_at[:size] & (counts > 0), groups) > 0)
        return urgent, touched & ~urgent & (now_s - self._shown_at_s > REFRESH_S)

    def _first_of(self, urgent: Bool, stale: Bool, sizes: Int64, num_points: int) -> Int64:
        """Return the pieces (K,) whose turn it is, as many as have so many surfels, in ascending order."""
        order = [np.flatnonzero(mask) for mask in (urgent, stale)]
        turns = np.concatenate([some[np.argsort(self._shown_at_s[some], kind="stable")] for some in order])
        enough = int(np.searchsorted(np.cumsum(sizes[turns]), num_points * self.stride)) + 1
        return np.sort(turns[:enough])

    def _grow(self, groups: int) -> None:
        more = groups - len(self._shown_at_s)
        if more > 0:
            self._counts = np.concatenate([self._counts, np.zeros(more * GROUP, np.int32)])
            self._boxes = np.concatenate([self._boxes, np.zeros((more * GROUP, 6), np.float32)])
            self._looked_at = np.concatenate([self._looked_at, np.zeros(more * GROUP, np.bool_)])
            self._again = np.concatenate([self._again, np.zeros(more, np.bool_)])
            self._shown_at_s = np.concatenate([self._shown_at_s, np.full(more, -np.inf)])


def _by_group(values: Array, groups: int) -> Int64:
    """Return the sum over the pages of each group."""
    padded = np.zeros(groups * GROUP, np.int64)
    padded[: len(values)] = values
    return np.asarray(padded.reshape(groups, GROUP).sum(axis=1))
