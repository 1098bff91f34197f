"""What brightness adds to a geometric alignment, and when it is believed.

Where geometry fixes every motion, the two are weighed by what each is worth in this frame, and the sum is taken only
when it explains geometry that it has not seen better than geometry alone does. Where geometry leaves motions free,
brightness moves along these and no others. What neither fixes stays where it was.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int64
from scanweld.geometry import se3
from scanweld.geometry.views import ModelView
from scanweld.registration.gauss_newton import Spectrum
from scanweld.registration.photometric.residuals import (
    Eliminated,
    LitPoints,
    LitTarget,
    eliminate_brightness,
    estimate_brightness,
    half_grey,
    photometric_sums,
    seen_points,
)

logger = logging.getLogger(__name__)

PARTS = 8
"""Contiguous shares of the image whose sums are kept apart: neighbours have common errors, shares hardly."""

MAX_POINTS = 20_000
"""Points whose brightness is compared."""


@dataclass(frozen=True)
class Photometry:
    """The brightness of the points that are aligned, and of the image that they are aligned with.

    Attributes
    ----------
    intensities : (N,) float32, 0..255, of the source points
    grey : (H, W) float32, 0..255, the target at its finest level
    view : the view that the source points are from, with the brightness of all of its rows
    rows : (N,) int64, which of its rows they are
    """

    intensities: Float32
    grey: Float32
    view: ModelView
    rows: Int64

    @cached_property
    def pixels(self) -> Int64:
        """(N,) row-major pixels of the source points in their view."""
        return self.view.pixels[self.rows]

    @cached_property
    def pictures(self) -> list[tuple[Float32, Bool]]:
        """The source's view, level by level: grey images and where they are filled."""
        filled = self.view.index_map >= 0
        grey = np.zeros(filled.shape, np.float32)
        assert self.view.intensities is not None
        grey[filled] = self.view.intensities[self.view.index_map[filled]]
        pictures: list[tuple[Float32, Bool]] = [(grey, filled)]
        while min(filled.shape) >= 32:
            grey, filled = pictures[-1]
            share = half_grey(filled.astype(np.float32))
            mean = half_grey(np.where(filled, grey, 0).astype(np.float32)) / np.maximum(share, np.float32(0.25))
            pictures.append((np.asarray(mean, np.float32), share > 0))
        return pictures


@dataclass(frozen=True, slots=True)
class GeometricSums:
    """Point-to-plane normal equations of K shares of the points: information (K, 6, 6), gradient (K, 6)."""

    information: Float64
    gradient: Float64

    def moved(self, xi: Float64) -> GeometricSums:
        """Return the sums after a small step xi (6,): the gradient changes by H xi."""
        return GeometricSums(self.information, self.gradient + self.information @ xi)


Geometry = Callable[[Float64, int], GeometricSums]
"""Sums at T_target_source, in so many contiguous shares of the points."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """What came of brightness.

    Attributes
    ----------
    T_target_source : the pose, that of geometry where brightness is not used
    words : what was done, for a person
    used : whether brightness has changed the pose
    information : (6, 6), what brightness adds to that of geometry
    parts : which motions geometry and brightness fix together; None leaves that to geometry
    """

    T_target_source: Float64
    words: str
    used: bool = False
    information: Float64 = field(default_factory=lambda: np.zeros((6, 6)))
    parts: Spectrum | None = None


@dataclass(frozen=True, slots=True)
class Gates:
    """When a point and the surface behind its pixel are the same: distance [m] and cosine of the normals."""

    distance_m: float
    min_cosine: float


def dispersion(information: Float64, scores: Float64) -> float:
    """Return how much larger the scores (K, D) of K shares scatter than their information (D, D) says, at least 1.

    Errors that neighbours share, and weights that are too large, both show here (McCullagh and Nelder 1989, sec. 9.2).
    """
    count = len(scores)
    scatter = scores.T @ scores * (count / (count - 1))
    return max(1.0, float(np.trace(solve_or_zero(information, scatter))) / len(information))


def refine_observed(
    T_target_source: Float64, points: LitPoints, target: LitTarget, shares: GeometricSums, gates: Gates
) -> Refinement:
    """Weigh brightness and geometry where geometry fixes every motion.

    Both are calibrated by how their shares of the image scatter. The joint answer is taken when brightness brings what
    one half of the geometry says nearer to the other half: twofold cross-validation by interleaved shares. Geometric
    losses follow from the sums, as the motion is small; brightness is looked at anew at the answer of each half, or
    staying where all of the geometry had led to would pass for knowledge.
    """
    points = points.every(max(1, -(-len(points) // MAX_POINTS)))
    brightness = estimate_brightness(points, target, T_target_source, gates.distance_m, gates.min_cosine)
    if brightness is None:
        return Refinement(T_target_source, "too few points with brightness")
    points, _ = seen_points(points, target, T_target_source, gates.distance_m, gates.min_cosine)

    def light(x: Float64, parts: int = 1) -> Eliminated:
        T = se3.exp(x) @ T_target_source
        return eliminate_brightness(photometric_sums(points, target, T, brightness, parts), brightness)

    H_g, g_g = shares.information.sum(axis=0), shares.gradient.sum(axis=0)
    x_g = -solve_or_zero(H_g, g_g)
    phi_g = dispersion(H_g, shares.gradient + shares.information @ x_g)
    H_g, g_g = H_g / phi_g, g_g / phi_g
    change, phis = 0.0, []
    for first in (0, 1):  # every second share, and the others
        H_held, g_held = shares.information[first::2].sum(axis=0) / phi_g, shares.gradient[first::2].sum(axis=0) / phi_g
        H_rest = H_g - H_held
        x = -solve_or_zero(H_rest, g_g - g_held)
        seen = light(x, PARTS)
        phis.append(
            dispersion(seen.information, seen.scores_at(-solve_or_zero(H_rest + seen.information, seen.gradient)))
        )
        step = -solve_or_zero(H_rest + seen.information / phis[-1], seen.gradient / phis[-1])
        change += float((g_held + H_held @ x) @ step + step @ H_held @ step / 2)
    phi_p = float(np.mean(phis))
    words = f"brightness changes the held-out geometric loss by {change:+.2f}"
    logger.debug("%s; dispersions %.1f and %.1f, scale %.1f", words, phi_g, phi_p, brightness.scale)
    if not change < 0:
        return Refinement(T_target_source, words)
    x = np.zeros(6)
    for _ in range(2):  # brightness is linear over a fraction of a pixel only, geometry over more
        seen = light(x)
        H_p, g_p = seen.information / phi_p, seen.gradient / phi_p
        step = -solve_or_zero(H_g + H_p, g_g + H_g @ x + g_p)
        x = se3.log(se3.exp(step) @ se3.exp(x))
    return Refinement(se3.exp(x) @ T_target_source, words, True, H_p * phi_g)


def solve_or_zero(H: Float64, g: Float64) -> Float64:
    """Return H^-1 g of a symmetric H, not negative; directions without any information stay zero."""
    values, vectors = np.linalg.eigh(H)
    known = values > 1e-10 * values.max(initial=0.0)
    along = vectors[:, known]
    return np.asarray((along / values[known]) @ (along.T @ g))
