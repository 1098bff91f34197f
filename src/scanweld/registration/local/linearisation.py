"""The normal equations of a metric at given pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64
from scanweld.parallel import run_ranges
from scanweld.registration.gauss_newton import NormalEquations
from scanweld.registration.local import kernels
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import PLANE, Motion, Problem
from scanweld.registration.robust import RobustKernel, mad_scale

METRICS = {
    "point-to-point": kernels.POINT,
    "point-to-plane": kernels.PLANE,
    "symmetric": kernels.SYMMETRIC,
    "gicp": kernels.GENERALISED,
    "coloured": kernels.COLOURED,
}

LEAST_NOISE = 0.02  # spacings: on noise-free planes the median is 0, and all that is curved would be an outlier
_LEAST_BESIDE_COLOUR = 0.1  # spacings; more trust in a noise-free surface would leave texture no say along it
_LEAST_COLOUR_NOISE = 0.01  # of the range of intensities; images have 256 steps
_GRAIN = 6  # chunks that are worth a thread
_UPPER = np.triu_indices(8)
_SAMPLE = 2048  # residuals whose median stands for all


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Sums over the pairs, about the origin of the centred target.

    Attributes
    ----------
    equations : of the rigid motion (6, or 3 in the plane)
    similarity : (7, 7) H and (7,) g with the logarithm of the scale last
    rmse_m : weighted root mean square of the geometric residuals [m]
    count : number of pairs
    """

    equations: NormalEquations
    similarity: tuple[Float64, Float64]
    rmse_m: float
    count: int


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of the residuals: geometric [m], and of intensity."""

    geometric: float
    colour: float

    @property
    def array(self) -> Float64:
        """Both, as the kernels take them."""
        return np.array([self.geometric, self.colour])


def estimate_noise(
    problem: Problem, metric: int, pairs: Pairing, motion: Motion, known_m: float = 0.0
) -> tuple[Noise, Float64]:
    """Return the noise from the median of a sample of residuals, and that sample [m]."""
    coloured = metric == kernels.COLOURED
    stride = max(1, len(pairs.partner) // _SAMPLE)
    squares = np.zeros((2, len(pairs.partner) // stride + 1))
    count = kernels.pair_squares(metric, stride, *_arguments(problem, pairs, motion), squares)
    residuals = np.sqrt(squares[:, :count])
    least = (_LEAST_BESIDE_COLOUR if coloured else LEAST_NOISE) * problem.spacing
    geometric = known_m or max(mad_scale(residuals[0]), least, 1e-300)
    colour = max(mad_scale(residuals[1]), _LEAST_COLOUR_NOISE) if coloured else _LEAST_COLOUR_NOISE
    return Noise(geometric, colour), residuals[0]


def linearise(
    problem: Problem, metric: int, pairs: Pairing, motion: Motion, noise: Noise, kernel: RobustKernel, sample: Float64
) -> Linearisation:
    """Sum the weighted rows of all pairs; the kernel may set its threshold by `sample`, some of the residuals [m]."""
    chunks = -(-len(pairs.partner) // kernels.CHUNK)
    partials = np.empty((chunks, kernels.SUMS))
    moved, partner, target, *rest = _arguments(problem, pairs, motion)
    robust = np.array(kernel.compiled(sample / noise.geometric), dtype=np.float64)
    deviations = noise.array

    def body(start: int, stop: int) -> None:
        kernels.pair_sums(
            metric, start, stop, moved, partner, problem.weights, target, *rest, deviations, robust, partials
        )

    run_ranges(chunks, body, grain=_GRAIN)
    sums = partials.sum(axis=0)
    full = np.zeros((8, 8))
    full[_UPPER] = full.T[_UPPER] = sums[: kernels.PRODUCTS]
    return _assemble(metric, problem.dimension, full, sums[kernels.PRODUCTS :])


def _assemble(metric: int, dimension: int, full: Float64, moments: Float64) -> Linearisation:
    weight = float(moments[0])
    centroid = moments[1:4] / weight if weight > 0 else np.zeros(3)
    spread = moments[4] / weight - centroid @ centroid if weight > 0 else 0.0
    twist = PLANE if dimension == 2 else slice(6)
    equations = NormalEquations(
        information=full[twist][:, twist],
        gradient=full[twist, 7],
        # Slopes are compared with those of rows of unit length; GICP's shrink where the normals disagree.
        total_weight=float(np.trace(full[:dimension, :dimension])) / (dimension if metric == kernels.POINT else 1),
        centroid_m=centroid[:dimension],
        radius_m=float(np.sqrt(max(spread, 0.0))),
    )
    rmse = float(np.sqrt(max(full[7, 7], 0.0) / weight)) if weight > 0 else 0.0
    return Linearisation(equations, (full[:7, :7], full[:7, 7]), rmse, int(moments[5]))


def surfaces_at(problem: Problem, motion: Motion) -> tuple[object, ...]:
    """Return what the kernels take of the clouds beside the pairs, at a motion."""
    colours = problem.colours
    return (
        problem.target,
        problem.normals,
        problem.source_normals,
        np.ascontiguousarray(motion.T[:3, :3]),
        (colours.source, colours.target, colours.gradients),
        problem.thickness,
    )


def _arguments(problem: Problem, pairs: Pairing, motion: Motion) -> tuple[object, ...]:
    return (pairs.moved, pairs.partner, *surfaces_at(problem, motion))
