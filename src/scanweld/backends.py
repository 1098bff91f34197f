"""Which implementation of the hot operations runs: compiled kernels, or plain NumPy to compare them with.

A package with such operations has a module `backends` that says what they are, and chooses by :func:`get_backend`
(docs/decisions/0016-backends.md).
"""

from __future__ import annotations

import os

from scanweld.errors import InvalidInputError

BACKENDS = ("numba", "numpy")
"""Compiled kernels, and the reference: slow, and written to be read."""

_backend = os.environ.get("SCANWELD_BACKEND") or "numba"


def get_backend() -> str:
    """Name of the implementation that is used.

    Raises
    ------
    InvalidInputError
        When the environment variable SCANWELD_BACKEND names none.
    """
    return _known(_backend, "SCANWELD_BACKEND")


def set_backend(name: str) -> None:
    """Use an implementation of the hot operations from now on: "numba", the default, or "numpy", the slow reference.

    Both give the same answers but for rounding. A run keeps to one of them: set it before.

    Raises
    ------
    InvalidInputError
        When there is no such implementation.
    """
    global _backend
    _backend = _known(name, "backend")


def _known(name: str, what: str) -> str:
    if name not in BACKENDS:
        raise InvalidInputError(f"{what}: expected {' or '.join(BACKENDS)}, got {name!r}")
    return name
