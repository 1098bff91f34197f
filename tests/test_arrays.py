"""Validation at the boundary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.arrays import ROTATION_TOLERANCE, as_colors, as_points, as_transform, finite_rows
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
        ([1, 2, 3], r"a single point is cloud\[None\]$"),
        (np.zeros(7), r"got \(7,\)$"),
        (7.0, r"got \(\)$"),
        (np.zeros((5, 4)), r"got \(5, 4\); if the first columns are the coordinates: cloud\[:, :3\]$"),
        (np.zeros((5, 1)), r"got \(5, 1\)$"),
        (np.zeros((3, 1000)), r"got \(3, 1000\); did you mean cloud[.]T\?"),
        (np.zeros((2, 3, 1)), r"got \(2, 3, 1\)$"),
        (np.zeros((480, 640, 3)), r"an organised cloud is cloud[.]reshape\(-1, 3\)$"),
        ([["a", "b"]], "expected real numbers, got dtype <U1$"),
        (np.zeros((2, 3), dtype=complex), "got dtype complex128, complex numbers: numpy.stack"),
        (np.zeros((2, 3), dtype=bool), r"got dtype bool, a mask: select rows with it, points\[mask\]$"),
        (np.ones((2, 3), dtype=object), r"got dtype object; if all are numbers: numpy.asarray\(points, dtype=float\)$"),
        ([[1, 2], [3]], r"not a rectangular array of numbers \(rows differ in length\)$"),
        (None, "expected real numbers, got None$"),
        ({"x": 1}, "expected real numbers, got one dict$"),
        ("scan.ply", r"got one str; a file is read by read_points\(path\)$"),
        (Path("scan.ply"), r"got one \w+; a file is read by read_points\(path\)$"),
    ],
)
def test_what_is_no_point_set(points: object, words: str) -> None:
    with pytest.raises(InvalidInputError, match=words) as caught:
        as_points(points, "cloud")  # type: ignore[arg-type]
    assert str(caught.value).startswith("cloud: ")


def test_masked_entries_become_nan() -> None:
    points = np.ma.masked_less(np.arange(6).reshape(3, 2), 1)
    np.testing.assert_array_equal(as_points(points), [[np.nan, 1], [2, 3], [4, 5]])
    np.testing.assert_array_equal(as_points(np.ma.masked_array([[1, 2]], mask=False)), [[1, 2]])


def test_a_signalling_nan_is_a_nan() -> None:
    """0x7F800001: a NaN whose conversion to float64 raises the processor's invalid flag."""
    points = np.array([[0x7F800001, 0x3F800000]], np.uint32).view(np.float32)
    np.testing.assert_array_equal(as_points(points), [[np.nan, 1]])


@pytest.mark.parametrize(
    ("colors", "expected"),
    [
        (np.array([[1, 2, 3]], np.uint8), [[1, 2, 3]]),
        (np.array([[1, 2, 3, 200]], np.uint8), [[1, 2, 3]]),
        (np.array([[0, 257, 65535]], np.uint16), [[0, 1, 255]]),
        ([[-1, 100, 300]], [[0, 100, 255]]),
        ([[0, 0.5, 1.0]], [[0, 128, 255]]),
        ([[0, 0.5, 1.5]], [[0, 0, 2]]),
        ([[np.nan, np.inf, 1.0]], [[0, 0, 255]]),
        (np.empty((0, 3)), np.empty((0, 3))),
    ],
)
def test_colours_of_every_kind(colors: object, expected: object) -> None:
    """Half of 255 is 127.5, rounded to even: 128; 0.5 of 0..255 rounds to 0, 1.5 to 2."""
    whole = as_colors(colors)  # type: ignore[arg-type]
    assert whole.dtype == np.uint8
    np.testing.assert_array_equal(whole, expected)


@pytest.mark.parametrize("colors", [[1, 2, 3], [[1, 2]], [["red", "green", "blue"]]])
def test_what_is_no_colour(colors: object) -> None:
    with pytest.raises(InvalidInputError, match="paint: expected numbers of shape"):
        as_colors(colors, "paint")  # type: ignore[arg-type]


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
