"""The closed form of many small problems at once, as random sampling needs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Array, Bool, Float64, Int64
from scanweld.errors import InvalidInputError
from scanweld.parallel import run_ranges
from scanweld.registration.closed_form import kernels as k
from scanweld.registration.closed_form.align import as_weights, scale_kind
from scanweld.registration.closed_form.fit import frozen, moment_rows
from scanweld.registration.closed_form.moments import kernels as m
from scanweld.registration.result import Status


@dataclass(frozen=True, slots=True)
class ClosedFormBatch:
    """Alignments of B problems; entry by entry what :func:`align_closed_form` says of each.

    Attributes
    ----------
    T_target_source : (B, D + 1, D + 1)
    scale : (B,)
    rmse_m : (B,) [m]
    rank : (B,) int64, number of singular values of W that are not zero, 0..D
    num_inliers, num_dropped : (B,) int64, pairs in use, and pairs that were not finite
    statuses : (B,) object, each a :class:`Status`
    """

    T_target_source: Float64
    scale: Float64
    rmse_m: Float64
    rank: Int64
    num_inliers: Int64
    num_dropped: Int64
    statuses: npt.NDArray[Any]

    @property
    def converged(self) -> Bool:
        """Mask (B,) of the problems that have an answer."""
        return np.asarray(self.statuses == Status.CONVERGED)

    def __len__(self) -> int:
        return len(self.scale)


def align_closed_form_batch(
    source: npt.ArrayLike, target: npt.ArrayLike, *, weights: npt.ArrayLike | None = None, scale: str = "none"
) -> ClosedFormBatch:
    """Align many sets of pairs, in parallel over the problems: row i of problem p with row i of problem p.

    Parameters
    ----------
    source, target : (B, N, D) [m], D >= 2. Fill problems of fewer pairs with NaN, or with weights of 0
    weights : (B, N), not negative; None counts all pairs alike
    scale : as in :func:`align_closed_form`

    Raises
    ------
    InvalidInputError
        When shapes do not match, weights are negative, or the scale is unknown.
    """
    a, b = _as_problems(source, "source"), _as_problems(target, "target")
    if a.shape != b.shape:
        raise InvalidInputError(f"target: expected the shape of source, {a.shape}, got {b.shape}")
    kind = scale_kind(scale)
    count, num_pairs, d = a.shape
    w = np.empty((count, 0)) if weights is None else as_weights(weights, (count, num_pairs))
    a, b, w = (frozen(array, np.float64) for array in (a, b, w))
    scalars, T = np.zeros((count, k.NUM_SCALARS)), np.tile(np.eye(d + 1), (count, 1, 1))

    def body(start: int, stop: int) -> None:
        k.align_problems(start, stop, a, b, w, kind, True, moment_rows(num_pairs, d), scalars, T)

    run_ranges(count, body)
    if scalars[:, m.INVALID].any():
        raise InvalidInputError("weights: expected finite values that are not negative")
    used = scalars[:, m.COUNT].astype(np.int64)
    lost = (kind != k.NO_SCALE) & (scalars[:, k.SCALE_FOUND] == 0)
    degenerate = (scalars[:, k.NUM_FREE] > 0) | (scalars[:, k.MIRRORED] > 0) | lost
    statuses = np.where(degenerate, np.array(Status.DEGENERATE, object), np.array(Status.CONVERGED, object))
    statuses[used < d] = Status.TOO_FEW_CORRESPONDENCES
    return ClosedFormBatch(
        T_target_source=T,
        scale=scalars[:, k.SCALE],
        rmse_m=np.sqrt(scalars[:, k.ERROR] / np.where(used > 0, scalars[:, m.WEIGHT], 1.0)),
        rank=scalars[:, k.RANK].astype(np.int64),
        num_inliers=used,
        num_dropped=scalars[:, m.DROPPED].astype(np.int64),
        statuses=statuses,
    )


def _as_problems(points: npt.ArrayLike, name: str) -> Float64:
    try:
        array: Array = np.asarray(points)
    except ValueError as error:
        raise InvalidInputError(f"{name}: not a rectangular array ({error})") from None
    if array.dtype.kind not in "fiu":
        raise InvalidInputError(f"{name}: expected numbers, got dtype {array.dtype}")
    if array.ndim != 3 or not 2 <= array.shape[2] <= 64:
        raise InvalidInputError(f"{name}: expected shape (B, N, D), D >= 2, got {array.shape}")
    return np.ascontiguousarray(array, dtype=np.float64)
