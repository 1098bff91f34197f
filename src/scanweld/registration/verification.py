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
    stride = max(1, positions_m.shape[1] // SAMPLES)
    counts = np.empty(4, np.int64)
    kernels.compare_with_depth(
        np.ascontiguousarray(positions_m[:, ::stride]), np.ascontiguousarray(normals[:, ::stride]),
        T_target_source[:3].astype(np.float32), target.surface.reshape(-1, 8), intrinsics_array(target.camera),
        target.camera.width, target.camera.height, counts,
    )  # fmt: skip
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
    p, n, q = (side.astype(np.float64) for side in _pairs(positions_m, normals, T_target_source, target))
    # Partners are chosen by their place alone: choosing by the normals would make their noise alike.
    near = np.abs(q[2] - p[2]) < 0.1
    p, n, q = p[:, near], n[:, near], q[:, near]
    if p.shape[1] == 0:
        return np.eye(6)
    weights = q[6] ** 2 / (q[6] ** 2).sum()
    arm = (p.T - centroid_m) / radius_m
    slopes = np.concatenate([n, np.cross(arm, n.T).T])
    target_slopes = np.concatenate([q[3:6], np.cross(arm, q[3:6].T).T])
    product = (slopes * weights) @ target_slopes.T
    values, vectors = np.linalg.eigh((product + product.T) / 2)
    seen, seen_by_target = vectors.T @ slopes, vectors.T @ target_slopes
    error = np.sqrt((seen * seen_by_target - values[:, None]) ** 2 @ weights**2)
    apparent = seen_by_target**2 @ weights
    free = (values < MIN_MEAN_CONSTRAINT) | ((values < SIGNIFICANCE * error) & (values < MIN_SHARE * apparent))
    return np.asarray(vectors[:, free])


def _pairs(
    positions_m: Float32, normals: Float32, T_target_source: Float64, target: SurfaceLevel
) -> tuple[Float32, Float32, Float32]:
    """Sample the points that project onto a pixel with a surface.

    Returns the points and normals (3, M), target frame, and the surface (8, M) behind their pixels.
    """
    stride = max(1, positions_m.shape[1] // SAMPLES)
    rotation, translation = (
        T_target_source[:3, :3].astype(np.float32),
        T_target_source[:3, 3].astype(np.float32),
    )
    p = rotation @ positions_m[:, ::stride] + translation[:, None]
    n = rotation @ normals[:, ::stride]
    camera = target.camera
    z = np.maximum(p[2], np.float32(1e-6))
    u = np.floor(camera.fx * p[0] / z + camera.cx + 0.5)
    v = np.floor(camera.fy * p[1] / z + camera.cy + 0.5)
    inside = (p[2] > 0.01) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    p, n = p[:, inside], n[:, inside]
    q = target.surface[v[inside].astype(np.int64), u[inside].astype(np.int64)].T
    valid = q[6] > 0
    return p[:, valid], n[:, valid], q[:, valid]
