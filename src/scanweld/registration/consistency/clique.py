"""The largest clique of a graph of consistent pairs: those that are all consistent with each other.

Exact by branch and bound within a budget that is counted in nodes, never in seconds: the answer does not depend on the
machine. Beyond the budget the best clique so far is returned, and said not to be proven.

Sources: R. Rossi, D. Gleich, A. Gebremedhin, "Parallel maximum clique algorithms with applications to network
analysis", 2015 (cores as bounds, one search for each vertex among those peeled after it). P. San Segundo et al., 2011
(see `kernels.branch_and_bound`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Int64
from scanweld.parallel import run_ranges
from scanweld.registration.consistency.kernels import (
    WORD,
    branch_and_bound,
    core_numbers,
    count_bits,
    count_promising,
    greedy_clique,
    induced,
)

UInt64 = npt.NDArray[np.uint64]

MAX_NODES = 100_000
"""Default budget of the exact search."""

_SEEDS = 24  # greedy cliques are grown from so many vertices of the highest cores
_LARGEST = 2048  # vertices of a subproblem that is searched exactly: 16 MB for each of the tables


@dataclass(frozen=True, slots=True)
class Clique:
    """Vertices that are all joined.

    Attributes
    ----------
    vertices : ascending
    proven : whether no larger one exists
    """

    vertices: Int64
    proven: bool

    def __len__(self) -> int:
        return len(self.vertices)


def largest_clique(
    adjacency: UInt64, *, alive: Bool | None = None, at_least: int = 1, max_nodes: int = MAX_NODES
) -> Clique:
    """Find the largest clique of a bit matrix (N, words).

    Parameters
    ----------
    alive : (N,), vertices to look at; all when None
    at_least : smaller cliques are not worth the search
    max_nodes : budget of the exact search; 0 grows cliques greedily only

    Returns
    -------
    One of the largest cliques, if there is one of `at_least` vertices; otherwise any.
    """
    count = len(adjacency)
    living = np.ones(count, np.bool_) if alive is None else alive
    graph = adjacency if alive is None else _restricted(adjacency, living)
    if not living.any():
        return Clique(np.empty(0, np.int64), True)
    degrees, order = np.empty(count, np.int64), np.empty(count, np.int64)
    run_ranges(count, lambda start, stop: count_bits(start, stop, graph, degrees))
    core = core_numbers(graph, count, degrees, order)
    best = np.array([int(np.flatnonzero(living)[0])])
    everyone = _bits(living)
    buffer = np.empty(count, np.int64)
    for seed in order[::-1][:_SEEDS]:
        if core[seed] < max(at_least - 1, len(best)):
            break
        size = greedy_clique(graph, everyone, seed, buffer)
        if size > len(best):
            best = buffer[:size].copy()
    if max_nodes <= 0:
        return Clique(np.sort(best), False)
    best, proven = _search(graph, order, core, best, max(at_least - 1, len(best)), max_nodes)
    return Clique(np.sort(best), proven)


def _search(graph: UInt64, order: Int64, core: Int64, best: Int64, bound: int, max_nodes: int) -> tuple[Int64, bool]:
    """Search exactly for more than `bound` vertices among each vertex's neighbours that are peeled after it."""
    rank, counts = np.empty_like(order), np.empty_like(order)
    rank[order] = np.arange(len(order))
    threshold = bound
    run_ranges(len(order), lambda a, b: count_promising(a, b, graph, order, rank, core, threshold, counts))
    proven = True
    for i in np.flatnonzero(counts >= bound)[::-1]:
        if counts[i] < bound:
            continue
        v = order[i]
        neighbours = _members(graph[v])
        neighbours = neighbours[(rank[neighbours] > i) & (core[neighbours] >= bound)]
        if len(neighbours) < bound:
            continue
        if len(neighbours) > _LARGEST or max_nodes <= 0:
            proven = False
            continue
        neighbours = neighbours[np.argsort(-core[neighbours], kind="stable")]
        small = np.empty((len(neighbours), -(-len(neighbours) // WORD)), np.uint64)
        induced(graph, neighbours, small)
        buffer = np.empty(len(neighbours) + 1, np.int64)
        # With v itself, more than bound - 1 of its neighbours make a larger clique.
        size, nodes = branch_and_bound(small, len(neighbours), bound - 1, max_nodes, buffer)
        proven &= nodes <= max_nodes
        max_nodes -= nodes + 1  # looking at a subproblem is not free either
        if size:
            best = np.append(neighbours[buffer[:size]], v)
            bound = len(best)
    return best, bool(proven)


def _restricted(adjacency: UInt64, alive: Bool) -> UInt64:
    graph = adjacency & _bits(alive)
    graph[~alive] = 0
    return np.asarray(graph)


def _bits(mask: Bool) -> UInt64:
    """Return a mask (N,) as a row of bits."""
    padded = np.zeros(-(-len(mask) // WORD) * WORD, np.bool_)
    padded[: len(mask)] = mask
    return np.packbits(padded, bitorder="little").view("<u8").astype(np.uint64)


def _members(row: UInt64) -> Int64:
    """Return the indices of the bits set in a row."""
    return np.flatnonzero(np.unpackbits(row.astype("<u8").view(np.uint8), bitorder="little"))
