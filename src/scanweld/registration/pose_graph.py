"""Pose graphs: many poses from measured motions between them, some of which may be wrong.

Nodes are poses T_world_node, edges measured motions T_i_j between them. The residual of an edge is

    e = log(T_i^-1 T_j T_i_j^-1)        (6,), translation [m] first, rotation [rad] second

so the error of a measurement is the left perturbation exp(e) T_i_j, an error at the origin of node i along i's axes.
That is how :class:`~scanweld.registration.result.RegistrationResult` states its information with i the target and j
the source, so an alignment becomes an edge as it is (:func:`edge_information`).

The sum of e^T W e is minimised by sparse Levenberg-Marquardt, over perturbations T exp(xi) = exp(Ad_T xi) T: left
perturbations seen from the node, so that the damping and the conditioning do not depend on how far away the world's
origin is. Edges that may be wrong (loops) are `robust`: graduated non-convexity decides which of them to keep, or a
kernel weighs them down.

Sources: G. Grisetti, R. Kümmerle, C. Stachniss, W. Burgard, "A tutorial on graph-based SLAM", 2010. H. Yang,
P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception", 2020. H. B. Nielsen,
"Damping parameter in Marquardt's method", 1999.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Float64, as_transform, as_transforms
from scanweld.config import check_ranges, setting
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.registration.chordal import STARTS, starting_poses
from scanweld.registration.loop_selection import Selection, select_and_minimise
from scanweld.registration.pose_graph_problem import (
    Descent,
    GraphProblem,
    free_nodes,
    minimise,
    node_covariances,
    unanchored,
)
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.robust import KERNELS, robust_kernel

__all__ = ["PoseGraph", "PoseGraphConfig", "PoseGraphResult", "edge_information"]

REJECTED = 0.1
"""A robust edge whose weight ended below this is called rejected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphConfig:
    """Settings of :meth:`PoseGraph.optimise`."""

    robust: str = setting(
        "graduated",
        "what is done about wrong robust edges: graduated (keeps or drops each, as the other edges allow), or a "
        "kernel's name (none, huber, cauchy, geman_mcclure, tukey), which weighs each by its residual at the moment",
    )
    max_chi2_per_dof: float = setting(
        3.0,
        "graduated drops a robust edge whose chi-square exceeds so many times its degrees of freedom; 3 keeps 99.4 % "
        "of the right ones where the information is calibrated. Raise it where alignments claim too much",
        low=0.0,
    )
    noise_factor: float = setting(
        3.0,
        "graduated believes the informations first, and where that drops edges also that all errors are so many times "
        "larger; the likelier answer wins. Raising it keeps right loops after odometry that claims too much",
        low=1.0,
    )
    start: str = setting(
        "auto",
        "given (the nodes' poses), chordal (computed from the edges), or auto: whichever fits the edges better",
    )
    max_iterations: int = setting(100, "factorisations before giving up; each selection of edges counts its own", low=1)
    tolerance: float = setting(
        1e-10,
        "done when a step promises to lower the cost by less than this share; raising it stops earlier",
        low=0.0,
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.robust != "graduated" and self.robust not in KERNELS:
            raise ConfigError(f"robust = {self.robust!r}: expected graduated or one of {', '.join(KERNELS)}")
        if self.start not in STARTS:
            raise ConfigError(f"start = {self.start!r}: expected one of {', '.join(STARTS)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphResult:
    """Optimised poses and what they are worth.

    Attributes
    ----------
    T_world_node : (N, 4, 4), in the order of the nodes
    status : CONVERGED; MAX_ITERATIONS where the steps were still large; DEGENERATE where the edges that were kept do
        not hold every node (see `loose_nodes`)
    num_iterations : factorisations done
    cost_history : half the weighted chi-square before the first and after each accepted step; the weights of robust
        edges change on the way
    chi2 : (E,) squared Mahalanobis length of each residual at the end, without the robust weight
    variance_factor : chi-square of the kept edges over their redundancy (degrees of freedom that the poses do not use
        up), about 1 where the informations are calibrated; variances are so many times larger where it is well above.
        1 where nothing is redundant
    weights : (E,) robust weights; 1 for edges that are not robust
    loose_nodes : nodes that nothing connects to a fixed node or prior, or that the edges leave free in some direction
    covariance : (K, 6, 6) marginal covariances of the nodes asked for, translation first, left perturbation at the
        world's origin, as in RegistrationResult; zero for fixed nodes, infinite on the diagonal for loose ones
    note : one sentence for a person; "" where nothing is amiss
    """

    T_world_node: Float64
    status: Status
    num_iterations: int
    cost_history: tuple[float, ...]
    chi2: Float64
    weights: Float64
    variance_factor: float
    loose_nodes: tuple[int, ...] = ()
    covariance: Float64 | None = None
    note: str = ""

    @property
    def rejected(self) -> Bool:
        """Mask (E,) of the robust edges that were overruled."""
        return np.asarray(self.weights < REJECTED)


class PoseGraph:
    """Nodes, edges and priors; :meth:`optimise` leaves them as they are.

    The first node is fixed where no node is fixed and there is no prior.
    """

    def __init__(self) -> None:
        self._poses: list[Float64] = []
        self._fixed: list[bool] = []
        self._edges: list[_Edge] = []

    @property
    def num_nodes(self) -> int:
        """Number of nodes."""
        return len(self._poses)

    @property
    def num_edges(self) -> int:
        """Number of edges, priors included."""
        return len(self._edges)

    @property
    def T_world_node(self) -> Float64:
        """The poses (N, 4, 4) from which an optimisation starts; a copy."""
        return np.stack(self._poses) if self._poses else np.zeros((0, 4, 4))

    def add_node(self, T_world_node: npt.ArrayLike, *, fixed: bool = False) -> int:
        """Add a pose (4, 4), or a guess of it, and return the node's index."""
        self._poses.append(as_transform(T_world_node, "T_world_node"))
        self._fixed.append(fixed)
        return len(self._poses) - 1

    def add_edge(
        self, i: int, j: int, T_i_j: npt.ArrayLike, information: npt.ArrayLike, *, robust: bool = False
    ) -> int:
        """Add a measured motion and return the edge's index.

        Parameters
        ----------
        i, j : nodes; T_i_j maps points of j to the frame of i
        T_i_j : (4, 4)
        information : (6, 6) inverse covariance of e in exp(e) T_i_j, translation [m] first, rotation [rad] second:
            at the origin of i, along the axes of i. Positive semidefinite; zero along what was not measured
        robust : whether the edge may be wrong

        Raises
        ------
        InvalidInputError
            When a node does not exist, i = j, T_i_j is no rigid transform, or the information is not symmetric and
            positive semidefinite.
        """
        self._check_node(i)
        self._check_node(j)
        if i == j:
            raise InvalidInputError(f"edge: expected two different nodes, got {i} twice")
        name = f"edge {i} -> {j}"
        edge = _Edge(i, j, as_transform(T_i_j, name), _as_information(information, name), robust)
        self._edges.append(edge)
        return len(self._edges) - 1

    def add_prior(
        self, node: int, T_world_node: npt.ArrayLike, information: npt.ArrayLike, *, robust: bool = False
    ) -> int:
        """Add what is known of one node's pose and return the edge's index.

        Parameters
        ----------
        information : (6, 6) as of an edge, but at the position of `T_world_node`, along the world's axes: with
            diag(w, w, w, 0, 0, 0) it is the position that is known
        """
        self._check_node(node)
        name = f"prior of node {node}"
        T = as_transform(T_world_node, name)
        # An edge from a fixed frame at the prior's position with the world's axes.
        place, turn = np.eye(4), T.copy()
        place[:3, 3] = T[:3, 3]
        turn[:3, 3] = 0
        self._edges.append(_Edge(-1, node, turn, _as_information(information, name), robust, place))
        return len(self._edges) - 1

    def set_poses(self, T_world_node: npt.ArrayLike) -> None:
        """Replace the poses (N, 4, 4) of all nodes, by those of a result for example."""
        poses = np.asarray(T_world_node, dtype=np.float64)
        if poses.shape != (self.num_nodes, 4, 4):
            raise InvalidInputError(f"T_world_node: expected shape ({self.num_nodes}, 4, 4), got {poses.shape}")
        self._poses = list(as_transforms(poses, "T_world_node"))

    def optimise(self, config: PoseGraphConfig | None = None, *, covariance_of: Sequence[int] = ()) -> PoseGraphResult:
        """Return the poses that fit the edges best; the graph keeps its own (see :meth:`set_poses`).

        Parameters
        ----------
        config : see :class:`PoseGraphConfig`
        covariance_of : nodes whose marginal covariance is wanted; each costs six solves

        Raises
        ------
        InvalidInputError
            When the graph has no nodes or `covariance_of` names one that does not exist.
        """
        if not self._poses:
            raise InvalidInputError("pose graph: it has no nodes; add_node comes first")
        for node in covariance_of:
            self._check_node(node)
        settings = config or PoseGraphConfig()
        problem, poses = self._problem()
        descent = _solve(problem, poses, settings)
        return _judge(self.num_nodes, problem, descent, covariance_of)

    def _check_node(self, node: int) -> None:
        if not 0 <= node < self.num_nodes:
            raise InvalidInputError(f"node {node}: the graph has nodes 0 to {self.num_nodes - 1}")

    def _problem(self) -> tuple[GraphProblem, Float64]:
        """Return the arrays of the graph; priors hang on fixed frames, numbered after the nodes."""
        places = [edge.place for edge in self._edges if edge.place is not None]
        poses = np.stack([*self._poses, *places])
        ends = np.array([(edge.i, edge.j) for edge in self._edges], dtype=np.int64).reshape(-1, 2)
        ends[ends[:, 0] < 0, 0] = self.num_nodes + np.arange(len(places))
        held = np.array([*self._fixed, *[True] * len(places)])
        if not held.any():
            held[0] = True
        problem = GraphProblem(
            ends,
            np.array([edge.T_i_j for edge in self._edges]).reshape(-1, 4, 4),
            np.array([edge.information for edge in self._edges]).reshape(-1, 6, 6),
            np.array([edge.robust for edge in self._edges], dtype=np.bool_),
            held,
        )
        return problem, poses


@dataclass(frozen=True, slots=True)
class _Edge:
    """An edge, or a prior: then i is -1 and `place` the fixed frame that it hangs on."""

    i: int
    j: int
    T_i_j: Float64
    information: Float64
    robust: bool
    place: Float64 | None = None


def edge_information(result: RegistrationResult, *, min_sigma_m: float = 1e-4) -> Float64:
    """Return the information (6, 6) of an edge (target, source) whose T_i_j is `result.T_target_source`.

    The inverse of the result's covariance where it has one; else the information of the metric that was minimised
    over the variance of its residuals. Both are left perturbations at the target's origin, as an edge's is; free
    directions have information zero.

    Parameters
    ----------
    min_sigma_m : residuals are not believed to be smaller than this [m]
    """
    if result.information.shape != (6, 6):
        raise InvalidInputError(f"result: expected an alignment in 3-D, got information {result.information.shape}")
    if result.covariance is None:
        return np.asarray(result.information / max(result.rmse_m, min_sigma_m) ** 2)
    # In units of the standard deviations, so that metres and radians compare.
    sigma = np.sqrt(np.diag(result.covariance))
    sigma = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(result.covariance / np.outer(sigma, sigma))
    known = values > 1e-10
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    return np.asarray(inverse / np.outer(sigma, sigma))


def _as_information(information: npt.ArrayLike, name: str) -> Float64:
    matrix = np.array(information, dtype=np.float64)
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"{name}: expected a finite information matrix (6, 6), got shape {matrix.shape}")
    # In units of the diagonal: 1e8 / rad^2 beside 1e2 / m^2 must not hide a negative direction.
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 0))
    unit = np.outer(diagonal, diagonal)
    if (np.abs(matrix - matrix.T) > 1e-6 * unit).any() or (np.abs(matrix) > (1 + 1e-6) * unit).any():
        raise InvalidInputError(f"{name}: the information must be symmetric and positive semidefinite")
    scaled = (matrix + matrix.T) / 2 / np.where(unit > 0, unit, 1.0)
    if np.linalg.eigvalsh(scaled)[0] < -1e-6:
        raise InvalidInputError(f"{name}: the information must be symmetric and positive semidefinite")
    return np.asarray((matrix + matrix.T) / 2)


def _solve(problem: GraphProblem, poses: Float64, config: PoseGraphConfig) -> Descent:
    """Minimise the robust cost from `poses`."""
    if config.robust == "graduated" and problem.robust.any():
        selection = Selection(
            max_chi2_per_dof=config.max_chi2_per_dof,
            noise_factor=config.noise_factor,
            tolerance=config.tolerance,
            max_iterations=config.max_iterations,
            start=config.start,
        )
        return select_and_minimise(problem, poses, selection)
    kernel = robust_kernel("none" if config.robust == "graduated" else config.robust)

    def weights_of(chi2: Float64) -> Float64:
        return np.where(problem.robust, kernel.weight(problem.mahalanobis(chi2)), 1.0)

    poses = starting_poses(problem, poses, config.start)
    return minimise(problem, poses, weights_of, tolerance=config.tolerance, max_iterations=config.max_iterations)


def _judge(num_nodes: int, problem: GraphProblem, descent: Descent, covariance_of: Sequence[int]) -> PoseGraphResult:
    """Look at where the steps ended, and say what it is worth."""
    poses, trusted = descent.poses, descent.weights >= REJECTED
    kept, weights = problem.kept(trusted), descent.weights[trusted]
    apart = unanchored(kept.ends, problem.held)
    free = free_nodes(kept, poses, weights)
    loose = tuple(int(k) for k in np.flatnonzero((apart | free)[:num_nodes]))
    notes = []
    status = Status.CONVERGED
    if not descent.settled:
        status = Status.MAX_ITERATIONS
        notes.append(f"still moving after {descent.num_iterations} factorisations")
    if loose:
        status = Status.DEGENERATE
        if apart.any():
            notes.append(f"{apart.sum()} nodes have no path of trusted edges to a fixed node or prior")
        if (free & ~apart).any():
            notes.append(f"the edges leave {(free & ~apart).sum()} nodes free in some direction")
    covariance = None
    if len(covariance_of):
        covariance = node_covariances(kept, poses, weights, covariance_of)
        covariance[np.isin(covariance_of, loose)] = np.diag(np.full(6, np.inf))
    return PoseGraphResult(
        T_world_node=poses[:num_nodes],
        status=status,
        num_iterations=descent.num_iterations,
        cost_history=descent.costs,
        chi2=problem.chi2(poses),
        weights=descent.weights,
        variance_factor=_variance_factor(kept, poses, weights),
        loose_nodes=loose,
        covariance=covariance,
        note="; ".join(notes),
    )


def _variance_factor(kept: GraphProblem, poses: Float64, weights: Float64) -> float:
    redundancy = int(kept.dof.sum()) - 6 * kept.system.num_nodes
    return float(weights @ kept.chi2(poses)) / redundancy if redundancy > 0 else 1.0
