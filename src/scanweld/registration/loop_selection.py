"""Which of the edges that may be wrong are kept: truncated least squares, graduated by what drift explains.

A right loop after a long way is far off, because the way drifted; a wrong one is far off because it is wrong. What the
drift can explain is known: the covariance of the motion along the trusted edges. So a loop is first tested against its
own covariance plus that of the path between its ends (individual compatibility), and the share of the path's
covariance that is granted shrinks while the loops that passed pull the graph together, until a loop must agree by its
own covariance alone. The last stage is a minimum of the truncated cost, sum of min(chi2, limit).

Informations often claim too much, and right loops then disagree by many of their standard deviations. So where edges
are dropped the same is done with larger errors throughout, and the likelier answer wins.

Plain graduated non-convexity (H. Yang et al. 2020) starts instead from all edges with equal weight. On simulated loops
with 30 % of wrong edges that start was so bent that it dropped the right ones in most runs.

Sources: E. Olson, M. Kaess, "Evaluating the performance of map optimization algorithms", 2009, and J. Neira,
J. D. Tardós, "Data association in stochastic mapping using the joint compatibility test", 2001, for the test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from scanweld.arrays import Bool, Float64, Int64
from scanweld.geometry import se3
from scanweld.registration.chordal import starting_poses
from scanweld.registration.pose_graph_problem import Descent, GraphProblem, minimise

_SHARES = (1.0, 1 / 4, 1 / 16, 1 / 64, 1 / 256)  # of the path's covariance, one stage each
_ROUGH, _ROUGH_ITERATIONS = 1e-4, 15  # end of a stage whose edges change anyway
_ROUNDS = 20  # selections at the end; each lowers the truncated cost, so they end by themselves
_WRONG_SPREAD = 30.0  # standard deviations of a right edge over which wrong ones spread, each degree of freedom


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What decides about robust edges; see :class:`~scanweld.registration.pose_graph.PoseGraphConfig`."""

    max_chi2_per_dof: float
    noise_factor: float
    tolerance: float
    max_iterations: int
    start: str


def select_and_minimise(problem: GraphProblem, poses: Float64, config: Selection) -> Descent:
    """Minimise the truncated cost; the weights of the result are 0 for dropped edges, 1 for kept ones.

    The informations are believed first. Where that drops an edge, the errors are also taken to be `noise_factor` times
    larger, all alike, and the likelier of the two answers is returned.

    Parameters
    ----------
    poses : (N, 4, 4); where trusted edges alone do not connect the graph, the robust edges that fit these best do
    """
    tree, joins = skeleton(problem, poses)
    keep = ~problem.robust
    keep[joins] = True
    start = _descend(problem, starting_poses(problem.kept(keep), poses, config.start), keep, config, rough=True)
    drift = path_covariances(problem, start.poses, tree)
    limit = np.where(problem.robust, config.max_chi2_per_dof * np.maximum(problem.dof, 1), np.inf)
    best = _graduate(problem, start, drift, limit, config)
    count = start.num_iterations + best.num_iterations
    larger = config.noise_factor**2
    if (_plausible(problem, start.poses, drift, larger * limit) & (best.weights == 0)).any():
        other = _graduate(problem, start, drift, larger * limit, config)
        count += other.num_iterations
        if _unlikelihood(problem, other, larger) < _unlikelihood(problem, best, 1.0):
            best = other
    return replace(best, costs=(*start.costs, *best.costs), num_iterations=count)


def _unlikelihood(problem: GraphProblem, descent: Descent, variance: float) -> float:
    """Return -2 log of the restricted likelihood of an answer whose edges have `variance` times their covariances.

    Kept edges add chi2 / variance, and log(variance) for each of their degrees of freedom that the poses do not use up;
    dropped ones are spread evenly over `_WRONG_SPREAD` standard deviations.
    """
    kept = descent.weights > 0
    redundancy = max(int(problem.dof[kept].sum()) - 6 * problem.system.num_nodes, 0)
    chi2 = float(problem.chi2(descent.poses)[kept].sum())
    dropped = int(problem.dof[~kept].sum())
    return chi2 / variance + redundancy * float(np.log(variance)) + 2 * dropped * float(np.log(_WRONG_SPREAD))


def _plausible(problem: GraphProblem, poses: Float64, drift: Float64, limit: Float64) -> Bool:
    """Mask (E,) of the edges that their own covariance and `drift` (E, 6, 6) explain."""
    residuals, _ = problem.residuals(poses)
    total = _covariances(problem.information) + drift
    chi2 = np.einsum("ea,ea->e", residuals, np.linalg.solve(total, residuals[:, :, None])[:, :, 0])
    return np.asarray(chi2 <= limit)


def _graduate(problem: GraphProblem, start: Descent, drift: Float64, limit: Float64, config: Selection) -> Descent:
    """Shrink the share of the path's covariance that edges are granted, until none is left.

    Parameters
    ----------
    limit : (E,) chi-square beyond which an edge is dropped; infinite for trusted ones
    """
    descent, keep = start, start.weights > 0
    costs: list[float] = []
    count = 0

    def go_on(selected: Bool, *, rough: bool) -> None:
        nonlocal descent, keep, count
        descent, keep = _descend(problem, descent.poses, selected, config, rough=rough), selected
        costs.extend(descent.costs)
        count += descent.num_iterations

    for share in _SHARES:
        if (problem.chi2(descent.poses) <= limit).all():
            break
        selected = _plausible(problem, descent.poses, share * drift, limit)
        if not np.array_equal(selected, keep):
            go_on(selected, rough=True)
    for _ in range(_ROUNDS):
        before = keep
        go_on(problem.chi2(descent.poses) <= limit, rough=False)
        if np.array_equal(before, keep):
            break
    return replace(descent, costs=tuple(costs), num_iterations=count)


def _descend(problem: GraphProblem, poses: Float64, keep: Bool, config: Selection, *, rough: bool) -> Descent:
    """Minimise over the edges in `keep` alone."""
    kept = problem.kept(keep)
    ones = np.ones(len(kept.ends))
    descent = minimise(
        kept,
        poses,
        lambda chi2: ones,
        tolerance=max(_ROUGH, config.tolerance) if rough else config.tolerance,
        max_iterations=min(_ROUGH_ITERATIONS, config.max_iterations) if rough else config.max_iterations,
    )
    return replace(descent, weights=keep.astype(np.float64))


@dataclass(frozen=True, slots=True)
class Tree:
    """A spanning tree over the unknown nodes, numbered by their slots, and a root that stands for the held ones.

    Attributes
    ----------
    order : (U + 1,) the root first, every node after its parent
    parent : (U + 1,) the root's is itself
    edge : (U + 1,) edge to the parent; -1 for the root
    """

    order: Int64
    parent: Int64
    edge: Int64


def skeleton(problem: GraphProblem, poses: Float64) -> tuple[Tree, Int64]:
    """Return a spanning tree that prefers trusted edges, and the robust edges in it.

    Robust edges that join what trusted ones leave apart are taken in the order of their chi-square at `poses`.
    """
    root = problem.system.num_nodes
    ends = np.where(problem.slots >= 0, problem.slots, root)[problem.ends]
    cost = np.ones(len(ends))
    by_chi2 = np.argsort(np.where(problem.robust, problem.chi2(poses), -1.0), kind="stable")
    cost[by_chi2] += np.where(problem.robust[by_chi2], 1.0 + np.arange(len(ends)), 0.0)
    low, high = ends.min(axis=1), ends.max(axis=1)
    # One edge a pair of nodes, the cheapest: the sparse matrix would add them up.
    order = np.lexsort((cost, high, low))
    order = order[low[order] != high[order]]
    pair = low[order] * (root + 1) + high[order]
    order = order[np.flatnonzero(np.diff(pair, prepend=-1))]
    graph = sp.coo_matrix((cost[order], (low[order], high[order])), shape=(root + 1, root + 1)).tocsr()
    number = sp.coo_matrix((order + 1, (low[order], high[order])), shape=(root + 1, root + 1)).tocsr()
    visited, parent = breadth_first_order(minimum_spanning_tree(graph), root, directed=False)
    parent = parent.astype(np.int64)
    parent[root] = root
    nodes = np.arange(root + 1)
    edge = np.asarray(number[np.minimum(nodes, parent), np.maximum(nodes, parent)]).ravel().astype(np.int64) - 1
    used = edge[edge >= 0]
    return Tree(visited.astype(np.int64), parent, edge), used[problem.robust[used]]


def path_covariances(problem: GraphProblem, poses: Float64, tree: Tree) -> Float64:
    """Return the covariances (E, 6, 6) of T_i_j along the tree, at the origin of i, for every edge (i, j).

    An error exp(e) T_a_b of an edge moves all that hangs on it by exp(Ad(T_a) e) in the world, so in the world the
    covariances of a path add up, and those of two paths from the root share those of their common part.
    """
    centred = poses.copy()
    centred[:, :3, 3] -= poses[:, :3, 3].mean(axis=0)  # far from the origin the sums below would cancel
    used = tree.edge[tree.order[1:]]
    turn = se3.adjoint(centred[problem.ends[used, 0]])
    steps = turn @ _covariances(problem.information[used]) @ np.swapaxes(turn, 1, 2)
    total = np.zeros((len(tree.order), 6, 6))
    for node, step in zip(tree.order[1:], steps, strict=True):
        total[node] = total[tree.parent[node]] + step
    i, j = np.where(problem.slots >= 0, problem.slots, len(tree.order) - 1)[problem.ends].T
    world = total[i] + total[j] - 2 * total[_meeting(tree, i, j)]
    back = se3.adjoint(se3.inverse(centred[problem.ends[:, 0]]))
    return np.asarray(back @ world @ np.swapaxes(back, 1, 2))


def _meeting(tree: Tree, i: Int64, j: Int64) -> Int64:
    """Return the lowest common ancestors of nodes (E,) and (E,), by jumps of powers of two."""
    depth = np.zeros(len(tree.order), dtype=np.int64)
    for node in tree.order[1:]:
        depth[node] = depth[tree.parent[node]] + 1
    jumps = [tree.parent]
    while 2 ** len(jumps) <= depth.max(initial=0):
        jumps.append(jumps[-1][jumps[-1]])
    i, j = np.where(depth[i] >= depth[j], i, j), np.where(depth[i] >= depth[j], j, i)
    for k in reversed(range(len(jumps))):
        i = np.where(depth[i] - depth[j] >= 2**k, jumps[k][i], i)
    for jump in reversed(jumps):
        apart = jump[i] != jump[j]
        i, j = np.where(apart, jump[i], i), np.where(apart, jump[j], j)
    return np.where(i == j, i, tree.parent[i])


def _covariances(information: Float64) -> Float64:
    """Inverses (E, 6, 6) of informations; what was not measured has a variance far above all others."""
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scale = np.where(scale > 0, scale, 1.0)
    unit = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(information / unit + 1e-6 * np.eye(6)) / unit)
