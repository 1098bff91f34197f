"""One step of a local aligner: Gauss-Newton on the rows of a metric, or the closed form of the pairs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.registration.closed_form import RANK_TOLERANCE, HornFit, fit_horn, fit_pairs
from scanweld.registration.gauss_newton import (
    MIN_MEAN_CONSTRAINT,
    NormalEquations,
    Spectrum,
    solve,
    spectrum,
    standard_deviation,
)
from scanweld.registration.local import kernels
from scanweld.registration.local.config import IcpConfig
from scanweld.registration.local.linearisation import METRICS, Noise, linearise
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import PLANE, Motion, Problem
from scanweld.registration.robust import RobustKernel

_NOISE_MARGIN = 3.0  # how far the slope of a direction must stand above what noisy normals alone produce


@dataclass(frozen=True, slots=True)
class Step:
    """A motion after a step, and how well the pairs before it knew it.

    Attributes
    ----------
    motion : after the step
    rmse_m : of the pairs before it [m]
    deviation_m : standard deviation of the estimate, as a displacement of the points [m]
    """

    motion: Motion
    rmse_m: float
    deviation_m: float


def min_constraint(problem: Problem) -> float:
    """Mean squared slope below which a direction is free, given how noisy the normals are."""
    return max(MIN_MEAN_CONSTRAINT, _NOISE_MARGIN * problem.normal_variance)


def gauss_newton_step(
    problem: Problem,
    config: IcpConfig,
    motion: Motion,
    pairs: Pairing,
    noise: Noise,
    kernel: RobustKernel,
    sample: Float64,
) -> Step:
    """Solve the linearised problem in the directions that the data, the locks and the prior leave to it."""
    metric = METRICS[config.method]
    sums = linearise(problem, metric, pairs, motion, noise, kernel, sample)
    equations, similarity = sums.equations, sums.similarity
    surfaces = sums
    if metric == kernels.GENERALISED and (config.scale != "none" or problem.prior is not None):
        # Its leash along the surface is no knowledge.
        surfaces = linearise(problem, kernels.PLANE, pairs, motion, noise, kernel, sample)
    scaled = config.scale != "none" and holds_scale(
        surfaces.equations, surfaces.similarity[0], problem, min_constraint(problem)
    )
    if scaled:
        equations = _without_scale(equations, similarity, problem.dimension)
    least = RANK_TOLERANCE if config.method == "point-to-point" else min_constraint(problem)
    parts = unlocked_spectrum(equations, problem, least)
    if problem.prior is not None:
        if metric == kernels.GENERALISED:
            parts = unlocked_spectrum(surfaces.equations, problem, least)
        equations, parts = with_prior(equations, parts, problem, motion, noise.geometric)
    xi = solve(equations, parts)
    xi = xi if problem.dimension == 3 else in_space_twist(xi)
    step = _split_step(xi) if config.method == "symmetric" else se3.exp(xi)
    scale = _scale_step(xi, similarity) if scaled else 1.0
    T = step @ motion.T
    T[:3, 3] *= scale
    deviation = noise.geometric * standard_deviation(equations, parts)
    return Step(Motion(T, motion.scale * scale), sums.rmse_m, deviation)


def closed_form_step(
    problem: Problem, config: IcpConfig, motion: Motion, pairs: Pairing, noise: Noise, kernel: RobustKernel
) -> Step:
    """Align the pairs in closed form, in the source's frame: T <- T T_step.

    There "no rotation" means "as the initial guess has it", which is what a free rotation must get.
    """
    rows, weights = weighted_pairs(problem, pairs, noise, kernel)
    d = problem.dimension
    R = motion.T[:d, :d]
    partners = (problem.target[pairs.partner[rows], :d] - motion.T[:d, 3]) @ R / motion.scale
    fit = fit_pairs(problem.source[rows, :d], np.ascontiguousarray(partners), weights=weights, scale=config.scale)
    scale = fit.scale if fit.scale > 0 else 1.0
    T = motion.T.copy()
    T[:d, :d] = R @ fit.rotation
    T[:d, 3] = motion.scale * R @ fit.translation_m + motion.T[:d, 3]
    total = float(weights.sum())
    rmse = float(np.sqrt(weights @ pairs.squared[rows] / total)) if total > 0 else 0.0
    return Step(Motion(T, motion.scale * scale), rmse, 0.0)


def explained_fit(problem: Problem, config: IcpConfig, motion: Motion, pairs: Pairing, weights: Float64) -> HornFit:
    """Return every quantity of the closed form that led from `motion` to the next, about the source as given."""
    rows = np.flatnonzero(pairs.partner >= 0)
    d = problem.dimension
    R = motion.T[:d, :d]
    partners = (problem.target[pairs.partner[rows], :d] - motion.T[:d, 3]) @ R / motion.scale
    fit = fit_horn(problem.source[rows, :d], partners, weights, scale=config.scale)
    mean_a, mean_b = fit.mean_source + problem.source_center[:d], fit.mean_target + problem.source_center[:d]
    return replace(
        fit,
        mean_source=mean_a,
        mean_target=mean_b,
        translation_m=mean_b - fit.scale * fit.rotation @ mean_a,
    )


def weighted_pairs(
    problem: Problem, pairs: Pairing, noise: Noise, kernel: RobustKernel
) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Float64]:
    """Return the source rows of the pairs, and their weights by distance."""
    rows = np.flatnonzero(pairs.partner >= 0)
    weights = kernel.weight(np.sqrt(pairs.squared[rows]) / noise.geometric)
    return rows, weights * problem.weights[rows] if len(problem.weights) else weights


def unlocked_spectrum(equations: NormalEquations, problem: Problem, least: float) -> Spectrum:
    """Spectrum over the directions that no lock holds; a locked translation is that of the points' centroid."""
    twist = range(6) if problem.dimension == 3 else PLANE
    locks = [place for place, axis in enumerate(twist) if axis in problem.locks]
    if not locks:
        return spectrum(equations, least)
    parts = spectrum(equations, least, held=np.eye(len(equations.gradient))[:, locks])
    count = len(locks)
    return Spectrum(parts.values[count:], parts.basis[:, count:], parts.observable[count:])


def with_prior(
    equations: NormalEquations, parts: Spectrum, problem: Problem, motion: Motion, noise_m: float
) -> tuple[NormalEquations, Spectrum]:
    """Add the prior's rows, in units of the data's noise, to what the data says in the directions that it holds.

    What the data says in a free direction is the noise of its normals, and must not compete with a prior however weak.
    What neither the data nor the prior knows to within the gate remains free.
    """
    assert problem.prior is not None
    total = max(equations.total_weight, 1e-300)
    basis, known = parts.basis, parts.observable
    prior = basis.T @ (noise_m**2 * problem.prior.information) @ basis
    error = se3.log(motion.T @ se3.inverse(problem.prior.T_target_source))
    slopes: Float64 = np.where(known, basis.T @ equations.gradient, 0.0)
    slopes += basis.T @ (noise_m**2 * problem.prior.information @ error)
    data = basis.T @ equations.information @ basis * np.outer(known, known)
    inner = (data + prior) / total
    values, vectors = np.linalg.eigh(inner)
    least = max((noise_m / problem.gate) ** 2 / total, 1e-15 * float(values.max(initial=0.0)))
    back = np.linalg.pinv(basis)
    both = replace(
        equations, information=np.asarray(total * back.T @ inner @ back), gradient=np.asarray(back.T @ slopes)
    )
    return both, Spectrum(values, basis @ vectors, values > least)


def in_space_twist(xi: Float64) -> Float64:
    """Twist (6,) of a twist (3,) of the plane."""
    space = np.zeros(6)
    space[PLANE] = xi
    return space


def _split_step(xi: Float64) -> Float64:
    """Half the turn, the shift, half the turn: what the symmetric metric linearises (Rusinkiewicz 2019, eq. 8)."""
    half = se3.exp(np.concatenate([np.zeros(3), xi[3:] / 2]))
    shift = np.eye(4)
    shift[:3, 3] = xi[:3]
    return np.asarray(half @ shift @ half)


def holds_scale(equations: NormalEquations, similarity: Float64, problem: Problem, least: float) -> bool:
    """Whether the data tells a scale from the motions that it tells; three planes that meet in a point do not.

    Parameters
    ----------
    similarity : (7, 7), with the log scale last
    least : mean squared slope below which a direction is free
    """
    parts = unlocked_spectrum(equations, problem, least)
    twist = PLANE if problem.dimension == 2 else np.arange(6)
    held = parts.basis[:, parts.observable]
    along = held.T @ similarity[twist, 6]
    left = similarity[6, 6] - along @ np.linalg.lstsq(held.T @ equations.information @ held, along, rcond=None)[0]
    return bool(left > least * equations.total_weight * equations.radius_m**2)


def _without_scale(equations: NormalEquations, similarity: tuple[Float64, Float64], dimension: int) -> NormalEquations:
    """What remains for the rigid motion once the scale has been eliminated (Schur complement)."""
    H, g = similarity
    if H[6, 6] <= 0:
        return equations
    keep = PLANE if dimension == 2 else np.arange(6)
    h = H[keep, 6]
    return replace(
        equations,
        information=equations.information - np.outer(h, h) / H[6, 6],
        gradient=equations.gradient - h * float(g[6] / H[6, 6]),
    )


def _scale_step(xi: Float64, similarity: tuple[Float64, Float64]) -> float:
    H, g = similarity
    if H[6, 6] <= 0:
        return 1.0
    # A step that more than halves or doubles is no linearisation's business.
    return float(np.exp(np.clip(-(g[6] + H[6, :6] @ xi) / H[6, 6], -0.5, 0.5)))
