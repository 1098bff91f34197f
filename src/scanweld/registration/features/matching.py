"""Which points of two clouds look alike: mutual nearest neighbours among their features.

Histograms are compared by their square roots (Hellinger distance), rounded to integers: sums of their products are
exact in float32, so the answer does not depend on how, or on how many threads, a matrix product is computed.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float32, Float64, Int64, as_points
from scanweld.errors import InvalidInputError

_ROWS = 1024  # of the distance matrix at a time: 40 MB against 10 000 features
_LARGEST_NORM = 2800  # squares of such lengths, times two, stay below 2^24, up to which float32 counts exactly


def match_features(source: npt.ArrayLike, target: npt.ArrayLike, *, candidates: int = 1) -> tuple[Int64, Int64]:
    """Pair features that are among each other's nearest.

    Parameters
    ----------
    source, target : (N, F), (M, F), histograms: no value is negative. Rows of zeros know nothing, and are left out
    candidates : K; a pair counts when each is one of the K nearest of the other. More pairs, more wrong ones

    Returns
    -------
    Rows of the source, ascending, and of the target: (P,) each

    Raises
    ------
    InvalidInputError
        When shapes do not match, or a value is negative or not finite.
    """
    forward, backward = nearest_features(source, target, candidates)
    return mutual_matches(forward, backward)


def nearest_features(source: npt.ArrayLike, target: npt.ArrayLike, count: int = 1) -> tuple[Int64, Int64]:
    """Return the nearest features of each in the other set, the nearest first, the lowest row where there is a tie.

    Parameters, errors : as for :func:`match_features`

    Returns
    -------
    Rows of the target (N, K) for each of the source, and rows of the source (M, K) for each of the target; -1 for rows
    of zeros. K is `count`, or fewer where there are no more
    """
    a, b = _histograms(source, "source", None), _histograms(target, "target", np.shape(source)[-1])
    rows, columns = np.flatnonzero(a.any(axis=1)), np.flatnonzero(b.any(axis=1))
    k = min(count, len(rows), len(columns))
    forward, backward = np.full((len(a), k), -1), np.full((len(b), k), -1)
    if k > 0:
        a_levels, b_levels = _levels(a[rows]), _levels(b[columns])
        forward[rows] = columns[_nearest(a_levels, b_levels, k)]
        backward[columns] = rows[_nearest(b_levels, a_levels, k)]
    return forward, backward


def mutual_matches(forward: Int64, backward: Int64) -> tuple[Int64, Int64]:
    """Return the pairs (P,) of rows that list each other; the arrays are those of :func:`nearest_features`."""
    i, j = np.repeat(np.arange(len(forward)), forward.shape[1]), forward.ravel()
    known = j >= 0
    i, j = i[known], j[known]
    mutual = (backward[j] == i[:, None]).any(axis=1)
    return i[mutual], j[mutual]


def _histograms(features: npt.ArrayLike, name: str, length: int | None) -> Float64:
    shape = np.shape(features)
    array = as_points(features, name, dimensions=(length or (shape[-1] if shape else 0),))
    if not (np.isfinite(array).all() and (array >= 0).all()):
        raise InvalidInputError(f"{name}: features are histograms, expected finite values that are not negative")
    return array


def _levels(histograms: Float64) -> Float32:
    """Square roots of the shares of the bins, as whole numbers."""
    shares = histograms / histograms.sum(axis=1, keepdims=True)
    return np.asarray(np.rint(np.sqrt(shares) * _LARGEST_NORM), dtype=np.float32)


def _nearest(queries: Float32, features: Float32, k: int) -> Int64:
    """Return the k nearest features of each query (N, k), ascending; the lowest index where there is a tie."""
    # |q - f|^2 = |q|^2 + |f|^2 - 2 q.f, of which |q|^2 does not matter; halved, all terms are exact.
    half = 0.5 * (features.astype(np.float64) ** 2).sum(axis=1)
    half = half.astype(np.float32)
    transposed = np.ascontiguousarray(features.T)
    found = np.empty((len(queries), k), np.int64)
    for start in range(0, len(queries), _ROWS):
        rows = slice(start, start + _ROWS)
        distances = half - queries[rows] @ transposed
        for rank in range(k):
            best = distances.argmin(axis=1)
            found[rows, rank] = best
            distances[np.arange(len(best)), best] = np.inf
    return found
