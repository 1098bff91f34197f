"""Point feature histograms and their matching."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.normals import estimate_normals
from scanweld.parallel import limited_threads
from scanweld.registration.features.fpfh import FPFH_LENGTH, compute_fpfh
from scanweld.registration.features.matching import match_features, nearest_features


def corner(count: int = 900, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on three walls with a ball before them, and their outward normals: every sign is known."""
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for axis in range(3):
        wall = rng.uniform(0, 1, (count // 4, 3))
        wall[:, axis] = 0
        points.append(wall)
        normals.append(np.tile(np.eye(3)[axis], (len(wall), 1)))
    ball = rng.standard_normal((count // 4, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points.append(0.5 + 0.25 * ball)
    normals.append(ball)
    return np.concatenate(points), np.concatenate(normals)


def reference_fpfh(points: np.ndarray, normals: np.ndarray, radius: float) -> np.ndarray:
    """FPFH with oriented normals, straight from the definition (Rusu et al. 2009), loops and all."""
    count = len(points)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    simplified = np.zeros((count, 33))
    for i in range(count):
        used = 0
        for j in np.flatnonzero(distance[i] <= radius):
            u, direction = normals[i], points[j] - points[i]
            if distance[i, j] == 0:
                continue
            direction = direction / distance[i, j]
            v = np.cross(direction, u)
            if np.linalg.norm(v) < 1e-9:
                continue
            v /= np.linalg.norm(v)
            w = np.cross(u, v)
            angles = (
                (v @ normals[j] + 1) / 2,
                (u @ direction + 1) / 2,
                np.arctan2(w @ normals[j], u @ normals[j]) / (2 * np.pi) + 0.5,
            )
            for block, place in enumerate(angles):
                centres = (np.arange(11) + 0.5) / 11
                shares = np.maximum(1 - np.abs(np.clip(place, centres[0], centres[-1]) - centres) * 11, 0)
                simplified[i, 11 * block : 11 * block + 11] += shares
            used += 1
        simplified[i] /= max(used, 1)
    result = simplified.copy()
    for i in range(count):
        near = [j for j in np.flatnonzero(distance[i] <= radius) if j != i]
        if near:
            weights = 1 / distance[i, near]
            result[i] += weights @ simplified[near] / weights.sum()
    return result


def test_kernel_equals_the_definition() -> None:
    points, normals = corner(240)
    computed = compute_fpfh(points, normals, 0.3, oriented=True)
    assert computed.shape == (240, FPFH_LENGTH)
    np.testing.assert_allclose(computed, reference_fpfh(points, normals, 0.3), atol=1e-9)


def test_a_plane_has_the_feature_of_a_plane() -> None:
    """On a plane alpha = phi = theta = 0, the middle of the middle bin, for the point and for all its neighbours:
    a count of 1 from the SPFH and 1 from the neighbours' mean, so 2 in bins 5, 16 and 27 and nothing elsewhere."""
    points = np.random.default_rng(0).uniform(0, 1, (200, 3)) * [1, 1, 0]
    expected = np.zeros(33)
    expected[[5, 16, 27]] = 2
    for oriented in (False, True):
        features = compute_fpfh(points, np.tile([0.0, 0, 1], (200, 1)), 0.3, oriented=oriented)
        np.testing.assert_allclose(features, np.tile(expected, (200, 1)), atol=1e-9)


def test_features_do_not_depend_on_the_pose() -> None:
    points, normals = corner()
    T = se3.exp([1.0, -2.0, 3.0, 0.4, -1.1, 0.7])
    moved = compute_fpfh(se3.transform_points(T, points), normals @ T[:3, :3].T, 0.25)
    np.testing.assert_allclose(moved, compute_fpfh(points, normals, 0.25), atol=1e-6)


def test_unoriented_features_do_not_depend_on_signs_and_oriented_ones_do() -> None:
    points, normals = corner()
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (len(points), 1))
    same = compute_fpfh(points, normals, 0.25)
    np.testing.assert_allclose(compute_fpfh(points, signs * normals, 0.25), same, atol=1e-9)
    inside_out = compute_fpfh(points, -normals, 0.25, oriented=True)
    assert np.abs(inside_out - compute_fpfh(points, normals, 0.25, oriented=True)).max() > 0.5


def test_points_without_normals_or_neighbours_have_no_feature() -> None:
    points, normals = corner()
    normals[7] = 0
    lonely = np.concatenate([points, [[50.0, 0, 0]]])
    features = compute_fpfh(lonely, np.concatenate([normals, [[0.0, 0, 1]]]), 0.25)
    assert not features[7].any()
    assert not features[-1].any()
    assert np.isfinite(features).all()
    rows, columns = match_features(features, features)
    assert 7 not in rows
    assert len(lonely) - 1 not in columns


def test_matching_finds_the_moved_points_of_a_noisy_scan() -> None:
    points, _ = corner(1600)
    rng = np.random.default_rng(2)
    T = se3.exp([0.3, 0.2, -0.4, 1.0, 0.5, -2.0])
    order = rng.permutation(len(points))
    moved = se3.transform_points(T, points[order]) + rng.normal(0, 0.002, points.shape)
    first, second = (compute_fpfh(p, estimate_normals(p, neighbours=15), 0.2) for p in (points, moved))
    i, j = match_features(first, second)
    error = np.linalg.norm(se3.transform_points(T, points[i]) - moved[j], axis=1)
    assert len(i) > 100
    assert (error < 0.03).mean() > 0.4  # of 1600 places, all of which may be chosen


def test_nearest_features_equal_brute_force() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.random((70, 33)), rng.random((50, 33))
    forward, backward = nearest_features(a, b, 3)
    root_a, root_b = (np.sqrt(f / f.sum(axis=1, keepdims=True)) for f in (a, b))
    distance = np.linalg.norm(root_a[:, None] - root_b[None], axis=2)
    for found, table in ((forward, distance), (backward, distance.T)):  # rounding may exchange what is as near
        np.testing.assert_allclose(np.take_along_axis(table, found, 1), np.sort(table, axis=1)[:, :3], atol=2e-3)
    i, j = match_features(a, b, candidates=3)
    pairs = {(r, c) for r in range(70) for c in forward[r] if r in backward[c]}
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == {(int(r), int(c)) for r, c in pairs}


def test_same_bytes_at_any_thread_count() -> None:
    points, normals = corner()
    results = []
    for threads in (1, 2, 8):
        with limited_threads(threads):
            results.append(compute_fpfh(points, normals, 0.25).tobytes())
    assert len(set(results)) == 1


@pytest.mark.parametrize(
    ("points", "normals", "radius", "message"),
    [
        (np.zeros((4, 2)), np.zeros((4, 3)), 1.0, "points_m: expected shape"),
        (np.zeros((4, 3)), np.zeros((3, 3)), 1.0, r"one per point \(4\), got 3"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), 1.0, "not finite"),
        (np.zeros((4, 3)), np.zeros((4, 3)), 0.0, "positive distance"),
    ],
)
def test_bad_input_of_features(points: np.ndarray, normals: np.ndarray, radius: float, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        compute_fpfh(points, normals, radius)


def test_bad_input_of_matching() -> None:
    with pytest.raises(InvalidInputError, match="histograms"):
        match_features(-np.ones((3, 33)), np.ones((3, 33)))
    with pytest.raises(InvalidInputError, match="target: expected shape"):
        match_features(np.ones((3, 33)), np.ones((3, 12)))
    rows, columns = match_features(np.zeros((0, 33)), np.ones((3, 33)))
    assert len(rows) == len(columns) == 0
    assert compute_fpfh(np.empty((0, 3)), np.empty((0, 3)), 1.0).shape == (0, FPFH_LENGTH)
