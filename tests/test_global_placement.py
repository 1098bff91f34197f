"""Placing surfaces without features: turns from the main directions, shifts from correlation."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.geometry import se3
from scanweld.registration.global_search.agreement import depth_map
from scanweld.registration.global_search.directions import dominant_directions, turns
from scanweld.registration.global_search.placement import place
from scanweld.registration.global_search.scan import prepare_scan


def noisy(directions: np.ndarray, counts: list[int], rng: np.random.Generator, deg: float = 4.0) -> np.ndarray:
    """Normals scattered about directions."""
    normals = np.repeat(directions, counts, axis=0)
    normals = normals + np.deg2rad(deg) * rng.standard_normal(normals.shape)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(se3.rotation_angle_rad(a.T @ b)))


def test_directions_are_found_with_their_shares() -> None:
    rng = np.random.default_rng(0)
    true = np.array([[0, 0, 1.0], [1, 0, 0], [0, 0.6, 0.8]])
    found, shares = dominant_directions(noisy(true, [500, 300, 200], rng))
    assert len(found) == 3
    np.testing.assert_allclose(found, true, atol=0.02)
    np.testing.assert_allclose(shares, [0.5, 0.3, 0.2], atol=0.05)


def test_points_without_normals_have_no_directions() -> None:
    directions, shares = dominant_directions(np.zeros((50, 3)))
    assert directions.shape == (0, 3)
    assert shares.shape == (0,)


@pytest.mark.parametrize("oriented", [True, False])
def test_turns_hold_the_true_one(oriented: bool) -> None:
    rng = np.random.default_rng(1)
    true = se3.exp_so3(rng.standard_normal(3))
    # A floor and two walls; the target saw another wall instead of one of them.
    source = noisy(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]), [400, 200, 200], rng)
    target = noisy(np.array([[0, 0, 1.0], [1, 0, 0], [0, -1, 0]]), [400, 200, 200], rng) @ true.T
    found = turns(source, target, oriented=oriented)
    np.testing.assert_allclose(np.swapaxes(found, 1, 2) @ found, np.broadcast_to(np.eye(3), found.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found), 1)
    assert min(angle_deg(true, turn) for turn in found) < 2


def test_no_turn_without_two_directions() -> None:
    rng = np.random.default_rng(2)
    wall = noisy(np.array([[0, 0, 1.0]]), [300], rng)
    assert turns(wall, wall, oriented=True).shape == (0, 3, 3)


def room(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points of a floor, two walls and two boxes, seen from a place, on rays at even steps; and that place."""
    viewpoint = np.array([2.0, 1.6, 1.5])
    rays = rng.standard_normal((60000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    best = np.full(len(rays), np.inf)
    for axis, at in ((0, 0.0), (1, 0.0), (2, 0.0)):
        t = (at - viewpoint[axis]) / rays[:, axis]
        best = np.where((t > 0) & (t < best), t, best)
    for low, high in (([0.5, 0.3, 0.0], [1.0, 1.2, 0.7]), ([1.4, 0.2, 0.0], [1.8, 0.6, 1.1])):
        a, b = (low - viewpoint) / rays, (high - viewpoint) / rays
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        best = np.where((enter < leave) & (enter > 0) & (enter < best), enter, best)
    kept = best < 4
    return viewpoint + rays[kept] * best[kept, None] + 0.003 * rng.standard_normal((kept.sum(), 3)), viewpoint


def test_a_shifted_and_turned_room_is_placed() -> None:
    rng = np.random.default_rng(3)
    points, viewpoint = room(rng)
    T = se3.exp([0.7, -0.4, 0.5, 0.3, 1.1, -0.6])
    moved, seen_from = se3.transform_points(se3.inverse(T), points), se3.transform_points(se3.inverse(T), viewpoint)
    source, target = prepare_scan(moved, 0.06, seen_from), prepare_scan(points, 0.06, viewpoint)
    views = depth_map(moved, seen_from), depth_map(points, viewpoint)
    rotations = turns(source.normals, target.normals, oriented=True)
    best = place(source, target, rotations, views, 5)[0]
    assert angle_deg(best[:3, :3], T[:3, :3]) < 3
    # A grid of three voxels: half a cell off along each axis.
    off = se3.transform_points(best, moved.mean(axis=0)) - se3.transform_points(T, moved.mean(axis=0))
    assert np.abs(off).max() < 0.2


def test_nothing_to_place_without_turns() -> None:
    points, viewpoint = room(np.random.default_rng(4))
    scan = prepare_scan(points, 0.1, viewpoint)
    assert place(scan, scan, np.empty((0, 3, 3)), (None, None), 5) == []
