"""The growing map in pieces: which of them changed since they were shown, and a copy of those.

A piece is a group of neighbouring pages of the map's storage. That a page changed is told from its count, its box and
the frame that last saw its first surfel, so that a million surfels are looked through in some ten microseconds.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.mapping.storage.kernels import PAGE, ROWS, STRIDE
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.viewer.coloring import Coloring, age_colors, confidence_colors, normal_colors

GROUP = 32
"""Pages of a piece: few enough that a change costs little, many enough that a browser draws a million in time."""

MOVED_M = 0.005
"""A page whose box moved by more than this is shown anew at once; a move of less waits for its turn."""

REFRESH_S = 2.0
"""Pages that only gained confidence are shown anew this often."""

_ROWS_OF = {
    Coloring.RGB: (0, 1, 2, 8, 9, 10),
    Coloring.NORMAL: (0, 1, 2, 3, 4, 5),
    Coloring.CONFIDENCE: (0, 1, 2, 6),
    Coloring.AGE: (0, 1, 2, 11),
}
"""Rows of a page that a colouring needs, see `scanweld.mapping.storage.kernels`."""

_LAST_SEEN = 12

_NO_COUNT = PAGE + 1
"""Count of a page that was shown and is to be shown again, whatever it holds."""


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
    newest : number of the newest frame that saw any of these
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
        places = np.arange(PAGE)
        shown: Bool = (places < self.counts[:, None]) & (places % self.stride == 0)
        columns = self.rows[:, :, :PAGE].transpose(1, 0, 2)[:, shown]
        ends = np.cumsum(np.bincount(self.piece, np.count_nonzero(shown, axis=1), int(self.numbers.max()) + 1))
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
        self._counts: Int32 = np.zeros(0, np.int32)
        self._boxes: Float32 = np.zeros((0, 6), np.float32)
        self._seen: Int32 = np.zeros(0, np.int32)
        self._shown_at_s: Float64 = np.zeros(0)

    def forget(self) -> None:
        """Show everything again; pieces that are empty by now are shown as empty, once."""
        self._counts[self._counts > 0] = _NO_COUNT
        self._shown_at_s[:] = -np.inf

    def take(self, surfels: SurfelMap, coloring: Coloring, num_points: int) -> CopiedPages | None:
        """Copy pages that changed, those shown longest ago first, of about `num_points` surfels; None without any.

        To be called while nothing changes the map.
        """
        pages, now_s = surfels.pages, time.monotonic()
        stride = max(1, -(-len(surfels) // self.max_points))
        if pages is not self._pages or stride != self.stride:
            self.forget()
            self._pages, self.stride = pages, stride
        groups = -(-pages.capacity // GROUP)
        self._grow(groups)
        size = pages.capacity
        seen = pages.whole.reshape(-1, ROWS, STRIDE)[:, _LAST_SEEN, 0]
        live = pages.counts > 0
        moved = np.abs(pages.boxes - self._boxes[:size]).max(axis=1) > MOVED_M
        urgent = _by_group((pages.counts != self._counts[:size]) | (live & moved), groups)
        touched = _by_group(live & (seen != self._seen[:size]), groups)
        stale = touched & ~urgent & (now_s - self._shown_at_s > REFRESH_S)
        chosen = self._first_of(urgent, stale, pages.counts, num_points)
        if len(chosen) == 0:
            return None
        self._shown_at_s[chosen] = now_s
        among = (chosen[:, None] * GROUP + np.arange(GROUP)).ravel()
        among = among[among < size]
        self._counts[among], self._boxes[among] = pages.counts[among], pages.boxes[among]
        self._seen[among] = seen[among]
        slots = among[live[among]]
        rows = np.array(_ROWS_OF[coloring])
        copied = pages.pool.reshape(-1, ROWS, STRIDE)[slots[:, None], rows]
        newest = int(seen[live].max(initial=0))
        return CopiedPages(np.sort(chosen), slots // GROUP, pages.counts[slots], copied, coloring, self.stride, newest)

    def _first_of(self, urgent: Bool, stale: Bool, counts: Int32, num_points: int) -> Int64:
        """Return the pieces (K,) whose turn it is, as many as belong to so many surfels, in ascending order."""
        order = [np.flatnonzero(mask) for mask in (urgent, stale)]
        turns = np.concatenate([some[np.argsort(self._shown_at_s[some], kind="stable")] for some in order])
        sizes = np.add.reduceat(counts, np.arange(0, len(counts), GROUP))[turns]
        enough = int(np.searchsorted(np.cumsum(sizes), num_points * self.stride)) + 1
        return np.sort(turns[:enough])

    def _grow(self, groups: int) -> None:
        more = groups - len(self._shown_at_s)
        if more > 0:
            self._counts = np.concatenate([self._counts, np.zeros(more * GROUP, np.int32)])
            self._boxes = np.concatenate([self._boxes, np.zeros((more * GROUP, 6), np.float32)])
            self._seen = np.concatenate([self._seen, np.full(more * GROUP, -1, np.int32)])
            self._shown_at_s = np.concatenate([self._shown_at_s, np.full(more, -np.inf)])


def _by_group(pages: Bool, groups: int) -> Bool:
    """Whether any page of each group is marked."""
    padded = np.zeros(groups * GROUP, np.bool_)
    padded[: len(pages)] = pages
    return np.asarray(padded.reshape(groups, GROUP).any(axis=1))
