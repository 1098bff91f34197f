"""Whether a pose is possible: points moved by it must not stand where the other view saw free space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.geometry.depth import SurfaceLevel, intrinsics_array
from scanweld.registration import kernels
from scanweld.registration.gauss_newton import MIN_MEAN_CONSTRAINT

SAMPLES = 6000
"""Points that are compared: a share of 0.5 is known to 1.3 % (two standard deviations)."""

SIGNIFICANCE = 4.0
"""Standard errors above zero that make a constraint."""

MIN_SHARE = 0.25
"""A constraint of which both sides see at least this share is not made of noise, however few the points."""


class AgreementLimits(Protocol):
    """What a trusted answer needs; :class:`~.projective.ProjectiveConfig` has them."""

    @property
    def min_agreement(self) -> float:
        """Smallest share of points that agree."""
        ...

    @property
    def max_conflict(self) -> float:
        """Largest share of points in front of the depth."""
        ...


@dataclass(frozen=True, slots=True)
class Agreement:
    """Shares of the compared points, those that project onto a pixel with a surface.

    Attributes
    ----------
    compared : number of compared points
    agree : share on the surface, within four standard deviations of the depth noise
    conflict : share in front of it, where the other camera looked through
    hidden : share behind it, which occlusion allows
    """

    compared: int
    agree: float
    conflict: float
    hidden: float

    def fits(self, limits: AgreementLimits) -> bool:
        """Whether the shares are within the limits of a trusted answer."""
        return self.agree >= limits.min_agreement and self.conflict <= limits.max_conflict

    @property
    def words(self) -> str:
        """The shares in words."""
        return (
            f"only {self.agree:.0%} of the points agree with the depth, {self.conflict:.0%} would stand in free space"
        )


def check_against_depth(
    positions_m: Float32, normals: Float32, T_target_source: Float64, target: SurfaceLevel
) -> Agreement:
    """Compare points (3, N) with normals (3, N), source frame, with the depth of a target view.

    On true poses of static scenes at most 3 % of the compared points stand in free space, recorded or rendered. In
    wrong minima of the alignment it is mostly 9 % or more, though up to 80 % of the points may lie on a surface: the
    walls of a room agree with themselves in many places (docs/decisions/0003-verification.md).

    A point agrees when it is within four standard deviations of the surface's plane, within 0.1 m in depth, and its
    normal within 60 degrees; what does not is in front or behind from six standard deviations and 5 cm in depth on.
    """
    counts = np.empty(4, np.int64)
    kernels.compare_with_depth(*_sampled(positions_m, normals, T_target_source, target), counts)
    compared, *shares = counts.tolist()
    return Agreement(compared, *(share / max(1, compared) for share in shares))


def noise_directions(
    positions_m: Float32,
    normals: Float32,
    T_target_source: Float64,
    target: SurfaceLevel,
    centroid_m: Float64,
    radius_m: float,
) -> Float64:
    """Return the motions that nothing but noise constrains: (6, K), orthonormal columns.

    The normals of a noisy wall scatter, and to the normal equations that looks like relief: a blank wall seems to fix
    all six motions. The noise of the two sides is independent, though, so the products of the slopes that one side
    sees with those that the other sees average to the relief that is there for both (the method of instrumental
    variables). A motion is free when its mean product is below the threshold of :func:`~.gauss_newton.spectrum`, or
    when it is within ``SIGNIFICANCE`` standard errors of zero and far below what the target alone seems to see.

    Parameters
    ----------
    positions_m, normals, T_target_source, target : as for :func:`check_against_depth`
    centroid_m, radius_m : pivot in the target frame and size; columns are twists about it, rotations times the radius
    """
    points, *others = _sampled(positions_m, normals, T_target_source, target)
    pairs = np.empty((13, points.shape[1] + 1), np.float32)
    # Partners are chosen by their place alone: choosing by the normals would make their noise alike.
    found = kernels.slope_pairs(
        points, *others, centroid_m.astype(np.float32), np.float32(1 / radius_m), np.float32(0.1), pairs
    )
    if found == 0:
        return np.eye(6)
    slopes, target_slopes, (weights,) = np.split(pairs[:, :found].astype(np.float64), [6, 12])
    weights /= weights.sum()
    product = (slopes * weights) @ target_slopes.T
    values, vectors = np.linalg.eigh((product + product.T) / 2)
    seen, seen_by_target = vectors.T @ slopes, vectors.T @ target_slopes
    error = np.sqrt((seen * seen_by_target - values[:, None]) ** 2 @ weights**2)
    apparent = seen_by_target**2 @ weights
    free = (values < MIN_MEAN_CONSTRAINT) | ((values < SIGNIFICANCE * error) & (values < MIN_SHARE * apparent))
    return np.asarray(vectors[:, free])


def _sampled(
    positions_m: Float32, normals: Float32, T_target_source: Float64, target: SurfaceLevel
) -> tuple[Float32, Float32, Float32, Float32, Float32, int, int]:
    """Return what the kernels take of a sample of the points, of the motion, and of the target."""
    stride = max(1, positions_m.shape[1] // SAMPLES)
    positions_m, normals = (np.ascontiguousarray(side[:, ::stride]) for side in (positions_m, normals))
    transform, camera = T_target_source[:3].astype(np.float32), target.camera
    surface = target.surface.reshape(-1, 8)
    return positions_m, normals, transform, surface, intrinsics_array(camera), camera.width, camera.height
