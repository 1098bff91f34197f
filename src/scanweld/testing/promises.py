"""How a check says which promise was broken, and sees what a call has changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from scanweld.arrays import Float64

_RIGID = 1e-6  # largest entry of R^T R - I in what the library computes


def require(satisfied: bool | np.bool_, fault: str) -> None:
    """Raise AssertionError with what is wrong, unless the promise was kept; also where Python leaves out `assert`."""
    if not satisfied:
        raise AssertionError(fault)


def contents(value: Any) -> Any:
    """Return what a value holds, down to the bytes of its arrays, to be compared with `==`."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return [(key, contents(item)) for key, item in value.items()]
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    if is_dataclass(value):
        return [(field.name, contents(getattr(value, field.name))) for field in fields(value)]
    return contents(vars(value)) if hasattr(value, "__dict__") and not isinstance(value, type) else value


@contextmanager
def untouched(call: str, *arguments: Any) -> Iterator[None]:
    """Require that a block leaves the arguments of a call as they are."""
    before = contents(arguments)
    yield
    require(contents(arguments) == before, f"{call}: it has changed what it was given")


def require_array(value: Any, dtype: type, shape: tuple[int, ...], what: str) -> None:
    """Require an array of a type and shape, whose numbers are finite."""
    require(
        isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape,
        f"{what}: expected {np.dtype(dtype).name} {shape}, got {described(value)}",
    )
    require(np.isfinite(value).all(), f"{what}: a value is not finite")


def require_pose(T: Any, what: str) -> None:
    """Require a rigid transform (4, 4) float64."""
    require_array(T, np.float64, (4, 4), what)
    R: Float64 = T[:3, :3]
    rigid = np.abs(R.T @ R - np.eye(3)).max() < _RIGID and np.linalg.det(R) > 0
    require(rigid and np.array_equal(T[3], [0, 0, 0, 1]), f"{what}: not a rigid transform")


def described(value: Any) -> str:
    """Type and shape of an array, or the type of anything else."""
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
