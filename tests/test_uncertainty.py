"""From the covariance of a motion to that of points."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.uncertainty import point_covariances


def result(T, covariance, scale=1.0):
    """An alignment with a covariance."""
    return RegistrationResult(
        T_target_source=T,
        status=Status.CONVERGED,
        information=np.eye(len(covariance)),
        covariance=covariance,
        scale=scale,
    )


def test_a_turn_moves_what_is_far_away():
    """A turn about z with a variance of 1e-4 rad^2, shifts known: a point 3 m out along x moves along y.

    Its variance is 3^2 * 1e-4 m^2; the origin does not move.
    """
    found = point_covariances(result(np.eye(4), np.diag([0, 0, 0, 0, 0, 1e-4])), [[3.0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(found[0], np.diag([0, 9e-4, 0]), atol=1e-18)
    np.testing.assert_allclose(found[1], 0)


def test_it_is_the_moved_point_that_counts():
    """The same turn after a shift by 2 m along y: the point (3, 0) stands at (3, 2), so dp = phi (-2, 3)."""
    T = np.array([[1.0, 0, 0], [0, 1, 2], [0, 0, 1]])
    found = point_covariances(result(T, np.diag([0, 0, 1e-4])), [[3.0, 0]])
    np.testing.assert_allclose(found[0], 1e-4 * np.array([[4, -6], [-6, 9]]), atol=1e-18)
    twice = point_covariances(result(T, np.diag([0, 0, 1e-4]), scale=2.0), [[1.5, 0]])
    np.testing.assert_allclose(twice, found)


def test_samples_agree():
    """Points moved by motions drawn from the covariance scatter as it says, to the accuracy of 20 000 draws."""
    rng = np.random.default_rng(0)
    root = 0.01 * rng.normal(size=(6, 6))
    T, point = se3.exp([1, 2, 3, 0.5, -0.2, 1]), np.array([0.5, -1, 2])
    expected = point_covariances(result(T, root @ root.T), point[None])[0]
    moved = np.array([se3.transform_points(se3.exp(root @ z) @ T, point) for z in rng.normal(size=(20_000, 6))])
    np.testing.assert_allclose(np.cov(moved.T), expected, atol=0.05 * np.trace(expected))


def test_no_claim_is_an_error():
    nothing = RegistrationResult(T_target_source=np.eye(4), status=Status.NO_OVERLAP, information=np.zeros((6, 6)))
    with pytest.raises(InvalidInputError, match=r"has no covariance \(status no_overlap\)"):
        point_covariances(nothing, np.zeros((1, 3)))
    with pytest.raises(InvalidInputError, match="points_m"):
        point_covariances(result(np.eye(4), np.eye(6)), np.zeros((1, 2)))
