"""The Protocol of a neighbour index, SciPy's k-d tree behind it, and the choice between tree and grid."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from scanweld.arrays import Array, Float64, Int32, Int64

TREE_BELOW = 512
"""Points up to which a tree is chosen: it is built at once, and Numba stays unloaded."""

_UNEVEN = 6.0  # points a point sees in its cell, over the mean of the cells in use; 1 to 3 on surfaces
_TIE = 1e-12  # relative; distances that may be equal are compared again
_LEAST = 1e-150  # its square is not yet 0


class NeighbourIndex(Protocol):
    """Finds the points of a cloud that are near others. Equal distances go to the lowest row.

    Queries are finite, of the cloud's dimension. The answer depends on nothing but the points: not on the kind of
    index, nor on the number of threads.
    """

    @property
    def points(self) -> Float64:
        """The cloud (M, D), M >= 1."""

    def nearest(self, points: Float64, max_distance: float, hint: Array | None = None) -> tuple[Float64, Int64]:
        """Return distances (N,) and rows (N,); inf and M where no point is within `max_distance`, itself included.

        hint : (N,) rows to start from, e.g. the last partners; -1 or M for none. It changes the time only.
        """

    def nearest_into(
        self, points: Float64, start: int, stop: int, max_distance: float, partners: Int32, squared: Float64
    ) -> None:
        """Find the nearest points of queries start..stop (N, D) in this thread, in the caller's arrays.

        partners (N,): a row to start from or -1 before, the nearest row or -1 after; squared (N,): distance squared,
        0 where there is no partner.
        """

    def k_nearest(self, points: Float64, k: int, max_distance: float = math.inf) -> tuple[Float64, Int64]:
        """Return distances and rows (N, k), ascending; inf and M where there are fewer than k within the distance."""

    def within(self, points: Float64, radius: float) -> tuple[Int64, Int64]:
        """Return starts (N + 1,) and rows: rows[starts[i]:starts[i + 1]] lie within `radius` of query i, ascending."""


class KdTree:
    """k-d tree of points (M, D), M >= 1: for clouds of uneven density, and small ones; `tree` where it is there."""

    def __init__(self, points: Float64, num_threads: int | None = None, *, tree: cKDTree | None = None) -> None:
        self.points = np.ascontiguousarray(points, dtype=np.float64)
        self.tree = cKDTree(self.points) if tree is None else tree
        self._workers = num_threads or -1

    def nearest(self, points: Float64, max_distance: float, hint: Array | None = None) -> tuple[Float64, Int64]:
        """See :class:`NeighbourIndex`; a hint does not help a tree."""
        distances, rows = self._search(points, 1, max_distance, self._workers)
        return distances[:, 0], rows[:, 0]

    def nearest_into(
        self, points: Float64, start: int, stop: int, max_distance: float, partners: Int32, squared: Float64
    ) -> None:
        """See :class:`NeighbourIndex`."""
        _, rows = self._search(points[start:stop], 1, max_distance, 1)
        found = rows[:, 0] < len(self.points)
        partners[start:stop] = np.where(found, rows[:, 0], -1)
        squared[start:stop] = 0.0
        squared[start:stop][found] = self._squared(points[start:stop][found], rows[found, 0])

    def k_nearest(self, points: Float64, k: int, max_distance: float = math.inf) -> tuple[Float64, Int64]:
        """See :class:`NeighbourIndex`."""
        return self._search(points, k, max_distance, self._workers)

    def within(self, points: Float64, radius: float) -> tuple[Int64, Int64]:
        """See :class:`NeighbourIndex`."""
        lists = self.tree.query_ball_point(points, radius * (1 + _TIE), workers=self._workers, return_sorted=True)
        counts = np.fromiter(map(len, lists), np.int64, len(lists))
        rows = np.concatenate([np.zeros(0, np.int64), *(np.asarray(one, np.int64) for one in lists)])
        query = np.repeat(np.arange(len(points)), counts)
        inside = np.sqrt(self._squared(points[query], rows)) <= radius
        counts = np.bincount(query[inside], minlength=len(points))
        return np.concatenate([[0], np.cumsum(counts)]), rows[inside]

    def _squared(self, points: Float64, rows: Int64) -> Float64:
        """Squared distances between points and rows of the cloud, as every index computes them."""
        difference = points - self.points[rows]
        total = difference[..., 0] * difference[..., 0]
        for axis in range(1, difference.shape[-1]):
            total = total + difference[..., axis] * difference[..., axis]
        return np.asarray(total)

    def _search(self, points: Float64, k: int, max_distance: float, workers: int) -> tuple[Float64, Int64]:
        """The k nearest, with one more looked at: where it is as near as the last, the row decides."""
        count = len(self.points)
        reach = max(max_distance * (1 + _TIE), _LEAST) if np.isfinite(max_distance) else np.inf
        found = min(k + 1, count)
        distances, rows = self.tree.query(
            points, k=np.arange(1, found + 1), distance_upper_bound=reach, workers=workers
        )
        present = rows < count
        squared = np.where(present, self._squared(points[:, None], np.where(present, rows, 0)), np.inf)
        present &= np.sqrt(squared) <= max_distance
        squared, rows = np.where(present, squared, np.inf), np.where(present, rows, count).astype(np.int64)
        if found > 1 and (squared[:, 1:] <= squared[:, :-1]).any():
            order = np.lexsort((rows, squared), axis=1)
            squared, rows = np.take_along_axis(squared, order, 1), np.take_along_axis(rows, order, 1)
        if found > k:
            tied = np.flatnonzero((squared[:, k] <= squared[:, k - 1] * (1 + 4 * _TIE)) & (rows[:, k] < count))
            if len(tied):
                radii = np.sqrt(squared[tied, k]) * (1 + _TIE)
                squared[tied, :k], rows[tied, :k] = self._break_ties(points[tied], k, radii)
        distances = np.full((len(points), k), np.inf)
        indices = np.full((len(points), k), count, dtype=np.int64)
        kept = min(k, found)
        distances[:, :kept], indices[:, :kept] = np.sqrt(squared[:, :kept]), rows[:, :kept]
        return distances, indices

    def _break_ties(self, points: Float64, k: int, radii: Float64) -> tuple[Float64, Int64]:
        """The k nearest, by row among equals, of all that lie within a radius that holds more than k."""
        places, members, starts = self._distinct
        squared, rows = np.empty((len(points), k)), np.empty((len(points), k), dtype=np.int64)
        for n, near in enumerate(places.query_ball_point(points, radii)):
            listed = np.concatenate([members[starts[one] : min(starts[one + 1], starts[one] + k)] for one in near])
            apart = self._squared(points[n], listed)
            chosen = np.lexsort((listed, apart))[:k]
            squared[n], rows[n] = apart[chosen], listed[chosen]
        return squared, rows

    @cached_property
    def _distinct(self) -> tuple[cKDTree, Int64, Int64]:
        """A tree of the different points; and the rows at each, members[starts[i]:starts[i + 1]], ascending."""
        places, inverse, counts = np.unique(self.points, axis=0, return_inverse=True, return_counts=True)
        members = np.argsort(inverse.ravel(), kind="stable")
        return cKDTree(places), members, np.concatenate([[0], np.cumsum(counts)])


def build_index(points: Float64, num_threads: int | None = None, reach_m: float | None = None) -> NeighbourIndex:
    """Index points (M, D), M >= 1, finite: a hash grid where one cell size fits all of them, else a k-d tree.

    The answers are the same. A few points get a tree; so do clouds whose density varies so much (a raw LiDAR scan)
    that the cells near the sensor would hold hundreds of points when those far away hold one.

    Parameters
    ----------
    reach_m : the largest distance that will be asked for, where it is known: with a reach of many cells a grid is
        chosen for even clouds only
    """
    if len(points) <= TREE_BELOW:
        return KdTree(points, num_threads)
    from scanweld.geometry.neighbours.grid import HashGrid  # loads Numba

    grid = HashGrid(points, num_threads=num_threads)
    uneven = grid.unevenness > _UNEVEN
    return KdTree(points, num_threads) if uneven else grid
