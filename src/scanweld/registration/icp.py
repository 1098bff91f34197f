"""Iterative closest point: pair every source point with its nearest target point, align the pairs, repeat.

Point-to-point takes the closed form of :mod:`~scanweld.registration.closed_form` each time, point-to-plane
one Gauss-Newton step of :mod:`~scanweld.registration.gauss_newton`.

Sources: P. J. Besl, N. D. McKay, "A method for registration of 3-D shapes", 1992. Y. Chen, G. Medioni,
"Object modelling by registration of multiple range images", 1992.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.registration.closed_form import RANK_TOLERANCE, HornFit, fit_horn
from scanweld.registration.correspondences import Correspondences
from scanweld.registration.gauss_newton import (
    MIN_MEAN_CONSTRAINT,
    NormalEquations,
    Spectrum,
    free_directions,
    moved_origin,
    solve,
    spectrum,
)
from scanweld.registration.icp_problem import (
    SPACINGS_PER_GATE,
    IcpConfig,
    Matches,
    Motion,
    Problem,
    equations_of,
    kernel_of,
    match,
    neighbours_of,
    prepare_problem,
)
from scanweld.registration.plausibility import Evidence, doubt, gather_evidence
from scanweld.registration.residuals import normal_equations, point_to_plane
from scanweld.registration.result import FreeDirection, RegistrationResult, Status

__all__ = ["IcpConfig", "IcpStep", "icp"]

_CYCLE_SPACINGS = 0.1  # pairs that flip to and fro may keep the motion swaying by so much; that is an answer
_SHARED = 0.7  # different targets per pair, below which the sharing is worth a word
_NOISE_MARGIN = 3.0  # how far the slope of a direction must stand above what noisy normals alone produce


@dataclass(frozen=True, slots=True)
class IcpStep:
    """One iteration; `pairs` were found at `T_before`, and led to `T_after`.

    Attributes
    ----------
    T_before, T_after : (D + 1, D + 1), T_target_source
    scale_before, scale_after : 1 unless the scale is estimated
    pairs : rows of source and target, and their distances [m]
    fit : closed form of the step in the source's frame, T_after = T_before T_step; None for point-to-plane
    rmse_m : root mean square residual of the pairs before the step [m]
    displacement_m : how far the step moved the points
    """

    T_before: Float64
    T_after: Float64
    scale_before: float
    scale_after: float
    pairs: Correspondences
    fit: HornFit | None
    rmse_m: float
    displacement_m: float


def icp(
    source: npt.ArrayLike | PointCloud,
    target: npt.ArrayLike | PointCloud,
    *,
    target_normals: npt.ArrayLike | None = None,
    T_init: npt.ArrayLike | None = None,
    config: IcpConfig | None = None,
    num_threads: int | None = None,
    keep_history: bool = False,
) -> RegistrationResult:
    """Align `source` to `target`, both (N, D) points or clouds, D = 2 or 3, pairs unknown.

    Parameters
    ----------
    source, target : [m]; rows with a value that is not finite are dropped, and counted in the note
    target_normals : (M, D) unit normals; those of the cloud, or estimated, where absent
    T_init : (D + 1, D + 1), the initial T_target_source; identity when None
    config : see :class:`IcpConfig`
    num_threads : all cores when None; the result does not depend on it
    keep_history : keep an :class:`IcpStep` of every iteration

    Returns
    -------
    CONVERGED when the steps became small, every direction is held by the data, and the fit is better than
    that of unrelated points. DEGENERATE names the free directions, which stay where `T_init` put them.
    NO_OVERLAP where the clouds do not show the same thing, TOO_FEW_CORRESPONDENCES where there are hardly any
    points.

    Raises
    ------
    InvalidInputError
        When shapes do not match or `T_init` is no rigid transform.
    """
    settings = config or IcpConfig()
    problem = prepare_problem(source, target, target_normals, T_init, settings, num_threads)
    if isinstance(problem, RegistrationResult):
        return problem
    motion, count, settled, steps = _iterate(problem, settings, keep_history)
    return _judge(problem, settings, motion, count, settled, steps)


def _step(problem: Problem, config: IcpConfig, motion: Motion, matches: Matches) -> tuple[Motion, HornFit | None]:
    """Return the motion after one step."""
    d = problem.dimension
    if matches.normals is not None:
        equations = equations_of(matches)
        xi = solve(equations, spectrum(equations, _min_constraint(problem.normal_variance)))
        return Motion(_exp(xi) @ motion.T), None
    # In the source's frame: T <- T T_step, so that "no rotation" means "as the initial guess has it".
    R, t = motion.T[:d, :d], motion.T[:d, d]
    partners = (matches.partners - t) @ R / motion.scale
    fit = fit_horn(problem.source[matches.pairs.source], partners, matches.weights, scale=config.scale)
    scale = fit.scale if fit.scale > 0 else 1.0
    T = motion.T.copy()
    T[:d, :d] = R @ fit.rotation
    T[:d, d] = motion.scale * R @ fit.translation_m + t
    return Motion(T, motion.scale * scale), fit


def _exp(xi: Float64) -> Float64:
    """exp of a twist (3,) of the plane or (6,) of space."""
    if len(xi) == 6:
        return se3.exp(xi)
    T = se3.exp(np.array([xi[0], xi[1], 0, 0, 0, xi[2]]))
    keep = [0, 1, 3]
    return T[np.ix_(keep, keep)]


def _log(T: Float64) -> Float64:
    """Twist (3,) of a motion of the plane or (6,) of space."""
    if len(T) == 4:
        return se3.log(T)
    space = np.eye(4)
    space[np.ix_([0, 1, 3], [0, 1, 3])] = T
    xi = se3.log(space)
    return xi[[0, 1, 5]]


def _min_constraint(normal_variance: float) -> float:
    return max(MIN_MEAN_CONSTRAINT, _NOISE_MARGIN * normal_variance)


def _iterate(problem: Problem, config: IcpConfig, keep: bool) -> tuple[Motion, int, bool, list[IcpStep]]:
    """Step until the steps are small; return the motion, their number, whether they were small, and them."""
    kernel = kernel_of(config)
    motion = problem.start
    steps: list[IcpStep] = []
    landmark, sway = (
        motion,
        np.inf,
    )  # to notice a cycle: where the motion was, and how far it moved since (Brent 1980)
    for count in range(1, config.max_iterations + 1):
        matches = match(problem, motion, kernel)
        if len(matches.pairs) < problem.dimension or not matches.weights.any():
            return motion, count - 1, False, steps
        before = motion
        motion, fit = _step(problem, config, before, matches)
        points = problem.source[matches.pairs.source]
        displacement, back = _distance(points, before, motion), _distance(points, landmark, motion)
        if keep:
            steps.append(_record(problem, before, motion, matches, fit, displacement))
        small = config.tolerance * problem.spacing
        sway = max(sway, displacement)
        if displacement <= small or (back <= small and sway <= _CYCLE_SPACINGS * problem.spacing):
            return motion, count, True, steps
        if count & (count - 1) == 0:
            landmark, sway = motion, 0.0
    return motion, config.max_iterations, False, steps


def _distance(points: Float64, one: Motion, other: Motion) -> float:
    """Root mean square distance between the places where two motions put the points."""
    return float(np.sqrt(((one.apply(points) - other.apply(points)) ** 2).sum(axis=1).mean()))


def _record(
    problem: Problem,
    before: Motion,
    after: Motion,
    matches: Matches,
    fit: HornFit | None,
    displacement: float,
) -> IcpStep:
    return IcpStep(
        T_before=problem.uncentred(before),
        T_after=problem.uncentred(after),
        scale_before=before.scale,
        scale_after=after.scale,
        pairs=matches.pairs,
        fit=None if fit is None else _about_origin(fit, problem.source_center),
        rmse_m=matches.rmse,
        displacement_m=displacement,
    )


def _about_origin(fit: HornFit, center: Float64) -> HornFit:
    """Return the fit in coordinates of the source as it was given, instead of about its centre."""
    mean_a, mean_b = fit.mean_source + center, fit.mean_target + center
    translation = mean_b - fit.scale * fit.rotation @ mean_a
    return replace(fit, mean_source=mean_a, mean_target=mean_b, translation_m=translation)


def _judge(
    problem: Problem, config: IcpConfig, motion: Motion, count: int, settled: bool, steps: list[IcpStep]
) -> RegistrationResult:
    """Look at where the steps ended, and say what it is worth."""
    free: tuple[FreeDirection, ...] = ()
    matches = match(problem, motion, kernel_of(config))
    overlap = len(matches.pairs) / len(problem.source)
    status, notes = Status.CONVERGED if settled else Status.MAX_ITERATIONS, []
    if len(matches.pairs) == 0 or overlap < config.min_overlap:
        status = Status.NO_OVERLAP
        notes.append(
            f"{overlap:.0%} of the source is within {problem.gate:.3g} m of the target, "
            f"{config.min_overlap:.0%} must be; start nearer, or raise max_correspondence_distance_m"
        )
    elif len(matches.pairs) < problem.dimension:
        status = Status.TOO_FEW_CORRESPONDENCES
        notes.append(f"{len(matches.pairs)} source points are within {problem.gate:.3g} m of the target")
    else:
        evidence = _evidence(problem, config, motion)
        equations, parts = _constraints(problem, matches, evidence)
        free = free_directions(equations, parts)
        if free:
            status = Status.DEGENERATE
            notes.append(f"the data leaves free: {', '.join(direction.words for direction in free)}")
            if matches.normals is None:
                motion = _held(problem, motion, parts)
                matches = match(problem, motion, kernel_of(config))
        elif reason := doubt(evidence):
            status = Status.NO_OVERLAP
            notes.append(reason)
        if matches.pairs.num_targets < _SHARED * len(matches.pairs) and status is not Status.CONVERGED:
            notes.append(f"{len(matches.pairs)} source points share {matches.pairs.num_targets} targets")
    if status is Status.MAX_ITERATIONS:
        notes.insert(0, f"still moving after {count} steps; raise max_iterations, or look at the initial guess")
    if problem.dropped:
        notes.append(problem.dropped)
    return RegistrationResult(
        T_target_source=problem.uncentred(motion),
        status=status,
        information=moved_origin(equations_of(matches).information, problem.target_center),
        scale=motion.scale,
        num_iterations=count,
        num_inliers=len(matches.pairs),
        overlap=overlap,
        rmse_m=matches.rmse,
        unobservable=free,
        note="; ".join(notes),
        history=tuple(steps),
    )


def _evidence(problem: Problem, config: IcpConfig, motion: Motion) -> Evidence:
    reach = max(problem.gate, SPACINGS_PER_GATE * problem.spacing)
    k = neighbours_of(config, len(problem.target), problem.dimension)
    return gather_evidence(motion.apply(problem.source), problem.target, problem.index, problem.spacing, reach, k)


def _constraints(problem: Problem, matches: Matches, evidence: Evidence) -> tuple[NormalEquations, Spectrum]:
    """Return the equations that tell which directions the data holds, and their spectrum.

    Point pairs hold every translation, even along a plane that slides in itself: unless the points coincide,
    it is the surfaces that must hold them.
    """
    equations = equations_of(matches)
    if matches.normals is not None:
        return equations, spectrum(equations, _min_constraint(problem.normal_variance))
    parts = spectrum(equations, RANK_TOLERANCE)
    if not parts.observable.all() or evidence.coincident or not evidence.surfaces:
        return equations, parts
    residuals, jacobian = point_to_plane(evidence.moved, evidence.partners, evidence.normals)
    sliding = normal_equations(evidence.moved, residuals, jacobian, np.ones(len(residuals)))
    return sliding, spectrum(sliding, _min_constraint(evidence.normal_variance))


def _held(problem: Problem, motion: Motion, parts: Spectrum) -> Motion:
    """Take the free directions out of the motion since the start."""
    start = problem.start
    if motion.scale != start.scale:
        return motion
    y = np.linalg.solve(parts.basis, _log(motion.T @ se3.inverse(start.T)))
    return Motion(_exp(parts.basis @ np.where(parts.observable, y, 0.0)) @ start.T)
