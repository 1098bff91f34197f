"""Compiled kernels of the sorted hash grid: points sorted by cell, and searches over runs of cells.

Space is cut into cubes. The cells (i, j, k) of one row (j, k) have the consecutive buckets hash(j, k) + i, so the
points of a run of cells along x lie side by side in memory. Points of other rows that share a bucket are candidates too
many, never too few.

Arrays in common: `rows` (M, 4) float64 holds x, y, z and the original row of each point, sorted by bucket; `starts`
int32 says where each bucket begins; `lattice` (8,) float64 is the origin, cells per metre, the number of cells along
each axis, and the largest hash. Coordinates and lengths in cells are called `u`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from scanweld.parallel import inlined, kernel

# No fast-math here: a cell must come out the same wherever it is computed, and equal distances equal, as in NumPy.
exact = numba.njit(fastmath=False, error_model="numpy", boundscheck=False, cache=True, nogil=True)

SLACK = 1e-6
"""Cells by which every bound is widened: more than rounding can move a coordinate across a cell's face."""

RINGS = 10
"""Rings of rows searched around a query before the grid gives up and a tree is asked."""

NEAR = 1.5
"""Reach in cells up to which rows are searched in plain order."""

UNRESOLVED = -2
"""Partner of a query for which RINGS were not enough."""


@exact
def cell_coordinate(value, origin, per_m):
    """Coordinate in cells; monotone in `value`, so cells never disagree about who is on which side."""
    return (value - origin) * per_m


@exact
def squared_distance(x, y, z, point):
    """Squared distance as NumPy adds it."""
    dx, dy, dz = x - point[0], y - point[1], z - point[2]
    return dx * dx + dy * dy + dz * dz


@inlined
def row_bucket(j, k, largest):
    """Bucket of cell (0, j, k); `largest` is a power of two less one."""
    h = np.uint64(j) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(k) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return np.int64(h >> np.uint64(33)) & np.int64(largest)


@inlined
def clamped_cell(u, cells):
    """Cell of a coordinate, the nearest one inside the grid."""
    return np.int64(min(max(math.floor(u), 0.0), cells - 1.0))


@inlined
def beyond(u, cell):
    """Distance in cells from a coordinate to a cell, 0 inside."""
    return max(max(u - (cell + 1), cell - u), 0.0)


@kernel
def bounds(points, low, high):
    """Smallest and largest coordinates of points (M, 3)."""
    x0, y0, z0 = points[0, 0], points[0, 1], points[0, 2]
    x1, y1, z1 = x0, y0, z0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    low[0], low[1], low[2] = x0, y0, z0
    high[0], high[1], high[2] = x1, y1, z1


@kernel
def tally(points, lattice, buckets, starts):
    """Note the bucket of every point (M, 3) in buckets (M,) int32, and in starts[b + 1] where bucket b begins.

    starts, int32, is zero before. Returns the sum of squared bucket sizes and the number of buckets in use.
    """
    per_m = lattice[3]
    for n in range(len(points)):
        i = clamped_cell(cell_coordinate(points[n, 0], lattice[0], per_m), lattice[4])
        j = clamped_cell(cell_coordinate(points[n, 1], lattice[1], per_m), lattice[5])
        k = clamped_cell(cell_coordinate(points[n, 2], lattice[2], per_m), lattice[6])
        bucket = row_bucket(j, k, lattice[7]) + i
        buckets[n] = bucket
        starts[bucket + 2] += 1
    squares, used = np.int64(0), 0
    for b in range(2, len(starts)):
        size = np.int64(starts[b])
        squares += size * size
        used += 1 if size > 0 else 0
        starts[b] += starts[b - 1]
    return squares, used


@kernel
def place(points, buckets, starts, rows):
    """Write the points in the order of their buckets, stable, after :func:`tally`; starts[b] becomes the begin of b."""
    for n in range(len(points)):
        free = starts[buckets[n] + 1]  # once bucket b is full, this is where b + 1 begins
        starts[buckets[n] + 1] = free + 1
        rows[free, 0], rows[free, 1], rows[free, 2] = points[n, 0], points[n, 1], points[n, 2]
        rows[free, 3] = n


@inlined
def nearest_of_run(x, y, z, begin, end, rows, slack, bound, best, least, second):
    """Nearest of rows begin..end, the lowest original row among equals, and the distance of the second.

    All squared: `bound`, inclusive, how far to look; `least` and `second`, the distances of the row `best` and of the
    next one. The bound is that of `best` widened by `slack` (m).
    """
    for n in range(begin, end):
        d = squared_distance(x, y, z, rows[n])
        if d <= bound:
            row = np.int64(rows[n, 3])
            if (d < least) | (best < 0) | ((d == least) & (row < best)):
                least, second, best = d, least, row
                bound = min(bound, second, widened(d, slack))
            elif (d < second) & (row != best):
                second = d
                bound = min(bound, second)
    return bound, best, least, second


@inlined
def widened(square, slack):
    """Square of a distance, given squared, that has become longer by `slack`."""
    return square + slack * (2.0 * math.sqrt(square) + slack)


@inlined
def ring_distance(u, cell, ring, cells):
    """Least distance in cells from `u` to the two slabs `ring` away from its cell; large where both are outside."""
    near = 1e30
    if cell >= ring:
        near = u - (cell - ring + 1)
    if cell + ring < cells:
        near = min(near, cell + ring - u)
    return near


@kernel
def nearest_close_by(x, y, z, ux, uy, uz, reach, per_m, rows, starts, lattice, slack, bound, best, least, second):
    """Search the few rows within a short reach, in order."""
    columns, lines, layers = lattice[4], lattice[5], lattice[6]
    if (ux + reach < 0) | (ux - reach >= columns):
        return bound, best, least, second
    first, last = clamped_cell(ux - reach, columns), clamped_cell(ux + reach, columns)
    for j in range(clamped_cell(uy - reach, lines), clamped_cell(uy + reach, lines) + 1):
        dy = beyond(uy, j)
        for k in range(clamped_cell(uz - reach, layers), clamped_cell(uz + reach, layers) + 1):
            dz = beyond(uz, k)
            if dy * dy + dz * dz <= reach * reach:
                h = row_bucket(j, k, lattice[7])
                closer, best, least, second = nearest_of_run(
                    x, y, z, starts[h + first], starts[h + last + 1], rows, slack, bound, best, least, second
                )
                if closer < bound:
                    bound = closer
                    reach = math.sqrt(bound) * per_m + SLACK
    return bound, best, least, second


@kernel
def nearest_in_rings(x, y, z, ux, uy, uz, reach, per_m, rows, starts, lattice, slack, bound, best, least, second):
    """Search rows in square rings around the query's own, only as far as the best so far."""
    columns, lines, layers = lattice[4], lattice[5], lattice[6]
    j, k = clamped_cell(uy, lines), clamped_cell(uz, layers)
    for ring in range(RINGS + 1):
        if ring > 0 and min(ring_distance(uy, j, ring, lines), ring_distance(uz, k, ring, layers)) > reach:
            break
        for dj in range(-ring, ring + 1):
            dy = beyond(uy, j + dj)
            if (dy > reach) | (j + dj < 0) | (j + dj >= lines):
                continue
            step = 1 if abs(dj) == ring else 2 * ring
            for dk in range(-ring, ring + 1, step):
                dz = beyond(uz, k + dk)
                rest = reach * reach - dy * dy - dz * dz
                if (rest < 0) | (k + dk < 0) | (k + dk >= layers):
                    continue
                along = math.sqrt(rest)
                if (ux + along < 0) | (ux - along >= columns):
                    continue
                first, last = clamped_cell(ux - along, columns), clamped_cell(ux + along, columns)
                h = row_bucket(j + dj, k + dk, lattice[7])
                closer, best, least, second = nearest_of_run(
                    x, y, z, starts[h + first], starts[h + last + 1], rows, slack, bound, best, least, second
                )
                if closer < bound:
                    bound = closer
                    reach = min(math.sqrt(bound) * per_m + SLACK, RINGS + 0.0)
    return bound, best, least, second


@kernel
def nearest(points, start, stop, rows, starts, lattice, originals, gate, partners, squared, slack, anchors):
    """Fill the partner and the squared distance of queries start..stop (N, 3).

    gate: squared, inclusive. partners int32, in: a row of `originals` (M, 3) to start from, or -1; out: the nearest
    row, -1 where none is near enough, UNRESOLVED where the grid gave up. Returns how many are unresolved.

    anchors (N, 4), or (0, 4) to do without: where a query was when it was last searched for, and how far from there it
    may be before it can have another partner, which is what the search looks for `slack` (m) beyond the nearest.

    Rows of cells are searched in square rings around the query's own, and only as far as the best so far.
    """
    unresolved = 0
    per_m = lattice[3]
    columns, lines, layers = lattice[4], lattice[5], lattice[6]
    follows = len(anchors) > 0
    slack = slack if follows else 0.0
    furthest = widened(gate, slack)
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        bound, best, least, second = furthest, np.int64(-1), furthest, furthest
        hint = np.int64(partners[n])
        d = squared_distance(x, y, z, originals[hint]) if hint >= 0 else 0.0
        if follows and d <= gate and squared_distance(x, y, z, anchors[n]) < anchors[n, 3] * anchors[n, 3]:
            squared[n] = d
            continue
        if hint >= 0 and d <= furthest:
            best, least = hint, d
            bound = min(furthest, widened(d, slack))
        ux = cell_coordinate(x, lattice[0], per_m)
        uy = cell_coordinate(y, lattice[1], per_m)
        uz = cell_coordinate(z, lattice[2], per_m)
        i, j, k = clamped_cell(ux, columns), clamped_cell(uy, lines), clamped_cell(uz, layers)
        if best < 0:  # the cells at hand give a first bound
            h = row_bucket(j, k, lattice[7])
            begin, end = starts[h + max(i - 1, 0)], starts[h + min(i + 1, np.int64(columns) - 1) + 1]
            bound, best, least, second = nearest_of_run(x, y, z, begin, end, rows, slack, bound, best, least, second)
        reach = min(math.sqrt(bound) * per_m + SLACK, RINGS + 0.0)
        if reach <= NEAR:
            bound, best, least, second = nearest_close_by(
                x, y, z, ux, uy, uz, reach, per_m, rows, starts, lattice, slack, bound, best, least, second
            )
        else:
            bound, best, least, second = nearest_in_rings(
                x, y, z, ux, uy, uz, reach, per_m, rows, starts, lattice, slack, bound, best, least, second
            )
        # the gate, where nothing was found; a far hint is no proof
        proven = math.sqrt(min(least, gate)) * per_m + SLACK <= RINGS
        unresolved += 0 if proven else 1
        found = (best >= 0) & (least <= gate)
        partners[n] = (best if found else -1) if proven else UNRESOLVED
        squared[n] = least if proven and found else 0.0
        if follows:
            seen = min(math.sqrt(bound), (RINGS - SLACK) / per_m)  # no other point is nearer
            margin = 0.5 * (seen - math.sqrt(least)) if found else min(seen, math.sqrt(least)) - math.sqrt(gate)
            anchors[n, 0], anchors[n, 1], anchors[n, 2] = x, y, z
            anchors[n, 3] = max(margin - 1e-9 * seen, 0.0) if proven else 0.0
    return unresolved
