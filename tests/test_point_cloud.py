"""Point clouds: construction, voxel means by hand, spacing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.errors import InvalidInputError
from scanweld.geometry.point_cloud import PointCloud, median_spacing, voxel_downsample


def test_voxels_average_points_normals_and_colours():
    """Voxels of 1 m from the smallest corner (0, 0, 0): rows 0 and 2 share one, row 1 is alone."""
    points = [[0.0, 0, 0], [2.5, 0, 0], [0.5, 0.5, 0]]
    normals = [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]
    colors = np.array([[10, 20, 31], [1, 2, 3], [20, 40, 60]], dtype=np.uint8)
    small = voxel_downsample(PointCloud(np.array(points), np.array(normals), colors), 1.0)
    np.testing.assert_allclose(small.points_m, [[0.25, 0.25, 0], [2.5, 0, 0]])
    np.testing.assert_allclose(small.normals, [[0, np.sqrt(0.5), np.sqrt(0.5)], [1, 0, 0]])
    np.testing.assert_array_equal(small.colors, [[15, 30, 46], [1, 2, 3]])  # 45.5 rounds to even


def test_opposite_normals_do_not_become_nothing():
    cloud = PointCloud(np.zeros((2, 3)), np.array([[0.0, 0, 1], [0, 0, -1]]))
    np.testing.assert_array_equal(voxel_downsample(cloud, 1.0).normals, [[0, 0, 1]])


@given(st.integers(0, 10**6), st.integers(2, 3), st.floats(0.05, 2))
def test_voxels_keep_the_mean_and_the_shape(seed, dimension, voxel):
    """Weighted by their counts the voxels' means give the cloud's mean; no two lie in one voxel."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(300, dimension))
    small = voxel_downsample(PointCloud(points), voxel).points_m
    cells, counts = np.unique(np.floor((points - points.min(axis=0)) / voxel), axis=0, return_counts=True)
    assert len(small) == len(cells)
    np.testing.assert_allclose(counts @ small / 300, points.mean(axis=0), atol=1e-12)
    local = (small - points.min(axis=0)) / voxel
    assert (local > cells - 1e-9).all()
    assert (local < cells + 1 + 1e-9).all()


@pytest.mark.parametrize("offset", [1e6, -5e6])
def test_far_clouds_give_the_same_points_moved(offset):
    points = np.random.default_rng(0).uniform(size=(2000, 3)).round(3)
    near = voxel_downsample(PointCloud(points), 0.07).points_m
    far = voxel_downsample(PointCloud(points + offset), 0.07).points_m
    assert abs(len(near) - len(far)) <= 2  # a coordinate on a voxel's face may round across
    if len(near) == len(far):
        np.testing.assert_allclose(far - offset, near, atol=1e-8)


def test_many_voxels_do_not_overflow():
    """A 1e7 m cloud in 1 um voxels has 1e39 of them, more than an integer can number."""
    points = np.array([[0.0, 0, 0], [1e7, 1e7, 1e7], [1e7, 1e7, 1e7 - 3e-7], [0, 0, 1]])
    small = voxel_downsample(PointCloud(points), 1e-6).points_m
    assert len(small) in (3, 4)
    np.testing.assert_allclose(small[0], 0)


def test_the_order_of_equal_input_is_the_same_twice():
    points = np.random.default_rng(0).normal(size=(5000, 3))
    one, two = (voxel_downsample(PointCloud(points.copy()), 0.1).points_m for _ in range(2))
    assert one.tobytes() == two.tobytes()


@pytest.mark.parametrize("voxel", [0, -1, np.nan, np.inf, 1e-300])
def test_impossible_voxels(voxel):
    with pytest.raises(InvalidInputError, match="voxel"):
        voxel_downsample(PointCloud(np.random.default_rng(0).normal(size=(5, 3))), voxel)


def test_rows_that_are_not_finite_are_left_out():
    cloud = PointCloud(np.array([[0.0, 0], [np.nan, 1], [3, 3]]))
    assert len(cloud.finite()) == 2
    assert len(voxel_downsample(cloud, 1.0)) == 2
    assert len(voxel_downsample(PointCloud(np.zeros((0, 3))), 1.0)) == 0


def test_spacing_of_a_grid_is_its_pitch():
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2) * 0.25
    assert median_spacing(grid) == pytest.approx(0.25)
    assert median_spacing(np.repeat(grid, 3, axis=0)) == pytest.approx(0.25)  # duplicates do not count


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((1, 3)), np.ones((50, 3))])
def test_points_in_one_place_have_no_spacing(points):
    assert median_spacing(points) == 0


def test_moving_a_cloud_moves_points_and_turns_normals():
    """90 degrees about z and twice as large: (1, 0, 0) -> (0, 2, 0) + t, the normal x -> y."""
    T = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    moved = PointCloud(np.array([[1.0, 0, 0]]), np.array([[1.0, 0, 0]])).transformed(T, scale=2)
    np.testing.assert_allclose(moved.points_m, [[5, 8, 7]])
    np.testing.assert_allclose(moved.normals, [[0, 1, 0]])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((np.zeros((4, 5)),), "points_m"),
        ((np.zeros((4, 3)), np.zeros((3, 3))), "normals"),
        ((np.zeros((4, 3)), np.zeros((4, 2))), "normals"),
        ((np.zeros((4, 3)), None, np.zeros((4, 3))), "colors"),
        ((np.zeros((4, 3)), None, np.zeros((3, 3), np.uint8)), "colors"),
    ],
)
def test_wrong_shapes_raise(arguments, words):
    with pytest.raises(InvalidInputError, match=words):
        PointCloud(*arguments)
