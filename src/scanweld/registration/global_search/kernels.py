"""Compiled kernels of the search for motions: a clique from every match, and how many matches a motion explains."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel
from scanweld.registration.consistency.kernels import greedy_clique


@kernel
def grow_cliques(start, stop, adjacency, alive, sizes, members):
    """Grow a clique from each of the vertices start..stop; sizes (N,), and the first members in rows (N, K)."""
    clique = np.empty(adjacency.shape[0], np.int64)
    for seed in range(start, stop):
        size = greedy_clique(adjacency, alive, seed, clique)
        sizes[seed] = min(size, members.shape[1])
        for k in range(sizes[seed]):
            members[seed, k] = clique[k]


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
