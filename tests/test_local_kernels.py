"""Kernels of the local methods: each row against its NumPy reference, references against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.geometry import se3
from scanweld.registration import residuals
from scanweld.registration.local import kernels
from scanweld.registration.robust import Barron, RobustKernel, robust_kernel

THICKNESS = 1e-3


class Pairs:
    """Random pairs with normals, colours and a few points without a partner."""

    def __init__(self, seed: int, count: int = 1300) -> None:
        rng = np.random.default_rng(seed)
        self.source = rng.normal(size=(count, 3))
        self.target = rng.normal(size=(count + 7, 3))
        self.partner = rng.integers(0, len(self.target), count).astype(np.int32)
        self.partner[::11] = -1
        self.T = se3.exp(rng.normal(size=6))
        self.moved = np.empty_like(self.source)
        kernels.move_points(0, count, self.source, self.T[:3].copy(), self.moved)
        self.normals = self.unit(rng.normal(size=self.target.shape))
        self.source_normals = self.unit(rng.normal(size=self.source.shape))
        near = self.partner >= 0  # half of the pairs have almost equal normals, as scans do
        some = np.flatnonzero(near)[::2]
        turned = self.normals[self.partner[some]] + 1e-3 * rng.normal(size=(len(some), 3))
        self.source_normals[some] = self.unit(turned @ self.T[:3, :3])
        exact = some[::10]
        self.source_normals[exact] = self.normals[self.partner[exact]] @ self.T[:3, :3]
        gradients = rng.normal(size=self.target.shape)
        gradients -= (gradients * self.normals).sum(axis=1, keepdims=True) * self.normals
        self.colour = (rng.uniform(size=count), rng.uniform(size=len(self.target)), gradients)
        self.weights = rng.uniform(0, 2, count)

    @staticmethod
    def unit(v: np.ndarray) -> np.ndarray:
        return v / np.linalg.norm(v, axis=1, keepdims=True)

    @property
    def used(self) -> np.ndarray:
        return np.flatnonzero(self.partner >= 0)

    def arguments(self):
        R = np.ascontiguousarray(self.T[:3, :3])
        return self.target, self.normals, self.source_normals, R, self.colour, THICKNESS

    def sums(self, metric, weights, noise, robust):
        chunks = -(-len(self.source) // kernels.CHUNK)
        partials = np.empty((chunks, kernels.SUMS))
        target, *rest = self.arguments()
        code = np.array(robust, float)
        kernels.pair_sums(metric, 0, chunks, self.moved, self.partner, weights, target, *rest, noise, code, partials)
        total = partials.sum(axis=0)
        full = np.zeros((8, 8))
        full[np.triu_indices(8)] = total[:36]
        return full + np.triu(full, 1).T, total[36:]


def with_scale(jacobian: np.ndarray, slope: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Append the column of the log scale: d p' / d log s = p'."""
    return np.column_stack([jacobian, np.einsum("nd,nd->n", slope, moved)])


def reference_rows(pairs: Pairs, metric: int):
    """Rows (J, r) of the geometric residual, stacked over the components, as (components, N, 8)."""
    rows = pairs.used
    p, j = pairs.moved[rows], pairs.partner[rows]
    q, n = pairs.target[j], pairs.normals[j]
    m = pairs.source_normals[rows] @ pairs.T[:3, :3].T
    if metric == kernels.POINT:
        r, J = residuals.point_to_point(p, q)
        parts = [(with_scale(J[:, a], np.eye(3)[[a] * len(p)], p), r[:, a]) for a in range(3)]
    elif metric == kernels.SYMMETRIC:
        r, J = residuals.symmetric(p, q, n, m)
        parts = [(with_scale(J, J[:, :3], p), r)]
    else:
        r, J = residuals.point_to_plane(p, q, n)
        parts = [(with_scale(J, n, p), r)]
    return np.stack([np.column_stack([J, r]) for J, r in parts])


def coloured_rows(pairs: Pairs, noise: np.ndarray, kernel: RobustKernel):
    """Rows (2, N, 8), plane and colour, and their weights (2, N) in units of the geometric noise."""
    rows = pairs.used
    p, j = pairs.moved[rows], pairs.partner[rows]
    grey, target_grey, gradients = pairs.colour
    r, J = residuals.coloured(p, pairs.target[j], pairs.normals[j], gradients[j], target_grey[j] - grey[rows])
    colour = np.column_stack([with_scale(J, J[:, :3], p), r])
    both = np.stack([reference_rows(pairs, kernels.PLANE)[0], colour])
    weights = [kernel.weight(both[k, :, 7] / noise[k]) * (noise[0] / noise[k]) ** 2 for k in range(2)]
    return both, np.stack(weights)


def test_moved_points_are_turned_and_shifted():
    """x' = A x + t with A = 2 (a quarter turn about z) and t = (11, 20, 30), of the rows asked for only."""
    points = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9]])
    transform = np.array([[0.0, -2, 0, 11], [2, 0, 0, 20], [0, 0, 2, 30]])
    moved = np.zeros((3, 3))
    kernels.move_points(1, 3, points, transform, moved)
    np.testing.assert_array_equal(moved, [[0, 0, 0], [1, 28, 42], [-5, 34, 48]])


@pytest.mark.parametrize("metric", [kernels.POINT, kernels.PLANE, kernels.SYMMETRIC])
@pytest.mark.parametrize("name", ["none", "huber", "cauchy", "geman_mcclure", "tukey", "welsch"])
def test_sums_equal_the_reference(metric, name):
    pairs = Pairs(0)
    noise = np.array([0.4, 1.0])
    rows = reference_rows(pairs, metric)
    kernel = robust_kernel(name)
    size = np.sqrt((rows[:, :, 7] ** 2).sum(axis=0)) / noise[0]
    weights = kernel.weight(size) * pairs.weights[pairs.used]
    full, moments = pairs.sums(metric, pairs.weights, noise, kernel.compiled(size))
    expected = np.einsum("cna,n,cnb->ab", rows, weights, rows)
    np.testing.assert_allclose(full, expected, rtol=1e-11, atol=1e-9)
    moved = pairs.moved[pairs.used]
    expected = [weights.sum(), *(weights @ moved), weights @ (moved**2).sum(axis=1), len(moved)]
    np.testing.assert_allclose(moments, expected, rtol=1e-11)


def test_generalised_rows_make_the_information_of_the_discs():
    """sum of the three rows' outer products with d = p' - q must be d^T M d, its slope M, for equal normals, too."""
    pairs = Pairs(1)
    rows = pairs.used
    p, j = pairs.moved[rows], pairs.partner[rows]
    d, n = p - pairs.target[j], pairs.normals[j]
    m = pairs.source_normals[rows] @ pairs.T[:3, :3].T
    M = residuals.generalised_information(n, m, THICKNESS)
    full, _ = pairs.sums(kernels.GENERALISED, np.zeros(0), np.ones(2), (0, 0, 0))
    J = residuals.point_jacobian(p)
    J = np.concatenate([J, p[:, :, None]], axis=2)
    np.testing.assert_allclose(full[:7, :7], np.einsum("nak,nab,nbl->kl", J, M, J), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(full[:7, 7], np.einsum("nak,nab,nb->k", J, M, d), rtol=1e-9, atol=1e-9)
    assert full[7, 7] == pytest.approx(np.einsum("na,nab,nb->", d, M, d), rel=1e-10)


def test_colour_rows_are_added_in_units_of_the_geometric_noise():
    pairs = Pairs(2)
    noise, kernel = np.array([0.3, 0.7]), robust_kernel("cauchy")
    rows, weights = coloured_rows(pairs, noise, kernel)
    full, _ = pairs.sums(kernels.COLOURED, np.zeros(0), noise, kernel.compiled(rows[1, :, 7]))
    np.testing.assert_allclose(full, np.einsum("cna,cn,cnb->ab", rows, weights, rows), rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("metric", [kernels.POINT, kernels.PLANE, kernels.SYMMETRIC, kernels.GENERALISED])
def test_scores_of_the_targets_add_up_to_the_gradient(metric):
    pairs = Pairs(3)
    noise, robust = np.array([0.4, 1.0]), np.array([2.0, 2.3849, 0.0])
    target, *rest = pairs.arguments()
    full, _ = pairs.sums(metric, pairs.weights, noise, robust)
    bread = np.linalg.inv(full[:7, :7])

    def scores(stride, count):
        rows = np.zeros((count, 8))
        kernels.add_scores(
            metric, stride, pairs.moved, pairs.partner, pairs.weights, target, *rest, noise, robust, bread, rows
        )
        return rows

    by_target, by_source = scores(1, len(target)), scores(0, len(pairs.source))
    for rows in (by_target, by_source):
        np.testing.assert_allclose(rows[:, :7].sum(axis=0), full[:7, 7], rtol=1e-9, atol=1e-9)
        assert rows[:, 7].sum() == pytest.approx(7)  # leverages add up to the number of unknowns
    unused = np.setdiff1d(np.arange(len(target)), pairs.partner)
    assert (by_target[unused] == 0).all()
    assert (by_source[pairs.partner < 0] == 0).all()
    np.testing.assert_allclose(scores(3, -(-len(target) // 3)), by_target[::3], rtol=1e-12)


def test_scores_of_coloured_pairs_equal_the_reference():
    """Both rows of a pair, each weighted by its own residual with a loss of two parameters, go to its target."""
    pairs = Pairs(7)
    noise, kernel = np.array([0.3, 0.7]), Barron(alpha=-1.5, c=0.8)
    rows, weights = coloured_rows(pairs, noise, kernel)
    weights = weights * pairs.weights[pairs.used]
    bread = np.diag(np.arange(1.0, 8)) + 0.1
    expected = np.zeros((len(pairs.target), 8))
    scores = np.einsum("cn,cna,cn->na", weights, rows[:, :, :7], rows[:, :, 7])
    leverages = np.einsum("cn,cna,ab,cnb->n", weights, rows[:, :, :7], bread, rows[:, :, :7])
    np.add.at(expected, pairs.partner[pairs.used], np.column_stack([scores, leverages]))
    target, *rest = pairs.arguments()
    robust = np.array(kernel.compiled(rows[0, :, 7]), float)
    found = np.zeros_like(expected)
    kernels.add_scores(
        kernels.COLOURED, 1, pairs.moved, pairs.partner, pairs.weights, target, *rest, noise, robust, bread, found
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("metric", [kernels.PLANE, kernels.GENERALISED, kernels.COLOURED])
def test_squares_are_those_of_the_sums(metric):
    pairs = Pairs(4)
    squares = np.zeros((2, len(pairs.source)))
    count = kernels.pair_squares(metric, 1, pairs.moved, pairs.partner, *pairs.arguments(), squares)
    assert count == len(pairs.used)
    full, _ = pairs.sums(metric, np.zeros(0), np.ones(2), (0, 0, 0))
    assert squares.sum() == pytest.approx(full[7, 7], rel=1e-10)


def moved_residuals(name, xi, p, q, n, m, colour):
    """Residuals after the left perturbation exp(xi), pairs and weights held; xi (7,) with the log scale last."""
    p = np.exp(xi[6]) * se3.transform_points(se3.exp(xi[:6]), p)
    if name == "plane":
        return np.einsum("nd,nd->n", n, p - q)
    if name == "colour":
        gradient, difference = colour
        return difference + np.einsum("nd,nd->n", gradient, p - q)
    return (p - q).ravel()


@pytest.mark.parametrize("name", ["plane", "point", "colour"])
def test_jacobians_equal_finite_differences(name):
    pairs = Pairs(5, 40)
    rows = pairs.used
    p, j = pairs.moved[rows], pairs.partner[rows]
    q, n = pairs.target[j], pairs.normals[j]
    gradient, difference = pairs.colour[2][j], pairs.colour[1][j] - pairs.colour[0][rows]
    if name == "plane":
        J = residuals.point_to_plane(p, q, n)[1]
        J = with_scale(J, n, p)
    elif name == "colour":
        J = residuals.coloured(p, q, n, gradient, difference)[1]
        J = with_scale(J, J[:, :3], p)
    else:
        J = np.concatenate([residuals.point_jacobian(p), p[:, :, None]], axis=2).reshape(-1, 7)
    h = 1e-6
    numeric = np.stack(
        [
            moved_residuals(name, h * e, p, q, n, None, (gradient, difference))
            - moved_residuals(name, -h * e, p, q, n, None, (gradient, difference))
            for e in np.eye(7)
        ],
        axis=1,
    ) / (2 * h)
    np.testing.assert_allclose(J, numeric, atol=1e-7)


def test_the_symmetric_jacobian_is_that_of_both_sides_turned_by_half():
    """r = N . (R_h p + rho/... - R_h^T q): turning the source by half and the target back by half."""
    pairs = Pairs(6, 40)
    rows = pairs.used
    p, j = pairs.moved[rows], pairs.partner[rows]
    q, n = pairs.target[j], pairs.normals[j]
    m = pairs.source_normals[rows] @ pairs.T[:3, :3].T
    _, J = residuals.symmetric(p, q, n, m)
    middle = J[:, :3]

    def r(xi):
        half = se3.exp_so3(xi[3:] / 2)
        return np.einsum("nd,nd->n", middle, p @ half.T + xi[:3] - q @ half)

    h = 1e-6
    numeric = np.stack([(r(h * e) - r(-h * e)) / (2 * h) for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(J, numeric, atol=1e-7)
