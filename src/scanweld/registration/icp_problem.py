"""What an ICP run works on: settings, centred clouds, and the pairs at a motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_points, as_transform, finite_rows
from scanweld.config import check_ranges, setting
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.normals import NEIGHBOURS, fit_surfaces
from scanweld.geometry.point_cloud import PointCloud, median_spacing
from scanweld.registration.closed_form import SCALES
from scanweld.registration.correspondences import Correspondences, KdTree, find_correspondences
from scanweld.registration.gauss_newton import NormalEquations, free_directions, spectrum
from scanweld.registration.plausibility import has_surfaces
from scanweld.registration.residuals import normal_equations, point_equations, point_to_plane
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.robust import RobustKernel, mad_scale, robust_kernel

METHODS = ("point-to-point", "point-to-plane")
SPACINGS_PER_GATE = 10.0
RADII_PER_GATE = 0.1
"""The default gate is the larger of so many median spacings of the target's points, and so many of their
median
distances from their centre: scans from one place are far denser near the sensor than what must be reached."""

_NORMAL_SAMPLE = 2000
_LEAST_NOISE = 0.02  # spacings: on noise-free planes the median is 0, and all that is curved would be an outlier


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpConfig:
    """Settings of :func:`icp`."""

    method: str = setting("point-to-plane", "point-to-plane (surfaces, fast) or point-to-point (any points)")
    max_correspondence_distance_m: float = setting(
        0.0,
        "pairs further apart do not count [m]; 0 takes 10 times the median spacing of the target's points, or "
        "a tenth of their median distance from their centre if that is more. Raising it reaches further, and "
        "lets in more wrong pairs",
        low=0.0,
    )
    max_iterations: int = setting(100, "steps before giving up; more help slow point-to-point runs", low=1)
    tolerance: float = setting(
        1e-4,
        "done when a step moves the points by less than this share of the target's median spacing; "
        "raising it stops earlier",
        low=0.0,
    )
    kernel: str = setting(
        "auto",
        "robust kernel: none, huber, cauchy, geman_mcclure or tukey; auto takes cauchy for point-to-plane, "
        "whose residuals show the noise, and none for point-to-point, whose distances show the sampling",
    )
    scale: str = setting("none", "none, symmetric or least_squares; the last two with point-to-point only")
    min_overlap: float = setting(
        0.25,
        "share of the source that must find a partner; lower it for scans that share less",
        low=0.0,
        high=1.0,
    )
    neighbours: int = setting(NEIGHBOURS, "points for one normal; more smooth over noise and edges", low=3)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.method not in METHODS:
            raise ConfigError(f"method = {self.method!r}: expected one of {', '.join(METHODS)}")
        if self.scale not in SCALES:
            raise ConfigError(f"scale = {self.scale!r}: expected one of {', '.join(SCALES)}")
        if self.scale != "none" and self.method != "point-to-point":
            raise ConfigError("scale is estimated with method point-to-point only")
        kernel_of(self)


def kernel_of(config: IcpConfig) -> RobustKernel:
    if config.kernel == "auto":
        return robust_kernel("cauchy" if config.method == "point-to-plane" else "none")
    return robust_kernel(config.kernel)


@dataclass(frozen=True, slots=True)
class Motion:
    """x_target = scale R x + t, between the centred clouds."""

    T: Float64
    scale: float = 1.0

    def apply(self, points: Float64) -> Float64:
        return se3.transform_points(self.T, self.scale * points)


@dataclass(frozen=True, slots=True)
class Problem:
    """The centred clouds and all that does not change between iterations."""

    source: Float64
    target: Float64
    source_center: Float64
    target_center: Float64
    T_init: Float64
    normals: Float64 | None
    normal_variance: float
    index: KdTree
    spacing: float
    gate: float
    dropped: str

    @property
    def dimension(self) -> int:
        return int(self.source.shape[1])

    @property
    def start(self) -> Motion:
        d, T = self.dimension, self.T_init.copy()
        T[:d, d] += T[:d, :d] @ self.source_center - self.target_center
        return Motion(T)

    def uncentred(self, motion: Motion) -> Float64:
        """T_target_source between the clouds as they were given."""
        d, T = self.dimension, motion.T.copy()
        T[:d, d] += self.target_center - motion.scale * T[:d, :d] @ self.source_center
        return T


def prepare_problem(
    source: npt.ArrayLike | PointCloud,
    target: npt.ArrayLike | PointCloud,
    target_normals: npt.ArrayLike | None,
    T_init: npt.ArrayLike | None,
    config: IcpConfig,
    num_threads: int | None,
) -> Problem | RegistrationResult:
    """Validate, drop, centre, index; or say at once why there is no answer."""
    if isinstance(target, PointCloud) and target_normals is None and config.method == "point-to-plane":
        target_normals = target.normals  # a cloud may carry normals that the method does not use
    b = as_points(target.points_m if isinstance(target, PointCloud) else target, "target")
    dimension = b.shape[1]
    a = as_points(source.points_m if isinstance(source, PointCloud) else source, "source", dimensions=(dimension,))
    normals = None
    if target_normals is not None:
        normals = as_points(target_normals, "target_normals", dimensions=(dimension,))
        if len(normals) != len(b):
            raise InvalidInputError(f"target_normals: expected one per target point ({len(b)}), got {len(normals)}")
    T0 = np.eye(dimension + 1) if T_init is None else as_transform(T_init, "T_init", dimension=dimension)
    good_a, good_b = finite_rows(a), finite_rows(b, normals)
    bad = int((~good_a).sum() + (~good_b).sum())
    dropped = f"{bad} points were not finite and were dropped" if bad else ""
    a, b = a[good_a], b[good_b]
    if len(a) < dimension or len(b) < dimension:
        words = f"{len(a)} source and {len(b)} target points; at least {dimension} of each are needed"
        return _nothing(T0, Status.TOO_FEW_CORRESPONDENCES, words, dropped)
    # Coordinates of 1e6 lose nothing when the work is done about the clouds' own centres.
    center_a, center_b = a[0] + (a - a[0]).mean(axis=0), b[0] + (b - b[0]).mean(axis=0)
    a, b = a - center_a, b - center_b
    index = KdTree(b, num_threads)
    spacing = median_spacing(b, index.tree)
    variance = 0.0
    if config.method == "point-to-plane":
        sample = b[:: max(1, len(b) // _NORMAL_SAMPLE)]  # given normals: a sample tells how noisy they may be
        k = neighbours_of(config, len(b), dimension)
        surface = fit_surfaces(
            b, at=b if normals is None else sample, tree=index.tree, neighbours=k, num_threads=num_threads
        )
        # Where there are no surfaces, the normals' scatter is no noise about anything.
        if has_surfaces(b, sample, index):
            variance = float(np.median(surface.angular_variance))
        normals = surface.normals if normals is None else _unit(normals[good_b])
        if not normals.any():
            words = "the target's points lie on a line or in one place and have no normals; try point-to-point"
            return _nothing(T0, Status.DEGENERATE, words, dropped)
    reach = max(SPACINGS_PER_GATE * spacing, RADII_PER_GATE * float(np.median(np.linalg.norm(b, axis=1))))
    gate = config.max_correspondence_distance_m or reach or np.inf
    return Problem(a, b, center_a, center_b, T0, normals, variance, index, spacing, gate, dropped)


def _unit(normals: Float64) -> Float64:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(lengths > 0, lengths, 1.0))


def _nothing(T: Float64, status: Status, words: str, dropped: str) -> RegistrationResult:
    """Return the initial guess with the reason why there is nothing better; every direction is free."""
    dimension = len(T) - 1
    size = dimension * (dimension + 1) // 2
    nothing = NormalEquations(np.zeros((size, size)), np.zeros(size), 0.0, np.zeros(dimension), 1.0)
    return RegistrationResult(
        T_target_source=T,
        status=status,
        information=nothing.information,
        unobservable=free_directions(nothing, spectrum(nothing)),
        note="; ".join(filter(None, [words, dropped])),
    )


def neighbours_of(config: IcpConfig, count: int, dimension: int) -> int:
    """Number of neighbours for a normal; small clouds need fewer, or all their normals would be the same."""
    return max(min(config.neighbours, count // 3), dimension + 1)


@dataclass(frozen=True, slots=True)
class Matches:
    """The pairs at a motion, their residuals and weights."""

    pairs: Correspondences
    moved: Float64  # (M, D), source points of the pairs
    partners: Float64  # (M, D)
    normals: Float64 | None  # (M, D)
    residuals: Float64  # (M,), distances or plane distances
    weights: Float64  # (M,)

    @property
    def rmse(self) -> float:
        total = float(self.weights.sum())
        return float(np.sqrt(self.weights @ self.residuals**2 / total)) if total > 0 else 0.0


def match(problem: Problem, motion: Motion, kernel: RobustKernel) -> Matches:
    moved = motion.apply(problem.source)
    pairs = find_correspondences(problem.index, moved, problem.gate)
    normals = None
    if problem.normals is not None:
        known = problem.normals[pairs.target].any(axis=1)
        if not known.all():
            pairs = Correspondences(pairs.source[known], pairs.target[known], pairs.distances_m[known])
        normals = problem.normals[pairs.target]
    moved, partners = moved[pairs.source], problem.target[pairs.target]
    residuals = pairs.distances_m if normals is None else point_to_plane(moved, partners, normals)[0]
    noise = max(mad_scale(residuals), _LEAST_NOISE * problem.spacing, 1e-300)
    return Matches(pairs, moved, partners, normals, residuals, kernel.weight(residuals / noise))


def equations_of(matches: Matches) -> NormalEquations:
    """Normal equations of the metric that is minimised."""
    if matches.normals is not None:
        residuals, jacobian = point_to_plane(matches.moved, matches.partners, matches.normals)
        return normal_equations(matches.moved, residuals, jacobian, matches.weights)
    return point_equations(matches.moved, matches.partners, matches.weights)
