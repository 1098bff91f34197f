"""Sorted hash grid: the fast index for points on surfaces (docs/decisions, `kernels.md` K2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from threading import Lock

import numpy as np

from scanweld.arrays import Array, Float64, Int32, Int64
from scanweld.errors import InvalidInputError
from scanweld.geometry.neighbours import kernels
from scanweld.geometry.neighbours.kd_tree import KdTree
from scanweld.geometry.neighbours.many import kernels as many
from scanweld.parallel import limited_threads, run_ranges

OCCUPANCY = 8.0
"""Points that a point should see in its cell, itself included: fewer cells to visit against fewer points to measure."""

_OCCUPANCY_PER_NEIGHBOUR = 0.7  # the same where k neighbours are looked for in the cells around
_TRIALS = 8
_GRAIN = 2048  # queries that are worth a thread
_CELLS = 2.0**30  # along an axis: a cell's number is an int32 with room to spare
_HUGE = 1e300  # stands for no bound; kernels know no infinity


class HashGrid:
    """Points (M, D), M >= 1 and finite, sorted into cells; see :class:`~scanweld.geometry.neighbours.NeighbourIndex`.

    Parameters
    ----------
    points : (M, 2) or (M, 3) float64
    cell_m : side of a cell; found from the points when None
    num_threads : at most so many threads answer; all when None
    occupancy : points that a point should see in its cell, where the side is to be found

    Attributes
    ----------
    points : as given
    space : (M, 3), the same with z = 0 in 2-D
    rows, starts, lattice : what the kernels search, see :mod:`scanweld.geometry.neighbours.kernels`
    order : (M,) int64, sorted place -> row
    cell_m : side of a cell
    occupancy : points that a point sees in its cell, on average
    unevenness : the same over the mean of the cells in use: 1 to 3 on surfaces, more where the density varies
    """

    def __init__(
        self,
        points: Float64,
        cell_m: float | None = None,
        num_threads: int | None = None,
        occupancy: float = OCCUPANCY,
    ) -> None:
        self.points = np.ascontiguousarray(points, dtype=np.float64)
        if len(self.points) == 0:
            raise InvalidInputError("neighbours: expected at least one point, got none")
        self._num_threads = num_threads
        self.space = embedded(self.points)
        low, high = np.empty(3), np.empty(3)
        kernels.bounds(self.space, low, high)
        self._low, self._extent = low, high - low
        if not np.isfinite(self._extent).all():
            raise InvalidInputError("neighbours: some points are not finite; drop them first")
        self._buckets = np.empty(len(points), dtype=np.int32)
        self._settle(cell_m, occupancy)
        self.rows = np.empty((len(points), 4))
        kernels.place(self.space, self._buckets, self.starts, self.rows)
        del self._buckets
        self._lock = Lock()
        self._tree: KdTree | None = None
        self._regridded: HashGrid | None = None

    @property
    def order(self) -> Int64:
        return np.asarray(self.rows[:, 3].astype(np.int64))

    @property
    def sorted_points(self) -> Float64:
        """The points in the order of the cells (M, D)."""
        return self.rows[:, : self.points.shape[1]]

    def nearest(self, points: Float64, max_distance: float, hint: Array | None = None) -> tuple[Float64, Int64]:
        """See :class:`~scanweld.geometry.neighbours.NeighbourIndex`."""
        queries = embedded(points)
        partners = np.full(len(queries), -1, dtype=np.int32)
        if hint is not None:
            partners[:] = np.where(np.asarray(hint) < len(self.points), hint, -1)
        squared = np.empty(len(queries))
        self._run(len(queries), lambda a, b: self.nearest_into(queries, a, b, max_distance, partners, squared))
        none = partners < 0
        return np.where(none, np.inf, np.sqrt(squared)), np.where(none, len(self.points), partners).astype(np.int64)

    def nearest_into(
        self, points: Float64, start: int, stop: int, max_distance: float, partners: Int32, squared: Float64
    ) -> None:
        """See :class:`~scanweld.geometry.neighbours.NeighbourIndex`."""
        self.follow_into(points, start, stop, max_distance, partners, squared, np.empty((0, 4)), 0.0)

    def follow_into(
        self,
        points: Float64,
        start: int,
        stop: int,
        max_distance: float,
        partners: Int32,
        squared: Float64,
        anchors: Float64,
        slack_m: float,
    ) -> None:
        """Find the nearest points as :meth:`nearest_into`, of queries that move little from one call to the next.

        anchors : (N, 4), zero before the first call and then the caller's to keep, with `partners`, while the distance
            stays the same: where each query was searched for, and how far from there its partner cannot change
        slack_m : about how far the queries will move; each search looks so much further
        """
        if points.shape[1] == 2:
            rows = slice(start, stop)
            queries, own, distances, anchors = embedded(points[rows]), partners[rows], squared[rows], anchors[rows]
            start, stop = 0, len(queries)
        else:
            queries, own, distances = points, partners, squared
        unresolved = kernels.nearest(
            queries,
            start,
            stop,
            self.rows,
            self.starts,
            self.lattice,
            self.space,
            _inclusive_square(max_distance),
            own,
            distances,
            slack_m,
            anchors,
        )
        if unresolved:
            far = start + np.flatnonzero(own[start:stop] == kernels.UNRESOLVED)
            there = np.full(len(far), -1, dtype=np.int32)
            apart = np.zeros(len(far))
            wanted = np.ascontiguousarray(queries[far, : self.points.shape[1]])
            self.tree.nearest_into(wanted, 0, len(far), max_distance, there, apart)
            own[far], distances[far] = there, apart

    def k_nearest(self, points: Float64, k: int, max_distance: float = math.inf) -> tuple[Float64, Int64]:
        """See :class:`~scanweld.geometry.neighbours.NeighbourIndex`."""
        if k < 1:
            raise InvalidInputError(f"neighbours: expected k of at least 1, got {k}")
        grid = self.suited_to(k)
        queries = embedded(points)
        squared = np.empty((len(queries), k))
        indices = np.empty((len(queries), k), dtype=np.int64)
        gate = _inclusive_square(max_distance)

        def search(start: int, stop: int) -> None:
            many.k_nearest(queries, start, stop, k, gate, grid.rows, grid.starts, grid.lattice, squared, indices)

        self._run(len(queries), search)
        distances = np.where(indices < 0, np.inf, np.sqrt(squared))
        far = np.flatnonzero(indices[:, 0] == kernels.UNRESOLVED)
        indices[indices < 0] = len(self.points)
        if len(far):
            wanted = np.ascontiguousarray(queries[far, : self.points.shape[1]])
            distances[far], indices[far] = self.tree.k_nearest(wanted, k, max_distance)
        return distances, indices

    def within(self, points: Float64, radius: float) -> tuple[Int64, Int64]:
        """See :class:`~scanweld.geometry.neighbours.NeighbourIndex`."""
        queries = embedded(points)
        grid = self
        if not 0.2 < radius / self.cell_m < 4:
            grid = HashGrid(self.points, cell_m=_at_least(radius / 2, self._extent, len(self.points)))
        starts = np.zeros(len(queries) + 1, dtype=np.int64)
        bound = _inclusive_square(radius)

        def search(indices: Int64) -> Callable[[int, int], object]:
            return lambda a, b: many.within(queries, a, b, bound, grid.rows, grid.starts, grid.lattice, starts, indices)

        self._run(len(queries), search(np.empty(0, dtype=np.int64)))
        np.cumsum(starts, out=starts)
        indices = np.empty(starts[-1], dtype=np.int64)
        if len(indices):
            self._run(len(queries), search(indices))
        return starts, indices

    @property
    def tree(self) -> KdTree:
        """A k-d tree of the same points, for queries that are many cells away from all; built when first needed."""
        with self._lock:
            if self._tree is None:
                self._tree = KdTree(self.points, self._num_threads)
            return self._tree

    def suited_to(self, k: int) -> HashGrid:
        """Return this grid, or one of the same points whose cells are as large as k neighbours need."""
        wanted = max(_OCCUPANCY_PER_NEIGHBOUR * k, 4.0)
        if 0.8 * wanted <= self.occupancy <= 2.5 * wanted:
            return self
        with self._lock:
            if self._regridded is None or not 0.8 <= self._regridded._wanted / wanted <= 1.25:
                self._regridded = HashGrid(self.points, num_threads=self._num_threads, occupancy=wanted)
            return self._regridded

    def arranged(self, points: Float64) -> Float64:
        """Return queries (N, D) as (N, 4): x, y, z and their row, in the order of the cells."""
        queries = embedded(points)
        buckets = np.empty(len(queries), dtype=np.int32)
        starts = np.zeros_like(self.starts)
        rows = np.empty((len(queries), 4))
        kernels.tally(queries, self.lattice, buckets, starts)
        kernels.place(queries, buckets, starts, rows)
        return rows

    def _run(self, count: int, body: Callable[[int, int], object]) -> None:
        with limited_threads(self._num_threads):
            run_ranges(count, body, grain=_GRAIN)

    def _settle(self, cell_m: float | None, occupancy: float) -> None:
        """Choose the side of a cell and count the points of each."""
        self._wanted = occupancy
        count = len(self.points)
        if cell_m is not None:
            if not (np.isfinite(cell_m) and cell_m > 0):
                raise InvalidInputError(f"neighbours: expected a positive cell in metres, got {cell_m}")
            self._tally(_at_least(cell_m, self._extent, count))
            return
        x, y, z = np.sort(self._extent)[::-1]
        side = math.sqrt(max(2 * (x * y + y * z + z * x), x * x / count, 1e-300) * occupancy / count)
        tried: list[tuple[float, float]] = []
        for _ in range(_TRIALS):
            self._tally(_at_least(side, self._extent, count))
            tried.append((abs(math.log(self.occupancy / min(occupancy, count))), self.cell_m))
            if tried[-1][0] < 0.35 or (len(tried) > 1 and tried[-1][1] == tried[-2][1]):
                break
            side = self.cell_m * min(max(math.sqrt(min(occupancy, count) / self.occupancy), 0.1), 10.0)
        if min(tried)[1] != self.cell_m:
            self._tally(min(tried)[1])

    def _tally(self, cell_m: float) -> None:
        count = len(self.points)
        cells = np.floor(self._extent / cell_m) + 1
        largest = (1 << max(4, int(2 * count - 1).bit_length())) - 1
        self.cell_m = cell_m
        self.lattice = np.array([*self._low, 1 / cell_m, *cells, largest])
        self.starts = np.zeros(largest + int(cells[0]) + 2, dtype=np.int32)
        squares, used = kernels.tally(self.space, self.lattice, self._buckets, self.starts)
        self.occupancy = squares / count
        self.unevenness = self.occupancy * used / count


def embedded(points: Float64) -> Float64:
    """Points (N, 3) float64 in one piece; z = 0 in 2-D."""
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    return np.ascontiguousarray(points, dtype=np.float64)


def _at_least(cell_m: float, extent: Float64, count: int) -> float:
    """No more cells along x than twice the points, and no more along any axis than can be numbered."""
    return max(cell_m, float(extent[0]) / (2 * count + 16), float(extent.max()) / _CELLS, 1e-150)


def _inclusive_square(distance: float) -> float:
    """Largest d^2 whose root is not above `distance`."""
    if not distance >= 0:
        raise InvalidInputError(f"neighbours: expected a distance of at least 0 m, got {distance}")
    square = min(float(distance) ** 2 if distance < 1e150 else _HUGE, _HUGE)
    while math.sqrt(square) > distance:
        square = math.nextafter(square, 0.0)
    while square < _HUGE and math.sqrt(above := math.nextafter(square, math.inf)) <= distance:
        square = above
    return square
