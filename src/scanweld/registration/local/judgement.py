"""What the end of the iterations is worth: a status, the free directions, the covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3
from scanweld.geometry.normals import SurfaceFit
from scanweld.parallel import side_by_side
from scanweld.registration.closed_form import RANK_TOLERANCE
from scanweld.registration.gauss_newton import (
    NormalEquations,
    Spectrum,
    free_directions,
    moved_origin,
    solve,
)
from scanweld.registration.local import kernels
from scanweld.registration.local.config import IcpConfig, kernel_of
from scanweld.registration.local.covariance import scatter, slope, softened
from scanweld.registration.local.linearisation import LEAST_NOISE, METRICS, Linearisation, estimate_noise, linearise
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import (
    PLANE,
    SPACINGS_PER_GATE,
    Motion,
    Problem,
    neighbours_of,
)
from scanweld.registration.local.steps import holds_scale, in_space_twist, min_constraint, unlocked_spectrum, with_prior
from scanweld.registration.plausibility import SAMPLE, Evidence, doubt, gather_evidence
from scanweld.registration.residuals import normal_equations, point_jacobian, point_to_plane
from scanweld.registration.result import FreeDirection, RegistrationResult, Status
from scanweld.registration.robust import Cauchy, mad_scale

_PULLED, _PULLED_POINTS = 0.25, 0.4  # spacings; pairs of points show the sampling
_VAGUE_POINTS = 500  # source points that stand for all
_SHARED = 0.7  # different targets per pair, below which the sharing is worth a word


@dataclass(frozen=True, slots=True)
class Descent:
    """Where the steps ended.

    Attributes
    ----------
    problem : what was solved last, with the gate that was used
    motion : the last one
    pairs : of that problem
    count : steps taken
    settled : whether they became small
    """

    problem: Problem
    motion: Motion
    pairs: Pairing
    count: int
    settled: bool


@dataclass(frozen=True, slots=True)
class _Knowledge:
    """Directions that the data holds, and those that data and prior hold together; no locked ones among them."""

    data: Spectrum
    both: Spectrum


def judge(end: Descent, config: IcpConfig) -> RegistrationResult:
    """Look at where the steps ended, and say what it is worth."""
    problem, motion, pairs = end.problem, end.motion, end.pairs
    count = pairs.find(motion)
    overlap = count / len(problem.source)
    status, notes = Status.CONVERGED if end.settled else Status.MAX_ITERATIONS, []
    free: tuple[FreeDirection, ...] = ()
    knowledge: _Knowledge | None = None
    if count == 0 or overlap < config.min_overlap:
        status = Status.NO_OVERLAP
        notes.append(
            f"{overlap:.0%} of the source is within {problem.gate:.3g} m of the target, "
            f"{config.min_overlap:.0%} must be; start nearer, or raise max_correspondence_distance_m"
        )
    elif count < problem.dimension:
        status = Status.TOO_FEW_CORRESPONDENCES
        notes.append(f"{count} source points are within {problem.gate:.3g} m of the target")
    else:
        neighbours = neighbours_of(config, len(problem.target), problem.dimension)
        evidence = gather(problem, motion, pairs, neighbours)
        equations, data = _constraints(problem, config, motion, pairs, evidence)
        parts = data
        if problem.prior is not None:
            if config.method == "point-to-point":  # pairs of points hold on where the surfaces would let go
                motion = _held(motion, Motion(problem.prior.T_target_source), data, problem.dimension)
            noise, _ = estimate_noise(problem, METRICS[config.method], pairs, motion, config.kernel_scale_m)
            equations, parts = with_prior(equations, data, problem, motion, noise.geometric)
        knowledge = _Knowledge(data, parts)
        free = free_directions(equations, parts)
        if config.scale != "none" and not _scale_held(problem, config, motion, pairs, evidence):
            free = (*free, FreeDirection("scale", np.zeros(len(equations.gradient))))
            motion = Motion(motion.T, problem.start.scale)
        if free:
            status = Status.DEGENERATE
            notes.append(f"the data leaves free: {', '.join(direction.words for direction in free)}")
            motion = _held(motion, problem.start, parts, problem.dimension)
            count = pairs.find(motion)
        elif evidence.num_targets < problem.dimension:
            status = Status.TOO_FEW_CORRESPONDENCES
            notes.append("nearly all of the source is at one point of the target; are both in metres?")
        elif reason := doubt(evidence) or _pull(problem, config, evidence):
            status = Status.NO_OVERLAP
            notes.append(reason)
        num_targets = len(np.unique(pairs.partner[pairs.partner >= 0])) if not status.success else count
        if num_targets < _SHARED * count:
            notes.append(f"{count} source points share {num_targets} targets")
    if status is Status.MAX_ITERATIONS:
        notes.insert(0, f"still moving after {end.count} steps; raise max_iterations, or look at the initial guess")
    if problem.dropped:
        notes.append(problem.dropped)
    sums, covariance, scale_std = _statistics(problem, config, motion, pairs, knowledge)
    if status is Status.CONVERGED and (reason := _vague(problem, config, motion, covariance, sums.rmse_m)):
        status = Status.NO_OVERLAP
        notes.append(reason)
    offset = problem.target_center[: problem.dimension]
    return RegistrationResult(
        T_target_source=problem.uncentred(motion),
        status=status,
        information=moved_origin(sums.equations.information, offset),
        scale=motion.scale,
        scale_std=scale_std if status.success else 0.0,
        num_iterations=end.count,
        num_inliers=count,
        overlap=overlap,
        rmse_m=sums.rmse_m,
        covariance=_moved_covariance(covariance, offset) if status.has_pose else None,
        unobservable=free,
        note="; ".join(notes),
    )


def gather(problem: Problem, motion: Motion, pairs: Pairing, neighbours: int) -> Evidence:
    """Collect what tells a fit from chance, from some of the source's points, those that have a partner among them."""
    found = np.flatnonzero(pairs.partner >= 0)
    total = len(problem.source)
    count = total if total < 4 * SAMPLE else min(total, SAMPLE * total // len(found))
    # Evenly spread, but at no whole stride, which might be that of the data.
    rows = np.linspace(0, total - 1, count).astype(np.int64)
    if not (pairs.partner[rows] >= 0).any():
        rows = found
    known = len(problem.angular_variance) > 0
    return gather_evidence(
        problem.in_dimension(motion.apply(problem.source[rows])),
        problem.in_dimension(problem.target),
        problem.index,
        problem.spacing,
        max(problem.gate, SPACINGS_PER_GATE * problem.spacing),
        neighbours,
        problem.surfaces,
        SurfaceFit(problem.in_dimension(problem.normals), problem.angular_variance) if known else None,
    )


def _constraints(
    problem: Problem, config: IcpConfig, motion: Motion, pairs: Pairing, evidence: Evidence
) -> tuple[NormalEquations, Spectrum]:
    """Return the equations that tell which directions the data holds, and their spectrum.

    Pairs of points hold every translation, even along a plane that slides in itself: unless the points coincide, it is
    the surfaces that must hold them. That goes for GICP's leash along the surface, too; colour may hold what the
    surfaces leave free.
    """
    kernel = kernel_of(config)
    metric = METRICS[config.method]
    if metric == kernels.GENERALISED:
        metric = kernels.PLANE
    noise, sample = estimate_noise(problem, metric, pairs, motion, config.kernel_scale_m)
    equations = linearise(problem, metric, pairs, motion, noise, kernel, sample).equations
    if metric != kernels.POINT:
        return equations, unlocked_spectrum(equations, problem, min_constraint(problem))
    parts = unlocked_spectrum(equations, problem, RANK_TOLERANCE)
    if not parts.observable.all() or evidence.coincident or not evidence.surfaces:
        return equations, parts
    return _sliding(problem, evidence)


def _scale_held(problem: Problem, config: IcpConfig, motion: Motion, pairs: Pairing, evidence: Evidence) -> bool:
    """Whether the surfaces, or points that coincide, tell the scale."""
    metric = METRICS[config.method]
    if metric == kernels.POINT and evidence.surfaces and not evidence.coincident:
        residuals, jacobian, weights = _surface_rows(problem, evidence)
        columns = np.zeros((len(jacobian), 7))
        columns[:, PLANE if problem.dimension == 2 else np.arange(6)] = jacobian
        columns[:, 6] = np.einsum("nd,nd->n", evidence.normals, evidence.moved)
        equations = normal_equations(evidence.moved, residuals, jacobian, weights)
        return holds_scale(equations, (columns.T * weights) @ columns, problem, _least(problem, evidence))
    metric = kernels.PLANE if metric == kernels.GENERALISED else metric
    noise, sample = estimate_noise(problem, metric, pairs, motion, config.kernel_scale_m)
    sums = linearise(problem, metric, pairs, motion, noise, kernel_of(config), sample)
    return holds_scale(sums.equations, sums.similarity[0], problem, min_constraint(problem))


def _surface_rows(problem: Problem, evidence: Evidence) -> tuple[Float64, Float64, Float64]:
    """Return what the surfaces say, whatever the method: residuals (N,), Jacobians (N, K) and weights (N,)."""
    residuals, jacobian = point_to_plane(evidence.moved, evidence.partners, evidence.normals)
    # Normals at edges point anywhere; where they do, the residuals stand out.
    size = max(mad_scale(residuals), LEAST_NOISE * problem.spacing, 1e-300)
    return residuals, jacobian, Cauchy().weight(residuals / size)


def _sliding(problem: Problem, evidence: Evidence) -> tuple[NormalEquations, Spectrum]:
    """Return the equations of the surfaces, and which directions they hold."""
    equations = normal_equations(evidence.moved, *_surface_rows(problem, evidence))
    return equations, unlocked_spectrum(equations, problem, _least(problem, evidence))


def _least(problem: Problem, evidence: Evidence) -> float:
    """Mean squared slope of the sample's surfaces below which a direction is free."""
    # Pairs lie apart along the surface, which on a curved one turns their normals as noise does.
    return 2 * max(min_constraint(problem), 3.0 * evidence.normal_variance)


def _pull(problem: Problem, config: IcpConfig, evidence: Evidence) -> str:
    """Say how far an answer is from where the surfaces want it, or "" where that is near.

    Points beyond the rim of the target pull on point-to-point, and on the others from afar; small steps do not tell.
    Right answers are within a tenth of a spacing of what point-to-plane would answer, of point-to-point within a third.
    """
    if config.method == "coloured" or problem.prior is not None or problem.uneven:  # the spacing says nothing there
        return ""
    if evidence.coincident or not evidence.surfaces:
        return ""
    equations, parts = _sliding(problem, evidence)
    asked = float(np.linalg.norm(np.linalg.lstsq(parts.basis, solve(equations, parts), rcond=None)[0]))
    least = (_PULLED_POINTS if config.method == "point-to-point" else _PULLED) * problem.spacing
    if asked <= least:
        return ""
    return (
        f"the surfaces do not meet: point-to-plane would move on by {asked:.3g} m or more, as where points beyond the "
        "rim of a partial overlap pull; try kernel = 'trimmed', a smaller max_correspondence_distance_m, or "
        "point-to-plane"
    )


def _vague(problem: Problem, config: IcpConfig, motion: Motion, covariance: Float64, rmse_m: float) -> str:
    """Say how uncertain an answer is by its own residuals, or "" where it is a place that holds.

    Where moved points find other partners as well, the scores hardly change with the motion, and the steps ended on
    slack. No answer is worth much that may be off (one sigma) by twice what its pairs may be apart. Right answers to
    surfaces are held well or fit closely: in furnished rooms the product of sigma and residuals was at most 0.7 squared
    spacings, that of wrong ones mostly above 1.8. What a prior leaves uncertain its giver knows.
    """
    if problem.prior is not None or problem.uneven or not len(covariance):
        return ""
    stride = max(1, len(problem.source) // _VAGUE_POINTS)
    jacobian = point_jacobian(problem.in_dimension(motion.apply(problem.source[::stride])))
    sigma = float(np.sqrt(np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian).mean()))
    loose = config.method != "point-to-point" and sigma * rmse_m > problem.spacing**2
    if sigma <= 2 * problem.gate and not loose:
        return ""
    return (
        f"it holds nowhere: its own residuals leave it uncertain by {sigma:.3g} m (one sigma), where points are "
        f"{problem.spacing:.3g} m apart; start nearer, or use register_global"
    )


def _held(motion: Motion, reference: Motion, parts: Spectrum, dimension: int) -> Motion:
    """Take the free directions out of the motion since `reference`."""
    xi = se3.log(motion.T @ se3.inverse(reference.T))
    if dimension == 2:
        xi = xi[PLANE]
    # Locked directions are no columns of the basis: least squares leaves them out, as they are zero anyway.
    y = np.linalg.lstsq(parts.basis, xi, rcond=None)[0]
    held = parts.basis @ np.where(parts.observable, y, 0.0)
    return Motion(se3.exp(held if dimension == 3 else in_space_twist(held)) @ reference.T, motion.scale)


def _statistics(
    problem: Problem, config: IcpConfig, motion: Motion, pairs: Pairing, knowledge: _Knowledge | None
) -> tuple[Linearisation, Float64, float]:
    """Return the sums at the end, the covariance about the origin of the centred target, and the scale's deviation."""
    metric, kernel = METRICS[config.method], kernel_of(config)
    noise, sample = estimate_noise(problem, metric, pairs, motion, config.kernel_scale_m)
    sums = linearise(problem, metric, pairs, motion, noise, kernel, sample)
    rigid = PLANE if problem.dimension == 2 else np.arange(6)
    if knowledge is None or not knowledge.both.observable.any():
        return sums, np.zeros((len(rigid), len(rigid))), 0.0
    radius = (sums.equations.radius_m or 1.0) if config.scale != "none" else None
    every = _columns(knowledge.data.basis, rigid, radius)
    known = np.concatenate(
        [knowledge.data.observable, np.ones(every.shape[1] - len(knowledge.data.observable), np.bool_)]
    )
    data, back = every[:, known], np.linalg.pinv(every)[known].T
    both = _columns(knowledge.both.basis[:, knowledge.both.observable], rigid, radius)
    A = B = np.zeros((7, 7))
    if data.shape[1] > 0:
        weight = kernel.compiled(sample / noise.geometric)
        H = data.T @ sums.similarity[0] @ data
        bread = data @ np.linalg.pinv(H, hermitian=True) @ data.T
        change, scores = side_by_side(
            lambda: slope(problem, metric, pairs, motion, noise, weight, sample),
            lambda: scatter(problem, metric, pairs, motion, noise, weight, bread),
        )
        A = back @ softened(H, data.T @ change @ data) @ back.T
        B = back @ data.T @ scores @ data @ back.T
    if problem.prior is not None:
        A, B = A.copy(), B.copy()
        A[:6, :6] += noise.geometric**2 * problem.prior.information
        B[:6, :6] += noise.geometric**4 * problem.prior.information
    inverse = both @ np.linalg.inv(both.T @ A @ both) @ both.T
    covariance = inverse @ B @ inverse
    return sums, covariance[np.ix_(rigid, rigid)], float(motion.scale * np.sqrt(max(covariance[6, 6], 0.0)))


def _columns(twists: Float64, rigid: Int64, radius_m: float | None) -> Float64:
    """Return twists (K, L) as columns of (7, L), and the log scale as one more where there is a radius."""
    columns = np.zeros((7, twists.shape[1] + (radius_m is not None)))
    columns[rigid, : twists.shape[1]] = twists
    if radius_m is not None:
        columns[6, -1] = 1 / radius_m
    return columns


def _moved_covariance(covariance: Float64, offset_m: Float64) -> Float64:
    """Covariance about the origin of a frame in which this one's origin lies at `offset_m`."""
    dimension = len(offset_m)
    shift = np.eye(len(covariance))
    c = offset_m
    # exp of the new twist (rho, phi) is that of (rho + phi x c, phi) about the old origin; here the way back.
    if dimension == 3:
        shift[:3, 3:] = -np.array([[0, c[2], -c[1]], [-c[2], 0, c[0]], [c[1], -c[0], 0]])
    else:
        shift[:2, 2] = (c[1], -c[0])
    return np.asarray(shift @ covariance @ shift.T)
