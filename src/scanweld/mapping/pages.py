"""Pages of surfels: the storage that the kernels of the map work on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanweld.arrays import Array, Float32, Float64, Int32, Int64, UInt8
from scanweld.mapping import kernels
from scanweld.mapping.kernels import PAGE, ROWS, SPAN, STRIDE

CELL_M = 0.25
"""Edge of the cells that pages belong to [m]: a page is in view or not as a whole, and a cell of a wall seen from 3 m
is fifty pixels wide, so that what is read of the image for a page stays in the cache."""

BOX_TURNS = 64
"""Looks at the map after which the box of each page in view is brought up to date."""


class PagePool:
    """Pages in one array that doubles when it is full, and a hash table of the cells that they lie in.

    Attributes
    ----------
    pool : (capacity * SPAN,) float32, see `kernels`
    whole : the same bytes as int32
    counts : (capacity,) int32, surfels of each page
    boxes : (capacity, 6) float32, lower and upper corner of what each page holds [m]
    cells : (capacity,) int64, key of the cell that each page fills
    probation : (capacity,) int32, first frame of what may be unstable in each page
    dirty : (capacity,) uint8, pages with a surfel that lost confidence
    """

    def __init__(self, capacity: int) -> None:
        self._looks = 0
        self._take(_arrays(max(1, capacity)))
        self._free: Int32 = np.arange(self.capacity, dtype=np.int32)[::-1].copy()
        self._num_free = self.capacity
        self._keys: Int64 = np.full(1 << 10, -1, np.int64)
        self._tails: Int32 = np.full(1 << 10, -1, np.int32)
        self._room = len(self._keys) // 2

    def _take(self, arrays: dict[str, Array]) -> None:
        self.pool: Float32 = arrays["pool"]
        self.whole: Int32 = self.pool.view(np.int32)
        self.counts: Int32 = arrays["counts"]
        self.boxes: Float32 = arrays["boxes"]
        self.cells: Int64 = arrays["cells"]
        self.probation: Int32 = arrays["probation"]
        self.dirty: UInt8 = arrays["dirty"]

    @property
    def capacity(self) -> int:
        """Pages that fit before the array grows."""
        return len(self.counts)

    @property
    def live(self) -> Int64:
        """Slots of the pages with surfels."""
        return np.flatnonzero(self.counts)

    def page(self, slot: int) -> Float32:
        """Return the rows (ROWS, count) of a page, a view."""
        return self.pool.reshape(-1, ROWS, STRIDE)[slot, :, : self.counts[slot]]

    def add(self, rows: Float32) -> Int32:
        """Put surfels (ROWS, N) into pages of the cells that they lie in; returns their numbers (N,)."""
        done, total, per_cell = 0, rows.shape[1], np.float32(1 / CELL_M)
        numbers = np.empty(total, np.int32)
        while done < total:
            if self._num_free == 0:
                self._grow()
            if self._room == 0:
                self._rehash()
            done, self._num_free, self._room = kernels.deposit(
                done, rows, per_cell, self._free, self._num_free, self._room, self.counts, self.boxes, self.cells,
                self.probation, self._keys, self._tails, self.pool, numbers,
            )  # fmt: skip
        if total:
            touched = np.unique(numbers // PAGE)
            first = int(rows[11].view(np.int32).min())
            self.probation[touched] = np.minimum(self.probation[touched], first)
        return numbers

    def release(self, slot: int) -> None:
        """Give a page back."""
        self.counts[slot] = self.dirty[slot] = 0
        self.cells[slot] = -1
        self._free[self._num_free] = slot
        self._num_free += 1

    def shrink(self, pages: Sequence[tuple[int, Float32]]) -> None:
        """Let pages hold `rows` (ROWS, count) each, not more than before; nearly empty ones are given up."""
        homeless = []
        for slot, rows in pages:
            self.counts[slot] = rows.shape[1]
            self.page(slot)[:] = rows
            if rows.shape[1] < PAGE // 4:
                self.release(slot)
                homeless.append(rows)
        for rows in homeless:  # only now: they may come into a page that was shrunk, too
            self.add(rows)

    def inside(self, planes: Float64) -> Int32:
        """Return the slots whose boxes are not wholly outside one of the planes (6, 4): n . x + d >= 0 is inside."""
        slots = np.empty(self.capacity, np.int32)
        slots = slots[: kernels.cull_pages(self.counts, self.boxes, planes.astype(np.float32), slots)]
        self._looks += 1
        for slot in slots[self._looks % BOX_TURNS :: BOX_TURNS].tolist():  # merging moves surfels a little
            self.fit_box(slot)
        return slots

    def fit_box(self, slot: int) -> None:
        """Bring the box of a page up to date."""
        positions = self.page(slot)[:3]
        self.boxes[slot, :3], self.boxes[slot, 3:] = positions.min(axis=1), positions.max(axis=1)

    def _grow(self) -> None:
        capacity = self.capacity
        grown = _arrays(2 * capacity)
        for name, values in grown.items():
            old = getattr(self, name)
            values[: len(old)] = old
        self._take(grown)
        self._free = np.empty(2 * capacity, np.int32)
        self._free[:capacity] = np.arange(capacity, 2 * capacity)[::-1]
        self._num_free = capacity

    def _rehash(self) -> None:
        """Double the table, without the cells that have no page to fill."""
        old = [(key, slot) for key, slot in zip(self._keys.tolist(), self._tails.tolist(), strict=True) if key >= 0]
        old = [(key, slot) for key, slot in old if slot >= 0 and self.cells[slot] == key]
        size = max(len(self._keys), 1 << (4 * len(old)).bit_length())
        self._keys, self._tails = np.full(size, -1, np.int64), np.full(size, -1, np.int32)
        for key, slot in old:
            k = kernels.find_cell(key, self._keys)
            self._keys[k], self._tails[k] = key, slot
        self._room = size // 2 - len(old)


def _arrays(capacity: int) -> dict[str, Array]:
    """Allocate what so many pages need."""
    return {
        "pool": np.empty(capacity * SPAN, np.float32), "counts": np.zeros(capacity, np.int32),
        "boxes": np.zeros((capacity, 6), np.float32), "cells": np.full(capacity, -1, np.int64),
        "probation": np.zeros(capacity, np.int32), "dirty": np.zeros(capacity, np.uint8),
    }  # fmt: skip
