"""Covariance of an answer, from the scatter of its scores.

The motion solves sum_i s_i = 0 with the scores s_i = w_i J_i^T r_i of the pairs, so that its covariance is the
sandwich A^-1 B A^-1 (P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967),
whatever the noise is like. Two things are particular to nearest neighbours.

B: pairs that share a target share its noise. Their scores are added before they are squared (K.-Y. Liang,
S. L. Zeger, "Longitudinal data analysis using generalized linear models", 1986); the answer follows targets that many
sources share, which makes their residuals too small by their leverage (J. G. MacKinnon, H. White, "Some
heteroskedasticity-consistent covariance matrix estimators", 1985, HC3).

A: the slope of the summed scores is smaller than the Hessian H of the steps, which holds pairs and weights. Weights
fall as residuals grow; and moved points find other partners, those whose noise suits them, and slide along the
surface without resistance where H of point-to-point has every point tied to its partner. Where the noise is as large
as the spacing of the points, H is too stiff by a factor of two, for point-to-point by more. So the slope is measured:
a sample of the source is moved a little along each axis, and paired anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanweld.arrays import Float64, Int32, Int64
from scanweld.registration.local import kernels
from scanweld.registration.local.linearisation import Noise, surfaces_at
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import Motion, Problem
from scanweld.registration.residuals import point_jacobian
from scanweld.registration.robust import CompiledWeight, mad_scale

_CLUSTERS = 3_000  # targets whose scores stand for all
_MOVED = 512  # source points whose change of scores stands for all
_STEP = 0.5  # standard deviations of the residuals: small enough to be a slope, large enough to change partners
_LEAST_STEP = 0.01  # spacings, where there is no noise
_SOFTEST = 0.01  # of H; what a sample may say about a slope, whose noise could make it vanish
_LARGEST_LEVERAGE = 0.9


def scatter(
    problem: Problem, metric: int, pairs: Pairing, motion: Motion, noise: Noise, weight: CompiledWeight, bread: Float64
) -> Float64:
    """Return B (7, 7) = sum_j s_j s_j^T, s_j the summed scores of the pairs that share target j, over 1 - leverage.

    `bread` (7, 7) is the inverse of H, zero in directions that are not estimated.
    """
    stride = max(1, len(problem.target) // _CLUSTERS)
    scores = np.zeros((-(-len(problem.target) // stride), 8))
    _add_scores(problem, metric, pairs.moved, pairs.partner, motion, noise, weight, bread, stride, scores)
    scores = scores[:, :7] / (1 - np.minimum(scores[:, 7:], _LARGEST_LEVERAGE))
    return np.asarray(stride * (scores.T @ scores))


def slope(
    problem: Problem, metric: int, pairs: Pairing, motion: Motion, noise: Noise, weight: CompiledWeight, sample: Float64
) -> Float64:
    """Return A (7, 7): how the summed scores change with the motion, pairs and weights found anew.

    A score depends on where its point is, and the motion moves the points by dp'/d(xi): so one set of displacements
    along the axes tells the slope in every direction. `sample`: residuals [m].
    """
    step = max(_STEP * mad_scale(sample), _LEAST_STEP * problem.spacing)
    if step == 0:
        return np.zeros((7, 7))
    # Points beyond the gate may come within it; those whose pairs were rejected stay out.
    candidates = np.flatnonzero((pairs.partner >= 0) | (pairs.squared == 0))
    stride = max(1, len(candidates) // _MOVED)
    some = candidates[::stride]
    axes = np.eye(3)[: problem.dimension]
    shifts = np.concatenate([step * axes, -step * axes])
    moved = (pairs.moved[some] + shifts[:, None, :]).reshape(-1, 3)
    part = _part(problem, np.tile(some, len(shifts)))
    _, rows = part.index.nearest(part.in_dimension(moved), part.gate, np.tile(pairs.partner[some], len(shifts)))
    partner = np.where(rows < len(part.target), rows, -1).astype(np.int32)
    scores = np.zeros((len(moved), 8))
    _add_scores(part, metric, moved, partner, motion, noise, weight, np.zeros((7, 7)), 0, scores)
    ahead, behind = scores[:, :7].reshape(2, len(axes), len(some), 7)
    places = pairs.moved[some]
    jacobian = np.concatenate([point_jacobian(places), places[:, :, None]], axis=2)[:, : len(axes)]
    A = np.einsum("ani,naj->ij", ahead - behind, jacobian) / (2 * step)
    return np.asarray(stride * (A + A.T) / 2)


def softened(H: Float64, A: Float64) -> Float64:
    """Return A (K, K), held between a hundredth of H, positive definite, and H, which fixed pairs would give."""
    values, vectors = np.linalg.eigh(H)
    if not values[-1] > 0:  # all weights are zero, and so is the scatter
        return np.eye(len(H))
    values = np.maximum(values, 1e-12 * values[-1])
    root, inverse = vectors * np.sqrt(values), vectors / np.sqrt(values)
    shares, turned = np.linalg.eigh(inverse.T @ A @ inverse)
    root = root @ turned
    return np.asarray((root * np.clip(shares, _SOFTEST, 1.0)) @ root.T)


def _part(problem: Problem, rows: Int64) -> Problem:
    """The problem with some of the source's points."""
    return replace(
        problem,
        source=problem.source[rows],
        source_normals=problem.source_normals[rows] if len(problem.source_normals) else problem.source_normals,
        weights=problem.weights[rows] if len(problem.weights) else problem.weights,
        colours=replace(
            problem.colours, source=problem.colours.source[rows] if len(problem.colours.source) else np.zeros(0)
        ),
    )


def _add_scores(
    problem: Problem,
    metric: int,
    moved: Float64,
    partner: Int32,
    motion: Motion,
    noise: Noise,
    weight: CompiledWeight,
    bread: Float64,
    stride: int,
    scores: Float64,
) -> None:
    target, *rest = surfaces_at(problem, motion)
    robust = np.array(weight, dtype=np.float64)
    kernels.add_scores(
        metric, stride, moved, partner, problem.weights, target, *rest, noise.array, robust, bread, scores
    )
