"""Corrections of the map that each page follows when it is next used.

A closed loop moves every surfel, but only those in view are needed for the next frame. So a correction is noted, and
costs no more in a large map than in a small one (docs/decisions/0019-deferred-corrections.md).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int64
from scanweld.geometry import se3
from scanweld.state import Stateful


class Corrections(Stateful):
    """What pages of each epoch, the number of corrections that they have followed, have still to follow.

    Attributes
    ----------
    tables : (E, A + 1, 4, 4), T_now_then of each keyframe for the pages of each epoch; the last keyframe is any other
    meetings : where pages that moved in different ways have come together
    """

    STATE: ClassVar = {"tables": Float64, "meetings": Stateful}

    def __init__(self) -> None:
        self.tables: Float64 = np.empty((0, 1, 4, 4))
        self.meetings = Meetings()

    def __len__(self) -> int:
        """The epoch of the pages that have followed all."""
        return len(self.tables)

    def add(self, T_new_old: Float64) -> None:
        """Note a correction (A + 1, 4, 4), the last for keyframes that it does not name."""
        tables, count = self.tables, max(self.tables.shape[1], len(T_new_old))
        before = np.concatenate(
            [tables[:, :-1], np.tile(np.eye(4), (len(tables), count - tables.shape[1] + 1, 1, 1))], 1
        )
        new = np.concatenate([T_new_old[:-1], np.tile(np.eye(4), (count - len(T_new_old) + 1, 1, 1))])
        self.tables = np.concatenate([new @ before, new[None]])
        self.meetings.begin()

    def forget(self, epochs: int) -> None:
        """Forget the first corrections, which all pages have followed."""
        self.tables = self.tables[epochs:]

    def restored(self) -> None:
        """Check that these are motions."""
        if self.tables.ndim != 4 or self.tables.shape[2:] != (4, 4) or not np.isfinite(self.tables).all():
            raise ValueError("corrections that are none")


def farthest_moves(T_new_old: Float64, boxes: Float32) -> Float64:
    """Return how far (S,) any of the motions (A, 4, 4) takes what is in each box (S, 6), at most [m].

    A point p = c + d moves by R p + t - p = (R c + t - c) + (R - I) d, and |R - I| = 2 sin(angle / 2).
    """
    middles = 0.5 * (boxes[:, :3] + boxes[:, 3:]).astype(np.float64)
    halves = 0.5 * np.linalg.norm((boxes[:, 3:] - boxes[:, :3]).astype(np.float64), axis=1)
    farthest = np.zeros(len(boxes))
    for T in T_new_old:
        stretch = 2 * np.sin(0.5 * float(se3.rotation_angle_rad(T)))
        shift = middles @ (T[:3, :3] - np.eye(3)).T + T[:3, 3]
        np.maximum(farthest, np.linalg.norm(shift, axis=1) + stretch * halves, out=farthest)
    return farthest


class Meetings(Stateful):
    """Cells of which pages were moved, with the keyframes that these belong to and how far they went.

    Attributes
    ----------
    cells : (C,) keys, ascending
    least, largest : (4, C) anchor and motion [m] of the surfels that moved
    fresh : (C,) whether something came since the cell was last dealt with
    """

    STATE: ClassVar = {"cells": Int64, "least": Float64, "largest": Float64, "fresh": Bool}

    def __init__(self) -> None:
        self.cells: Int64 = np.empty(0, np.int64)
        self.least: Float64 = np.empty((4, 0))
        self.largest: Float64 = np.empty((4, 0))
        self.fresh: Bool = np.empty(0, np.bool_)

    def begin(self) -> None:
        """Forget the cells that were dealt with: with a new correction they are looked at anew."""
        self._keep(self.fresh)

    def add(self, cells: Int64, least: Float64, largest: Float64) -> None:
        """Note pages (P,) that were moved, each with its cell and the ranges (4, P) of its surfels."""
        keys = np.concatenate([self.cells, cells])
        order = np.argsort(keys, kind="stable")
        first = np.flatnonzero(np.diff(keys[order], prepend=-1))
        least = np.concatenate([self.least, least], axis=1)[:, order]
        largest = np.concatenate([self.largest, largest], axis=1)[:, order]
        fresh = np.concatenate([self.fresh, np.ones(len(cells), np.bool_)])[order]
        self.cells = keys[order][first]
        self.least = np.minimum.reduceat(least, first, axis=1)
        self.largest = np.maximum.reduceat(largest, first, axis=1)
        self.fresh = np.logical_or.reduceat(fresh, first)

    def among(self, gap: int, apart_m: float) -> Int64:
        """Return the fresh cells where keyframes at least `gap` apart moved by more than `apart_m` differently."""
        spread = self.largest - self.least
        met = (spread[0] >= gap) & (spread[1:].max(axis=0, initial=0.0) > apart_m)
        self.fresh &= met  # it takes another page to make a difference to the others
        return self.cells[self.fresh]

    def dealt_with(self, cell: int) -> None:
        """Note that a cell was dealt with."""
        self.fresh[np.searchsorted(self.cells, cell)] = False

    def restored(self) -> None:
        """Check that all is of the same cells."""
        count = len(self.cells)
        right = self.least.shape == self.largest.shape == (4, count) and self.fresh.shape == (count,)
        if not right or (np.diff(self.cells) <= 0).any():
            raise ValueError("meetings of other cells")

    def _keep(self, some: Bool) -> None:
        self.cells, self.fresh = self.cells[some], self.fresh[some]
        self.least, self.largest = self.least[:, some], self.largest[:, some]
