"""The contract of a neighbour index, as a test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanweld.arrays import Array, Float64, Int64
from scanweld.geometry.neighbours.kd_tree import NeighbourIndex
from scanweld.parallel import limited_threads
from scanweld.testing.promises import require, require_array, untouched


def check_neighbour_index(make: Callable[[Float64], NeighbourIndex]) -> None:
    """Check that an index keeps what :class:`~scanweld.geometry.neighbours.kd_tree.NeighbourIndex` promises.

    Its answers are those of brute force to the last bit, in two and in three dimensions, on clouds that tempt: lattices
    of equal distances, duplicates, one point, clusters far apart; distances are inclusive, the lowest row wins a tie,
    hints and threads change nothing, queries stay as they are.

    Parameters
    ----------
    make : makes an index of points (M, D), M >= 1

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    for points in _clouds():
        queries = _queries(points)
        index = make(points.copy())
        require_array(index.points, np.float64, points.shape, "points")
        require(np.array_equal(index.points, points), "points: not the cloud that was given")
        for count in (1, 3):
            with limited_threads(count):
                _check(index, points, queries)


def _clouds() -> list[Float64]:
    rng = np.random.default_rng(0)
    clouds: list[Float64] = []
    for dimension in (2, 3):
        even = rng.normal(size=(400, dimension))
        clouds += [
            even,
            np.round(even * 3) / 4,  # equal distances everywhere
            even[rng.integers(0, 100, 400)],
            even * 1e-3 + 1e3 * rng.integers(0, 2, (400, 1)),
            np.ones((30, dimension)),
            even[:1].copy(),
        ]
    return clouds


def _queries(points: Float64) -> Float64:
    """Points of the cloud, some beside them, and some far outside."""
    rng = np.random.default_rng(1)
    some = points[rng.integers(0, len(points), 30)]
    scale = points.std(axis=0) + 1e-3
    far = points.mean(axis=0) + 20 * scale * rng.normal(size=(10, points.shape[1]))
    return np.concatenate([some, some + 0.05 * scale * rng.normal(size=some.shape), far])


def _check(index: NeighbourIndex, points: Float64, queries: Float64) -> None:
    squared = np.zeros((len(queries), len(points)))
    for axis in range(points.shape[1]):
        difference = queries[:, axis, None] - points[None, :, axis]
        squared += difference * difference
    some = float(points.std()) / 3
    with untouched("a search", queries):
        for reach in (np.inf, some, 0.0):
            distances, rows = _nearest(squared, 1, reach)
            for hint in (None, np.arange(len(queries)) % (len(points) + 2) - 1):
                _require_same(
                    index.nearest(queries, reach, hint), (distances[:, 0], rows[:, 0]), f"nearest within {reach:g}"
                )
            _check_in_place(index, queries, reach, squared)
        for k, reach in ((1, np.inf), (5, some), (12, np.inf), (len(points) + 2, np.inf)):
            if reach == np.inf:
                _require_same(index.k_nearest(queries, k), _nearest(squared, k, reach), f"k_nearest, {k}")
            _require_same(
                index.k_nearest(queries, k, reach), _nearest(squared, k, reach), f"k_nearest, {k} within {reach:g}"
            )
        for radius in (0.0, some, 4 * some):
            inside = np.sqrt(squared) <= radius
            starts: Int64 = np.concatenate([[0], np.cumsum(inside.sum(axis=1))])
            _require_same(index.within(queries, radius), (starts, np.nonzero(inside)[1]), f"within {radius:g}")


def _check_in_place(index: NeighbourIndex, queries: Float64, reach: float, squared: Float64) -> None:
    """Only the queries that were asked for are answered, in the caller's arrays."""
    start, stop = 7, len(queries) - 9
    partners, apart = np.full(len(queries), -1, np.int32), np.full(len(queries), -5.0)
    index.nearest_into(queries, start, stop, reach, partners, apart)
    _, rows = _nearest(squared, 1, reach)
    found = rows[:, 0] < len(index.points)
    asked = (np.arange(len(queries)) >= start) & (np.arange(len(queries)) < stop)
    least = squared.min(axis=1)
    _require_same(
        (partners, apart),
        (
            np.where(asked & found, rows[:, 0], -1).astype(np.int32),
            np.where(asked, np.where(found, least, 0.0), -5.0),
        ),
        f"nearest_into within {reach:g}",
    )


def _nearest(squared: Float64, k: int, reach: float) -> tuple[Float64, Int64]:
    """Return the k nearest by brute force; a stable sort puts the lowest row first among equals."""
    order = np.argsort(squared, axis=1, kind="stable")[:, :k]
    near = np.sqrt(np.take_along_axis(squared, order, axis=1))
    distances, rows = np.full((len(squared), k), np.inf), np.full((len(squared), k), squared.shape[1], np.int64)
    distances[:, : order.shape[1]] = np.where(near <= reach, near, np.inf)
    rows[:, : order.shape[1]] = np.where(near <= reach, order, squared.shape[1])
    return distances, rows


def _require_same(got: tuple[Array, Array], expected: tuple[Array, Array], call: str) -> None:
    require(isinstance(got, tuple) and len(got) == 2, f"{call}: expected two arrays, got {type(got).__name__}")
    for part, (one, other) in enumerate(zip(got, expected, strict=True), 1):
        require(
            one.dtype == other.dtype and one.shape == other.shape,
            f"{call}: array {part}: expected {other.dtype} {other.shape}, got {one.dtype} {one.shape}",
        )
        wrong = np.argwhere(one != other)
        if len(wrong):
            place = tuple(wrong[0].tolist())
            raise AssertionError(
                f"{call}: array {part} differs from brute force in {len(wrong)} places, at {place}: expected "
                f"{other[place]!r}, got {one[place]!r}"
            )
