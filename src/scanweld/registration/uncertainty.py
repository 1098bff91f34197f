"""From the covariance of a motion to that of the places where it puts points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_points
from scanweld.errors import InvalidInputError
from scanweld.registration.residuals import point_jacobian
from scanweld.registration.result import RegistrationResult


def point_covariances(result: RegistrationResult, points_m: npt.ArrayLike) -> Float64:
    """Return the covariance (N, D, D) [m^2] of where an alignment puts source points (N, D) [m].

    It is J C J^T with the Jacobian J = [I | -[p']_x] of the moved point p' = s R p + t. The covariance of a motion is
    stated at the target's origin, where an uncertain rotation far away looks like an uncertain translation; that of a
    point of the scan is what a person wants to know. Directions in `result.unobservable` have no finite variance and
    are left out, and so is what an estimated scale (`scale_std`) adds.

    Raises
    ------
    InvalidInputError
        When the result makes no claim about its covariance, or the points have another dimension.
    """
    if result.covariance is None:
        raise InvalidInputError(f"result: has no covariance (status {result.status.value})")
    d = len(result.T_target_source) - 1
    points = as_points(points_m, "points_m", dimensions=(d,))
    moved = result.scale * points @ result.T_target_source[:d, :d].T + result.T_target_source[:d, d]
    jacobian = point_jacobian(moved)
    return np.asarray(jacobian @ result.covariance @ jacobian.transpose(0, 2, 1))
