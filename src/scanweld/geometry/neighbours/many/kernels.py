"""Compiled kernels that find many neighbours: the k nearest, or all within a radius.

Arrays in common are those of :mod:`scanweld.geometry.neighbours.kernels`.
"""

from __future__ import annotations

import math

import numpy as np

from scanweld.geometry.neighbours.kernels import (
    SLACK,
    UNRESOLVED,
    beyond,
    cell_coordinate,
    clamped_cell,
    row_bucket,
    squared_distance,
)
from scanweld.parallel import inlined, kernel

FAR_RINGS = 32
"""Rings searched for k neighbours before the grid gives up and a tree is asked."""

BLOCK = 1024
"""Candidates that the block around a cell may hold."""

LANES = 32
"""Blocks are padded to a multiple of this, or the last few of a vector loop would take longer than all the others."""

FAR = np.float32(1e15)
"""Coordinate of the padding."""

BLOCK_RINGS = 3
"""Largest block, in cells to each side."""


@kernel
def ball(x, y, z, bound, rows, starts, lattice, slots, squares):
    """Write the places in `rows` of all points within `bound` (squared, inclusive) and their squared distances.

    Returns how many there are, of which the first len(slots) are written.
    """
    per_m = lattice[3]
    columns, lines, layers = lattice[4], lattice[5], lattice[6]
    ux = cell_coordinate(x, lattice[0], per_m)
    uy = cell_coordinate(y, lattice[1], per_m)
    uz = cell_coordinate(z, lattice[2], per_m)
    reach = math.sqrt(bound) * per_m + SLACK
    count = 0
    if (ux + reach < 0) | (ux - reach >= columns):
        return count
    for j in range(clamped_cell(uy - reach, lines), clamped_cell(uy + reach, lines) + 1):
        dy = beyond(uy, j)
        for k in range(clamped_cell(uz - reach, layers), clamped_cell(uz + reach, layers) + 1):
            dz = beyond(uz, k)
            rest = reach * reach - dy * dy - dz * dz
            if rest < 0:
                continue
            along = math.sqrt(rest)
            h = row_bucket(j, k, lattice[7])
            begin = starts[h + clamped_cell(ux - along, columns)]
            end = starts[h + clamped_cell(ux + along, columns) + 1]
            for n in range(begin, end):
                d = squared_distance(x, y, z, rows[n])
                if d <= bound and in_row(rows[n], j, k, lattice):
                    if count < len(slots):
                        slots[count], squares[count] = n, d
                    count += 1
    return count


@inlined
def in_row(point, j, k, lattice):
    """Whether a point lies in row (j, k) of cells: two rows may share buckets, and no point may count twice."""
    return (clamped_cell(cell_coordinate(point[1], lattice[1], lattice[3]), lattice[5]) == j) & (
        clamped_cell(cell_coordinate(point[2], lattice[2], lattice[3]), lattice[6]) == k
    )


@kernel
def sort_ascending(values, first, count):
    """Sort values[first : first + count] in place (Shell 1959); NumPy's sort takes seconds to compile."""
    gap = count // 2
    while gap > 0:
        for n in range(first + gap, first + count):
            value, m = values[n], n
            while m >= first + gap and values[m - gap] > value:
                values[m] = values[m - gap]
                m -= gap
            values[m] = value
        gap //= 2


@kernel
def within(points, start, stop, bound, rows, starts, lattice, ends, indices):
    """Count the points within `bound` (squared) of queries start..stop in ends[q + 1]; or, where `indices` is not
    empty, write their original rows, ascending, up to ends[q + 1]."""
    slots, squares = np.empty(1024, np.int64), np.empty(1024)
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        count = ball(x, y, z, bound, rows, starts, lattice, slots, squares)
        if len(indices) == 0:
            ends[n + 1] = count
            continue
        if count > len(slots):
            slots, squares = np.empty(2 * count, np.int64), np.empty(2 * count)
            ball(x, y, z, bound, rows, starts, lattice, slots, squares)
        first = ends[n + 1] - count
        for m in range(count):
            indices[first + m] = np.int64(rows[slots[m], 3])
        sort_ascending(indices, first, count)


@kernel
def fill_block(i, j, k, rings, rows, starts, lattice, block, slots):
    """Gather the points of the cells up to `rings` around a cell, in cells about its centre, as block (3, BLOCK)
    float32, and their places in `rows`. Returns how many, with padding, or -1 when they are too many."""
    per_m = lattice[3]
    first, last = max(i - rings, 0), min(i + rings, np.int64(lattice[4]) - 1)
    count = 0
    for jj in range(max(j - rings, 0), min(j + rings, np.int64(lattice[5]) - 1) + 1):
        for kk in range(max(k - rings, 0), min(k + rings, np.int64(lattice[6]) - 1) + 1):
            h = row_bucket(jj, kk, lattice[7])
            begin, end = starts[h + first], starts[h + last + 1]
            if count + end - begin > block.shape[1] - 1:
                return -1
            for n in range(begin, end):
                block[0, count] = cell_coordinate(rows[n, 0], lattice[0], per_m) - (i + 0.5)
                block[1, count] = cell_coordinate(rows[n, 1], lattice[1], per_m) - (j + 0.5)
                block[2, count] = cell_coordinate(rows[n, 2], lattice[2], per_m) - (k + 0.5)
                slots[count] = n
                count += 1 if in_row(rows[n], jj, kk, lattice) else 0
    padded = (count + LANES - 1) // LANES * LANES
    for n in range(count, padded):
        block[0, n], block[1, n], block[2, n] = FAR, np.float32(0), np.float32(0)
    return padded


@inlined
def count_up_to(values, count, limit):
    """How many of the first values are at most `limit`."""
    total = np.int32(0)
    for n in range(count):
        total += np.int32(values[n] <= limit)
    return np.int64(total)


@kernel
def separating_value(values, count, k, largest, guess):
    """Find t <= largest with exactly k of the first values <= t: secant steps on the count, which grows about
    linearly in squared distance on a surface. -1 when fewer than k are <= largest, -2 when a tie is in the way."""
    low, high = np.float32(0), largest
    below, above = 0, count_up_to(values, count, largest)
    if above <= k:
        return largest if above == k else np.float32(-1)
    t = guess
    for _ in range(16):
        if not (t > low and t < high):
            t = low + (high - low) * np.float32(0.5)
        n = count_up_to(values, count, t)
        if n == k:
            return t
        if n < k:
            low, below = t, n
        else:
            high, above = t, n
        t = low + (high - low) * np.float32(k + 0.5 - below) / np.float32(above - below)
    return np.float32(-2)


@kernel
def margin_around(values, count, t):
    """Gap between the largest value <= t and the smallest one above."""
    inside, outside = np.float32(0), np.float32(1e30)
    for n in range(count):
        v = values[n]
        inside = max(inside, v if v <= t else np.float32(0))
        outside = min(outside, v if v > t else np.float32(1e30))
    return outside - inside


@kernel
def k_in_block(x, y, z, k, gate, rows, starts, lattice, work, chosen):
    """Try to find the k nearest points of a query in the block of cells around it.

    Returns k; 0 without success, -1 when the block holds too few. chosen (BLOCK,) int64: places in `rows`, unsorted.

    The block is kept for the next query, mostly of the same cell. All of it is measured in vector instructions; the
    k-th distance is found by counting, not by sorting.
    """
    block, squares, slots, kept, memory = work
    per_m = lattice[3]
    ux = cell_coordinate(x, lattice[0], per_m)
    uy = cell_coordinate(y, lattice[1], per_m)
    uz = cell_coordinate(z, lattice[2], per_m)
    i, j, m = clamped_cell(ux, lattice[4]), clamped_cell(uy, lattice[5]), clamped_cell(uz, lattice[6])
    outside = max(max(beyond(ux, i), beyond(uy, j)), beyond(uz, m))
    if (outside > SLACK) | (k >= len(slots)):
        return 0
    if (kept[0] != i) | (kept[1] != j) | (kept[2] != m):
        kept[0], kept[1], kept[2], kept[3] = i, j, m, 1
        kept[4] = fill_block(i, j, m, kept[3], rows, starts, lattice, block, slots)
    bx, by, bz = block[0], block[1], block[2]
    qx, qy, qz = np.float32(ux - (i + 0.5)), np.float32(uy - (j + 0.5)), np.float32(uz - (m + 0.5))
    squared_gate = gate * per_m * per_m
    t = np.float32(-1)
    while kept[3] <= BLOCK_RINGS:
        count = kept[4]
        if count < 0:
            return 0
        if count >= k:
            for n in range(count):
                dx, dy, dz = bx[n] - qx, by[n] - qy, bz[n] - qz
                squares[n] = dx * dx + dy * dy + dz * dz
            inner = min(
                min(min(ux - i, i + 1 - ux), min(uy - j, j + 1 - uy)), min(uz - m, m + 1 - uz)
            )  # to the block's nearest face, less its rings
            safe = kept[3] + inner - 1e-4
            largest = np.float32(safe * safe)
            if safe * safe > squared_gate:
                largest = np.float32(squared_gate * 0.999999)
            t = separating_value(squares, count, k, largest, memory[0])
            if t != -1:
                break
        kept[3] += 1
        if kept[3] <= BLOCK_RINGS:
            kept[4] = fill_block(i, j, m, kept[3], rows, starts, lattice, block, slots)
    else:
        kept[0] = -1
        return -1
    size = kept[3] + 0.5
    if (t < 0) or margin_around(squares, kept[4], t) < 4e-6 * size * size:  # float32 cannot tell who is nearer
        return 0
    memory[0] = t
    found = 0
    for n in range(kept[4]):
        chosen[found] = slots[n]
        found += 1 if squares[n] <= t else 0
    return k


@kernel
def sort_nearest(count, k, rows, slots, squares):
    """Move the k nearest of `count` points to the front, ascending, the lowest original row first among equals."""
    filled = 0
    for n in range(count):
        d, slot = squares[n], slots[n]
        if filled == k and d > squares[k - 1]:
            continue
        place = filled if filled < k else k - 1
        if filled == k and d == squares[place] and rows[slot, 3] > rows[slots[place], 3]:
            continue
        while place > 0 and (
            squares[place - 1] > d or (squares[place - 1] == d and rows[slots[place - 1], 3] > rows[slot, 3])
        ):
            squares[place], slots[place] = squares[place - 1], slots[place - 1]
            place -= 1
        squares[place], slots[place] = d, slot
        filled = min(filled + 1, k)
    return filled


@kernel
def k_in_ball(x, y, z, k, gate, cells, rows, starts, lattice, slots, squares):
    """Find the k nearest points within `gate` (squared) in balls that grow from a radius of some cells.

    Returns how many, ascending at the front of `slots`, and the two arrays, larger ones where they were too small; -1
    where FAR_RINGS are not enough.
    """
    largest = FAR_RINGS / lattice[3]
    radius = cells / lattice[3]
    while True:
        bound = min(radius * radius, gate)
        count = ball(x, y, z, bound, rows, starts, lattice, slots, squares)
        if count >= min(k, len(rows)) or bound >= gate:
            break
        if radius >= largest:
            return -1, slots, squares
        radius = min(radius * 1.6, largest)
    if count > len(slots):
        slots, squares = np.empty(2 * count, np.int64), np.empty(2 * count)
        ball(x, y, z, bound, rows, starts, lattice, slots, squares)
    return sort_nearest(count, k, rows, slots, squares), slots, squares


@inlined
def working_space():
    """Arrays of a search for k neighbours: the block around a cell, what it holds, and the last threshold."""
    return (
        np.empty((3, BLOCK), np.float32),
        np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.int32),
        np.full(5, -1, np.int64),
        np.zeros(1, np.float32),
    )


@kernel
def k_nearest(points, start, stop, k, gate, rows, starts, lattice, distances, indices):
    """Fill squared distances and original rows (N, k) of the nearest points of queries start..stop, ascending.

    indices is -1 where there are fewer within `gate` (squared), UNRESOLVED where the grid gave up; the number of
    those is returned.
    """
    work = working_space()
    chosen = np.empty(BLOCK, np.int64)
    slots, squares = np.empty(BLOCK, np.int64), np.empty(BLOCK)
    unresolved = 0
    for q in range(start, stop):
        x, y, z = points[q, 0], points[q, 1], points[q, 2]
        found = k_in_block(x, y, z, k, gate, rows, starts, lattice, work, chosen)
        if found > 0:
            for n in range(found):
                slots[n], squares[n] = chosen[n], squared_distance(x, y, z, rows[chosen[n]])
            sort_nearest(found, k, rows, slots, squares)
        else:
            cells = 1.0 if found == 0 else BLOCK_RINGS + 0.5
            found, slots, squares = k_in_ball(x, y, z, k, gate, cells, rows, starts, lattice, slots, squares)
        unresolved += 1 if found < 0 else 0
        for n in range(k):
            distances[q, n] = squares[n] if n < found else 0.0
            indices[q, n] = np.int64(rows[slots[n], 3]) if n < found else (UNRESOLVED if found < 0 else -1)
    return unresolved
