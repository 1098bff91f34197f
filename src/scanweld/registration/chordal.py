"""A start for a pose graph that needs no start: rotations first, translations after, each a linear problem.

Rotations are relaxed to any 3x3 matrices, which makes R_j = R_i R_ij linear, and the solution is projected back; with
the rotations known, t_j = t_i + R_i t_ij is linear as well. For odometry and loops with moderate noise the result is
so close to the optimum that Gauss-Newton converges, whatever the poses were before.

Source: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM: a survey on rotation
estimation and its use in pose graph optimization", 2015 (section III-B, the "chordal" relaxation).
"""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64
from scanweld.registration.block_system import BlockSystem
from scanweld.registration.pose_graph_problem import GraphProblem

STARTS = ("auto", "given", "chordal")


def starting_poses(problem: GraphProblem, poses: Float64, start: str) -> Float64:
    """Return `poses` ("given"), those of :func:`chordal_poses`, or whichever fit the edges better ("auto")."""
    if start == "given" or len(problem.ends) == 0:
        return poses
    chordal = chordal_poses(problem, poses)
    if start == "auto" and problem.chi2(poses).sum() <= problem.chi2(chordal).sum():
        return poses
    return chordal


def chordal_poses(problem: GraphProblem, T_world_node: Float64) -> Float64:
    """Return poses (N, 4, 4) that fit the edges; the traces of the informations are the weights.

    Parameters
    ----------
    T_world_node : (N, 4, 4); used where held, and returned where the edges say nothing
    """
    slots, T_i_j, information = problem.slots, problem.T_i_j, problem.information
    i, j = problem.ends.T
    num_unknowns = int((slots >= 0).sum())
    poses = T_world_node.copy()
    if num_unknowns == 0:
        return poses
    unknown = np.flatnonzero(slots >= 0)
    weight = np.stack([np.trace(information[:, k : k + 3, k : k + 3], axis1=1, axis2=2) for k in (0, 3)]) / 3
    eye = np.broadcast_to(np.eye(3), (len(i), 3, 3))
    held = (slots < 0)[:, None, None]

    # Columns of R^T: R_j^T - R_ij^T R_i^T = 0. Three unknowns a node, three right-hand sides.
    transposed = np.swapaxes(T_i_j[:, :3, :3], 1, 2)
    known = np.where(held, np.swapaxes(poses[:, :3, :3], 1, 2), 0.0)
    constant = known[j] - transposed @ known[i]
    system = BlockSystem(slots[i], slots[j], num_unknowns, 3)
    solved = _least_squares(system, -transposed, eye, weight[1][:, None, None] * eye, constant)
    if solved is None:
        return poses
    poses[unknown, :3, :3] = nearest_rotations(np.swapaxes(solved[slots[unknown]], 1, 2))

    # t_j - t_i - R_i t_ij = 0: one unknown a node, three right-hand sides.
    shift = np.einsum("eij,ej->ei", poses[i, :3, :3], T_i_j[:, :3, 3])
    place = np.where(held[:, 0], poses[:, :3, 3], 0.0)
    constant = (place[j] - place[i] - shift)[:, None, :]
    one = np.ones((len(i), 1, 1))
    system = BlockSystem(slots[i], slots[j], num_unknowns, 1)
    solved = _least_squares(system, -one, one, weight[0][:, None, None] * one, constant)
    if solved is None:
        return T_world_node.copy()
    poses[unknown, :3, 3] = solved[slots[unknown], 0]
    return poses


def nearest_rotations(matrices: Float64) -> Float64:
    """Return the rotations (N, 3, 3) nearest to matrices (N, 3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[:, None]
    return np.asarray(u @ vt)


def _least_squares(
    system: BlockSystem, first: Float64, second: Float64, information: Float64, constant: Float64
) -> Float64 | None:
    """Minimise the sum of |constant + A_i x_i + A_j x_j|^2_W; None where the edges leave something free."""
    matrix = system.matrix(first, second, information)
    factors = system.factor(matrix)
    if factors is None:
        return None
    solution = factors.solve(-system.gradient(first, second, information, constant))
    return system.to_nodes(solution) if np.isfinite(solution).all() else None
