"""Compiled kernels of the consistency graph: adjacency as rows of bits, core numbers, and the clique search.

Vertex j of row i is bit j % 64 of word j // 64. No sum here is of floating-point numbers: nothing depends on the order.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import inlined, kernel

WORD = 64
"""Bits of a word."""

ONE = np.uint64(1)


@inlined
def ones(word):
    """Number of bits set (the classic sum over fields of 2, 4 and 8 bits)."""
    x = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@inlined
def lowest(word):
    """Index of the lowest bit set; the word is not 0."""
    return ones((word & (~word + ONE)) - ONE)


@inlined
def test(row, j):
    """Whether bit j of a row is set."""
    return (row[j >> 6] >> np.uint64(j & 63)) & ONE != np.uint64(0)


@kernel
def consistency_rows(
    start, stop, source, target, bounds, normals, oriented, scale, slack, min_length, max_turn, adjacency
):
    """Fill rows start..stop of the bit matrix (N, words): which pairs keep their distance to pair i.

    Pairs i and j are consistent when | |b_i - b_j| - s |a_i - a_j| | <= bound_i + bound_j + slack s |a_i - a_j|, and
    |b_i - b_j| and s |a_i - a_j| are not both below `min_length`. Where normals are given, the cosines between the two
    normals, and between each normal and the line, must also agree within `max_turn`; unless the normals are `oriented`,
    their signs do not count.

    source, target (3, N); bounds (N,); normals (6, N) of the source and the target, or (6, 0).
    """
    count = source.shape[1]
    near = np.empty(WORD, np.int64)
    has_normals = normals.shape[1] > 0
    for i in range(start, stop):
        ax, ay, az = source[0, i], source[1, i], source[2, i]
        bx, by, bz = target[0, i], target[1, i], target[2, i]
        bound = bounds[i]
        for first in range(0, count, WORD):
            width = min(WORD, count - first)
            for k in range(width):
                j = first + k
                dx, dy, dz = source[0, j] - ax, source[1, j] - ay, source[2, j] - az
                ex, ey, ez = target[0, j] - bx, target[1, j] - by, target[2, j] - bz
                p = scale * np.sqrt(dx * dx + dy * dy + dz * dz)
                q = np.sqrt(ex * ex + ey * ey + ez * ez)
                close = (abs(p - q) <= bound + bounds[j] + slack * p) & (max(p, q) >= min_length)
                near[k] = 1 if close else 0
            word = np.uint64(0)
            for k in range(width):
                j = first + k
                accept = near[k] != 0 and j != i
                if accept and has_normals:
                    accept = same_turns(i, j, source, target, normals, oriented, bound + bounds[j], max_turn)
                if accept:
                    word |= ONE << np.uint64(k)
            adjacency[i, first // WORD] = word


@inlined
def same_turns(i, j, source, target, normals, oriented, bound, max_turn):
    """Whether two pairs agree about the angles between their normals and the line between them."""
    ax, ay, az, bx, by, bz = normals[0, i], normals[1, i], normals[2, i], normals[3, i], normals[4, i], normals[5, i]
    cx, cy, cz, dx, dy, dz = normals[0, j], normals[1, j], normals[2, j], normals[3, j], normals[4, j], normals[5, j]
    px, py, pz = source[0, j] - source[0, i], source[1, j] - source[1, i], source[2, j] - source[2, i]
    qx, qy, qz = target[0, j] - target[0, i], target[1, j] - target[1, i], target[2, j] - target[2, i]
    q = np.sqrt(qx * qx + qy * qy + qz * qz)
    # A short line turns with the noise of its ends: its cosine may differ by so much more.
    allowed = max_turn + bound / max(q, 1e-300)
    p, q = 1.0 / max(np.sqrt(px * px + py * py + pz * pz), 1e-300), 1.0 / max(q, 1e-300)
    s0, t0 = ax * cx + ay * cy + az * cz, bx * dx + by * dy + bz * dz
    s1, t1 = (ax * px + ay * py + az * pz) * p, (bx * qx + by * qy + bz * qz) * q
    s2, t2 = (cx * px + cy * py + cz * pz) * p, (dx * qx + dy * qy + dz * qz) * q
    if not oriented:
        s0, t0, s1, t1, s2, t2 = abs(s0), abs(t0), abs(s1), abs(t1), abs(s2), abs(t2)
    return (abs(s0 - t0) <= max_turn) & (abs(s1 - t1) <= allowed) & (abs(s2 - t2) <= allowed)


@kernel
def core_numbers(adjacency, count, degrees, order):
    """Peel the graph by smallest degree; returns core numbers (N,) and fills the order of peeling (N,).

    V. Batagelj, M. Zaversnik, "An O(m) algorithm for cores decomposition of networks", 2003: vertices in buckets by
    degree. A clique of k vertices lies within those of core number >= k - 1.
    """
    core = degrees.copy()
    largest = 0
    for v in range(count):
        largest = max(largest, core[v])
    begin = np.zeros(largest + 2, np.int64)
    for v in range(count):
        begin[core[v] + 1] += 1
    for d in range(largest + 1):
        begin[d + 1] += begin[d]
    place = np.empty(count, np.int64)
    fill = begin.copy()
    for v in range(count):
        place[v] = fill[core[v]]
        order[place[v]] = v
        fill[core[v]] += 1
    for k in range(count):
        v = order[k]
        for w in range(adjacency.shape[1]):
            word = adjacency[v, w]
            while word != np.uint64(0):
                u = w * WORD + lowest(word)
                word &= word - ONE
                if core[u] > core[v]:  # swap u with the first of its bucket, and shrink the bucket
                    first = begin[core[u]]
                    other = order[first]
                    order[place[u]], order[first] = other, u
                    place[other], place[u] = place[u], first
                    begin[core[u]] += 1
                    core[u] -= 1
    return core


@kernel
def count_bits(start, stop, adjacency, degrees):
    """Fill degrees[start:stop] with the number of bits of each row."""
    for i in range(start, stop):
        total = 0
        for w in range(adjacency.shape[1]):
            total += ones(adjacency[i, w])
        degrees[i] = total


@kernel
def greedy_clique(adjacency, alive, seed, clique):
    """Grow a clique from a seed among the `alive` vertices (bits); fills `clique` and returns its size.

    Each time the candidate joins that keeps the most candidates; the lowest index where there is a tie.
    """
    words = adjacency.shape[1]
    candidates = np.empty(words, np.uint64)
    left = 0
    for w in range(words):
        candidates[w] = adjacency[seed, w] & alive[w]
        left += ones(candidates[w])
    clique[0] = seed
    size = 1
    while left > 0:
        best, best_kept = -1, -1
        for w in range(words):
            word = candidates[w]
            while word != np.uint64(0):
                v = w * WORD + lowest(word)
                word &= word - ONE
                kept = 0
                for k in range(words):
                    kept += ones(candidates[k] & adjacency[v, k])
                if kept > best_kept:
                    best, best_kept = v, kept
        clique[size] = best
        size += 1
        for w in range(words):
            candidates[w] &= adjacency[best, w]
        left = best_kept
    return size


@kernel
def colour_order(adjacency, candidates, words, need, order, bounds):
    """Colour the candidates greedily; list those whose colour exceeds `need`, ascending, with their colours.

    Vertices of one colour are no neighbours, so a clique takes at most one of each: no clique among the candidates up
    to and including order[k] has more than bounds[k] vertices. Returns how many were listed.
    """
    uncoloured = candidates.copy()
    listed, colour, left = 0, 0, True
    while left:
        left = False
        colour += 1
        rest = uncoloured.copy()
        for w in range(words):
            while rest[w] != np.uint64(0):
                v = w * WORD + lowest(rest[w])
                bit = ONE << np.uint64(v & 63)
                rest[w] &= ~bit
                uncoloured[w] &= ~bit
                for k in range(w, words):
                    rest[k] &= ~adjacency[v, k]
                if colour > need:
                    order[listed] = v
                    bounds[listed] = colour
                    listed += 1
        for w in range(words):
            left |= uncoloured[w] != np.uint64(0)
    return listed


@kernel
def branch_and_bound(adjacency, count, lower, max_nodes, clique):
    """Find a clique of more than `lower` vertices, the largest there is; returns (its size or 0, nodes spent).

    P. San Segundo, D. Rodriguez-Losada, A. Jimenez, "An exact bit-parallel algorithm for the maximum clique problem",
    2011 (after Tomita): depth first, the last coloured vertex first, cut where colours cannot beat the best.
    """
    words = adjacency.shape[1]
    best, nodes, depth = lower, 0, 0
    deepest = 1
    for v in range(count):
        degree = 0
        for w in range(words):
            degree += ones(adjacency[v, w])
        deepest = max(deepest, degree + 1)
    candidates = np.zeros((deepest + 1, words), np.uint64)
    order = np.empty((deepest + 1, count), np.int32)
    bounds = np.empty((deepest + 1, count), np.int32)
    at = np.zeros(deepest + 1, np.int64)
    path = np.empty(deepest + 1, np.int64)
    found = 0
    for v in range(count):
        candidates[0, v >> 6] |= ONE << np.uint64(v & 63)
    at[0] = colour_order(adjacency, candidates[0], words, best, order[0], bounds[0])
    while depth >= 0:
        at[depth] -= 1
        k = at[depth]
        if k < 0 or depth + bounds[depth, k] <= best:
            depth -= 1
            continue
        nodes += 1
        if nodes > max_nodes:
            break
        v = order[depth, k]
        path[depth] = v
        candidates[depth, v >> 6] &= ~(ONE << np.uint64(v & 63))
        left = False
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & adjacency[v, w]
            left |= candidates[depth + 1, w] != np.uint64(0)
        if left:
            depth += 1
            at[depth] = colour_order(adjacency, candidates[depth], words, best - depth, order[depth], bounds[depth])
        elif depth + 1 > best:
            best = depth + 1
            found = best
            for d in range(best):
                clique[d] = path[d]
    return found, nodes


@kernel
def count_promising(start, stop, adjacency, order, rank, core, best, counts):
    """Fill counts[start:stop]: how many neighbours could be in a clique of more than `best` with each vertex.

    Only those peeled later count, of core number >= `best`, that share at least best - 1 more of them.
    """
    words = adjacency.shape[1]
    later = np.empty(words, np.uint64)
    for i in range(start, stop):
        v = order[i]
        counts[i] = 0
        if core[v] < best:
            continue
        for w in range(words):
            later[w] = np.uint64(0)
            word = adjacency[v, w]
            while word != np.uint64(0):
                u = w * WORD + lowest(word)
                if rank[u] > i and core[u] >= best:
                    later[w] |= word & (~word + ONE)
                word &= word - ONE
        for w in range(words):
            word = later[w]
            while word != np.uint64(0):
                u = w * WORD + lowest(word)
                word &= word - ONE
                shared = 0
                for k in range(words):
                    shared += ones(later[k] & adjacency[u, k])
                counts[i] += 1 if shared >= best - 1 else 0


@kernel
def induced(adjacency, members, small):
    """Fill the bit matrix `small` (m, words) with the graph among `members` (m,)."""
    m = len(members)
    for i in range(m):
        row = adjacency[members[i]]
        for w in range(small.shape[1]):
            small[i, w] = np.uint64(0)
        for j in range(m):
            if test(row, members[j]):
                small[i, j >> 6] |= ONE << np.uint64(j & 63)
