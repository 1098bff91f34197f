"""Array aliases and the one place where arrays from outside are validated."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from scanweld.errors import InvalidInputError

Array: TypeAlias = npt.NDArray[Any]
Float32: TypeAlias = npt.NDArray[np.float32]
Float64: TypeAlias = npt.NDArray[np.float64]
UInt8: TypeAlias = npt.NDArray[np.uint8]
Int32: TypeAlias = npt.NDArray[np.int32]
Int64: TypeAlias = npt.NDArray[np.int64]
Bool: TypeAlias = npt.NDArray[np.bool_]

ROTATION_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is still a rotation (files print four to nine digits)."""


def as_points(points: npt.ArrayLike, name: str = "points", *, dimensions: tuple[int, ...] = (2, 3)) -> Float64:
    """Return `points` as a float64 array of shape (N, D), D in `dimensions`.

    The array is checked for its shape and dtype only; rows that are not finite are the caller's to drop
    (:func:`finite_rows`) or refuse, because their partners in other arrays must go with them.

    Raises
    ------
    InvalidInputError
        When the input is not numeric, not two-dimensional or has another number of columns.
    """
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise InvalidInputError(f"{name}: not a rectangular array ({error})") from None
    if array.dtype.kind not in "fiu":
        raise InvalidInputError(f"{name}: expected numbers, got dtype {array.dtype}")
    allowed = " or ".join(str(d) for d in dimensions)
    if array.ndim != 2 or array.shape[1] not in dimensions:
        hint = ""
        if array.ndim == 2 and array.shape[0] in dimensions and array.shape[1] not in dimensions:
            hint = f"; did you mean {name}.T?"
        raise InvalidInputError(f"{name}: expected shape (N, {allowed}), got {array.shape}{hint}")
    return np.ascontiguousarray(array, dtype=np.float64)


def finite_rows(*arrays: Array | None) -> Bool:
    """Mask (N,) of the rows that are finite in every given array; None stands for an absent array."""
    given = [a for a in arrays if a is not None]
    mask = np.ones(len(given[0]), dtype=np.bool_)
    for array in given:
        mask &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    return mask


def as_transform(transform: npt.ArrayLike, name: str = "T", *, dimension: int = 3) -> Float64:
    """Return a rigid transform as a float64 array (D + 1, D + 1), rotation checked and re-orthonormalised.

    Raises
    ------
    InvalidInputError
        When the shape is wrong, a value is not finite, the last row is not (0, .., 0, 1), or the upper left
        block is further than ``ROTATION_TOLERANCE`` from a rotation (a reflection and a scale are refused).
    """
    array = np.array(transform, dtype=np.float64)
    size = dimension + 1
    if array.shape != (size, size):
        raise InvalidInputError(f"{name}: expected shape ({size}, {size}), got {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name}: has values that are not finite")
    if not np.allclose(array[-1], np.eye(size)[-1], atol=1e-9):
        raise InvalidInputError(f"{name}: the last row must be (0, .., 0, 1), got {array[-1].tolist()}")
    rotation = array[:dimension, :dimension]
    defect = float(np.abs(rotation.T @ rotation - np.eye(dimension)).max())
    if defect > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InvalidInputError(
            f"{name}: not a rotation (|R^T R - I| = {defect:.2g}, det = {np.linalg.det(rotation):.3g}); "
            "scale and reflection do not belong in a rigid transform"
        )
    u, _, vt = np.linalg.svd(rotation)
    array[:dimension, :dimension] = u @ vt
    return array
