"""Pose graphs: closing errors split as derived by hand, the dense optimum, wrong loops, bad starts, free nodes."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.registration.block_system import HELD, BlockSystem
from scanweld.registration.pose_graph import PoseGraph, PoseGraphConfig, edge_information
from scanweld.registration.pose_graph_problem import GraphProblem
from scanweld.registration.result import RegistrationResult, Status


def shift(x=0.0, y=0.0, z=0.0):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def spread(rng, count, size=1.0, angle=1.0):
    """Random poses (count, 4, 4)."""
    return se3.exp(np.concatenate([size * rng.normal(size=(count, 3)), angle * rng.normal(size=(count, 3))], axis=1))


def random_information(rng, count=1):
    """Full matrices (count, 6, 6) with standard deviations of about 1 cm and 0.5 degrees."""
    roots = rng.normal(size=(count, 6, 6)) + 2 * np.eye(6)
    roots = roots / np.array([0.02] * 3 + [0.02] * 3)
    return np.swapaxes(roots, 1, 2) @ roots


def circle(count, radius=5.0, turns=2.2):
    """Poses along a wavy circle walked more than once, looking ahead."""
    angle = np.linspace(0, 2 * np.pi * turns, count)
    T = se3.exp(np.stack([0 * angle, 0 * angle, 0 * angle, 0 * angle, 0 * angle, angle + np.pi / 2], axis=1))
    T[:, :3, 3] = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.3 * np.sin(3 * angle)], axis=1)
    return T


def sphere(layers, count, radius=5.0):
    """Poses along a spiral over a sphere, tangent to it."""
    angle = np.linspace(0, 2 * np.pi * layers, layers * count)
    height = np.linspace(-1.2, 1.2, layers * count)
    zero = 0 * angle
    T = se3.exp(np.stack([zero, zero, zero, zero, zero, angle], axis=1)) @ se3.exp(
        np.stack([zero, zero, zero, zero, -height, zero], axis=1)
    )
    T[:, :3, 3] = radius * np.stack(
        [np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)], axis=1
    )
    return T


def noisy_graph(truth, seed, *, loops, wrong, sigma_m=0.01, sigma_rad=0.003, robust=True):
    """Odometry with noise, right loops between near poses and wrong ones between any; and which edges are wrong."""
    rng = np.random.default_rng(seed)
    sigma = np.array([sigma_m] * 3 + [sigma_rad] * 3)
    information = np.diag(1 / sigma**2)
    graph, count = PoseGraph(), len(truth)

    def measured(i, j):
        return se3.exp(sigma * rng.normal(size=6)) @ se3.inverse(truth[i]) @ truth[j]

    odometry = [measured(k, k + 1) for k in range(count - 1)]
    T = truth[0]
    graph.add_node(T)
    for Z in odometry:
        T = T @ Z
        graph.add_node(T)
    for k, Z in enumerate(odometry):
        graph.add_edge(k, k + 1, Z, information)
    distance = np.linalg.norm(truth[:, None, :3, 3] - truth[None, :, :3, 3], axis=2)
    near = np.argwhere(np.triu(distance < 1.5, 10))
    for i, j in rng.permutation(near)[:loops]:
        graph.add_edge(i, j, measured(i, j), information, robust=robust)
    for _ in range(wrong):
        i, j = rng.choice(count, 2, replace=False)
        graph.add_edge(i, j, spread(rng, 1, 2.0)[0], information, robust=robust)
    return graph, np.arange(graph.num_edges) >= graph.num_edges - wrong


def position_rmse(T, truth):
    return np.sqrt(((T[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean())


# --- known solutions -------------------------------------------------------------------------------------------------


def test_a_closing_error_is_split_as_the_variances():
    """Four nodes on a line, odometry 1 m each with variances 1, 2, 3; a loop with variance 4 puts the last at 3.6 m.

    Minimise sum (d_k - 1)^2 / s_k + (sum d_k - 3.6)^2 / 4. Setting the slopes to zero, (d_k - 1) / s_k is the same
    for all k, so the error 0.6 is split as the variances, which sum to 10: d = 1 + 0.6 (1, 2, 3) / 10, and the loop
    keeps 0.6 * 4 / 10. Half of chi-square is 0.6^2 / 10 / 2. Along x the variance of the last node is that of two
    measurements side by side, 6 (odometry) and 4 (loop): 24 / 10.
    """
    graph = PoseGraph()
    for _ in range(4):
        graph.add_node(np.eye(4))
    for k, variance in enumerate((1.0, 2.0, 3.0)):
        graph.add_edge(k, k + 1, shift(1), np.diag([1 / variance, 1, 1, 1, 1, 1]))
    graph.add_edge(0, 3, shift(3.6), np.diag([1 / 4, 1, 1, 1, 1, 1]))
    result = graph.optimise(covariance_of=[0, 3])
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.T_world_node[:, 0, 3], [0, 1.06, 2.18, 3.36], atol=1e-12)
    np.testing.assert_allclose(result.T_world_node[:, :3, :3], np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(result.chi2, np.array([1, 2, 3, 4]) * 0.06**2, atol=1e-12)
    assert result.cost_history[-1] == pytest.approx(0.018)
    np.testing.assert_array_equal(result.covariance[0], 0)
    assert result.covariance[1][0, 0] == pytest.approx(2.4)


def test_a_closing_angle_is_split_too():
    """Three turns of 30 degrees about z, the loop says 102: 12 degrees split over four edges of equal variance."""
    graph = PoseGraph()
    turn = [se3.exp([0, 0, 0, 0, 0, np.radians(a)]) for a in (30, 102)]
    for _ in range(4):
        graph.add_node(np.eye(4))
    for k in range(3):
        graph.add_edge(k, k + 1, turn[0], np.eye(6))
    graph.add_edge(0, 3, turn[1], np.eye(6))
    poses = graph.optimise().T_world_node
    np.testing.assert_allclose(np.degrees(se3.log(poses)[:, 5]), [0, 33, 66, 99], atol=1e-9)


def test_the_information_of_an_edge_lives_at_the_origin_of_its_first_node():
    """Node 1 is turned by 90 degrees about z and measured from node 0, sharply along 0's x, vaguely along 0's y.

    A second measurement puts it 1 m further along both. Along 0's x it is as sharp as the first, along y far sharper:
    x is the mean, 0.5; y is that of the second, up to one in 10 001. Both know the rotation (1e-7 rad).
    """
    turned = se3.exp([0, 0, 0, 0, 0, np.pi / 2])
    graph = PoseGraph()
    graph.add_node(np.eye(4))
    graph.add_node(turned)
    graph.add_edge(0, 1, turned, np.diag([1e4, 1, 1, 1e14, 1e14, 1e14]))
    graph.add_edge(0, 1, shift(1, 1) @ turned, np.diag([1e4, 1e4, 1, 1e14, 1e14, 1e14]))
    T = graph.optimise().T_world_node[1]
    np.testing.assert_allclose(T[:3, 3], [0.5, 1e4 / 10_001, 0], atol=1e-9)


def test_a_prior_on_the_position_leaves_the_rotation_alone():
    """Two nodes 1 m apart, whose positions are known far from the origin, 1 m apart along y instead of x."""
    graph = PoseGraph()
    place = shift(5e5, 4e6, 100)
    graph.add_node(place)
    graph.add_node(place @ shift(1))
    graph.add_edge(0, 1, shift(1), np.eye(6))
    for node, T in enumerate((place, place @ shift(0, 1))):
        graph.add_prior(node, T, np.diag([1e4, 1e4, 1e4, 0, 0, 0]))
    graph.add_prior(0, place, np.diag([0, 0, 0, 1, 1, 0]))  # keeps the pair from rolling about the line between them
    result = graph.optimise()
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.T_world_node[:, :3, 3] - place[:3, 3], [[0, 0, 0], [0, 1, 0]], atol=1e-8)
    quarter = se3.exp([0, 0, 0, 0, 0, np.pi / 2])[:3, :3]
    np.testing.assert_allclose(result.T_world_node[:, :3, :3], [quarter, quarter], atol=1e-8)
    assert result.chi2.max() < 1e-12


def generator(xi):
    rho, (a, b, c) = xi[:3], xi[3:]
    return np.array([[0, -c, b, rho[0]], [c, 0, -a, rho[1]], [-b, a, 0, rho[2]], [0, 0, 0, 0]])


def series(matrix, first):
    """sum over k of matrix^k / (k + first)!: the exponential, and V of rho = V^-1 t."""
    return sum(np.linalg.matrix_power(matrix, k) / float(factorial(k + first)) for k in range(25))


def dense_residual(poses, edge):
    """The whitened residual of one edge, from SciPy's rotation vector and a series."""
    i, j, Z, information = edge
    E = np.linalg.inv(poses[i]) @ poses[j] @ np.linalg.inv(Z)
    phi = Rotation.from_matrix(E[:3, :3]).as_rotvec()
    V = series(generator(np.concatenate([np.zeros(3), phi]))[:3, :3], 1)
    return np.linalg.cholesky(information).T @ np.concatenate([np.linalg.solve(V, E[:3, 3]), phi])


def dense_gauss_newton(poses, edges):
    """Minimise with matrix series, left perturbations at the world's origin and difference quotients.

    Returns the poses, chi-square, and the covariance of all poses but the first.
    """
    poses = [T.copy() for T in poses]
    for _ in range(10):
        J = np.zeros((6 * len(edges), 6 * len(poses)))
        for row, edge in enumerate(edges):
            for node in edge[:2]:
                for k, xi in enumerate(1e-5 * np.eye(6)):
                    plus, minus = (
                        dense_residual({**dict(enumerate(poses)), node: series(generator(x), 0) @ poses[node]}, edge)
                        for x in (xi, -xi)
                    )
                    J[6 * row : 6 * row + 6, 6 * node + k] = (plus - minus) / 2e-5
        J = J[:, 6:]
        r = np.concatenate([dense_residual(poses, edge) for edge in edges])
        step = np.linalg.lstsq(J, -r, rcond=None)[0].reshape(-1, 6)
        poses[1:] = [series(generator(xi), 0) @ T for xi, T in zip(step, poses[1:], strict=True)]
        if np.abs(step).max() < 1e-9:
            break
    return np.stack(poses), r @ r, np.linalg.inv(J.T @ J)


def random_graph(seed, nodes=4, edges=4):
    """Random poses, full informations, edges both ways and twice; the start is off by about 0.1."""
    rng = np.random.default_rng(seed)
    truth = spread(rng, nodes)
    pairs = [(k, k + 1) for k in range(nodes - 1)] + [tuple(rng.choice(nodes, 2, replace=False)) for _ in range(edges)]
    noise = 0.02 * rng.normal(size=(len(pairs), 6))
    rows = [
        (i, j, se3.exp(xi) @ se3.inverse(truth[i]) @ truth[j], W)
        for (i, j), xi, W in zip(pairs, noise, random_information(rng, len(pairs)), strict=True)
    ]
    start = se3.exp(0.1 * rng.normal(size=(nodes, 6))) @ truth
    start[0] = truth[0]
    graph = PoseGraph()
    for T in start:
        graph.add_node(T)
    for row in rows:
        graph.add_edge(*row)
    return graph, rows, start


@pytest.mark.parametrize("seed", [0, 1])
def test_the_dense_optimum_and_its_covariance(seed):
    graph, edges, start = random_graph(seed)
    expected, chi2, covariance = dense_gauss_newton(start, edges)
    result = graph.optimise(covariance_of=range(1, 4))
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.T_world_node, expected, atol=1e-8)
    assert result.chi2.sum() == pytest.approx(chi2, rel=1e-8)
    # Gauss-Newton's matrix, from difference quotients; both are of the left perturbation at the world's origin.
    for k in range(3):
        block = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        np.testing.assert_allclose(result.covariance[k], block, atol=1e-4 * np.abs(block).max())


@pytest.mark.parametrize("seed", [0, 1])
def test_jacobians_are_the_slopes_of_the_residuals(seed):
    rng = np.random.default_rng(seed)
    poses, Z = spread(rng, 8, 3.0), spread(rng, 10, 3.0)
    ends = np.array([rng.choice(8, 2, replace=False) for _ in range(10)])
    information = np.broadcast_to(np.eye(6), (10, 6, 6))
    problem = GraphProblem(ends, Z, information, np.zeros(10, bool), np.arange(8) == 0)
    first, second = problem.jacobians(*problem.residuals(poses))
    h = 1e-6
    for side, jacobian in ((0, first), (1, second)):
        for k in range(6):
            quotient = 0.0
            for sign in (h, -h):
                moved = poses[ends].copy()
                moved[:, side] = moved[:, side] @ se3.exp(sign * np.eye(6)[k])
                E = se3.inverse(moved[:, 0]) @ moved[:, 1] @ se3.inverse(Z)
                quotient = quotient + np.sign(sign) * se3.log(E) / (2 * h)
            np.testing.assert_allclose(jacobian[:, :, k], quotient, atol=1e-6)


def test_gtsam_finds_the_same_optimum():
    """Its factor is log(T_i_j^-1 T_i^-1 T_j) = Ad(T_i_j^-1) e, rotation first."""
    gtsam = pytest.importorskip("gtsam")
    graph, truth = PoseGraph(), circle(40)
    graph, _ = noisy_graph(truth, 3, loops=30, wrong=0, sigma_m=0.05, sigma_rad=0.02, robust=False)
    swap = np.eye(6)[[3, 4, 5, 0, 1, 2]]
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T in enumerate(graph.T_world_node):
        values.insert(k, gtsam.Pose3(T))
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-9)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(graph.T_world_node[0]), tight))
    rng = np.random.default_rng(0)
    mixed = PoseGraph()
    for T in graph.T_world_node:
        mixed.add_node(T)
    for edge, W in zip(graph._edges, random_information(rng, graph.num_edges), strict=True):
        mixed.add_edge(edge.i, edge.j, edge.T_i_j, W)
        turn = se3.adjoint(edge.T_i_j) @ swap.T
        model = gtsam.noiseModel.Gaussian.Information(turn.T @ W @ turn)
        factors.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T_i_j), model))
    limits = gtsam.LevenbergMarquardtParams()
    limits.setRelativeErrorTol(1e-14)
    limits.setAbsoluteErrorTol(1e-14)
    solved = gtsam.LevenbergMarquardtOptimizer(factors, values, limits).optimize()
    expected = np.stack([solved.atPose3(k).matrix() for k in range(len(truth))])
    result = mixed.optimise(covariance_of=[25])
    np.testing.assert_allclose(result.T_world_node, expected, atol=1e-6)
    assert result.cost_history[-1] == pytest.approx(factors.error(solved), rel=1e-6)
    turn = se3.adjoint(expected[25]) @ swap.T
    marginal = gtsam.Marginals(factors, solved).marginalCovariance(25)
    np.testing.assert_allclose(result.covariance[0], turn @ marginal @ turn.T, rtol=1e-3, atol=1e-9)


# --- wrong loops and bad starts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", ["circle", "sphere"])
def test_wrong_loops_are_dropped_and_right_ones_kept(shape, seed):
    """Three wrong loops for seven right ones; the right ones have 6 degrees of freedom, and one in 170 exceeds 18."""
    truth = circle(150) if shape == "circle" else sphere(8, 20, 3.0)
    graph, wrong = noisy_graph(truth, seed, loops=70, wrong=30)
    result = graph.optimise()
    assert result.status is Status.CONVERGED
    np.testing.assert_array_equal(result.rejected & wrong, wrong)
    assert (result.rejected & ~wrong).sum() <= 2
    drift, error = position_rmse(graph.T_world_node, truth), position_rmse(result.T_world_node, truth)
    assert error < 0.5 * drift
    assert error < 0.1
    plain = graph.optimise(PoseGraphConfig(robust="none", max_iterations=20))
    assert position_rmse(plain.T_world_node, truth) > 10 * error


def test_the_optimum_with_wrong_loops_is_that_without_them():
    truth = circle(80)
    graph, wrong = noisy_graph(truth, 5, loops=30, wrong=12)
    clean, _ = noisy_graph(truth, 5, loops=30, wrong=0)
    result, expected = graph.optimise(), clean.optimise(PoseGraphConfig(robust="none"))
    np.testing.assert_array_equal(result.rejected, wrong)
    np.testing.assert_allclose(result.T_world_node, expected.T_world_node, atol=1e-6)


def test_odometry_that_claims_too_much_does_not_cost_the_loops():
    """Standard deviations said to be a third of what they are, and 30 % of wrong loops.

    Twenty-eight right loops leave 168 degrees of freedom; chi-square over them is about 9.
    """
    truth = circle(120)
    graph, wrong = noisy_graph(truth, 0, loops=28, wrong=12, sigma_m=0.03, sigma_rad=0.009)
    boastful = PoseGraph()
    for T in graph.T_world_node:
        boastful.add_node(T)
    for edge in graph._edges:
        boastful.add_edge(edge.i, edge.j, edge.T_i_j, 9 * edge.information, robust=edge.robust)
    result = boastful.optimise()
    np.testing.assert_array_equal(result.rejected, wrong)
    assert 6 < result.variance_factor < 12
    assert 0.7 < graph.optimise().variance_factor < 1.3
    np.testing.assert_allclose(result.T_world_node, graph.optimise().T_world_node, atol=1e-6)


def test_a_kernel_weighs_a_wrong_loop_down():
    truth = circle(40)
    graph, _ = noisy_graph(truth, 2, loops=20, wrong=0)
    wrong = graph.add_edge(3, 30, shift(5, 5, 5), 1e4 * np.eye(6), robust=True)
    result = graph.optimise(PoseGraphConfig(robust="geman_mcclure"))
    assert result.status is Status.CONVERGED
    assert result.weights[wrong] < 1e-3
    assert result.weights[:wrong].min() > 0.3
    assert (result.weights[:39] == 1).all()  # odometry is believed
    costs = graph.optimise(PoseGraphConfig(robust="none")).cost_history
    assert (np.diff(costs) < 0).all()


def test_a_trusted_edge_is_never_dropped():
    graph = PoseGraph()
    for _ in range(3):
        graph.add_node(np.eye(4))
    graph.add_edge(0, 1, shift(1), np.eye(6))
    graph.add_edge(0, 1, shift(9), 1e6 * np.eye(6))
    graph.add_edge(0, 2, shift(1), np.eye(6), robust=True)  # nothing speaks against it
    result = graph.optimise()
    np.testing.assert_array_equal(result.weights, 1)
    np.testing.assert_allclose(result.T_world_node[2], shift(1), atol=1e-9)


@pytest.mark.parametrize("start", ["auto", "chordal"])
def test_nonsense_as_a_start_does_not_matter(start):
    """All poses of the guess are random; noise-free edges are fulfilled, noisy ones as from the truth."""
    rng = np.random.default_rng(0)
    truth = sphere(6, 15, 2.0)
    for noise in (0.0, 0.02):
        good, _ = noisy_graph(truth, 1, loops=50, wrong=0, sigma_m=noise + 1e-12, sigma_rad=noise + 1e-12, robust=False)
        bad, _ = noisy_graph(truth, 1, loops=50, wrong=0, sigma_m=noise + 1e-12, sigma_rad=noise + 1e-12, robust=False)
        bad.set_poses(np.concatenate([truth[:1], spread(rng, len(truth) - 1, 10.0, 2.0)]))
        result = bad.optimise(PoseGraphConfig(start=start))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_world_node, good.optimise().T_world_node, atol=1e-4)
        if noise == 0:
            np.testing.assert_allclose(result.T_world_node, truth, atol=1e-9)


def test_a_poor_start_is_bridged_without_the_chordal_one():
    graph, _ = noisy_graph(circle(60), 0, loops=40, wrong=0, robust=False)
    expected = graph.optimise().T_world_node
    rng = np.random.default_rng(0)
    off = np.concatenate([expected[:1], expected[1:] @ spread(rng, 59, 0.5, 0.3)])
    graph.set_poses(off)
    result = graph.optimise(PoseGraphConfig(start="given"))
    np.testing.assert_allclose(result.T_world_node, expected, atol=1e-5)


# --- what the edges do not say ---------------------------------------------------------------------------------------


def test_nodes_without_a_path_to_a_fixed_one_are_named():
    graph = PoseGraph()
    for k in range(5):
        graph.add_node(shift(k))
    graph.add_edge(0, 1, shift(2), np.eye(6))
    graph.add_edge(3, 4, shift(0, 3), np.eye(6))
    result = graph.optimise(covariance_of=[1, 4])
    assert result.status is Status.DEGENERATE
    assert result.loose_nodes == (2, 3, 4)
    assert "3 nodes have no path" in result.note
    # What is known is still right: node 1, and the motion from 3 to 4, of which 3 stays where it was.
    np.testing.assert_allclose(result.T_world_node[1], shift(2), atol=1e-9)
    np.testing.assert_allclose(result.T_world_node[2:4], [shift(2), shift(3)], atol=1e-12)
    np.testing.assert_allclose(result.T_world_node[4], shift(3, 3), atol=1e-9)
    assert np.isfinite(result.covariance[0]).all()
    assert np.isinf(np.diag(result.covariance[1])).all()


@pytest.mark.parametrize("direction", [[0, 0, 1, 0, 0, 0], [0.6, 0, 0, 0, 0.8, 0]])
def test_a_direction_that_no_edge_measures_makes_its_nodes_loose(direction):
    """Nodes 2 and 3 hang on node 1 by an edge without information along one direction."""
    d = np.array(direction) / np.linalg.norm(direction)
    blind = 100 * (np.eye(6) - np.outer(d, d))
    graph = PoseGraph()
    for k in range(4):
        graph.add_node(shift(k))
    graph.add_edge(0, 1, shift(1), 100 * np.eye(6))
    graph.add_edge(1, 2, shift(1.2), blind)
    graph.add_edge(2, 3, shift(1), 100 * np.eye(6))
    result = graph.optimise()
    assert result.status is Status.DEGENERATE
    assert result.loose_nodes == (2, 3)
    assert "free" in result.note
    assert np.isfinite(result.T_world_node).all()
    assert graph.num_edges == 3
    graph.add_edge(0, 3, shift(3), 100 * np.eye(6))
    assert graph.optimise().status is Status.CONVERGED


@pytest.mark.parametrize("few", [1, 2, 3])
def test_a_long_loose_chain_is_named_beside_single_loose_nodes(few):
    """Of a unit vector of free motions a node of the chain has one part in sqrt(1000), a single node all of it."""
    d = np.array([0.6, 0, 0.8, 0, 0, 0])
    blind = 100 * (np.eye(6) - np.outer(d, d))
    graph = PoseGraph()
    graph.add_node(np.eye(4))
    for k in range(1, few + 1):
        graph.add_node(shift(0, k))
        graph.add_edge(0, k, shift(0, k), blind)
    for k in range(1000):
        graph.add_node(shift(0.1 * k))
        graph.add_edge(few + k if k else 0, few + 1 + k, shift(0.1 if k else 0), 100 * np.eye(6) if k else blind)
    assert graph.optimise().loose_nodes == tuple(range(1, few + 1001))


@pytest.mark.parametrize("turned", [[0.6, 0, 0.8, 0, 0, 0], [0.6, 0, 0, 0, 0.8, 0]])
def test_what_is_loose_neither_hides_other_loose_nodes_nor_what_is_known(turned):
    """Beside node 1, which is known as well as its edge, hang node 2, free along z, and 3 with 4, free along another
    direction; both ways of being free are named, and node 1 keeps the covariance of its edge."""
    graph = PoseGraph()
    for k in range(5):
        graph.add_node(shift(k))
    graph.add_edge(0, 1, shift(1), 100 * np.eye(6))
    graph.add_edge(1, 2, shift(1), 100 * np.diag([1, 1, 0, 1, 1, 1]))
    graph.add_edge(1, 3, shift(2), 100 * (np.eye(6) - np.outer(turned, turned)))
    graph.add_edge(3, 4, shift(1), 100 * np.eye(6))
    result = graph.optimise(covariance_of=[1, 2, 4])
    assert result.loose_nodes == (2, 3, 4)
    np.testing.assert_allclose(result.covariance[0], 0.01 * np.eye(6), atol=1e-9)
    assert np.isinf(np.diagonal(result.covariance[1:], axis1=1, axis2=2)).all()


def test_long_chains_are_not_taken_for_free_ones():
    graph = PoseGraph()
    for k in range(3000):
        graph.add_node(shift(0.1 * k))
    for k in range(2999):
        graph.add_edge(k, k + 1, shift(0.1), np.diag([1e4] * 3 + [1e5] * 3))
    result = graph.optimise(covariance_of=[2999])
    assert result.status is Status.CONVERGED
    # Along the chain 2999 variances of 1e-4 add up.
    assert result.covariance[0][0, 0] == pytest.approx(0.2999, rel=1e-6)


def test_too_few_iterations_are_no_success():
    graph, _ = noisy_graph(circle(60), 0, loops=40, wrong=0)
    result = graph.optimise(PoseGraphConfig(max_iterations=1, start="given"))
    assert result.status is Status.MAX_ITERATIONS
    assert "still moving" in result.note


def test_graphs_without_unknowns():
    with pytest.raises(InvalidInputError, match="no nodes"):
        PoseGraph().optimise()
    graph = PoseGraph()
    graph.add_node(shift(1, 2, 3))
    result = graph.optimise(covariance_of=[0])
    assert result.status is Status.CONVERGED
    np.testing.assert_array_equal(result.T_world_node, [shift(1, 2, 3)])
    np.testing.assert_array_equal(result.covariance, np.zeros((1, 6, 6)))


def test_the_world_does_not_matter():
    """The same graph seen from a world that is turned and 4000 km away, with one more fixed node."""
    graph, _ = noisy_graph(circle(40), 0, loops=20, wrong=6)
    T = se3.exp([5e5, 4e6, 100, 0.4, 0.3, 2.0])
    moved, _ = noisy_graph(circle(40), 0, loops=20, wrong=6)
    moved.set_poses(T @ graph.T_world_node)
    result, other = graph.optimise(), moved.optimise()
    np.testing.assert_array_equal(result.weights, other.weights)
    # Coordinates of 4e6 m are known to 1e-9.
    np.testing.assert_allclose(se3.inverse(T) @ other.T_world_node, result.T_world_node, atol=1e-6)


def test_the_graph_is_left_alone_and_the_answer_has_the_same_bytes():
    graph, _ = noisy_graph(circle(40), 0, loops=20, wrong=6)
    before = graph.T_world_node
    first, second = graph.optimise(), graph.optimise()
    np.testing.assert_array_equal(graph.T_world_node, before)
    assert first.T_world_node.tobytes() == second.T_world_node.tobytes()
    information = np.eye(6)
    graph.add_edge(0, 1, before[0], information)
    np.testing.assert_array_equal(information, np.eye(6))


# --- alignments as edges ---------------------------------------------------------------------------------------------


def test_an_alignment_in_the_plane_is_no_edge():
    result = RegistrationResult(T_target_source=np.eye(3), status=Status.CONVERGED, information=np.eye(3))
    with pytest.raises(InvalidInputError, match=r"expected an alignment in 3-D, got information \(3, 3\)"):
        edge_information(result)


def test_information_that_is_negative_along_no_axis_is_refused_all_the_same():
    """Correlations of 0.9, 0.9 and -0.9 between three things: possible two by two, not all three; 1 - 2 * 0.9 < 0."""
    information = np.eye(6)
    information[:3, :3] = [[1, 0.9, 0.9], [0.9, 1, -0.9], [0.9, -0.9, 1]]
    graph = PoseGraph()
    graph.add_node(np.eye(4))
    graph.add_node(np.eye(4))
    with pytest.raises(InvalidInputError, match="symmetric and positive semidefinite"):
        graph.add_edge(0, 1, np.eye(4), information)


def test_an_alignment_becomes_an_edge_as_it_is():
    """chi-square of an edge whose measurement is off by exp(xi) from the left is xi^T C^-1 xi."""
    rng = np.random.default_rng(0)
    C = np.linalg.inv(random_information(rng)[0])
    T = spread(rng, 1)[0]
    xi = 1e-3 * rng.normal(size=6)
    result = RegistrationResult(
        T_target_source=se3.exp(xi) @ T, status=Status.CONVERGED, information=np.eye(6), covariance=C
    )
    graph = PoseGraph()
    graph.add_node(np.eye(4), fixed=True)
    graph.add_node(T, fixed=True)
    graph.add_edge(0, 1, result.T_target_source, edge_information(result))
    assert graph.optimise().chi2[0] == pytest.approx(xi @ np.linalg.solve(C, xi), rel=1e-9)


def test_free_directions_of_an_alignment_carry_no_information():
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(6, 4)) * np.array([0.01] * 3 + [0.001] * 3)[:, None]
    C = roots @ roots.T  # two oblique directions have no variance here: they are free
    result = RegistrationResult(
        T_target_source=np.eye(4), status=Status.DEGENERATE, information=np.eye(6), covariance=C
    )
    information = edge_information(result)
    assert np.linalg.matrix_rank(information * np.outer([0.01] * 3 + [0.001] * 3, [0.01] * 3 + [0.001] * 3), 1e-6) == 4
    np.testing.assert_allclose(C @ information @ C, C, atol=1e-12)


def test_without_a_covariance_the_residuals_tell_the_noise():
    result = RegistrationResult(
        T_target_source=np.eye(4), status=Status.CONVERGED, information=np.diag([4.0] * 6), rmse_m=0.02
    )
    np.testing.assert_allclose(edge_information(result), np.diag([1e4] * 6))


# --- the linear part and the boundary --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 3, 6])
def test_the_sparse_equations_are_the_dense_ones(size):
    rng = np.random.default_rng(size)
    ends = np.array([[0, 1], [1, 2], [2, HELD], [3, 1], [1, 0], [4, 3], [HELD, 0]])
    A, B = rng.normal(size=(2, len(ends), size, size))
    W = np.einsum("eab,ecb->eac", A, A) + np.eye(size)
    r = rng.normal(size=(len(ends), size))
    H, g = np.zeros((5 * size, 5 * size)), np.zeros(5 * size)
    for k, pair in enumerate(ends):
        J = np.zeros((size, 5 * size))
        for node, block in zip(pair, (A[k], B[k]), strict=True):
            if node != HELD:
                J[:, node * size : (node + 1) * size] += block
        H += J.T @ W[k] @ J
        g += J.T @ W[k] @ r[k]
    system = BlockSystem(ends[:, 0], ends[:, 1], 5, size)
    matrix = system.matrix(A, B, W)
    rows = np.concatenate([system.rows_of(k) for k in range(5)])
    np.testing.assert_allclose(matrix.toarray()[np.ix_(rows, rows)], H, atol=1e-12)
    np.testing.assert_allclose(system.diagonal(matrix)[rows], np.diag(H), atol=1e-12)
    step = system.to_nodes(system.factor(matrix, 0.1).solve(system.gradient(A, B, W, r)))
    np.testing.assert_allclose(step.ravel(), np.linalg.solve(H + 0.1 * np.eye(len(H)), g), atol=1e-10)


def test_what_the_caller_got_wrong_is_said():
    graph = PoseGraph()
    graph.add_node(np.eye(4))
    graph.add_node(np.eye(4))
    with pytest.raises(InvalidInputError, match="nodes 0 to 1"):
        graph.add_edge(0, 2, np.eye(4), np.eye(6))
    with pytest.raises(InvalidInputError, match="two different"):
        graph.add_edge(1, 1, np.eye(4), np.eye(6))
    with pytest.raises(InvalidInputError, match="not a rotation"):
        graph.add_edge(0, 1, 2 * np.eye(4) - np.diag([0, 0, 0, 1]), np.eye(6))
    for information in (np.eye(3), np.full((6, 6), np.nan), -np.eye(6), np.triu(np.ones((6, 6))), 2 - np.eye(6)):
        with pytest.raises(InvalidInputError, match="information"):
            graph.add_edge(0, 1, np.eye(4), information)
    with pytest.raises(InvalidInputError, match="shape"):
        graph.set_poses(np.eye(4))
    with pytest.raises(InvalidInputError, match="node 7"):
        graph.optimise(covariance_of=[7])
    with pytest.raises(ConfigError, match="graduated"):
        PoseGraphConfig(robust="gnk")
    with pytest.raises(ConfigError, match="chordal"):
        PoseGraphConfig(start="odometry")
