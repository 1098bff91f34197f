"""The doubled-surface measure, on surfaces built so that the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.evaluation.doubled_surfaces import doubled_surfaces

UP = np.array([0.0, 0.0, 1.0])


def sheet(rng: np.random.Generator, size_m: float = 1.0, spacing_m: float = 0.0125, noise_m: float = 0.0) -> np.ndarray:
    """Points (N, 3) of a square z = 0, a jittered grid, with noise along z."""
    line = np.arange(0, size_m, spacing_m)
    x, y = np.meshgrid(line, line)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points[:, :2] += rng.uniform(-0.3, 0.3, (len(points), 2)) * spacing_m
    points[:, 2] = noise_m * rng.standard_normal(len(points))
    return points


def facing(points: np.ndarray, normal: np.ndarray, rng: np.random.Generator, noise_deg: float = 3.0) -> np.ndarray:
    """Unit normals (N, 3) about a direction."""
    n = normal + np.deg2rad(noise_deg) * rng.standard_normal(points.shape)
    return n / np.linalg.norm(n, axis=1, keepdims=True)


@pytest.mark.parametrize("noise_m", [0.0, 0.002, 0.004])
@pytest.mark.parametrize("distance_m", [0.025, 0.03, 0.045])
def test_two_parallel_sheets_are_doubled(distance_m: float, noise_m: float) -> None:
    """All of both sheets but a rim, where no layer surrounds a point: radius 3.5..5 cm of 1 m, at most a fifth."""
    rng = np.random.default_rng(0)
    a, b = sheet(rng, noise_m=noise_m), sheet(rng, noise_m=noise_m) + distance_m * UP
    points = np.concatenate([a, b])
    result = doubled_surfaces(points, facing(points, UP, rng), max_points=4000)
    assert result.share > 0.85
    assert result.num_points == 4000
    assert len(result.points_m) == round(result.share * result.num_points)


def test_three_layers_are_doubled() -> None:
    rng = np.random.default_rng(9)
    points = np.concatenate([sheet(rng, noise_m=0.001) + k * 0.025 * UP for k in range(3)])
    assert doubled_surfaces(points, facing(points, UP, rng, noise_deg=2.0), max_points=3000).share > 0.85


def test_half_of_a_floor_is_doubled() -> None:
    """A second layer over a quarter of a square floor, 4 cm above: a quarter of the floor and the layer itself are
    doubled, (0.25 + 0.25) / 1.25 = 40 %, less a rim."""
    rng = np.random.default_rng(1)
    floor, part = sheet(rng, 2.0), sheet(rng, 1.0) + 0.04 * UP + np.array([0.5, 0.5, 0])
    points = np.concatenate([floor, part])
    result = doubled_surfaces(points, facing(points, UP, rng))
    assert 0.32 < result.share < 0.40
    inside = (result.points_m[:, :2] > 0.49) & (result.points_m[:, :2] < 1.51)
    assert inside.all()


def test_sheets_further_apart_than_the_distance_are_not_doubled() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([sheet(rng), sheet(rng) + 0.07 * UP])
    normals = facing(points, UP, rng, noise_deg=0.5)
    assert doubled_surfaces(points, normals).share == 0.0
    assert doubled_surfaces(points, normals, distance_m=0.08).share > 0.85


@pytest.mark.parametrize("noise_m", [0.0, 0.003, 0.01, 0.02])
def test_a_noisy_sheet_is_one_surface(noise_m: float) -> None:
    rng = np.random.default_rng(3)
    points = sheet(rng, noise_m=noise_m)
    assert doubled_surfaces(points, facing(points, UP, rng, noise_deg=6.0)).share < 0.005


def test_a_corner_is_not_doubled() -> None:
    rng = np.random.default_rng(4)
    floor, wall = sheet(rng, noise_m=0.002), sheet(rng, noise_m=0.002)[:, [2, 1, 0]]
    points = np.concatenate([floor, wall])
    normals = np.concatenate([facing(floor, UP, rng), facing(wall, np.array([1.0, 0, 0]), rng)])
    assert doubled_surfaces(points, normals).share == 0.0


def test_the_two_sides_of_a_thin_board_are_not_doubled() -> None:
    rng = np.random.default_rng(5)
    front, back = sheet(rng, noise_m=0.001), sheet(rng, noise_m=0.001) - 0.018 * UP
    points = np.concatenate([front, back])
    normals = np.concatenate([facing(front, UP, rng), facing(back, -UP, rng)])
    assert doubled_surfaces(points, normals).share == 0.0
    assert doubled_surfaces(points, facing(points, UP, rng)).share > 0.85  # the same, facing one way


def test_a_book_on_a_table_is_not_doubled() -> None:
    """The table under the book is not seen, so it is not in the map: 3 cm of step, and no overlap."""
    rng = np.random.default_rng(6)
    table = sheet(rng, noise_m=0.001)
    under = (np.abs(table[:, :2] - 0.5) < 0.15).all(axis=1)
    book = sheet(rng, 0.3, noise_m=0.001) + 0.03 * UP + np.array([0.35, 0.35, 0])
    points = np.concatenate([table[~under], book])
    assert doubled_surfaces(points, facing(points, UP, rng)).share < 0.01


def test_a_ball_and_a_tilted_sheet_are_single() -> None:
    rng = np.random.default_rng(7)
    normals = rng.standard_normal((4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert doubled_surfaces(0.15 * normals, normals).share == 0.0
    tilted = sheet(rng, noise_m=0.002)
    assert doubled_surfaces(tilted, facing(tilted, np.array([0.2, 0.0, 1.0]), rng)).share < 0.005


def test_the_answer_does_not_depend_on_density_threads_or_the_frame() -> None:
    rng = np.random.default_rng(8)
    for spacing in (0.004, 0.015):
        points = np.concatenate([sheet(rng, spacing_m=spacing), sheet(rng, spacing_m=spacing) + 0.03 * UP])
        normals = facing(points, UP, rng)
        result = doubled_surfaces(points, normals, max_points=3000)
        assert result.share > 0.8
        assert result.num_points == 3000
        assert doubled_surfaces(points, normals, max_points=3000, num_threads=2).share == result.share
        turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        moved = doubled_surfaces(points @ turned.T + 5.0, normals @ turned.T, max_points=3000)
        assert moved.share == pytest.approx(result.share, abs=0.05)


def test_what_is_no_map_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="empty"):
        doubled_surfaces(np.empty((0, 3)), np.empty((0, 3)))
    with pytest.raises(InvalidInputError, match="2 points, but 1 normals"):
        doubled_surfaces(np.zeros((2, 3)), np.ones((1, 3)))
    with pytest.raises(InvalidInputError, match="positive"):
        doubled_surfaces(np.zeros((2, 3)), np.ones((2, 3)), distance_m=0)
    alone = doubled_surfaces(np.zeros((1, 3)), UP[None])
    assert alone.share == 0.0
    holed = np.array([[0.0, 0, 0], [np.nan, 0, 0]])
    assert doubled_surfaces(holed, np.tile(UP, (2, 1))).num_points == 1
