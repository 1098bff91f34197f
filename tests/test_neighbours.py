"""Neighbour indices: the same answers as brute force, to the last bit, from the hash grid and from the k-d tree."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from scanweld.errors import InvalidInputError
from scanweld.geometry.neighbours import KdTree, build_index
from scanweld.geometry.neighbours import kernels as K
from scanweld.geometry.neighbours.grid import HashGrid, embedded
from scanweld.geometry.neighbours.many import kernels as many
from scanweld.geometry.normals import estimate_normals, fit_surfaces, flatness
from scanweld.geometry.point_cloud import grid_order, median_spacing
from scanweld.parallel import set_num_threads
from scanweld.registration import correspondences

KINDS = ["gauss", "lattice", "line", "uneven", "far", "flat", "duplicates", "one place", "two clusters"]
INDICES = [HashGrid, KdTree]


def cloud(kind: str, count: int, dimension: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, dimension))
    if kind == "lattice":  # equal distances everywhere
        return np.round(points * 3) / 4
    if kind == "line":
        return np.outer(rng.uniform(size=count), np.arange(1, dimension + 1))
    if kind == "uneven":
        return points * 10 ** rng.uniform(-3, 3, (count, 1))
    if kind == "far":
        return points + 1e6
    if kind == "flat":
        return points * ([1.0] * (dimension - 1) + [1e-3])
    if kind == "duplicates":
        return points[rng.integers(0, max(count // 5, 1), count)]
    if kind == "one place":
        return np.ones((count, dimension))
    if kind == "two clusters":
        return points * 1e-3 + 1e3 * rng.integers(0, 2, (count, 1))
    return points


def queries_around(points: np.ndarray, seed: int) -> np.ndarray:
    """Points of the cloud, some beside them, and some far outside."""
    rng = np.random.default_rng(seed)
    some = points[rng.integers(0, len(points), 40)]
    scale = points.std(axis=0) + 1e-3
    far = points.mean(axis=0) + 20 * scale * rng.normal(size=(10, points.shape[1]))
    return np.concatenate([some, some + 0.05 * scale * rng.normal(size=some.shape), far])


def brute_distances(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    squared = np.zeros((len(queries), len(points)))
    for axis in range(points.shape[1]):
        squared += (queries[:, axis, None] - points[None, :, axis]) ** 2
    return squared


def brute_k_nearest(points: np.ndarray, queries: np.ndarray, k: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """A stable sort: the lowest row first among equals."""
    squared = brute_distances(points, queries)
    order = np.argsort(squared, axis=1, kind="stable")[:, :k]
    near = np.sqrt(np.take_along_axis(squared, order, axis=1))
    distances = np.full((len(queries), k), np.inf)
    rows = np.full((len(queries), k), len(points))
    distances[:, : order.shape[1]] = np.where(near <= reach, near, np.inf)
    rows[:, : order.shape[1]] = np.where(near <= reach, order, len(points))
    return distances, rows


cases = given(st.sampled_from(KINDS), st.integers(1, 900), st.integers(2, 3), st.integers(0, 10**6))


@pytest.mark.parametrize("make", INDICES)
@cases
def test_nearest_equals_brute_force(make, kind, count, dimension, seed):
    points = cloud(kind, count, dimension, seed)
    queries = queries_around(points, seed)
    index = make(points)
    hint = np.random.default_rng(seed).integers(-1, count + 1, len(queries))
    for reach in (np.inf, float(points.std()) / 4, 0.0):
        distances, rows = brute_k_nearest(points, queries, 1, reach)
        for guess in (None, hint):
            got = index.nearest(queries, reach, guess)
            np.testing.assert_array_equal(got[1], rows[:, 0])
            np.testing.assert_array_equal(got[0], distances[:, 0])


@pytest.mark.parametrize("make", INDICES)
@cases
def test_k_nearest_equals_brute_force(make, kind, count, dimension, seed):
    points = cloud(kind, count, dimension, seed)
    queries = queries_around(points, seed)
    index = make(points)
    for k, reach in ((1, np.inf), (7, float(points.std())), (20, np.inf), (count + 3, np.inf)):
        distances, rows = brute_k_nearest(points, queries, k, reach)
        got = index.k_nearest(queries, k, reach)
        np.testing.assert_array_equal(got[1], rows)
        np.testing.assert_array_equal(got[0], distances)


@pytest.mark.parametrize("make", INDICES)
@cases
def test_within_equals_brute_force(make, kind, count, dimension, seed):
    points = cloud(kind, count, dimension, seed)
    queries = queries_around(points, seed)
    index = make(points)
    for radius in (0.0, float(points.std()) / 3, float(points.std()) * 2):
        inside = np.sqrt(brute_distances(points, queries)) <= radius
        starts, rows = index.within(queries, radius)
        np.testing.assert_array_equal(starts, np.concatenate([[0], np.cumsum(inside.sum(axis=1))]))
        np.testing.assert_array_equal(rows, np.nonzero(inside)[1])


@pytest.mark.parametrize("make", INDICES)
def test_the_gate_is_inclusive(make):
    """|(0.3, 0, 0)| = 0.3 and |(3, 4, 12)| = 13: in at the distance, out one bit below it."""
    for point, distance in (([0.3, 0, 0], 0.3), ([3.0, 4, 12], 13.0), ([0.1, 0.2, 0.2], None)):
        distance = float(np.sqrt(np.sum(np.square(point)))) if distance is None else distance
        index = make(np.array([point, [100.0, 100, 100]]))
        assert index.nearest(np.zeros((1, 3)), distance)[1][0] == 0
        assert index.nearest(np.zeros((1, 3)), np.nextafter(distance, 0))[1][0] == 2


@pytest.mark.parametrize("cell", [0.01, 0.05, 0.3, 5.0])
@pytest.mark.parametrize("dimension", [2, 3])
def test_any_cell_gives_the_same_answer(cell, dimension):
    """Cells from a tenth of the spacing (queries give up and ask the tree) to one for all."""
    points = np.random.default_rng(0).uniform(size=(600, dimension))
    queries = np.random.default_rng(1).uniform(-1, 2, (200, dimension))
    grid = HashGrid(points, cell_m=cell)
    assert grid.cell_m == pytest.approx(cell)
    distances, rows = brute_k_nearest(points, queries, 9, np.inf)
    np.testing.assert_array_equal(grid.nearest(queries, np.inf)[1], rows[:, 0])
    squared = np.empty((200, 9))
    found = np.empty((200, 9), dtype=np.int64)
    arguments = (9, 1e300, grid.rows, grid.starts, grid.lattice, squared, found)
    unresolved = many.k_nearest(embedded(queries), 0, 200, *arguments)
    resolved = found[:, 0] >= 0
    assert unresolved == (found[:, 0] == K.UNRESOLVED).sum() == 200 - resolved.sum()
    np.testing.assert_array_equal(found[resolved], rows[resolved])
    np.testing.assert_array_equal(np.sqrt(squared[resolved]), distances[resolved])


def test_sorting_keeps_every_point_and_the_order_within_a_cell():
    points = np.random.default_rng(0).normal(size=(3000, 3))
    grid = HashGrid(points)
    np.testing.assert_array_equal(np.sort(grid.order), np.arange(3000))
    np.testing.assert_array_equal(grid.sorted_points, points[grid.order])
    assert (np.diff(grid.starts[: len(grid.starts) - 1]) >= 0).all()
    cells = np.floor((points - points.min(axis=0)) / grid.cell_m)[grid.order]
    same = (np.diff(cells, axis=0) == 0).all(axis=1)
    assert same.sum() > 1000
    assert (np.diff(grid.order)[same] > 0).all()


@pytest.mark.parametrize("kind", ["gauss", "flat", "far"])
def test_a_cell_holds_a_few_points(kind):
    grid = HashGrid(cloud(kind, 20_000, 3, 0))
    assert 4 < grid.occupancy < 16


def test_nearest_into_fills_its_range_only():
    points, queries = cloud("gauss", 2000, 3, 0), cloud("gauss", 100, 3, 1)
    expected = brute_k_nearest(points, queries, 1, 0.3)
    for index in (HashGrid(points), KdTree(points)):
        partners, squared = np.full(100, -1, np.int32), np.full(100, 7.0)
        partners[:10], partners[50:] = 3, 5
        index.nearest_into(queries, 10, 50, 0.3, partners, squared)
        rows = np.where(expected[1][:, 0] < 2000, expected[1][:, 0], -1)
        np.testing.assert_array_equal(partners[10:50], rows[10:50])
        np.testing.assert_allclose(np.sqrt(squared[10:50]), np.where(rows >= 0, expected[0][:, 0], 0)[10:50])
        assert (partners[:10] == 3).all()
        assert (partners[50:] == 5).all()
        assert (squared[:10] == 7).all()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", ["gauss", "lattice", "duplicates", "uneven"])
def test_followed_queries_get_the_partners_of_a_fresh_search(kind, dimension):
    """Queries that move by ever smaller steps, across the gate and back, from cell to cell: the same bytes."""
    points = cloud(kind, 3000, dimension, 0)
    queries = np.concatenate([queries_around(points, seed) for seed in range(8)])
    grid, rng, gate = HashGrid(points), np.random.default_rng(2), 0.3 * points.std(axis=0).min()
    partners, squared = np.full(len(queries), -1, np.int32), np.zeros(len(queries))
    anchors = np.zeros((len(queries), 4))
    for step in 0.3 * gate * 0.7 ** np.arange(25):
        queries = queries + step * rng.normal(size=queries.shape)
        grid.follow_into(queries, 0, len(queries), gate, partners, squared, anchors, 0.1 * gate)
        fresh, apart = np.full(len(queries), -1, np.int32), np.zeros(len(queries))
        grid.nearest_into(queries, 0, len(queries), gate, fresh, apart)
        assert partners.tobytes() == fresh.tobytes()
        assert squared.tobytes() == apart.tobytes()


def test_followed_queries_are_not_searched_for_again():
    """A query keeps its anchor while it moves less than its margin, half the lead over the second nearest point."""
    grid, query = HashGrid(np.array([[0.0, 0, 0], [1, 0, 0], [5, 5, 5]])), np.array([[0.2, 0, 0]])
    partners, squared, anchors = np.full(1, -1, np.int32), np.zeros(1), np.zeros((1, 4))
    grid.follow_into(query, 0, 1, 2.0, partners, squared, anchors, 10.0)
    np.testing.assert_allclose(anchors, [[0.2, 0, 0, 0.3]], rtol=1e-6)  # (0.8 - 0.2) / 2
    for x, anchor in ((0.45, 0.2), (0.55, 0.55)):
        grid.follow_into(np.array([[x, 0, 0]]), 0, 1, 2.0, partners, squared, anchors, 10.0)
        assert (partners[0], anchors[0, 0]) == (round(x), anchor)
        assert squared[0] == pytest.approx((x - round(x)) ** 2)


def test_sparse_places_are_fitted_like_the_others():
    """A dense floor, and so many points far apart that a coarser grid serves them."""
    rng = np.random.default_rng(0)
    floor = rng.uniform(-5, 5, (6000, 3)) * [1, 1, 0.01]
    points = np.concatenate([floor, rng.uniform(-200, 200, (300, 3))])
    grid, tree = (fit_surfaces(points, neighbours=12, index=kind(points)) for kind in INDICES)
    np.testing.assert_allclose(np.abs(np.einsum("nd,nd->n", grid.normals, tree.normals)), 1, atol=1e-9)
    np.testing.assert_allclose(grid.angular_variance, tree.angular_variance, rtol=1e-9)


def test_threads_do_not_change_a_byte():
    points = np.concatenate([cloud("flat", 20_000, 3, 0), cloud("uneven", 300, 3, 1)])
    queries = queries_around(points, 1)
    answers = []
    try:
        for threads in (1, 2, 8):
            set_num_threads(threads)
            grid = HashGrid(points)
            fit = fit_surfaces(points, index=grid)
            parts = [*grid.nearest(queries, 1.0), *grid.k_nearest(queries, 12), *grid.within(queries, 0.5)]
            answers.append([a.tobytes() for a in (*parts, fit.normals, fit.angular_variance, grid.rows)])
    finally:
        set_num_threads(2)
    assert answers[0] == answers[1] == answers[2]


def test_the_index_that_fits_is_chosen():
    assert isinstance(build_index(cloud("gauss", 100, 3, 0)), KdTree)
    assert isinstance(build_index(cloud("flat", 5000, 3, 0)), HashGrid)
    assert isinstance(build_index(cloud("uneven", 5000, 3, 0)), KdTree)
    assert correspondences.KdTree is KdTree


@pytest.mark.parametrize("dimension", [2, 3])
def test_normals_are_those_of_numpy(dimension):
    """Eigenvalues and smallest eigenvector of the covariance of SciPy's neighbours, from the grid and from the tree."""
    points = cloud("gauss", 3000, dimension, 0)
    _, near = cKDTree(points).query(points, k=12)
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(local, 1, 2) @ local / 12)
    apart = values[:, 1] > 1.05 * values[:, 0]
    for index in (HashGrid(points), KdTree(points)):
        fit = fit_surfaces(points, neighbours=12, index=index)
        cosine = np.abs(np.einsum("nd,nd->n", fit.normals, vectors[:, :, 0]))
        assert cosine[apart].min() > 1 - 1e-12
        np.testing.assert_allclose(fit.angular_variance, values[:, 0] / (12 * values[:, 1]), rtol=1e-9)
        round_or_flat = flatness(points, at=points, neighbours=12, index=index)
        np.testing.assert_allclose(round_or_flat, values[:, 0] / values[:, -1], rtol=1e-9)


@given(st.integers(0, 10**6), st.sampled_from(["any", "flat", "line", "round", "tiny"]))
def test_the_eigensolver_is_that_of_numpy(seed, kind):
    from scanweld.geometry.surfaces.kernels import smallest_of_three

    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    values = {
        "any": np.sort(rng.uniform(size=3)),
        "flat": np.array([0.0, *np.sort(rng.uniform(0.1, 1, 2))]),
        "line": np.array([0.0, 1e-9, 1.0]),
        "round": 1 + 1e-9 * np.sort(rng.uniform(size=3)),
        "tiny": 1e-12 * np.sort(rng.uniform(size=3)),
    }[kind]
    matrix = q @ np.diag(values) @ q.T
    matrix = (matrix + matrix.T) / 2
    low, middle, high, *vector = smallest_of_three(*matrix[np.triu_indices(3)])
    expected, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose([low, middle, high], expected, atol=4e-15 * expected[-1])
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(matrix @ vector, low * np.array(vector), atol=4e-15 * expected[-1])
    if expected[1] - expected[0] > 1e-3 * expected[-1]:
        assert abs(vectors[:, 0] @ vector) == pytest.approx(1, abs=1e-12)


def test_spacing_and_order_come_from_the_grid():
    pitch = np.stack(np.meshgrid(np.arange(40), np.arange(40)), axis=-1).reshape(-1, 2) * 0.25
    assert median_spacing(pitch, index=HashGrid(pitch)) == pytest.approx(0.25)
    points = np.random.default_rng(0).uniform(size=(5000, 3))
    order = grid_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(5000))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    assert np.median(steps) < 0.25 * np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
    assert len(grid_order(np.zeros((0, 3)))) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"points": np.zeros((0, 3))}, "at least one point"),
        ({"points": np.full((5, 3), np.nan)}, "not finite"),
        ({"points": np.array([[0.0, 0, 0], [0, np.inf, 0]])}, "not finite"),
        ({"points": np.ones((5, 3)), "cell_m": 0.0}, "cell"),
        ({"points": np.ones((5, 3)), "cell_m": np.nan}, "cell"),
    ],
)
def test_what_cannot_be_indexed_is_refused(arguments, words):
    with pytest.raises(InvalidInputError, match=words):
        HashGrid(**arguments)
    for distance in (-1.0, np.nan):
        with pytest.raises(InvalidInputError, match="at least 0 m"):
            HashGrid(np.ones((5, 3))).nearest(np.ones((1, 3)), distance)
    with pytest.raises(InvalidInputError, match="k of at least 1"):
        HashGrid(np.ones((5, 3))).k_nearest(np.ones((1, 3)), 0)


def test_a_tree_needs_no_numba():
    code = "import sys; from scanweld.geometry.neighbours import KdTree, build_index; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("scale", [1e-9, 1e6])
def test_scale_and_offset_together(scale):
    """Millimetres at UTM coordinates, and clouds in other units: the float32 of the blocks is relative to a cell."""
    points = scale * (cloud("flat", 3000, 3, 0) + [4e3, 5e3, 0])
    distances, rows = brute_k_nearest(points, points[:200], 10, np.inf)
    got = HashGrid(points).k_nearest(points[:200], 10)
    np.testing.assert_array_equal(got[1], rows)
    np.testing.assert_array_equal(got[0], distances)


def test_a_pile_of_duplicates_does_not_stop_the_tree():
    """A LiDAR's missing returns, all at the origin: 4000 of them in both clouds, and the lowest row wins."""
    points = np.concatenate([cloud("gauss", 1000, 3, 0), np.zeros((4000, 3))])
    tree = KdTree(points)
    distances, rows = tree.nearest(points, np.inf)
    np.testing.assert_array_equal(rows, np.minimum(np.arange(5000), 1000))
    assert (distances == 0).all()
    np.testing.assert_array_equal(tree.k_nearest(points[-5:], 6)[1], [np.arange(1000, 1006)] * 5)


def test_normals_of_a_cloud_with_lone_points():
    """A dense plane and a few points a hundred cells away: these take the way over the tree, with the same result."""
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(0, 1, (4000, 2)), np.zeros(4000)])
    points = np.concatenate([plane, 5 + 10 * rng.uniform(size=(8, 3))])
    grid, tree = HashGrid(points), KdTree(points)
    np.testing.assert_allclose(
        fit_surfaces(points, index=grid).normals, fit_surfaces(points, index=tree).normals, atol=1e-9
    )
    np.testing.assert_allclose(np.abs(estimate_normals(points)[:3900]), [[0, 0, 1]] * 3900, atol=1e-12)
