"""Array aliases and the one place where arrays from outside are validated."""

from __future__ import annotations

import os
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

LARGEST_COORDINATE = 1e100
"""Squares of larger ones overflow; no unit of length makes them."""

ROTATION_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is still a rotation (files print four to nine digits)."""


def as_points(points: npt.ArrayLike, name: str = "points", *, dimensions: tuple[int, ...] = (2, 3)) -> Float64:
    """Return `points` as a float64 array of shape (N, D), D in `dimensions`.

    Integers are taken too; masked entries of a masked array become NaN. The array is checked for its shape and dtype
    only; rows that are not finite are the caller's to drop (:func:`finite_rows`) or refuse, because their partners
    in other arrays must go with them.

    Raises
    ------
    InvalidInputError
        When the input is not numeric, not two-dimensional or has another number of columns.
    """
    try:
        array = np.asarray(points)
    except (ValueError, TypeError, RuntimeError) as error:  # the last of tensors that are elsewhere
        reason = "rows differ in length" if "inhomogeneous" in str(error) else str(error).partition("\n")[0]
        raise InvalidInputError(f"{name}: not a rectangular array of numbers ({reason})") from None
    if array.dtype.kind not in "fiu":
        raise InvalidInputError(f"{name}: expected real numbers, got {_described(points, array)}")
    if array.ndim != 2 or array.shape[1] not in dimensions:
        allowed = " or ".join(str(d) for d in dimensions)
        raise InvalidInputError(
            f"{name}: expected shape (N, {allowed}), got {array.shape}{_shape_hint(name, array.shape, dimensions)}"
        )
    with np.errstate(invalid="ignore"):  # a float32 that is a signalling NaN is a NaN like any other
        converted = np.ascontiguousarray(array, dtype=np.float64)
    if isinstance(points, np.ma.MaskedArray) and np.ma.is_masked(points):
        converted = np.where(np.ma.getmaskarray(points), np.nan, converted)
    return converted


def refuse_giants(points: Float64, name: str) -> None:
    """Raise InvalidInputError where a coordinate is finite but too large to be squared."""
    if points.size and LARGEST_COORDINATE < max(float(points.max()), -float(points.min())) < np.inf:
        raise InvalidInputError(f"{name}: a coordinate is beyond {LARGEST_COORDINATE:g}; is a column no coordinate?")


def _described(points: object, array: Array) -> str:
    """Say what is no array of numbers, and what may help."""
    if array.ndim == 0 and array.dtype.kind in "OSU":
        hint = "; a file is read by read_points(path)" if isinstance(points, str | os.PathLike) else ""
        return f"{'None' if points is None else f'one {type(points).__name__}'}{hint}"
    hints = {
        "O": "; if all are numbers: numpy.asarray(points, dtype=float)",
        "b": ", a mask: select rows with it, points[mask]",
        "c": ", complex numbers: numpy.stack([z.real, z.imag], axis=1)",
    }
    return f"dtype {array.dtype}{hints.get(array.dtype.kind, '')}"


def _shape_hint(name: str, shape: tuple[int, ...], dimensions: tuple[int, ...]) -> str:
    """Say what may have been meant by an array of another shape."""
    if len(shape) == 1 and shape[0] in dimensions:
        return f"; a single point is {name}[None]"
    if len(shape) == 2 and shape[0] in dimensions:
        return f"; did you mean {name}.T?"
    if len(shape) == 2 and shape[1] > max(dimensions):
        return f"; if the first columns are the coordinates: {name}[:, :{max(dimensions)}]"
    if len(shape) == 3 and shape[2] in dimensions:
        return f"; an organised cloud is {name}.reshape(-1, {shape[2]})"
    return ""


def as_colors(colors: npt.ArrayLike, name: str = "colors") -> UInt8:
    """Return `colors` as uint8 of shape (N, 3), red, green, blue; a fourth column (alpha) is left out.

    Fractions from 0 to 1 and integers of 16 bits are scaled to 0..255; floats of which one is above 1 are taken as
    0..255. A value that is not finite becomes 0.

    Raises
    ------
    InvalidInputError
        When the input is not numeric or of another shape.
    """
    array = np.asarray(colors)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] not in (3, 4):
        raise InvalidInputError(f"{name}: expected numbers of shape (N, 3) or (N, 4), got {array.shape} {array.dtype}")
    channels = array[:, :3]
    if channels.dtype == np.uint8:
        return np.ascontiguousarray(channels)
    values = np.nan_to_num(channels.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    if channels.dtype.kind == "f":
        largest = 1.0 if values.max(initial=0.0) <= 1.0 else 255.0
    else:
        largest = 65535.0 if channels.dtype.itemsize == 2 else 255.0
    return np.clip(np.rint(values * (255.0 / largest)), 0, 255).astype(np.uint8)


def finite_rows(*arrays: Array | None) -> Bool:
    """Mask (N,) of the rows that are finite in every given array; None stands for an absent array."""
    given = [a for a in arrays if a is not None]
    mask = np.ones(len(given[0]), dtype=np.bool_)
    for array in given:
        finite = np.isfinite(array)
        if not finite.all():  # the usual case needs no look at the rows, which is ten times slower
            mask &= finite.all(axis=tuple(range(1, array.ndim)))
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
    with np.errstate(all="ignore"):  # an absurd entry is refused below
        defect = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(d)).max(axis=(1, 2), initial=0.0)
        determinant = np.linalg.det(rotation)
    bad = ~((defect <= ROTATION_TOLERANCE) & (determinant >= 0))
    if bad.any():
        k = int(np.argmax(bad))
        size = f"|R^T R - I| = {defect[k]:.2g}, det = {determinant[k]:.3g}"
        fail(bad, f"not a rotation ({size}); scale and reflection do not belong in a rigid transform")
    u, _, vt = np.linalg.svd(rotation)
    array[:, :d, :d] = u @ vt
    return array
