"""Residual rows: by hand, against finite differences, and the moments' shortcut against the rows."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.geometry import se3
from scanweld.registration.residuals import (
    normal_equations,
    point_equations,
    point_to_plane,
    point_to_point,
    rotation_generators,
)


def moved_by(xi: np.ndarray, points: np.ndarray) -> np.ndarray:
    """exp(xi) applied to points of the plane or of space."""
    if points.shape[1] == 3:
        return se3.transform_points(se3.exp(xi), points)
    T = se3.exp(np.array([xi[0], xi[1], 0, 0, 0, xi[2]]))
    return points @ T[:2, :2].T + T[:2, 3]


def finite_differences(function, size: int, h: float = 1e-6) -> np.ndarray:
    return np.stack([(function(e) - function(-e)) / (2 * h) for e in h * np.eye(size)], axis=-1)


def test_the_plane_distance_is_a_dot_product():
    """Golden case 1: n = (1, 1, 0) / sqrt 2, r = (1, -1, 0): n . r = 0; an element-wise product gives 1."""
    n = np.array([[1.0, 1.0, 0.0]]) / np.sqrt(2)
    residuals, _ = point_to_plane(np.array([[1.0, -1.0, 0.0]]), np.zeros((1, 3)), n)
    assert residuals == pytest.approx(0, abs=1e-16)


def test_a_plane_row_by_hand():
    """p' = (1, 2, 3), n = z, q = 0: r = 3 and n^T [I | -[p']_x] = (0, 0, 1, p'_y, -p'_x, 0)."""
    residuals, jacobian = point_to_plane(np.array([[1.0, 2, 3]]), np.zeros((1, 3)), np.array([[0.0, 0, 1]]))
    np.testing.assert_allclose(residuals, [3])
    np.testing.assert_allclose(jacobian, [[0, 0, 1, 2, -1, 0]])


@pytest.mark.parametrize(("dimension", "size"), [(2, 3), (3, 6)])
def test_jacobians_are_the_finite_differences(dimension, size):
    rng = np.random.default_rng(0)
    p, q, n = rng.normal(size=(3, 20, dimension))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    residuals, jacobian = point_to_plane(p, q, n)
    numeric = finite_differences(lambda xi: point_to_plane(moved_by(xi, p), q, n)[0], size)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)
    np.testing.assert_allclose(residuals, (n * (p - q)).sum(axis=1))
    residuals, jacobian = point_to_point(p, q)
    numeric = finite_differences(lambda xi: point_to_point(moved_by(xi, p), q)[0], size)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)
    np.testing.assert_allclose(residuals, p - q)


@pytest.mark.parametrize("dimension", [2, 3])
def test_point_equations_are_the_sums_of_the_rows(dimension):
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(2, 30, dimension)) + 5
    w = rng.uniform(0.1, 2, 30)
    residuals, jacobian = point_to_point(p, q)
    rows, values = jacobian.reshape(-1, jacobian.shape[2]), residuals.reshape(-1)
    each = np.repeat(w, dimension)
    equations = point_equations(p, q, w)
    np.testing.assert_allclose(equations.information, (each[:, None] * rows).T @ rows)
    np.testing.assert_allclose(equations.gradient, (each[:, None] * rows).T @ values)
    planes = normal_equations(p, residuals[:, 0], jacobian[:, 0], w)
    assert planes.total_weight == equations.total_weight == pytest.approx(w.sum())
    np.testing.assert_allclose(planes.centroid_m, w @ p / w.sum())
    np.testing.assert_allclose(equations.centroid_m, planes.centroid_m)
    np.testing.assert_allclose(equations.radius_m, planes.radius_m)


def test_generators_turn_the_axes_into_each_other():
    """In 3-D generator k is the cross product with e_k; in n-D there are n (n - 1) / 2 of them, antisymmetric."""
    p = np.array([1.0, 2, 3])
    for k, generator in enumerate(rotation_generators(3)):
        np.testing.assert_allclose(generator @ p, np.cross(np.eye(3)[k], p))
    np.testing.assert_allclose(rotation_generators(2)[0] @ [1, 0], [0, 1])
    five = rotation_generators(5)
    assert five.shape == (10, 5, 5)
    np.testing.assert_allclose(five, -five.transpose(0, 2, 1))
