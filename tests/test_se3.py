"""Rigid motions: the group axioms, the maps between group and algebra, and the files' quaternions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from scanweld.geometry import se3


def twists(max_angle: float = 3.1) -> st.SearchStrategy[np.ndarray]:
    """Twists (6,) with a rotation below pi, small and zero ones included."""

    def build(rho: list[float], axis: list[float], angle: float) -> np.ndarray:
        direction = np.array(axis)
        length = np.linalg.norm(direction)
        direction = direction / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
        return np.concatenate([rho, angle * direction])

    numbers = st.floats(-10, 10, allow_subnormal=False)
    angles = st.one_of(st.floats(0, max_angle), st.floats(0, 1e-3), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 0.02]))
    return st.builds(
        build, st.lists(numbers, min_size=3, max_size=3), st.lists(numbers, min_size=3, max_size=3), angles
    )


def generator(xi: np.ndarray) -> np.ndarray:
    """xi as a 4x4 matrix, built from the definition of the cross product."""
    rho, (a, b, c) = xi[:3], xi[3:]
    return np.array([[0, -c, b, rho[0]], [c, 0, -a, rho[1]], [-b, a, 0, rho[2]], [0, 0, 0, 0]])


@given(twists())
def test_exp_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(se3.exp(xi), expm(generator(xi)), atol=1e-12 * (1 + np.abs(xi).max()))


@given(twists())
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@pytest.mark.parametrize("angle", [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, 0.8), (-0.36, 0.48, -0.8)])
def test_exp_undoes_log_near_half_a_turn(angle, axis):
    """At pi both signs of the axis are the same rotation, so the transform is compared, not the twist."""
    T = se3.exp(np.concatenate([[1.0, -2.0, 0.5], angle * np.array(axis)]))
    xi = se3.log(T)
    np.testing.assert_allclose(se3.exp(xi), T, atol=1e-9)
    assert np.linalg.norm(xi[3:]) == pytest.approx(angle, abs=1e-7)


@given(twists(), twists(), twists())
def test_group_axioms(x, y, z):
    A, B, C = se3.exp(x), se3.exp(y), se3.exp(z)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-11)
    np.testing.assert_allclose(A @ se3.inverse(A), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(A[:3, :3].T @ A[:3, :3], np.eye(3), atol=1e-13)
    assert np.linalg.det(A[:3, :3]) == pytest.approx(1)


@given(twists(), twists(0.5))
def test_adjoint_moves_a_twist_across_a_transform(x, y):
    T = se3.exp(x)
    np.testing.assert_allclose(T @ se3.exp(y), se3.exp(se3.adjoint(T) @ y) @ T, atol=1e-9)


@given(twists())
def test_the_derivative_of_a_left_perturbation(x):
    """d(exp(xi) T p)/d(xi) at 0 is [I | -[T p]_x], by central differences."""
    T, p, h = se3.exp(x), np.array([0.3, -1.2, 2.0]), 1e-6
    moved = se3.transform_points(T, p)
    numeric = np.stack(
        [
            (se3.transform_points(se3.exp(e) @ T, p) - se3.transform_points(se3.exp(-e) @ T, p)) / (2 * h)
            for e in h * np.eye(6)
        ],
        axis=1,
    )
    np.testing.assert_allclose(numeric, np.hstack([np.eye(3), -se3.hat(moved)]), atol=1e-8)


@given(twists(), st.sampled_from([1.0, 1e-3, 0.0]))
def test_left_jacobian_is_the_change_of_the_logarithm(x, size):
    """d/de log(exp(e) exp(x)) at e = 0, by central differences."""
    x = np.concatenate([x[:3], size * x[3:]])
    T, h = se3.exp(x), 1e-5
    numeric = np.stack([(se3.log(se3.exp(e) @ T) - se3.log(se3.exp(-e) @ T)) / (2 * h) for e in h * np.eye(6)], axis=1)
    # Near half a turn the logarithm bends ever more, and the difference quotient with it.
    np.testing.assert_allclose(se3.left_jacobian_inverse(x), numeric, atol=1e-6 * (1 + np.abs(x).max()))


@given(twists())
def test_left_jacobian_of_rotations_is_the_corner_of_that_of_motions(x):
    corner = se3.left_jacobian_inverse(x)[3:, 3:]
    np.testing.assert_allclose(corner @ se3.left_jacobian_so3(x[3:]), np.eye(3), atol=1e-12)


@given(twists())
def test_left_jacobian_leaves_the_own_direction_alone(x):
    """exp(s x) exp(x) = exp((1 + s) x), so J^-1 x = x exactly."""
    np.testing.assert_allclose(se3.left_jacobian_inverse(x) @ x, x, atol=1e-11)


@pytest.mark.parametrize("angle", [0.5, 0.02])
def test_left_jacobian_is_continuous_where_its_formulas_change(angle):
    below, above = (
        se3.left_jacobian_inverse([1, 2, 3, 0, 0.6 * angle * f, 0.8 * angle * f]) for f in (1 - 1e-12, 1 + 1e-12)
    )
    np.testing.assert_allclose(below, above, atol=2e-11)


def test_small_and_large_angles_meet_where_the_formulas_change():
    for threshold in (1e-4, 0.02):
        below, above = (se3.exp(np.array([1, 2, 3, 0, 0, threshold * f])) for f in (1 - 1e-9, 1 + 1e-9))
        np.testing.assert_allclose(below, above, atol=1e-10)
        for T in (below, above):
            np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-14)


def test_every_function_is_batched():
    rng = np.random.default_rng(0)
    xi = rng.normal(size=(4, 5, 6))
    T = se3.exp(xi)
    one = se3.exp(xi[2, 3])
    np.testing.assert_array_equal(T[2, 3], one)
    np.testing.assert_allclose(se3.log(T)[2, 3], se3.log(one), atol=1e-15)
    np.testing.assert_array_equal(se3.inverse(T)[2, 3], se3.inverse(one))
    np.testing.assert_array_equal(se3.adjoint(T)[2, 3], se3.adjoint(one))
    np.testing.assert_allclose(se3.rotation_angle_rad(T)[2, 3], se3.rotation_angle_rad(one))
    np.testing.assert_allclose(se3.interpolate(T, T[0], np.full((4, 5), 0.3))[0, 1], T[0, 1], atol=1e-12)


@given(twists(), twists(1.5), st.floats(0, 1))
def test_interpolation_moves_at_constant_twist(x, y, s):
    A = se3.exp(x)
    B = se3.exp(y) @ A
    np.testing.assert_allclose(se3.interpolate(A, B, 0.0), A, atol=1e-11)
    np.testing.assert_allclose(se3.interpolate(A, B, 1.0), B, atol=1e-9)
    np.testing.assert_allclose(se3.interpolate(A, B, s), se3.exp(s * y) @ A, atol=1e-9)


@given(twists())
def test_quaternions_agree_with_scipy(x):
    R = se3.exp(x)[:3, :3]
    expected = Rotation.from_matrix(R).as_quat()
    expected = -expected if expected[3] < 0 else expected
    got = se3.quaternion_xyzw_from_rotation(R)
    # At half a turn w is 0 and both signs are right.
    assert min(np.abs(got - expected).max(), np.abs(got + expected).max()) < 1e-9
    np.testing.assert_allclose(se3.from_quaternion_xyzw(got, [1, 2, 3])[:3, :3], R, atol=1e-12)


def test_a_quaternion_by_hand():
    """Half a right angle about z: q = (0, 0, sin 22.5 deg, cos 22.5 deg), R = [[c, -c], [c, c]], c = sqrt(1/2)."""
    q = [0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)]
    c = np.sqrt(0.5)
    expected = np.array([[c, -c, 0, 2], [c, c, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]])
    np.testing.assert_allclose(se3.from_quaternion_xyzw(q, [2, 3, 4]), expected, atol=1e-15)
    np.testing.assert_allclose(se3.from_quaternion_xyzw(3 * np.array(q), [2, 3, 4]), expected, atol=1e-15)


def test_transforms_of_the_plane():
    T = np.array([[0.6, -0.8, 1.0], [0.8, 0.6, 2.0], [0, 0, 1]])
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(se3.transform_points(T, [[1.0, 0.0]]), [[1.6, 2.8]])


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e120, 1e200])
def test_a_rotation_beyond_all_bounds_is_none(value):
    """NaN, as of an array of rotations, which has no exceptions either."""
    with np.errstate(all="ignore"):
        assert np.isnan(se3.exp([0, 0, 0, value, 0, 0])[:3, :3]).all()


def test_arguments_are_not_modified():
    xi = np.array([1.0, 2, 3, 0.1, 0.2, 0.3])
    T = se3.exp(xi)
    keep = T.copy()
    se3.inverse(T), se3.log(T), se3.adjoint(T), se3.interpolate(T, np.eye(4), 0.5)
    np.testing.assert_array_equal(T, keep)
    np.testing.assert_array_equal(xi, [1, 2, 3, 0.1, 0.2, 0.3])
