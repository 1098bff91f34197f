"""The way down: from a part of the source to all of it, and from other starts where the first leads nowhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.registration.local.anderson import Anderson
from scanweld.registration.local.config import IcpConfig, kernel_of
from scanweld.registration.local.history import IcpStep, record
from scanweld.registration.local.judgement import Descent
from scanweld.registration.local.linearisation import METRICS, estimate_noise
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import Motion, Problem, neighbours_of
from scanweld.registration.local.steps import closed_form_step, gauss_newton_step
from scanweld.registration.robust import GraduatedNonConvexity, RobustKernel

_COARSE_FROM = 500  # points of the source; fewer are all looked at from the beginning
_COARSEST = 1000  # points of the source that find the valley
_LEVEL_RATIO = 8  # a level has so many times the points of the one before
_SETTLED_COARSE, _SETTLED_FINE = 0.5, 0.25  # a step of so many standard deviations of the estimate moves nothing
_CYCLE_SPACINGS = 0.1  # pairs that flip to and fro may keep the motion swaying by so much; that is an answer
_PROBES = 500  # points whose displacement stands for all
_MUCH_TIGHTER = 0.7  # of the gate: reason enough to step on with a tighter one
_CLOSE_SPACINGS = 3.0  # pairs of one surface are no further apart
_NORMAL_MAD = 1.4826  # standard deviations in a median absolute deviation
_AGREE = 0.8  # cosine between the normals of a pair on one surface
_FITS = 0.8  # share of the pairs within the gate that are close, where the surfaces meet
_CLEARLY = 1.05  # times the first answer's fit that another must reach
_SCREENED, _TRY_ITERATIONS = 350, 15  # points and steps that tell a promising start
_CONFIRMED = 4  # other starts that lead to the first answer again: no need to look further
_TURNS_DEG = (25.0, 50.0)
_SHIFTS_GATES = (1.0, 2.5)
_FARTHEST_RAD = np.deg2rad(75.0)  # from the first guess: a room fits itself after a quarter turn, all of it at once


def descend(
    problem: Problem, config: IcpConfig, steps: list[IcpStep] | None = None, start: Motion | None = None
) -> Descent:
    """Step from coarse to fine until the steps are small; every level has more of the source's points.

    With a `start` that is near the answer there is nothing coarse to do.
    """
    motion, count = start or problem.start, 0
    levels = _coarse_levels(problem, config) if start is None else []
    for level in levels:
        level = replace(level, gate=problem.gate)
        rough = replace(config, method="gicp" if len(level.source_normals) else config.method)
        end = iterate(level, rough, motion, _SETTLED_COARSE, steps)
        if count == 0 and config.attempts > 0:
            end = _best_attempt(level, rough, end)
        motion, count = end.motion, count + end.count
        if _fit(level, end)[0] >= _FITS:
            problem = _tightened(problem, end)
    end = iterate(problem, config, motion, _SETTLED_FINE, steps)
    count += end.count
    tight = _tightened(problem, end) if levels or start else problem
    if end.settled and tight.gate < _MUCH_TIGHTER * problem.gate:
        end = iterate(tight, config, end.motion, _SETTLED_FINE, steps)
        count += end.count
    return replace(end, count=count)


def _tightened(problem: Problem, end: Descent) -> Problem:
    """The problem with a gate that fits the distances between the surfaces once they meet.

    A gate that was wide enough to get there lets in pairs of the rim with what lies beyond it, which bias the answer.
    """
    found = end.pairs.partner >= 0
    if not end.settled or not found.any():
        return problem
    typical = _NORMAL_MAD * float(np.sqrt(np.median(end.pairs.squared[found])))
    return replace(problem, gate=min(problem.gate, _CLOSE_SPACINGS * max(problem.spacing, typical)))


def _coarse_levels(problem: Problem, config: IcpConfig) -> list[Problem]:
    """Parts of the source, coarsest first; each is an eighth of the next.

    Only the coarsest, which finds the valley, gets normals of the source: fitting them takes longer than its steps.
    """
    count = len(problem.source)
    if not config.coarse_to_fine or count < _COARSE_FROM:
        return []
    ratio = count / _COARSEST
    strides = [max(1, round(ratio / _LEVEL_RATIO ** int(np.log(max(ratio, 1)) / np.log(_LEVEL_RATIO))))]
    while count // strides[0] >= _LEVEL_RATIO * _COARSEST:
        strides.insert(0, strides[0] * _LEVEL_RATIO)
    neighbours = neighbours_of(config, count, problem.dimension)
    return [problem.coarse(stride, neighbours, fit=stride == strides[0]) for stride in strides]


def iterate(
    problem: Problem, config: IcpConfig, motion: Motion, settled: float, steps: list[IcpStep] | None = None
) -> Descent:
    """Pair and step until a step is small, or below `settled` standard deviations of what the points can tell."""
    pairs, kernels = Pairing(problem, config), _Kernels(config)
    ahead = Anderson(motion, config.anderson)
    probes = moments(problem.source)
    last = np.inf
    landmark, sway = motion, np.inf  # to notice a cycle: where the motion was, and how far it moved since (Brent 1980)
    for count in range(1, config.max_iterations + 1):
        if pairs.find(motion) < problem.dimension:
            return Descent(problem, motion, pairs, count - 1, False)
        noise, sample = estimate_noise(problem, METRICS[config.method], pairs, motion, config.kernel_scale_m)
        kernel, true_kernel = kernels.next(sample / noise.geometric)
        if config.method == "point-to-point" and not problem.constrained:
            step = closed_form_step(problem, config, motion, pairs, noise, kernel)
        else:
            step = gauss_newton_step(problem, config, motion, pairs, noise, kernel, sample)
        before, motion = motion, ahead.accelerate(motion, step.motion)
        displacement, back = distance(probes, before, motion), distance(probes, landmark, motion)
        if steps is not None:
            steps.append(record(problem, config, before, motion, pairs, noise, kernel, step.rmse_m, displacement))
        small = config.tolerance * problem.spacing
        sway = max(sway, displacement)
        cycles = back <= small and sway <= _CYCLE_SPACINGS * problem.spacing
        # Steps that shrink by a constant factor have so much left to go.
        shrinking, last = min(displacement / max(last, 1e-300), 1.0), displacement
        ahead_m = displacement * shrinking / max(1 - shrinking, 1e-9)
        noise_only = max(displacement, ahead_m) <= settled * step.deviation_m
        if true_kernel and (displacement <= small or cycles or noise_only):
            return Descent(problem, motion, pairs, count, True)
        if count & (count - 1) == 0:
            landmark, sway = motion, 0.0
    return Descent(problem, motion, pairs, config.max_iterations, False)


def moments(points: Float64) -> Float64:
    """Return the mean of (x, 1) (x, 1)^T (4, 4) over some of the points (N, 3)."""
    some = points[:: max(1, len(points) // _PROBES)]
    some = np.column_stack([some, np.ones(len(some))])
    return np.asarray(some.T @ some / len(some))


def distance(probes: Float64, one: Motion, other: Motion) -> float:
    """Root mean square distance between the places where two motions put points with these :func:`moments`."""
    difference = one.matrix - other.matrix
    return float(np.sqrt(max(float(np.vdot(difference @ probes, difference)), 0.0)))


def _best_attempt(problem: Problem, config: IcpConfig, end: Descent) -> Descent:
    """Try other starts around the first guess when the first one led to where the surfaces do not meet.

    A right answer has its pairs either close together or not at all, beyond the rim; in a wrong minimum many are a good
    way apart. The closest fit wins, and only a clearly closer one replaces the first, or one whose surfaces meet.
    """
    closeness, score = _fit(problem, end)
    if closeness >= _FITS:
        return end
    few = problem.coarse(max(1, len(problem.source) // _SCREENED), config.neighbours)
    short = replace(config, max_iterations=_TRY_ITERATIONS)
    probes, confirmed = moments(few.source), 0
    count, best = end.count, (_fit(few, replace(end, problem=few, pairs=Pairing(few, config)))[1], end.motion)
    for start in _starts(problem, config.attempts):
        attempt = iterate(few, short, start, _SETTLED_COARSE)
        count += attempt.count
        closeness, other = _fit(few, attempt)
        confirmed += distance(probes, attempt.motion, end.motion) < problem.spacing
        if confirmed == _CONFIRMED:
            return replace(end, count=count)
        turned = se3.rotation_angle_rad(attempt.motion.T @ se3.inverse(problem.start.T))
        if other > best[0] and turned <= _FARTHEST_RAD:
            best = other, attempt.motion
            if closeness >= _FITS:
                break
    if best[1] is not end.motion:
        attempt = iterate(problem, config, best[1], _SETTLED_COARSE)
        count += attempt.count
        closeness, other = _fit(problem, attempt)
        end = attempt if other > (_CLEARLY if closeness < _FITS else 1 / _CLEARLY) * score else end
    return replace(end, count=count)


def _fit(problem: Problem, end: Descent) -> tuple[float, float]:
    """Return the share of pairs that fit, and the sum of those pairs, nearer ones counting more, per source point.

    A pair fits when it is close and its normals agree.
    """
    pairs = end.pairs
    if pairs.find(end.motion) == 0 or problem.spacing == 0:
        return 0.0, 0.0
    found = np.flatnonzero(pairs.partner >= 0)
    nearness = np.maximum(1 - pairs.squared[found] / (_CLOSE_SPACINGS * problem.spacing) ** 2, 0)
    if len(problem.source_normals):
        turned = problem.source_normals[found] @ end.motion.T[:3, :3].T
        cosines = np.abs(np.einsum("nd,nd->n", turned, problem.normals[pairs.partner[found]]))
        nearness *= cosines > _AGREE
    return float((nearness > 0).mean()), float(nearness.sum() / len(problem.source))


def _starts(problem: Problem, count: int) -> Iterator[Motion]:
    """Yield `count` motions around the first guess: turns about the source's centre, and shifts by the gate."""
    start = problem.start
    free = [k for k in range(6) if k not in problem.locks]
    axes = np.eye(6)[free]
    moves = [*axes, *-axes]
    reach = problem.gate if np.isfinite(problem.gate) else 0.0
    shifts, far = ([k * reach * move for move in moves if move[:3].any()] for k in _SHIFTS_GATES)
    small, large = ([np.deg2rad(angle) * move for move in moves if move[3:].any()] for angle in _TURNS_DEG)
    both = [(a + b) / np.sqrt(2) for k, a in enumerate(large) for b in large[k + 1 :] if a @ b == 0]
    for xi in [*small, *shifts, *large, *far, *both][:count]:
        T = start.T.copy()
        T[:3, :3] = se3.exp_so3(xi[3:]) @ T[:3, :3]  # the source is centred: it turns about its centre
        T[:3, 3] += xi[:3]
        yield Motion(T, start.scale)


class _Kernels:
    """The robust kernel of each iteration: always the same, or narrowing (graduated non-convexity)."""

    def __init__(self, config: IcpConfig) -> None:
        self._kernel = kernel_of(config)
        self._graduated = config.graduated
        self._hard = config.kernel in ("trimmed", "tukey")
        self._schedule: list[RobustKernel] | None = None

    def next(self, u: Float64) -> tuple[RobustKernel, bool]:
        """Return the kernel for residuals u (K,) in units of the noise, and whether it is the last."""
        if not self._graduated:
            return self._kernel, True
        if self._schedule is None:
            self._schedule = list(GraduatedNonConvexity("truncated" if self._hard else "geman_mcclure").schedule(u))
        kernel = self._schedule[0]
        if len(self._schedule) > 1:
            self._schedule.pop(0)
            return kernel, False
        return kernel, True
