"""Compiled kernels of the pages that surfels live in, and how a page is laid out.

Pages of `PAGE` surfels lie in one flat array: `pool` as float32, `whole` the same bytes as int32. Page `slot` begins at
slot * SPAN; its row r, one number per surfel, is at r * STRIDE from there. Surfel k of it has the number
slot * PAGE + k.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

PAGE = 256
"""Surfels of a page."""

STRIDE = PAGE + 16
"""Distance of a page's rows: 17 cache lines, so that equal places of different rows lie in different cache sets."""

ROWS = 14
"""Numbers per surfel: position, normal, confidence, radius, colour, created, last seen, anchor."""

Y, Z, NX, NY, NZ, CONFIDENCE, RADIUS, RED, GREEN, BLUE, CREATED, LAST_SEEN, ANCHOR = (
    np.uint64(row * STRIDE) for row in range(1, ROWS)
)
"""Distances of the rows from the first, x."""

SPAN = ROWS * STRIDE
"""Distance of the pages."""


SHELF = 64
"""Pages of a shelf: neighbours in time, so mostly in space. They are culled together, and leave memory together; a
shelf is a whole number of the system's memory pages of 4 kB."""


@kernel
def is_outside(box, planes):
    """Whether a box (6,), its lower and upper corner, is wholly outside one of the planes (6, 4) n . x + d >= 0."""
    inside = True
    for k in range(planes.shape[0]):
        farthest = planes[k, 3]
        for axis in range(3):
            normal = planes[k, axis]
            farthest += max(normal * box[axis], normal * box[3 + axis])
        inside = inside & (farthest >= 0)
    return not inside


@kernel
def cull_pages(counts, boxes, shelves, planes, slots):
    """List the pages that are not wholly outside one of the planes (6, 4) n . x + d >= 0; returns how many.

    counts (P,) int32 surfels of each page; boxes (P, 6) float32 their lower and upper corners; shelves (S, 6) float32
    the same around the pages of each shelf, which may be too large; those looked at become as small as they can be.
    slots (P,) int32: the list.
    """
    listed = 0
    for shelf in range(len(shelves)):
        around = shelves[shelf]
        if (around[0] > around[3]) or is_outside(around, planes):
            continue
        for axis in range(3):
            around[axis], around[3 + axis] = np.float32(1e9), np.float32(-1e9)
        for slot in range(shelf * SHELF, min((shelf + 1) * SHELF, len(counts))):
            if counts[slot] == 0:
                continue
            for axis in range(3):
                around[axis] = min(around[axis], boxes[slot, axis])
                around[3 + axis] = max(around[3 + axis], boxes[slot, 3 + axis])
            slots[listed] = slot
            listed += 0 if is_outside(boxes[slot], planes) else 1
    return listed


@kernel
def fit_boxes(start, stop, slots, counts, pool, boxes):
    """Bring the boxes (P, 6) of pages slots[start:stop] up to date."""
    for s in range(start, stop):
        slot = slots[s]
        base = np.uint64(slot) * np.uint64(SPAN)
        for axis in range(3):
            row = base + np.uint64(axis) * np.uint64(STRIDE)
            low, high = np.float32(1e9), np.float32(-1e9)
            for k in range(np.uint64(counts[slot])):
                low, high = min(low, pool[row + k]), max(high, pool[row + k])
            boxes[slot, axis], boxes[slot, 3 + axis] = low, high


@kernel
def find_cell(key, keys):
    """Place of a key in a hash table (2^n,) int64 with linear probing, or the free place (-1) where it belongs."""
    mask = np.uint64(len(keys) - 1)
    k = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20) & mask
    while (keys[k] != key) & (keys[k] >= 0):
        k = (k + np.uint64(1)) & mask
    return k


@kernel
def cell_key(x, y, z, per_cell):
    """Key of the cell that a place lies in, never negative; cells 524 km apart share one."""
    half, mask = np.int64(1 << 20), np.int64((1 << 21) - 1)
    key = (np.int64(np.floor(x * per_cell)) + half) & mask
    key = (key << np.int64(21)) | ((np.int64(np.floor(y * per_cell)) + half) & mask)
    return (key << np.int64(21)) | ((np.int64(np.floor(z * per_cell)) + half) & mask)


@kernel
def region_key(key):
    """Key of the region of 8 x 8 x 8 cells that a cell is in."""
    mask = np.int64((1 << 18) - 1)
    x, y, z = key >> np.int64(45), (key >> np.int64(24)) & mask, (key >> np.int64(3)) & mask
    return (x << np.int64(36)) | (y << np.int64(18)) | z


@kernel
def rehash(old_keys, old_tails, cells, keys, tails):
    """Fill a table (2^n,) with the cells of another one that still have a page to fill; returns how many.

    keys, tails, cells: see `deposit`; keys is -1 everywhere.
    """
    filled = 0
    for k in range(len(old_keys)):
        slot = old_tails[k]
        if (old_keys[k] >= 0) and (slot >= 0) and (cells[slot] == old_keys[k]):
            entry = find_cell(old_keys[k], keys)
            keys[entry], tails[entry] = old_keys[k], slot
            filled += 1
    return filled


@kernel
def settle_pages(slots, per_cell, counts, boxes, cells, keys, tails):
    """Give pages to the cells that their middles lie in, to be filled where those have none; returns the new keys.

    There is room for them. For the arguments see `deposit`.
    """
    new = 0
    for s in range(len(slots)):
        slot, half = slots[s], np.float32(0.5)
        x, y, z = (
            half * (boxes[slot, 0] + boxes[slot, 3]),
            half * (boxes[slot, 1] + boxes[slot, 4]),
            half * (boxes[slot, 2] + boxes[slot, 5]),
        )
        key = cell_key(x, y, z, per_cell)
        entry = find_cell(key, keys)
        if keys[entry] < 0:
            keys[entry], tails[entry] = key, -1
            new += 1
        tail = tails[entry]
        cells[slot] = key
        if (tail < 0) or (cells[tail] != key) or (counts[tail] == PAGE):
            tails[entry] = slot
    return new


@kernel
def deposit(
    first, rows, per_cell, room, counts, boxes, shelves, cells, probation, keys, tails, used, owners, following,
    regions, heads, free, left, pool, numbers,
):  # fmt: skip
    """Put surfels rows[:, first:] (ROWS, N) into pages of their cells, until pages or room in the table run out.

    A new page goes to a shelf of the region that its cell is in: what is in view together leaves memory together.

    per_cell: cells per metre; room: keys that may still come into the table of cells; counts, boxes, shelves, cells,
    probation: see `PagePool`; keys (2^n,) int64, -1 where free, tails (2^n,) int32: the table of cells and the page
    that each fills; used, owners, following, regions (its keys), heads, free, left: see `Regions`; numbers (N,) int32:
    the surfels' numbers. Returns how far it came, and the room that is left.
    """
    for k in range(first, rows.shape[1]):
        x, y, z = rows[0, k], rows[1, k], rows[2, k]
        key = cell_key(x, y, z, per_cell)
        entry = find_cell(key, keys)
        if keys[entry] < 0:
            if room == 0:
                return k, room
            keys[entry], tails[entry] = key, -1
            room -= 1
        slot = tails[entry]
        # A page that was released since, and may belong to another cell by now, is no longer this cell's.
        if slot < 0 or (cells[slot] != key) | (counts[slot] == PAGE):
            region = region_key(key)
            place = find_cell(region, regions)
            if regions[place] < 0:
                if left[1] == 0:
                    return k, room
                regions[place], heads[place] = region, -1
                left[1] -= 1
            shelf = heads[place]
            while (shelf >= 0) and (used[shelf] == SHELF):
                shelf = following[shelf]
            if shelf < 0:
                if left[0] == 0:
                    return k, room
                left[0] -= 1
                shelf = free[left[0]]
                owners[shelf], following[shelf], heads[place] = region, heads[place], shelf
            slot = shelf * SHELF
            while counts[slot] > 0:
                slot += 1
            used[shelf] += 1
            tails[entry], cells[slot], counts[slot] = slot, key, 0
            probation[slot] = 0x7FFFFFFF
            for axis in range(3):
                boxes[slot, axis], boxes[slot, 3 + axis] = np.float32(1e9), np.float32(-1e9)
        i = np.uint64(slot) * np.uint64(SPAN) + np.uint64(counts[slot])
        for row in range(np.uint64(ROWS)):
            pool[i + row * np.uint64(STRIDE)] = rows[row, k]
        for axis in range(3):
            boxes[slot, axis] = min(boxes[slot, axis], rows[axis, k])
            boxes[slot, 3 + axis] = max(boxes[slot, 3 + axis], rows[axis, k])
            shelves[slot // SHELF, axis] = min(shelves[slot // SHELF, axis], rows[axis, k])
            shelves[slot // SHELF, 3 + axis] = max(shelves[slot // SHELF, 3 + axis], rows[axis, k])
        numbers[k] = slot * PAGE + counts[slot]
        counts[slot] += 1
    return rows.shape[1], room


@kernel
def clean_pages(start, stop, slots, frame_id, unstable_frames, stable, pool, whole, counts, probation):
    """Drop from pages slots[start:stop] what stayed unstable for too long or has no confidence left.

    probation (P,) int32: the first frame of what is still unstable.
    """
    for s in range(start, stop):
        slot = slots[s]
        base = np.uint64(slot) * np.uint64(SPAN)
        kept, earliest = np.uint64(0), 0x7FFFFFFF
        for k in range(np.uint64(counts[slot])):
            confidence, created = pool[base + CONFIDENCE + k], whole[base + CREATED + k]
            if (confidence <= 0) | ((frame_id - created > unstable_frames) & (confidence < stable)):
                continue
            if confidence < stable:
                earliest = min(earliest, created)
            if kept < k:
                for row in range(np.uint64(ROWS)):
                    whole[base + row * np.uint64(STRIDE) + kept] = whole[base + row * np.uint64(STRIDE) + k]
            kept += np.uint64(1)
        counts[slot], probation[slot] = kept, earliest


@kernel
def move_pages(start, stop, slots, epochs, tables, counts, pool, whole, least, largest):
    """Let pages slots[start:stop] follow the corrections that they have not followed yet.

    epochs (P,) int32: how many corrections each page has followed; tables (E, A + 1, 12) float64: the upper rows of
    T_now_then of each keyframe for the pages of each epoch, the last for all other keyframes. least, largest (4, S)
    float64 are written: the range of the anchors, and of the motion [m], of each page's surfels.
    """
    others = tables.shape[1] - 1
    for s in range(start, stop):
        slot = slots[s]
        base, table = np.uint64(slot) * np.uint64(SPAN), tables[epochs[slot]]
        for k in range(4):
            least[k, s], largest[k, s] = 1e9, -1e9
        for k in range(np.uint64(counts[slot])):
            anchor = whole[base + ANCHOR + k]
            T = table[others if (anchor < 0) | (anchor > others) else anchor]
            x, y, z = np.float64(pool[base + k]), np.float64(pool[base + Y + k]), np.float64(pool[base + Z + k])
            pool[base + k] = T[0] * x + T[1] * y + T[2] * z + T[3]
            pool[base + Y + k] = T[4] * x + T[5] * y + T[6] * z + T[7]
            pool[base + Z + k] = T[8] * x + T[9] * y + T[10] * z + T[11]
            moved = (pool[base + k] - x, pool[base + Y + k] - y, pool[base + Z + k] - z)
            least[0, s], largest[0, s] = min(least[0, s], anchor), max(largest[0, s], anchor)
            for axis in range(3):
                least[1 + axis, s] = min(least[1 + axis, s], moved[axis])
                largest[1 + axis, s] = max(largest[1 + axis, s], moved[axis])
            x, y, z = np.float64(pool[base + NX + k]), np.float64(pool[base + NY + k]), np.float64(pool[base + NZ + k])
            pool[base + NX + k] = T[0] * x + T[1] * y + T[2] * z
            pool[base + NY + k] = T[4] * x + T[5] * y + T[6] * z
            pool[base + NZ + k] = T[8] * x + T[9] * y + T[10] * z
