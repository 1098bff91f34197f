"""What the local aligners work on: centred clouds in an order that is kind to caches, their index and their surfaces.

Inside, everything is three-dimensional: a problem of the plane has z = 0, and its motion is locked to the plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64, as_transform, finite_rows, refuse_giants
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.neighbours import KdTree, NeighbourIndex, build_index
from scanweld.geometry.normals import fit_surfaces
from scanweld.geometry.point_cloud import PointCloud, grid_order, median_spacing, voxel_downsample_each
from scanweld.parallel import side_by_side
from scanweld.registration.gauss_newton import NormalEquations, free_directions, moved_origin, spectrum
from scanweld.registration.local.colour import intensity, intensity_gradients
from scanweld.registration.local.config import IcpConfig
from scanweld.registration.plausibility import has_surfaces
from scanweld.registration.prior import MotionPrior, parse_locks
from scanweld.registration.result import RegistrationResult, Status

SPACINGS_PER_GATE = 10.0
RADII_PER_GATE = 0.1
"""The default gate is the larger of so many median spacings of the target's points, and so many of their median
distances from their centre: scans from one place are far denser near the sensor than what must be reached."""

THICKNESS = 1e-3
"""Least variance across a disc over that along it: how far GICP trusts surfaces (Segal et al. 2009, section III.B)."""

_COARSE_THICKNESS = 1e-2  # far from the answer the surfaces are trusted less: the leash along them pulls more
_SORTED_FROM = 4096  # points; a smaller cloud fits into the cache in any order
_NORMAL_SAMPLE = 1000
_SURFACE_SAMPLE = 150
PLANE = np.array([0, 1, 5])
"""The entries of a twist of space (x, y, z, rx, ry, rz) that move a plane z = 0 within itself."""

_OUT_OF_PLANE = (2, 3, 4)


@dataclass(frozen=True, slots=True)
class Motion:
    """x_target = scale R x + t, between the centred clouds."""

    T: Float64
    scale: float = 1.0

    @property
    def matrix(self) -> Float64:
        """[scale R | t] (3, 4)."""
        matrix = self.T[:3].copy()
        matrix[:, :3] *= self.scale
        return matrix

    def apply(self, points: Float64) -> Float64:
        """Move points (N, 3)."""
        return se3.transform_points(self.T, self.scale * points)


@dataclass(frozen=True, slots=True)
class Colours:
    """Intensities 0..1 of source (N,) and target (M,), and the target's gradients along its surface (M, 3) [1/m]."""

    source: Float64
    target: Float64
    gradients: Float64


@dataclass(frozen=True, slots=True)
class Problem:
    """The clouds and all that does not change between iterations.

    Attributes
    ----------
    dimension : 2 or 3, of the points as they were given
    source, target : (N, 3), (M, 3) [m], centred and reordered
    source_rows, target_rows : (N,), (M,), their rows in the clouds as given (or as thinned)
    source_center, target_center : (3,) [m]
    T_init : (4, 4), between the clouds as given
    normals : (M, 3), zero where unknown; (0, 3) where the method needs none
    source_normals : (N, 3) in the source's frame, or (0, 3)
    weights : (N,) of the source's points, or (0,) for ones
    colours : see :class:`Colours`; empty arrays where the method needs none
    normal_variance : median angular variance of the normals [rad^2]; 0 where there are no surfaces
    surfaces : whether the target's neighbourhoods are flat
    index : of the target, in its own dimension
    spacing : median spacing of the target [m]
    gate : largest distance of a pair [m]
    locks : indices of the twist that stay at the initial guess
    prior : between the centred clouds, or None
    dropped : what was dropped, in words
    thickness : of GICP's discs
    angular_variance : (M,) of each normal [rad^2]; (0,) where the normals were given
    """

    dimension: int
    source: Float64
    target: Float64
    source_rows: Int64
    target_rows: Int64
    source_center: Float64
    target_center: Float64
    T_init: Float64
    normals: Float64
    source_normals: Float64
    weights: Float64
    colours: Colours
    normal_variance: float
    surfaces: bool
    index: NeighbourIndex
    spacing: float
    gate: float
    locks: tuple[int, ...]
    prior: MotionPrior | None
    dropped: str
    thickness: float
    angular_variance: Float64

    @property
    def uneven(self) -> bool:
        """Whether the density varies too much for a grid, as in a raw LiDAR scan."""
        return len(self.target) >= _SORTED_FROM and isinstance(self.index, KdTree)

    @property
    def constrained(self) -> bool:
        """Whether locks or a prior hold the motion, for which there is no closed form."""
        return self.prior is not None or len(self.locks) > (3 if self.dimension == 2 else 0)

    @property
    def start(self) -> Motion:
        """The initial guess between the centred clouds."""
        T = self.T_init.copy()
        T[:3, 3] += T[:3, :3] @ self.source_center - self.target_center
        return Motion(T)

    def centred(self, T: Float64, scale: float) -> Motion:
        """The motion between the centred clouds of a T_target_source (4, 4) between the clouds as given."""
        T = T.copy()
        T[:3, 3] += scale * T[:3, :3] @ self.source_center - self.target_center
        return Motion(T, scale)

    def uncentred(self, motion: Motion) -> Float64:
        """T_target_source between the clouds as they were given, (D + 1, D + 1)."""
        T = self.uncentred_in_space(motion)
        return in_plane(T) if self.dimension == 2 else T

    def uncentred_in_space(self, motion: Motion) -> Float64:
        """The same (4, 4) in the plane, too."""
        T = motion.T.copy()
        T[:3, 3] += self.target_center - motion.scale * T[:3, :3] @ self.source_center
        return T

    def in_dimension(self, points: Float64) -> Float64:
        """Points (N, 3) as the index takes them."""
        return np.ascontiguousarray(points[:, : self.dimension])

    def coarse(self, stride: int, neighbours: int, *, fit: bool = True) -> Problem:
        """The same problem with every `stride`-th point of the source; `fit` gives it normals where it has none."""
        part = slice(None, None, stride)
        source = np.ascontiguousarray(self.source[part])
        source_normals = np.ascontiguousarray(self.source_normals[part])
        if fit and len(self.normals) and not len(source_normals):
            cloud = self.in_dimension(self.source)
            at = self.in_dimension(source)
            surfaces = fit_surfaces(cloud, at=at, index=build_index(cloud), neighbours=neighbours)
            source_normals = _embedded(surfaces.normals)
        return replace(
            self,
            source=source,
            source_rows=self.source_rows[part],
            source_normals=source_normals,
            weights=np.ascontiguousarray(self.weights[part]),
            colours=replace(self.colours, source=np.ascontiguousarray(self.colours.source[part])),
            thickness=max(self.thickness, _COARSE_THICKNESS),
        )


def in_space(matrix: Float64) -> Float64:
    """The motion of space (4, 4) of a motion of the plane (3, 3)."""
    T = np.eye(4)
    T[np.ix_([0, 1, 3], [0, 1, 3])] = matrix
    return T


def in_plane(T: Float64) -> Float64:
    """The motion of the plane (3, 3) of a motion of space (4, 4) that keeps z = 0."""
    return T[np.ix_([0, 1, 3], [0, 1, 3])]


def prepare_problem(
    source: PointCloud,
    target: PointCloud,
    *,
    weights: npt.ArrayLike | None,
    T_init: npt.ArrayLike | None,
    prior: MotionPrior | None,
    config: IcpConfig,
) -> Problem | RegistrationResult:
    """Validate, drop, thin, centre, order, index; or say at once why there is no answer."""
    d = target.dimension
    if source.dimension != d:
        raise InvalidInputError(f"source: expected shape (N, {d}) as the target, got {source.points_m.shape}")
    refuse_giants(source.points_m, "source")
    refuse_giants(target.points_m, "target")
    T0 = np.eye(4) if T_init is None else _initial(T_init, d)
    if prior is not None and d == 2:
        raise InvalidInputError("prior: priors are for 3-D points; in 2-D pass T_init and locks")
    locks = tuple(sorted({*parse_locks(config.locks), *(_OUT_OF_PLANE if d == 2 else ())}))
    if config.scale == "symmetric" and (prior is not None or config.locks):
        raise InvalidInputError("scale = 'symmetric' has no prior and no locks; take scale = 'least_squares'")
    w = _weights(weights, len(source), config)
    if config.method == "coloured" and (source.colors is None or target.colors is None):
        raise InvalidInputError("coloured: both clouds need colours, PointCloud(points, colors=...)")
    good_a, good_b = finite_rows(source.points_m), finite_rows(target.points_m, target.normals)
    bad = int((~good_a).sum() + (~good_b).sum())
    dropped = f"{bad} points were not finite and were dropped" if bad else ""
    if bad:
        source, target, w = source.select(good_a), target.select(good_b), w[good_a] if len(w) else w
    if len(source) < d or len(target) < d:
        words = f"{len(source)} source and {len(target)} target points; at least {d} of each are needed"
        return _nothing(T0, d, Status.TOO_FEW_CORRESPONDENCES, words, dropped)
    rows_a, rows_b = np.flatnonzero(good_a), np.flatnonzero(good_b)
    if config.voxel_m > 0:
        source, target = voxel_downsample_each((source, target), config.voxel_m)
        rows_a, rows_b = np.arange(len(source)), np.arange(len(target))
        if len(source) <= d or len(target) <= d:
            words = f"voxels of {config.voxel_m:g} m leave {len(source)} source and {len(target)} target points"
            return _nothing(T0, d, Status.TOO_FEW_CORRESPONDENCES, words, dropped)
    # Coordinates of 1e6 lose nothing when the work is done about the clouds' own centres.
    center_a, center_b = _center(source.points_m), _center(target.points_m)
    a, b = source.points_m - center_a, target.points_m - center_b
    order_a, order_b = _order(a), _order(b)
    if order_a is not None:
        a, rows_a, source, w = a[order_a], rows_a[order_a], source.select(order_a), w[order_a] if len(w) else w
    if order_b is not None:
        b, rows_b, target = b[order_b], rows_b[order_b], target.select(order_b)
    calls = (
        lambda: _look_at(b, target.normals, config),
        lambda: _normals_of_source(a, source.normals, config),
    )
    if config.needs_source_normals and source.normals is None and target.normals is None:
        look, source_normals = side_by_side(*calls)
    else:
        look, source_normals = calls[0](), calls[1]()
    if config.needs_normals and not look.normals.any():
        words = "the target's points lie on a line or in one place and have no normals; try point-to-point"
        return _nothing(T0, d, Status.DEGENERATE, words, dropped)
    colours = Colours(np.zeros(0), np.zeros(0), np.zeros((0, 3)))
    if config.method == "coloured":
        grey = intensity(target)
        gradients = intensity_gradients(b, look.normals, grey, look.index, neighbours_of(config, len(b), d))
        colours = Colours(intensity(source), grey, gradients)
    reach = max(SPACINGS_PER_GATE * look.spacing, RADII_PER_GATE * float(np.median(np.linalg.norm(b, axis=1))))
    return Problem(
        dimension=d,
        source=_embedded(a),
        target=_embedded(b),
        source_rows=rows_a,
        target_rows=rows_b,
        source_center=_embedded(center_a[None])[0],
        target_center=_embedded(center_b[None])[0],
        T_init=T0,
        normals=_embedded(look.normals),
        source_normals=_embedded(source_normals),
        weights=w,
        colours=colours,
        normal_variance=look.normal_variance,
        surfaces=look.surfaces,
        index=look.index,
        spacing=look.spacing,
        gate=config.max_correspondence_distance_m or reach or np.inf,
        locks=locks,
        prior=None if prior is None else _centred_prior(prior, center_a, center_b),
        dropped=dropped,
        # A disc that noise turns is as thick as that: more trust would follow the noise.
        thickness=max(THICKNESS, look.normal_variance),
        angular_variance=look.angular_variance,
    )


def neighbours_of(config: IcpConfig, count: int, dimension: int) -> int:
    """Number of neighbours for a normal; small clouds need fewer, or all their normals would be the same."""
    return max(min(config.neighbours, count // 3), dimension + 1)


def _initial(T_init: npt.ArrayLike, dimension: int) -> Float64:
    T = as_transform(T_init, "T_init", dimension=dimension)
    return in_space(T) if dimension == 2 else T


def _weights(weights: npt.ArrayLike | None, count: int, config: IcpConfig) -> Float64:
    if weights is None:
        return np.zeros(0)
    w = np.ascontiguousarray(weights, dtype=np.float64)
    if w.shape != (count,):
        raise InvalidInputError(f"weights: expected one per source point, shape ({count},), got {w.shape}")
    if not np.isfinite(w).all() or (w < 0).any():
        raise InvalidInputError("weights: expected finite values that are not negative")
    if config.voxel_m > 0:
        raise InvalidInputError("weights: they belong to the points as given; thin the clouds yourself, or voxel_m = 0")
    return w


def _center(points: Float64) -> Float64:
    return np.asarray(points[0] + (points - points[0]).mean(axis=0))


def _order(points: Float64) -> Int64 | None:
    """Neighbours in space become neighbours in memory; None keeps the order of a small cloud."""
    return grid_order(points) if len(points) >= _SORTED_FROM else None


def _embedded(points: Float64) -> Float64:
    """(N, 2) or (N, 3) as (N, 3)."""
    if points.shape[1] == 3:
        return np.ascontiguousarray(points)
    return np.column_stack([points, np.zeros(len(points))])


def _unit(normals: Float64) -> Float64:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(lengths > 0, lengths, 1.0))


@dataclass(frozen=True, slots=True)
class _Look:
    """What :class:`Problem` says of the target under the same names, in its own dimension."""

    index: NeighbourIndex
    spacing: float
    surfaces: bool
    normals: Float64
    normal_variance: float
    angular_variance: Float64


def _look_at(points: Float64, normals: Float64 | None, config: IcpConfig) -> _Look:
    index = build_index(points)
    places = points[:: max(1, len(points) // _SURFACE_SAMPLE)]
    spacing, surfaces = side_by_side(
        lambda: median_spacing(points, index=index), lambda: has_surfaces(points, places, index)
    )
    if not config.needs_normals:
        return _Look(index, spacing, surfaces, np.zeros((0, points.shape[1])), 0.0, np.zeros(0))
    # Given normals: a sample tells how noisy they may be.
    at = None if normals is None else points[:: max(1, len(points) // _NORMAL_SAMPLE)]
    fit = fit_surfaces(points, at=at, index=index, neighbours=neighbours_of(config, *points.shape))
    # Where there are no surfaces, the normals' scatter is no noise about anything.
    variance = float(np.median(fit.angular_variance)) if surfaces else 0.0
    if normals is not None:
        return _Look(index, spacing, surfaces, _unit(normals), variance, np.zeros(0))
    return _Look(index, spacing, surfaces, fit.normals, variance, fit.angular_variance)


def _normals_of_source(points: Float64, normals: Float64 | None, config: IcpConfig) -> Float64:
    if not config.needs_source_normals:
        return np.zeros((0, points.shape[1]))
    if normals is not None:
        return _unit(normals)
    return fit_surfaces(points, index=build_index(points), neighbours=neighbours_of(config, *points.shape)).normals


def _centred_prior(prior: MotionPrior, center_a: Float64, center_b: Float64) -> MotionPrior:
    T = prior.T_target_source.copy()
    T[:3, 3] += T[:3, :3] @ center_a - center_b
    return MotionPrior(T, moved_origin(prior.information, -center_b))


def _nothing(T: Float64, dimension: int, status: Status, words: str, dropped: str) -> RegistrationResult:
    """Return the initial guess with the reason why there is nothing better; every direction is free."""
    size = dimension * (dimension + 1) // 2
    nothing = NormalEquations(np.zeros((size, size)), np.zeros(size), 0.0, np.zeros(dimension), 1.0)
    return RegistrationResult(
        T_target_source=T if dimension == 3 else in_plane(T),
        status=status,
        information=nothing.information,
        unobservable=free_directions(nothing, spectrum(nothing)),
        note="; ".join(filter(None, [words, dropped])),
    )
