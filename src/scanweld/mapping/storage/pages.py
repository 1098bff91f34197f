"""Pages of surfels: the storage that the kernels of the map work on, all of it in memory or a part of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.config import check_ranges, setting
from scanweld.errors import InvalidInputError
from scanweld.mapping.storage import kernels
from scanweld.mapping.storage.backing import MappedFile, Memory
from scanweld.mapping.storage.corrections import Corrections, farthest_moves
from scanweld.mapping.storage.kernels import PAGE, ROWS, SHELF, SPAN, STRIDE
from scanweld.mapping.storage.regions import Regions
from scanweld.mapping.storage.residence import Residence
from scanweld.parallel import run_ranges
from scanweld.state import Stateful

CELL_M = 0.25
"""Edge of the cells that pages belong to [m]: a page is in view or not as a whole, and a cell of a wall seen from 3 m
is fifty pixels wide, so that what is read of the image for a page stays in the cache."""

BOX_TURNS = 64
"""Looks at the map after which the box of each page in view is brought up to date."""

BATCH_SHELVES = 64
"""Shelves of a batch, a million surfels: what is made of it should not take much memory either."""

NEVER = 0x7FFFFFFF
"""Probation of a page without anything unstable."""

FEWEST_CELLS = 16
"""Room of the table of cells at first, a power of two: half of it may be taken."""

PART = 512
"""Pages whose surfels are handed out at once, 7 MB, where all of them are asked for."""

SPARSE = PAGE // 4
"""A page that is left with fewer surfels is given up."""

MOST_PAGES = 0x7FFFFFFF // (PAGE * SHELF) * SHELF
"""The number of a surfel is an int32."""

_PER_CELL = np.float32(1 / CELL_M)
_OUTWARD = np.repeat(np.array([-1, 1], np.float32), 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapConfig:
    """Where the map is kept."""

    memory_budget_mb: float = setting(
        0.0,
        "memory for surfels [MB]; what was not in view lately waits on disk, results stay the same. 0 keeps all in "
        "memory; set it for recordings of hours, about 14 million surfels take a gigabyte",
        low=0.0,
    )
    folder: str = setting(
        "",
        "folder on a disk for what waits there; empty: beside the run's results, or else the system's for such files",
    )

    def __post_init__(self) -> None:
        check_ranges(self)


class PagePool(Stateful):
    """Pages in one array that grows when it is full, and a hash table of the cells that they lie in.

    With a memory budget the array is a file, of which the shelves that were used last are in memory. A shelf is used by
    naming its pages: `inside`, `use` and `batches` do. Kernels may read any page at any time, but one that was not
    named is not counted, and may lie where it lay before the last corrections.

    Attributes
    ----------
    pool : (capacity * SPAN,) float32, see `kernels`
    counts : (capacity,) int32, surfels of each page
    boxes : (capacity, 6) float32, lower and upper corner of what each page holds [m]
    shelves : (capacity / SHELF, 6) float32, around the boxes of each shelf's pages, which may be smaller
    cells : (capacity,) int64, key of the cell that each page fills
    probation : (capacity,) int32, first frame of what may be unstable in each page
    dirty : (capacity,) uint8, pages with a surfel that lost confidence
    thinned : (capacity,) int32, surfels of each page when it was last looked at for crowds
    epochs : (capacity,) int32, corrections that each page has followed
    corrections : what pages of earlier epochs have still to follow
    total : surfels of all pages
    """

    STATE: ClassVar = {
        "counts": Int32, "boxes": Float32, "shelves": Float32, "cells": Int64, "probation": Int32, "dirty": UInt8,
        "thinned": Int32, "epochs": Int32, "corrections": Stateful, "_behind": int, "total": int, "_looks": int,
        "_waiting": dict[int, list[Int32]], "_keys": Int64, "_tails": Int32,
        "_room": int, "regions": Stateful, "contents": Iterator[Float32],
    }  # fmt: skip
    MADE = frozenset({"config", "_backing", "_residence", "pool"})

    def __init__(self, capacity: int, config: MapConfig | None = None) -> None:
        self.config = config or MapConfig()
        self.total = 0
        budget = self.config.memory_budget_mb
        self._backing = MappedFile(self.config.folder, MOST_PAGES * SPAN) if budget > 0 else Memory(MOST_PAGES * SPAN)
        self._residence = Residence(self._backing, SHELF * SPAN, int(budget * 1e6 / 4))
        self._looks = 0
        self.corrections = Corrections()
        self._behind = 0  # pages below this slot have followed all corrections
        self._waiting: dict[int, list[Int32]] = {}
        self._keys: Int64 = np.full(FEWEST_CELLS, -1, np.int64)
        self._tails: Int32 = np.full(FEWEST_CELLS, -1, np.int32)
        self._room = len(self._keys) // 2
        for name, values in _columns(0).items():
            setattr(self, name, values)
        self.pool: Float32 = np.empty(0, np.float32)
        self.regions = Regions()
        self._grow(max(1, capacity))

    counts: Int32
    boxes: Float32
    shelves: Float32
    cells: Int64
    probation: Int32
    dirty: UInt8
    epochs: Int32
    thinned: Int32

    @property
    def whole(self) -> Int32:
        """The bytes of `pool` as int32."""
        return self.pool.view(np.int32)

    @property
    def capacity(self) -> int:
        """Pages that fit before the array grows."""
        return len(self.counts)

    @property
    def live(self) -> Int64:
        """Slots of the pages with surfels."""
        return np.flatnonzero(self.counts)

    @property
    def contents(self) -> Iterator[Float32]:
        """The surfels (ROWS, N) of all pages, part by part, each where it is by its epoch."""
        for slots in self._batches(self.live):
            self._recall(slots)
            for start in range(0, len(slots), PART):
                yield self.rows_in(slots[start : start + PART])

    @contents.setter
    def contents(self, parts: Iterator[Float32]) -> None:
        self._check()
        self.pool = self._backing.grow(np.empty(0, np.float32), self.capacity * SPAN)
        self._residence = Residence(self._backing, SHELF * SPAN, int(self.config.memory_budget_mb * 1e6 / 4))
        self._residence.grow(len(self.shelves))
        slots = self.live
        for rows in parts:
            ends = np.cumsum(self.counts[slots])
            num = int(np.searchsorted(ends, rows.shape[-1], side="right"))
            if rows.shape != (ROWS, ends[num - 1] if num else -1):
                raise ValueError("a part of a page")
            self._recall(slots[:num])
            for slot, page in zip(slots[:num].tolist(), np.split(rows, ends[: num - 1], axis=1), strict=True):
                self.page(slot)[:] = page
            slots = slots[num:]
        if len(slots):
            raise ValueError("pages are missing")

    def _check(self) -> None:
        """Raise ValueError where kernels would leave the arrays."""
        right = all(getattr(self, name).shape == values.shape for name, values in _columns(self.capacity).items())
        right = right and bool((self.counts >= 0).all() and (self.counts <= PAGE).all())
        if not right or self.counts.sum(dtype=np.int64) != self.total or self.capacity > MOST_PAGES:
            raise ValueError("pages of other sizes")
        epochs = self.epochs[self.live]
        if epochs.min(initial=0) < 0 or epochs.max(initial=0) > len(self.corrections):
            raise ValueError("pages of epochs that there are not")
        self.regions.check(self.counts > 0)
        size, taken = len(self._keys), int(np.count_nonzero(self._keys >= 0))
        if size < FEWEST_CELLS or size & (size - 1) or self._tails.shape != (size,) or self._room != size // 2 - taken:
            raise ValueError("a table of cells of another size")
        named = [slots for several in self._waiting.values() for slots in several]
        slots = np.concatenate([*named, self._tails[self._tails != -1]])
        if len(slots) and (slots.min() < 0 or slots.max() >= self.capacity):
            raise ValueError("pages that are not there")

    @property
    def resident_mb(self) -> float:
        """Memory that the pages take, counted by whole shelves [MB]."""
        return self._memory_mb(self._residence.num_held)

    @property
    def most_resident_mb(self) -> float:
        """The same, at most so far [MB]."""
        return self._memory_mb(self._residence.most_held)

    def _memory_mb(self, shelves: int) -> float:
        return 4e-6 * (shelves * SHELF * SPAN if self._backing.paged else len(self.pool))

    @property
    def in_memory(self) -> Bool:
        """Which shelves (S,) are in memory."""
        return self._residence.held if self._backing.paged else np.ones(len(self.shelves), np.bool_)

    def page(self, slot: int) -> Float32:
        """Return the rows (ROWS, count) of a page, a view."""
        return self.pool.reshape(-1, ROWS, STRIDE)[slot, :, : self.counts[slot]]

    def use(self, slots: Array) -> None:
        """Have pages in memory, where corrections have taken them.

        Others leave memory where the budget asks for it, those first that were used longest ago.
        """
        self._recall(slots)
        late = slots[self.epochs[slots] < len(self.corrections)]
        if len(late):
            self._follow(late.astype(np.int64))

    def _recall(self, slots: Array) -> None:
        """Have pages in memory, wherever they lie."""
        if self._backing.paged:
            self._residence.use(np.unique(slots // SHELF))

    def batches(self, slots: Array | None = None) -> Iterator[Array]:
        """Yield slots, by default those of all pages with surfels, in parts of which four fit the budget.

        The pages of a part are in memory while it is looked at.
        """
        for some in self._batches(self.live if slots is None else slots):
            self.use(some)
            yield some

    def _batches(self, slots: Array) -> Iterator[Array]:
        """Yield slots in parts of which four fit the budget."""
        if len(slots) == 0:
            return
        shelf = np.cumsum(np.diff(slots // SHELF, prepend=slots[0] // SHELF) != 0)
        size = min(BATCH_SHELVES, self._residence.room // 4) if self._backing.paged else BATCH_SHELVES
        part = shelf // max(1, size)
        yield from np.split(slots, np.flatnonzero(np.diff(part)) + 1)

    def numbers_in(self, slots: Array) -> Int64:
        """Return the numbers (N,) of the surfels of pages, page by page."""
        counts = self.counts[slots].astype(np.int64)
        first = np.cumsum(counts) - counts
        return np.asarray(np.repeat(slots * np.int64(PAGE) - first, counts) + np.arange(int(counts.sum())))

    def slots_of(self, numbers: Array) -> Int64:
        """Return the slots, in order, of the pages that surfels are in."""
        held: Bool = np.zeros(self.capacity, np.bool_)
        held[numbers // PAGE] = True
        return np.flatnonzero(held)

    def rows_in(self, slots: Array, some: slice = slice(0, ROWS)) -> Float32:
        """Return some rows of the surfels of pages (R, N), page by page."""
        rows: Float32 = np.empty((some.stop - some.start, int(self.counts[slots].sum())), np.float32)
        done = 0
        for slot in slots.tolist():
            page = self.page(slot)
            rows[:, done : done + page.shape[1]] = page[some]
            done += page.shape[1]
        return rows

    def rows(self, numbers: Int64) -> Float32:
        """Return the rows (ROWS, N) of surfels."""
        return np.asarray(self.pool[_places(numbers)])

    def put(self, numbers: Int64, rows: Float32) -> None:
        """Give surfels new rows (ROWS, N); whoever moves them calls :meth:`fit_boxes`."""
        self.pool[_places(numbers)] = rows

    def add(self, rows: Float32) -> Int32:
        """Put surfels (ROWS, N) into pages of the cells that they lie in; returns their numbers (N,)."""
        done, total = 0, rows.shape[1]
        numbers = np.empty(total, np.int32)
        while done < total:
            if self._room == 0:
                self._rehash()
            regions = self.regions
            done, self._room = kernels.deposit(
                done, rows, _PER_CELL, self._room, self.counts, self.boxes, self.shelves, self.cells, self.probation,
                self._keys, self._tails, regions.used, regions.owners, regions.following, regions.keys, regions.heads,
                regions.free, regions.left, self.pool, numbers,
            )  # fmt: skip
            if done < total and regions.left[1] == 0:
                regions.make_room()
            elif done < total and self._room > 0:
                self._grow(self._next_capacity())
        self.total += total
        if total:
            touched = np.unique(numbers // PAGE)
            self.epochs[touched] = len(self.corrections)  # pages that have still to move take nothing in
            self.use(touched)
            first = int(rows[11].view(np.int32).min())
            self.probation[touched] = np.minimum(self.probation[touched], first)
            self._waiting.setdefault(first, []).append(touched)
        return numbers

    def on_probation_since(self, frame_id: int) -> Int64:
        """Return the slots, in order, of the pages with something that was new before a frame, and may be unstable.

        They are not named again unless :meth:`clean` says so, so they have to be cleaned.
        """
        due = [frame for frame in self._waiting if frame < frame_id]
        named = [slots for frame in due for slots in self._waiting.pop(frame)]
        slots = np.unique(np.concatenate(named)).astype(np.int64) if named else np.empty(0, np.int64)
        return slots[(self.counts[slots] > 0) & (self.probation[slots] < frame_id)]

    def clean(self, slots: Int64, frame_id: int, unstable_frames: int, stable_confidence: float) -> int:
        """Drop from pages what is unstable after so many frames, or without confidence; returns how many went."""
        before, stable, whole = self.counts[slots], np.float32(stable_confidence), self.whole

        def body(start: int, stop: int, some: Int64) -> None:
            kernels.clean_pages(
                start, stop, some, frame_id, unstable_frames, stable, self.pool, whole, self.counts, self.probation
            )

        for some in self.batches(slots):
            run_ranges(len(some), partial(body, some=some), grain=8)
        self.dirty[slots] = 0
        self.thinned[slots] = np.minimum(self.thinned[slots], self.counts[slots])
        after, since = self.counts[slots], self.probation[slots]
        self.total -= int((before - after).sum())
        for first in np.unique(since[(after > 0) & (since < NEVER)]).tolist():
            self._waiting.setdefault(first, []).append(slots[(after > 0) & (since == first)].astype(np.int32))
        # Only now: where surfels go must not depend on what fitted into a batch.
        self.give_up(slots[(after < before) & (after < SPARSE)])
        return int((before - after).sum())

    def drop(self, numbers: Int64) -> None:
        """Remove surfels, each named once."""
        gone, slots = np.sort(numbers), self.slots_of(numbers)
        self.use(slots)
        for slot, places in zip(slots.tolist(), np.split(gone, np.searchsorted(gone, slots[1:] * PAGE)), strict=False):
            kept = np.delete(self.page(slot), places % PAGE, axis=1)
            self.counts[slot] = kept.shape[1]
            self.page(slot)[:] = kept
        self.total -= len(gone)
        self.give_up(slots[self.counts[slots] < SPARSE])

    def give_up(self, slots: Int64) -> None:
        """Give pages back; their surfels go to the pages that their cells fill now."""
        if len(slots) == 0:
            return
        self.use(slots)
        rows = self.rows_in(slots)
        self.counts[slots] = self.dirty[slots] = self.thinned[slots] = 0
        self.cells[slots] = -1
        self.regions.release(slots)
        self.total -= rows.shape[1]
        self.add(rows)

    def cull(self, planes: Float64) -> Int32:
        """Return the slots whose boxes are not wholly outside one of the planes (6, 4): n . x + d >= 0 is inside."""
        slots = np.empty(self.capacity, np.int32)
        found = kernels.cull_pages(self.counts, self.boxes, self.shelves, planes.astype(np.float32), slots)
        return slots[:found].copy()

    def inside(self, planes: Float64) -> Int32:
        """Return what :meth:`cull` does, and have these pages in memory."""
        slots = self.cull(planes)
        self.use(slots)
        self._looks += 1
        self.fit_boxes(slots[self._looks % BOX_TURNS :: BOX_TURNS])  # merging moves surfels a little
        return slots

    def fit_boxes(self, slots: Array) -> None:
        """Bring the boxes of pages up to date."""
        slots = np.ascontiguousarray(slots, np.int64)

        def body(start: int, stop: int) -> None:
            kernels.fit_boxes(start, stop, slots, self.counts, self.pool, self.boxes)

        run_ranges(len(slots), body, grain=64)
        np.minimum.at(self.shelves[:, :3], slots // SHELF, self.boxes[slots, :3])
        np.maximum.at(self.shelves[:, 3:], slots // SHELF, self.boxes[slots, 3:])

    def correct(self, T_new_old: Float64) -> None:
        """Let pages follow a correction (A + 1, 4, 4), see :class:`Corrections`, each when it is next used.

        Until then its box is as wide as to hold it wherever it may come to.
        """
        live = self.live
        done = int(self.epochs[live].min(initial=len(self.corrections)))
        self.epochs[live] -= done
        self.corrections.forget(done)
        self.corrections.add(T_new_old)
        self._behind = 0
        reach_m = np.zeros(len(self.shelves), np.float32)
        filled = self.shelves[:, 0] <= self.shelves[:, 3]
        reach_m[filled] = np.nextafter(farthest_moves(T_new_old, self.shelves[filled]), np.inf, dtype=np.float32)
        self.shelves += reach_m[:, None] * _OUTWARD
        self.boxes[live] += reach_m[live // SHELF, None] * _OUTWARD
        self.cells[live] = -1  # what is new belongs to other pages than those that have not moved yet

    def follow(self, slots: int) -> None:
        """Let a few more pages, those of so many slots, follow all corrections though nobody uses them."""
        if self._behind < self.capacity and len(self.corrections):
            some = np.arange(self._behind, min(self._behind + slots, self.capacity))
            self._behind += len(some)
            some = some[(self.counts[some] > 0) & (self.epochs[some] < len(self.corrections))]
            for _ in self.batches(some):
                pass  # they are used

    def take_in(self, other: PagePool) -> None:
        """Add the surfels of another storage; they meet those here in the way in which they were moved last."""
        other.follow(other.capacity)
        met = other.corrections.meetings
        for slots in self.batches(np.flatnonzero((self.counts > 0) & np.isin(self.cells, met.cells))):
            anchors = self.rows_in(slots, slice(13, 14))[0].view(np.int32)
            first = np.cumsum(self.counts[slots]) - self.counts[slots]
            stayed = np.zeros((2, 4, len(slots)))
            stayed[:, 0] = np.minimum.reduceat(anchors, first), np.maximum.reduceat(anchors, first)
            self.corrections.meetings.add(self.cells[slots], stayed[0], stayed[1])
        self.corrections.meetings.add(met.cells, met.least, met.largest)
        for slots in other.batches():
            self.add(other.rows_in(slots))

    def _follow(self, slots: Int64) -> None:
        """Move pages that have corrections to follow."""
        tables = self.corrections.tables[:, :, :3].reshape(len(self.corrections), -1, 12)
        whole, ranges = self.whole, np.empty((2, 4, len(slots)))

        def body(start: int, stop: int) -> None:
            kernels.move_pages(
                start, stop, slots, self.epochs, tables, self.counts, self.pool, whole, ranges[0], ranges[1]
            )

        run_ranges(len(slots), body, grain=16)
        self.epochs[slots] = len(self.corrections)
        self.fit_boxes(slots)
        self.settle(slots)
        self.corrections.meetings.add(self.cells[slots], ranges[0], ranges[1])

    def settle(self, slots: Int64) -> None:
        """Let pages that were moved, all at once, be those of the cells that their boxes have come to."""
        self.cells[slots] = -1
        if self._room < len(slots):
            self._rehash(len(slots))
        self._room -= kernels.settle_pages(
            slots, _PER_CELL, self.counts, self.boxes, self.cells, self._keys, self._tails
        )

    def _next_capacity(self) -> int:
        """How many pages there should be room for: of pages only their columns are copied, 45 bytes each."""
        return max(min(self.capacity + max(self.capacity // 4, SHELF), MOST_PAGES), self.capacity + 1)

    def _grow(self, capacity: int) -> None:
        if capacity > MOST_PAGES:
            raise InvalidInputError(
                f"map: expected at most {MOST_PAGES:,} pages of {PAGE} surfels, got {capacity:,}; take every second "
                "frame or pixel, or map a part of the recording at a time"
            )
        capacity = -(-capacity // SHELF) * SHELF
        for name, values in _columns(capacity).items():
            old = getattr(self, name)
            values[: len(old)] = old
            setattr(self, name, values)
        self.pool = self._backing.grow(self.pool, capacity * SPAN)
        self._residence.grow(len(self.shelves))
        self.regions.grow(len(self.shelves))

    def _rehash(self, more: int = 0) -> None:
        """Make the table larger, with room for `more` cells, and leave out the cells that have no page to fill."""
        used = int(np.count_nonzero(self._keys >= 0)) + more
        keys: Int64 = np.full(max(len(self._keys), 1 << (4 * used).bit_length()), -1, np.int64)
        tails: Int32 = np.full(len(keys), -1, np.int32)
        filled = kernels.rehash(self._keys, self._tails, self.cells, keys, tails)
        self._keys, self._tails, self._room = keys, tails, len(keys) // 2 - filled


def _names_others(slots: Int32, capacity: int, least: int) -> bool:
    """Whether there are slots below `least`, or of pages beyond the capacity."""
    return slots.ndim != 1 or bool(len(slots) and (slots.min() < least or slots.max() >= capacity))


def _places(numbers: Int64) -> Int64:
    """Return where in the pool the rows (ROWS, N) of surfels are."""
    first = numbers // PAGE * SPAN + numbers % PAGE
    return np.asarray(first + np.arange(ROWS)[:, None] * STRIDE)


def _columns(capacity: int) -> dict[str, Array]:
    """Return what is kept of so many pages and their shelves besides the surfels, where all are empty."""
    boxes: Float32 = np.zeros((-(-capacity // SHELF), 6), np.float32)
    boxes[:, :3], boxes[:, 3:] = 1e9, -1e9
    return {
        "counts": np.zeros(capacity, np.int32), "boxes": np.zeros((capacity, 6), np.float32), "shelves": boxes,
        "cells": np.full(capacity, -1, np.int64), "probation": np.zeros(capacity, np.int32),
        "dirty": np.zeros(capacity, np.uint8),
        "thinned": np.zeros(capacity, np.int32), "epochs": np.zeros(capacity, np.int32),
    }  # fmt: skip
