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
    array = np.asarray(transform, dtype=np.float64)
    size = dimension + 1
    if array.shape != (size, size):
        raise InvalidInputError(f"{name}: expected shape ({size}, {size}), got {array.shape}")
    checked: Float64 = as_transforms(array[None], name)[0]
    return checked


def as_transforms(transforms: npt.ArrayLike, name: str = "T") -> Float64:
    """Return rigid transforms (N, D + 1, D + 1) as :func:`as_transform` does each; errors name the row."""
    array = np.array(transforms, dtype=np.float64)
    d = array.shape[-1] - 1

    def fail(bad: Any, what: str) -> None:
        if np.any(bad):
            where = name if len(array) == 1 else f"{name} {int(np.argmax(bad))}"
            raise InvalidInputError(f"{where}: {what}")

    fail(~np.isfinite(array).all(axis=(1, 2)), "has values that are not finite")
    last = np.eye(d + 1)[-1]
    fail((np.abs(array[:, -1] - last) > 1e-9).any(axis=1), "the last row must be (0, .., 0, 1)")
    rotation = array[:, :d, :d]
    defect = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(d)).max(axis=(1, 2), initial=0.0)
    determinant = np.linalg.det(rotation)
    bad = (defect > ROTATION_TOLERANCE) | (determinant < 0)
    if bad.any():
        k = int(np.argmax(bad))
        size = f"|R^T R - I| = {defect[k]:.2g}, det = {determinant[k]:.3g}"
        fail(bad, f"not a rotation ({size}); scale and reflection do not belong in a rigid transform")
    u, _, vt = np.linalg.svd(rotation)
    array[:, :d, :d] = u @ vt
    return array
