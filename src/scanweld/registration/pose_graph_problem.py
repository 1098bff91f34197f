"""The nonlinear least squares of a pose graph as arrays: residuals, Jacobians, Levenberg-Marquardt, and what the
edges leave free."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from scanweld.arrays import Bool, Float64, Int64
from scanweld.geometry import se3
from scanweld.registration.block_system import HELD, BlockSystem

_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e9  # shares of the diagonal
_FIRST_DAMPING = 1e-6
_FREE_PIVOT = 1e-11  # of the scaled system; the weakest node of a chain of 10 000 has 1e-4
_FREE_DIAGONAL = 1e-13  # what is added to a singular system
_FREE_SHARE = 1e-2  # of the largest motion in a free direction, beyond which a node takes part in it


class GraphProblem:
    """Edges between nodes, some of which are held.

    Parameters
    ----------
    ends : (E, 2) nodes i, j
    T_i_j : (E, 4, 4)
    information : (E, 6, 6), left perturbation of T_i_j
    robust : (E,) whether an edge may be wrong
    held : (N,) nodes that stay; the first node of a component without one is held as well

    Attributes
    ----------
    slots : (N,) number of the unknown of each node, or HELD
    dof : (E,) ranks of the informations
    """

    def __init__(self, ends: Int64, T_i_j: Float64, information: Float64, robust: Bool, held: Bool) -> None:
        self.ends, self.T_i_j, self.information, self.robust, self.held = ends, T_i_j, information, robust, held
        self.T_j_i = se3.inverse(T_i_j)
        self.dof = _ranks(information)
        self.slots = _slots(ends, held)
        i, j = ends.T
        self.system = BlockSystem(self.slots[i], self.slots[j], int((self.slots >= 0).sum()), 6)

    def kept(self, mask: Bool) -> GraphProblem:
        """Return the problem of some of the edges."""
        if mask.all():
            return self
        return GraphProblem(self.ends[mask], self.T_i_j[mask], self.information[mask], self.robust[mask], self.held)

    def residuals(self, poses: Float64) -> tuple[Float64, Float64]:
        """Return e = log(T_i^-1 T_j T_i_j^-1), (E, 6), and the motions T_i^-1 T_j, (E, 4, 4)."""
        i, j = self.ends.T
        between = se3.inverse(poses[i]) @ poses[j]
        return se3.log(between @ self.T_j_i), between

    def chi2(self, poses: Float64) -> Float64:
        """Return e^T W e, (E,)."""
        return self.chi2_of(self.residuals(poses)[0])

    def chi2_of(self, residuals: Float64) -> Float64:
        """Return e^T W e, (E,), of residuals (E, 6)."""
        return np.asarray(np.maximum(np.einsum("ea,eab,eb->e", residuals, self.information, residuals), 0.0))

    def mahalanobis(self, chi2: Float64) -> Float64:
        """Return residuals (E,) in units of their noise, 1 on average for a right edge: sqrt(chi2 / dof)."""
        return np.asarray(np.sqrt(chi2 / np.maximum(self.dof, 1)))

    def jacobians(self, residuals: Float64, between: Float64) -> tuple[Float64, Float64]:
        """Return de/dxi_i and de/dxi_j, (E, 6, 6) each, of perturbations T exp(xi).

        With E = T_i^-1 T_j T_i_j^-1: T_i exp(xi_i) makes it exp(-xi_i) E, and T_j exp(xi_j) makes it
        T_i^-1 T_j exp(xi_j) T_i_j^-1 = exp(Ad(T_i^-1 T_j) xi_j) E. The logarithm of exp(d) E is e + J^-1(e) d.
        """
        inverse = se3.left_jacobian_inverse(residuals)
        return -inverse, inverse @ se3.adjoint(between)

    def moved(self, poses: Float64, step: Float64) -> Float64:
        """Return the poses after a step (U, 6) of the unknowns."""
        result = poses.copy()
        nodes = np.flatnonzero(self.slots >= 0)
        result[nodes] = poses[nodes] @ se3.exp(step[self.slots[nodes]])
        return result

    def rounding(self, poses: Float64) -> float:
        """Return the cost that rounding alone makes."""
        extent = 1 + np.abs(poses[:, :3, 3]).max()
        error = np.finfo(np.float64).eps * np.array([extent] * 3 + [1.0] * 3)
        return float(8 * (np.diagonal(self.information, axis1=1, axis2=2) * error**2).sum())


@dataclass(frozen=True, slots=True)
class Descent:
    """Where a minimisation ended.

    Attributes
    ----------
    poses : (N, 4, 4)
    weights : (E,) of the edges, at the last accepted step
    costs : half the weighted chi-square, before the first step and after each accepted one
    num_iterations : factorisations
    settled : whether it ended because its steps became small
    """

    poses: Float64
    weights: Float64
    costs: tuple[float, ...]
    num_iterations: int
    settled: bool


def minimise(
    problem: GraphProblem,
    poses: Float64,
    weights_of: Callable[[Float64], Float64],
    *,
    tolerance: float,
    max_iterations: int,
) -> Descent:
    """Minimise the cost whose edges weigh `weights_of(chi2)`, by Levenberg-Marquardt with Nielsen's damping.

    The weights are those before each step. The losses are concave in chi-square, so what lowers the weighted cost
    lowers the robust one.
    """
    at = _linearise(problem, poses, weights_of)
    costs, settled, count = [at.cost], problem.system.num_nodes == 0, 0
    damping, growth = _FIRST_DAMPING, 2.0
    while not settled and count < max_iterations:
        count += 1
        step, predicted = at.step(damping)
        small = predicted <= tolerance * at.cost + at.rounding
        trial = problem.moved(at.poses, step) if np.isfinite(predicted) else at.poses
        decrease = at.cost - 0.5 * float(at.weights @ problem.chi2(trial))
        settled = small and damping <= _FIRST_DAMPING
        if decrease > 0:
            gain = decrease / predicted
            at = _linearise(problem, trial, weights_of)
            costs.append(at.cost)
            damping, growth = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), _LEAST_DAMPING), 2.0
        elif small:  # or is it small because it is damped?
            damping, growth = _LEAST_DAMPING, 2.0
        else:
            damping, growth = min(damping * growth, _MOST_DAMPING), growth * 2
    return Descent(at.poses, at.weights, tuple(costs), count, settled)


@dataclass(frozen=True, slots=True)
class _Linearised:
    """The problem around some poses: H step = -g, and what a damping of 1 adds to the diagonal of H."""

    problem: GraphProblem
    poses: Float64
    weights: Float64
    cost: float
    rounding: float
    matrix: sp.csc_matrix
    gradient: Float64
    scale: Float64

    def step(self, damping: float) -> tuple[Float64, float]:
        """Return the step (U, 6) and how much it promises to lower the cost; infinity where there is none."""
        system = self.problem.system
        factors = system.factor(self.matrix, damping * self.scale)
        if factors is None:
            return np.zeros((system.num_nodes, 6)), np.inf
        step = -factors.solve(self.gradient)
        return system.to_nodes(step), 0.5 * float(step @ (damping * self.scale * step - self.gradient))


def _linearise(problem: GraphProblem, poses: Float64, weights_of: Callable[[Float64], Float64]) -> _Linearised:
    residuals, between = problem.residuals(poses)
    chi2 = problem.chi2_of(residuals)
    weights = weights_of(chi2)
    first, second = problem.jacobians(residuals, between)
    information = weights[:, None, None] * problem.information
    matrix = problem.system.matrix(first, second, information)
    diagonal = problem.system.diagonal(matrix)
    return _Linearised(
        problem,
        poses,
        weights,
        cost=0.5 * float(weights @ chi2),
        rounding=problem.rounding(poses),
        matrix=matrix,
        gradient=problem.system.gradient(first, second, information, residuals),
        # Nodes without a trusted edge have no diagonal of their own.
        scale=np.maximum(diagonal, 1e-9 * float(diagonal.max(initial=1e-300))),
    )


def unanchored(ends: Int64, held: Bool) -> Bool:
    """Mask (N,) of the nodes that no path of edges connects to a held one."""
    count, label = _components(ends, len(held))
    anchored = np.zeros(count, dtype=np.bool_)
    anchored[label[held]] = True
    return np.asarray(~anchored[label])


def free_nodes(problem: GraphProblem, poses: Float64, weights: Float64) -> Bool:
    """Mask (N,) of the nodes that move in a direction that leaves every residual as it is.

    Looks at the pivots of the scaled system, then for the free motion by inverse iteration.
    """
    system = problem.system
    free = np.zeros(len(problem.slots), dtype=np.bool_)
    if system.num_nodes == 0:
        return free
    scaled, scale = _scaled(problem, poses, weights)
    unknowns = np.flatnonzero(problem.slots >= 0)
    free[unknowns] = (system.to_nodes(scale) == 0).any(axis=1)[problem.slots[unknowns]]
    factors, regular = _factors(problem, scaled, scale)
    if regular:
        return free
    if factors is None:
        free[unknowns] = True
        return free
    motions = np.random.default_rng(0).normal(size=(len(scale), 8))
    for _ in range(3):
        motions, _ = np.linalg.qr(factors.solve(motions))
    still = np.linalg.norm(scaled @ motions, axis=0) < 1e-9
    size = np.linalg.norm(system.to_nodes(motions[:, still] if still.any() else motions[:, :1]), axis=(1, 2))
    free[unknowns] |= (size > _FREE_SHARE * size.max())[problem.slots[unknowns]]
    return free


def node_covariances(problem: GraphProblem, poses: Float64, weights: Float64, nodes: Sequence[int]) -> Float64:
    """Return the marginal covariances (K, 6, 6) of nodes, left perturbation at the world's origin.

    Zero for held nodes, and where the system cannot be factorised; of free nodes it says nothing.
    """
    system = problem.system
    result = np.zeros((len(nodes), 6, 6))
    factors = None
    if system.num_nodes:
        scaled, scale = _scaled(problem, poses, weights)
        factors, _ = _factors(problem, scaled, scale)
        scale = np.where(scale > 0, scale, 1.0)
    if factors is None:
        return result
    for k, node in enumerate(nodes):
        if problem.slots[node] == HELD:
            continue
        rows = system.rows_of(int(problem.slots[node]))
        selected = np.zeros((len(scale), 6))
        selected[rows, np.arange(6)] = 1
        block = factors.solve(selected)[rows] / np.outer(scale[rows], scale[rows])
        # T exp(xi) = exp(Ad_T xi) T
        turn = se3.adjoint(poses[node])
        result[k] = turn @ ((block + block.T) / 2) @ turn.T
    return result


def _factors(problem: GraphProblem, scaled: sp.csc_matrix, scale: Float64) -> tuple[Any, bool]:
    """Factorise the scaled system, ones in the place of unknowns of which no edge says anything; is the rest regular?

    Where it is not, a little on the diagonal keeps its free motions finite and away from what is known.
    """
    silent = np.asarray(scale == 0, dtype=np.float64)
    factors = problem.system.factor(scaled, silent)
    if factors is not None and np.abs(factors.U.diagonal()).min() > _FREE_PIVOT:
        return factors, True
    return problem.system.factor(scaled, silent + _FREE_DIAGONAL), False


def _scaled(problem: GraphProblem, poses: Float64, weights: Float64) -> tuple[sp.csc_matrix, Float64]:
    """Return D^-1 H D^-1 with ones on its diagonal, and D; zeros in both where no edge says anything."""
    residuals, between = problem.residuals(poses)
    first, second = problem.jacobians(residuals, between)
    matrix = problem.system.matrix(first, second, weights[:, None, None] * problem.information)
    scale = np.sqrt(np.maximum(problem.system.diagonal(matrix), 0))
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    columns = np.repeat(np.arange(len(scale)), np.diff(matrix.indptr))
    values = matrix.data * inverse[matrix.indices] * inverse[columns]
    return sp.csc_matrix((values, matrix.indices, matrix.indptr), shape=matrix.shape), scale


def _ranks(information: Float64) -> Int64:
    """Ranks (E,) of informations (E, 6, 6), in units of their diagonals."""
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scale = np.where(scale > 0, scale, 1.0)
    values = np.linalg.eigvalsh(information / (scale[:, :, None] * scale[:, None, :]))
    return np.asarray((values > 1e-9).sum(axis=1), dtype=np.int64)


def _components(ends: Int64, num_nodes: int) -> tuple[int, Int64]:
    graph = sp.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(num_nodes, num_nodes))
    count, label = connected_components(graph, directed=False)
    return int(count), np.asarray(label, dtype=np.int64)


def _slots(ends: Int64, held: Bool) -> Int64:
    """Number the unknown nodes; each component without a held node holds its first."""
    _, label = _components(ends, len(held))
    apart = unanchored(ends, held)
    _, first = np.unique(label, return_index=True)
    stays = held.copy()
    stays[first[apart[first]]] = True
    return np.where(stays, HELD, np.cumsum(~stays) - 1)
