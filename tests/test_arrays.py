"""Validation at the boundary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.arrays import ROTATION_TOLERANCE, as_points, as_transform, finite_rows
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.uint8])
@pytest.mark.parametrize("columns", [2, 3])
def test_points_become_contiguous_float64(dtype: type, columns: int) -> None:
    given_points = np.arange(4 * columns).astype(dtype).reshape(columns, 4).T
    points = as_points(given_points)
    assert points.dtype == np.float64
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(points, given_points)


def test_points_from_lists_and_none_at_all() -> None:
    np.testing.assert_array_equal(as_points([[1, 2], [3, 4]]), [[1, 2], [3, 4]])
    assert as_points(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([1, 2, 3], r"expected shape \(N, 2 or 3\), got \(3,\)"),
        (np.zeros((5, 4)), r"got \(5, 4\)$"),
        (np.zeros((3, 100)), r"did you mean cloud[.]T\?"),
        ([["a", "b"]], "expected numbers"),
        (np.zeros((2, 3), dtype=complex), "expected numbers"),
        (np.zeros((2, 3), dtype=bool), "expected numbers"),
        ([[1, 2], [3]], "not a rectangular array"),
        (np.zeros((2, 3, 1)), "expected shape"),
    ],
)
def test_what_is_no_point_set(points: object, words: str) -> None:
    with pytest.raises(InvalidInputError, match=words) as caught:
        as_points(points, "cloud")  # type: ignore[arg-type]
    assert str(caught.value).startswith("cloud: ")


def test_finite_rows_of_several_arrays() -> None:
    a = np.array([[0, 1], [np.nan, 1], [2, 3], [4, 5]])
    b = np.array([1.0, 1.0, np.inf, 1.0])
    np.testing.assert_array_equal(finite_rows(a, None, b), [True, False, False, True])


@given(st.integers(0, 2**32 - 1))
def test_a_rigid_transform_is_kept(seed: int) -> None:
    T = se3.exp(np.random.default_rng(seed).normal(scale=2, size=6))
    np.testing.assert_allclose(as_transform(T), T, atol=1e-14)


@given(st.integers(0, 2**32 - 1))
def test_a_rounded_rotation_is_made_orthonormal(seed: int) -> None:
    """Five printed digits leave an error up to 1e-5, which is within the tolerance."""
    T = np.round(se3.exp(np.random.default_rng(seed).normal(size=6)), 5)
    before = T.copy()
    R = as_transform(T)[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert np.abs(R - T[:3, :3]).max() < ROTATION_TOLERANCE
    np.testing.assert_array_equal(T, before)


def test_transforms_in_the_plane() -> None:
    T = np.array([[0, -1, 3], [1, 0, 4], [0, 0, 1.0]])
    np.testing.assert_allclose(as_transform(T, dimension=2), T)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda T: T[:3], r"expected shape \(4, 4\), got \(3, 4\)"),
        (lambda T: T * np.nan, "not finite"),
        (lambda T: T + np.diag([0, 0, 0, 1.0]), "last row"),
        (lambda T: T @ np.diag([1, 1, -1, 1.0]), "det = -1"),
        (lambda T: T @ np.diag([1.01, 1.01, 1.01, 1]), "scale and reflection do not belong"),
        (lambda T: T @ np.diag([0, 0, 0, 1.0]), "not a rotation"),
    ],
)
def test_what_is_no_rigid_transform(change: object, words: str) -> None:
    T = se3.exp(np.array([1, 2, 3, 0.1, 0.2, 0.3]))
    with pytest.raises(InvalidInputError, match=words) as caught:
        as_transform(change(T), "T_init")  # type: ignore[operator]
    assert str(caught.value).startswith("T_init: ")
