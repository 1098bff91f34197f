"""Compiled kernels of the search for motions: a clique from every match, and how many matches a motion explains."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel
from scanweld.registration.consistency.kernels import ONE, WORD, lowest, ones, test


@kernel
def grow_cliques(start, stop, adjacency, sizes, members):
    """Grow a clique of at most K from each of the vertices start..stop; sizes (N,), members (N, K).

    The neighbours that share the most neighbours with the seed join first (the second-order consistency of Z. Chen et
    al., "SC2-PCR", CVPR 2022), as long as they are joined with all members.
    """
    count, words = adjacency.shape
    candidates = np.empty(count, np.int64)
    shared = np.empty(count, np.int64)
    for seed in range(start, stop):
        left = 0
        for w in range(words):
            word = adjacency[seed, w]
            while word != np.uint64(0):
                v = w * WORD + lowest(word)
                word &= word - ONE
                total = 0
                for k in range(words):
                    total += ones(adjacency[seed, k] & adjacency[v, k])
                candidates[left], shared[left] = v, total
                left += 1
        size = 1
        members[seed, 0] = seed
        while left > 0 and size < members.shape[1]:
            best = 0
            for c in range(1, left):
                if shared[c] > shared[best]:
                    best = c
            joining = candidates[best]
            members[seed, size] = joining
            size += 1
            kept = 0
            for c in range(left):
                if test(adjacency[joining], candidates[c]):
                    candidates[kept], shared[kept] = candidates[c], shared[c]
                    kept += 1
            left = kept
        sizes[seed] = size


@kernel
def count_agreeing(start, stop, motions, source, target, bound, counts):
    """Fill counts[start:stop]: how many pairs (N, 3), (N, 3) each motion [sR | t] (P, 3, 4) brings within `bound`."""
    squared = bound * bound
    for p in range(start, stop):
        m = motions[p]
        total = 0
        for k in range(len(source)):
            x, y, z = source[k, 0], source[k, 1], source[k, 2]
            dx = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] - target[k, 0]
            dy = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] - target[k, 1]
            dz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] - target[k, 2]
            total += 1 if dx * dx + dy * dy + dz * dz <= squared else 0
        counts[p] = total
