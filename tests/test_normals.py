"""Normals: of a plane, a ball and a line, oriented, and zero where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.geometry.normals import estimate_normals, fit_surfaces, flatness


def ball(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_plane_has_one_normal(offset):
    """Points of x + 2 y + 2 z = 0: the normal is (1, 2, 2) / 3."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-1, 1, (2, 300, 1))
    points = u * [2, -1, 0] + v * [0, 1, -1] + offset
    np.testing.assert_allclose(estimate_normals(points), np.tile([1 / 3, 2 / 3, 2 / 3], (300, 1)), atol=1e-8)


def test_a_ball_has_radial_normals_that_face_the_viewer():
    points = ball(4000)
    outside = estimate_normals(points, viewpoint_m=[0, 0, 0])
    assert np.degrees(np.arccos(np.clip((outside * -points).sum(axis=1), -1, 1))).max() < 5
    far = np.array([0.0, 0, 10])
    seen = estimate_normals(points, viewpoint_m=far)
    assert ((seen * (far - points)).sum(axis=1) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1)


def test_a_line_of_the_plane():
    points = np.column_stack([np.linspace(0, 4, 100), np.linspace(0, 3, 100)])
    np.testing.assert_allclose(estimate_normals(points, viewpoint_m=[0, 10]), np.tile([-0.6, 0.8], (100, 1)), atol=1e-9)


@pytest.mark.parametrize("points", [np.linspace(0, 1, 50)[:, None] * [1.0, 2, 3], np.ones((50, 3)), np.ones((50, 2))])
def test_no_surface_has_no_normal(points):
    np.testing.assert_array_equal(estimate_normals(points), 0)


def test_chunks_and_threads_do_not_change_a_byte():
    points = ball(20_000) + 0.01 * np.random.default_rng(1).normal(size=(20_000, 3))
    one, two = (estimate_normals(points, neighbours=8, num_threads=n) for n in (1, 2))
    assert one.tobytes() == two.tobytes()
    np.testing.assert_allclose(fit_surfaces(points, neighbours=8, at=points[9000:9005]).normals,
                               fit_surfaces(points, neighbours=8).normals[9000:9005], atol=1e-12)  # fmt: skip


def test_the_variance_of_a_normal_is_that_of_its_scatter():
    """A plane with noise sigma: the fitted normals scatter by as much as their variance says, to a factor of 1.5."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 1, (20_000, 2)), 0.002 * rng.normal(size=20_000)])
    inner = points[(np.abs(points[:, :2] - 0.5) < 0.4).all(axis=1)]
    fit = fit_surfaces(points, at=inner)
    upright = fit.normals * np.sign(fit.normals[:, 2:])
    scatter = (upright[:, :2] ** 2).mean()
    assert fit.angular_variance.mean() == pytest.approx(scatter, rel=0.5)


def test_flatness_tells_a_surface_from_a_cloud():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(size=(3000, 3))
    assert np.median(flatness(cloud, at=cloud, neighbours=64)) > 0.4
    assert np.median(flatness(ball(3000), at=ball(3000), neighbours=64)) < 0.05


@pytest.mark.parametrize(
    ("points", "options", "words"),
    [
        (np.zeros((2, 3)), {}, "at least 3"),
        (np.zeros((9, 3)), {"neighbours": 2}, "at least 3"),
        (np.full((9, 3), np.nan), {}, "not finite"),
        (ball(9), {"viewpoint_m": [0, 0]}, "viewpoint_m"),
        (np.zeros((9, 4)), {}, "points_m"),
    ],
)
def test_wrong_input_raises(points, options, words):
    with pytest.raises(InvalidInputError, match=words):
        estimate_normals(points, **options)
