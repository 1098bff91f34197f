"""Projective point-to-plane alignment of points against a depth image, coarse to fine.

Correspondence by projection (Blais and Levine 1995), point-to-plane distance (Chen and Medioni 1991), linearised and
solved by Gauss-Newton with Huber weights on residuals in units of the depth noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.config import check_ranges, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceLevel
from scanweld.registration import kernels
from scanweld.registration.backends import backend
from scanweld.registration.gauss_newton import (
    NormalEquations,
    Spectrum,
    free_directions,
    solve,
    spectrum,
    standard_deviation,
)
from scanweld.registration.photometric.filling import fill_free
from scanweld.registration.photometric.refinement import (
    PARTS,
    Gates,
    GeometricSums,
    Photometry,
    Refinement,
    refine_observed,
)
from scanweld.registration.photometric.residuals import LitPoints, LitTarget, half_grey
from scanweld.registration.result import FreeDirection, RegistrationResult, Status
from scanweld.registration.verification import Agreement, check_against_depth, noise_directions


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectiveConfig:
    """Schedule and gates of the projective aligner."""

    iterations: int = setting(10, "most iterations on each pyramid level; raise for fast motion", low=1, high=1000)
    coarse_gate_m: float = setting(
        0.25,
        "largest distance of a match on the coarsest level [m]; raise for fast motion, lower for clutter",
        low=1e-3,
    )
    widest_gate_m: float = setting(
        1.0, "coarse gates up to this are tried when an alignment fails [m]; raise for fast motion", low=1e-3
    )
    fine_gate_m: float = setting(
        0.05,
        "largest distance of a match on the finest level [m]; lower for clutter, raise for noise",
        low=1e-3,
    )
    min_cosine: float = setting(0.7, "matched normals agree at least this well; lower for noise", low=-1.0, high=1.0)
    robust_sigma: float = setting(
        2.0, "Huber threshold in standard deviations of the depth noise; lower for outliers", low=0.1
    )
    max_points: int = setting(
        80_000,
        "source points on the finest level; a quarter on each coarser; raise for accuracy, costs time",
        low=100,
    )
    min_points: int = setting(200, "fewer matches than this give no answer", low=12)
    min_overlap: float = setting(0.05, "smaller shares of matched points give no answer", low=0.0, high=1.0)
    min_agreement: float = setting(
        0.6, "share of the compared points that agree with the depth in a trusted answer", low=0.0, high=1.0
    )
    max_conflict: float = setting(
        0.06,
        "share of the compared points in front of the depth in a trusted answer; raise where things move",
        low=0.0,
        high=1.0,
    )
    step_m: float = setting(1e-4, "converged when a step moves the points less than this [m]", low=0.0)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class ProjectiveStep:
    """Sums of one iteration; residuals in standard deviations of the depth noise.

    `partials` (K, SUMS) are those of the shares, see :class:`~.backends.ProjectiveBackend`.
    """

    level: int
    equations: NormalEquations
    loss: float
    rmse_m: float
    num_inliers: int
    num_matched: int
    num_projected: int
    partials: Float64

    @property
    def shares(self) -> GeometricSums:
        """The equations of each share of the points; they add up to `equations`."""
        return _as_equations(self.partials)


def projective_step(
    positions_m: Float32,
    normals: Float32,
    T_target_source: Float64,
    target: SurfaceLevel,
    gate_m: float,
    config: ProjectiveConfig,
    centroid_m: Float64,
    radius_m: float,
    level: int = 0,
    parts: int | None = None,
) -> ProjectiveStep:
    """Match source points by projection into `target` and sum the point-to-plane normal equations.

    Parameters
    ----------
    positions_m, normals : (3, N) float32, source frame
    T_target_source : (4, 4), where the linearisation happens
    target : the image that is projected into, target frame = its camera's
    gate_m : largest distance of a correspondence [m]
    centroid_m, radius_m : of the source points in the target frame, for :class:`NormalEquations`
    parts : sum so many contiguous shares of the points, each on its own
    """
    partials = _partial_sums(positions_m, normals, T_target_source, target, gate_m, config, parts)
    sums = partials.sum(axis=0)
    whole = _as_equations(sums[None])
    information, gradient = whole.information[0], whole.gradient[0]
    # Unit normals: the translation block's trace is the sum of the weights w / sigma^2.
    weight = float(np.trace(information[:3, :3]))
    matched = int(sums[30])
    return ProjectiveStep(
        level,
        NormalEquations(information, gradient, weight, centroid_m, radius_m),
        loss=float(sums[28] / matched) if matched else 0.0,
        rmse_m=float(np.sqrt(max(sums[27], 0.0) / weight)) if weight > 0 else 0.0,
        num_inliers=int(sums[29]),
        num_matched=matched,
        num_projected=int(sums[31]),
        partials=partials,
    )


def _partial_sums(
    positions_m: Float32,
    normals: Float32,
    T_target_source: Float64,
    target: SurfaceLevel,
    gate_m: float,
    config: ProjectiveConfig,
    parts: int | None = None,
) -> Float64:
    """Return the sums (K, SUMS) of contiguous shares of the points, see :class:`~.backends.ProjectiveBackend`."""
    count = positions_m.shape[1]
    if parts is None:
        bounds = np.append(np.arange(0, count, kernels.CHUNK), count)
    else:
        bounds = np.linspace(0, count, parts + 1).astype(np.int64)
    return backend().point_to_plane_sums(
        positions_m, normals, T_target_source, target, bounds, gate_m, config.min_cosine, config.robust_sigma
    )


_UPPER = np.triu_indices(7)


def _as_equations(partials: Float64) -> GeometricSums:
    """Return the normal equations of each share."""
    full = np.zeros((len(partials), 7, 7))
    rows, columns = _UPPER
    full[:, rows, columns] = full[:, columns, rows] = partials[:, :28]
    return GeometricSums(full[:, :6, :6], full[:, :6, 6])


def align_projective(
    positions_m: Float32,
    normals: Float32,
    target: Sequence[SurfaceLevel],
    T_target_source: Float64,
    config: ProjectiveConfig | None = None,
    *,
    photometry: Photometry | None = None,
    keep_history: bool = False,
) -> RegistrationResult:
    """Align source points with a target pyramid from an initial guess.

    Parameters
    ----------
    positions_m, normals : (3, N) float32, source frame, normals towards the viewer
    target : pyramid, finest level first
    T_target_source : (4, 4) initial guess
    photometry : brightness of both sides; used where it helps (:mod:`.photometric.refinement`), and where it does not,
        the result is that without it
    keep_history : put the :class:`ProjectiveStep` of every iteration into the result

    The answer is checked against the free space of the target (:func:`~.verification.check_against_depth`): a
    minimum that contradicts what the target saw is no answer, however small its residuals are.
    """
    config = config or ProjectiveConfig()
    start = np.array(T_target_source, dtype=np.float64)
    end = _descend(positions_m, normals, target, start, config)
    num_free = 0 if end.parts is None else int((~end.parts.observable).sum())
    # Noise on normals is a slope of less than 13 degrees: a geometry that constrains more is no noise.
    weak = end.parts is None or float(end.parts.values.min()) < WEAK_CONSTRAINT
    held = (
        noise_directions(end.positions_m, end.normals, end.T_target_source, target[0], end.centroid_m, end.radius_m)
        if weak
        else np.zeros((6, 0))
    )
    if num_free < held.shape[1] < 6:
        # Noise has moved what nothing constrains: again from the start, along the other directions only.
        history = end.history
        end = _descend(positions_m, normals, target, start, config, held)
        end.history[:0] = history
    last = end.history[-1]
    information = last.equations.information
    if end.parts is not None and not end.parts.observable.all():
        # Along free directions there is noise, and no knowledge.
        known = end.parts.basis * end.parts.observable @ np.linalg.inv(end.parts.basis)
        information = known.T @ information @ known
    refined = None
    if photometry is not None and end.parts is not None and last.num_matched >= config.min_points:
        refined = _refine(end, photometry, target, config)
    if refined is not None and refined.used:
        end.T_target_source, end.parts = refined.T_target_source, refined.parts or end.parts
        information = information + refined.information
    agreement = check_against_depth(end.positions_m, end.normals, end.T_target_source, target[0])
    overlap = last.num_matched / max(1, end.positions_m.shape[1])
    free = free_directions(last.equations, end.parts) if end.parts is not None and last.num_matched >= 6 else ()
    status, note = _judge(last, overlap, agreement, free, end.converged, len(end.history), config)
    if refined is not None and refined.parts is not None and status.has_pose:
        note = f"{note}; {refined.words}" if note else refined.words
    return RegistrationResult(
        T_target_source=end.T_target_source,
        status=status,
        information=information,
        num_iterations=len(end.history),
        num_inliers=last.num_inliers,
        overlap=overlap,
        rmse_m=last.rmse_m,
        loss=last.loss,
        unobservable=free,
        note=note,
        history=tuple(end.history) if keep_history else (),
    )


CONTRACTION = 0.3
"""Each step leaves about so much of its length to go (measured: 0.1 to 0.35), unless steps shrink more slowly."""

WEAK_CONSTRAINT = 0.05
"""Mean squared slope along a direction below which it could be noise."""


@dataclass(slots=True)
class _Descent:
    """Where the iterations ended, the last step, and the source points of the finest level."""

    T_target_source: Float64
    history: list[ProjectiveStep]
    parts: Spectrum | None
    converged: bool
    positions_m: Float32
    normals: Float32
    centroid_m: Float64
    radius_m: float
    stride: int = 1
    xi: Float64 = field(default_factory=lambda: np.zeros(6))


def _descend(
    positions_m: Float32,
    normals: Float32,
    target: Sequence[SurfaceLevel],
    T_target_source: Float64,
    config: ProjectiveConfig,
    held: Float64 | None = None,
) -> _Descent:
    """Iterate from the coarsest level to the finest; `held` as in :func:`~.gauss_newton.spectrum`."""
    coarsest = len(target) - 1
    end = _Descent(T_target_source, [], None, False, positions_m, normals, np.zeros(3), 1.0)
    for level, stride in _stages(positions_m.shape[1], coarsest, config):
        if stride != end.stride:
            end.positions_m = np.ascontiguousarray(positions_m[:, ::stride])
            end.normals = np.ascontiguousarray(normals[:, ::stride])
            end.stride = stride
        few = end.positions_m[:, :: max(1, end.positions_m.shape[1] // 1000)]
        end.centroid_m, end.radius_m = _centroid_and_radius(se3.transform_points(end.T_target_source, few.T))
        gate = config.fine_gate_m * (config.coarse_gate_m / config.fine_gate_m) ** (level / max(coarsest, 1))
        end.converged, before = False, math.inf
        for _ in range(config.iterations):
            step = projective_step(
                end.positions_m, end.normals, end.T_target_source, target[level], gate, config,
                end.centroid_m, end.radius_m, level, PARTS if level == 0 else None,
            )  # fmt: skip
            end.history.append(step)
            if step.num_matched < max(6, config.min_points >> (2 * level)):
                break
            end.parts = spectrum(step.equations, held=held)
            end.xi = solve(step.equations, end.parts)
            end.T_target_source = se3.exp(end.xi) @ end.T_target_source
            motion = _largest_shift(end.xi, end.centroid_m, end.radius_m)
            # On the finest level what is left is noise within half a standard deviation of the estimate. A coarse level
            # need only hand over a start within its pixel size.
            deviation = standard_deviation(step.equations, end.parts) if level == 0 else 0.0
            left, before = motion * min(max(motion / before, CONTRACTION), 1.0), motion
            if left < max(config.step_m * 4**level, 0.25 * deviation):
                end.converged = True
                break
    return end


def _largest_shift(xi: Float64, centroid_m: Float64, radius_m: float) -> float:
    """Return how far a small step moves points around a centroid at most: its shift, and its turn at their radius."""
    x, y, z, a, b, c = xi.tolist()
    u, v, w = centroid_m.tolist()
    shift = math.hypot(x + b * w - c * v, y + c * u - a * w, z + a * v - b * u)
    return shift + radius_m * math.hypot(a, b, c)


def _stages(count: int, coarsest: int, config: ProjectiveConfig) -> Iterator[tuple[int, int]]:
    """Yield level and stride through the points of each stage: few points lead there, all have the last word."""

    def stride(level: int) -> int:
        return max(1, -(-count // max(config.min_points, config.max_points >> (2 * level))))

    for level in range(coarsest, 0, -1):
        yield level, stride(level)
    if stride(1) > stride(0):
        yield 0, stride(1)
    yield 0, stride(0)


def _refine(
    end: _Descent, photometry: Photometry, target: Sequence[SurfaceLevel], config: ProjectiveConfig
) -> Refinement:
    """Let brightness act on the points of the finest level."""
    points = LitPoints(end.positions_m, end.normals, photometry.intensities[:: end.stride].copy())

    def geometry(T_target_source: Float64, parts: int) -> GeometricSums:
        return _as_equations(
            _partial_sums(end.positions_m, end.normals, T_target_source, target[0], config.fine_gate_m, config, parts)
        )

    gates = Gates(config.fine_gate_m, config.min_cosine)
    assert end.parts is not None
    if end.parts.observable.all():
        lit = LitTarget(target[0], photometry.grey)
        return refine_observed(end.T_target_source, points, lit, end.history[-1].shares.moved(end.xi), gates)
    greys = [photometry.grey]
    for _ in target[1:]:
        greys.append(half_grey(greys[-1]))
    lits = [LitTarget(level, grey) for level, grey in zip(target, greys, strict=True)]
    return fill_free(end.T_target_source, points, lits, photometry, end.stride, geometry, end.parts, gates)


@lru_cache(maxsize=16)
def schedules(config: ProjectiveConfig) -> tuple[ProjectiveConfig, ...]:
    """Return the configured schedule, then wider and more tolerant ones for when it fails.

    Which coarse gate has the largest basin depends on the scene: one that is wide enough for the motion takes in wrong
    neighbours. The free-space check tells a right answer from a wrong one, so trying several is safe; it is strict
    where the search is wide, whatever the configuration allows to a prediction that is known to be close.
    """
    usual = ProjectiveConfig()
    strict = replace(
        config,
        min_agreement=max(config.min_agreement, usual.min_agreement),
        max_conflict=min(config.max_conflict, usual.max_conflict),
    )
    found, gate = [config], config.coarse_gate_m * 2
    while gate <= config.widest_gate_m:
        found.append(replace(strict, coarse_gate_m=gate, min_cosine=min(config.min_cosine, 0.0)))
        if gate * 2 > config.widest_gate_m:
            found.append(replace(strict, coarse_gate_m=gate))
        gate *= 2
    return tuple(found)


def _centroid_and_radius(points_m: Float64) -> tuple[Float64, float]:
    if len(points_m) == 0:
        return np.zeros(3), 1.0
    centroid = points_m.mean(axis=0)
    return centroid, float(np.sqrt(((points_m - centroid) ** 2).sum(axis=1).mean())) or 1.0  # a single point has none


def _judge(
    last: ProjectiveStep,
    overlap: float,
    agreement: Agreement,
    free: tuple[FreeDirection, ...],
    converged: bool,
    iterations: int,
    config: ProjectiveConfig,
) -> tuple[Status, str]:
    """Say what the end of the iterations is worth, and why."""
    if last.num_matched < config.min_points:
        return Status.TOO_FEW_CORRESPONDENCES, f"{last.num_matched} matches, fewer than {config.min_points}"
    if overlap < config.min_overlap:
        return Status.NO_OVERLAP, f"only {overlap:.0%} of the points match"
    if not agreement.fits(config):
        return Status.NO_OVERLAP, agreement.words
    if free:
        return Status.DEGENERATE, "free: " + "; ".join(direction.words for direction in free)
    if not converged:
        return Status.MAX_ITERATIONS, f"still moving after {iterations} iterations"
    return Status.CONVERGED, ""
