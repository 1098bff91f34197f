"""The worked example, and how large a set may be to be explained."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_points
from scanweld.errors import InvalidInputError

WORKED_SOURCE: Float64 = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (2, 0.5)], dtype=np.float64)
"""The five points of the worked example [m]."""

WORKED_TARGET: Float64 = np.array([(2.10, 2.71), (3.01, 3.72), (1.24, 3.79), (1.79, 4.56), (3.04, 4.63)])
"""The same points turned by 45 degrees, moved by (2, 3), with noise, rounded to 1 cm."""

MOST_POINTS = 200
"""Larger sets are not explained: their tables would not be read."""


def as_small_set(points: npt.ArrayLike, name: str) -> Float64:
    """Return points (N, D) that can be explained.

    Raises
    ------
    InvalidInputError
        When there are none or more than ``MOST_POINTS``, or a value is not finite.
    """
    array = as_points(points, name)
    if not 1 <= len(array) <= MOST_POINTS:
        raise InvalidInputError(f"{name}: only 1 to {MOST_POINTS} points can be explained, got {len(array)}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name}: has values that are not finite; drop those rows first")
    return array
