"""What brightness adds to a geometric alignment, and when it is believed.

Where geometry fixes every motion, the two are weighed by what each is worth in this frame, and the sum is taken only
when it explains geometry that it has not seen better than geometry alone does. Where geometry leaves motions free,
brightness moves along these and no others. What neither fixes stays where it was.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int32, Int64
from scanweld.geometry import se3
from scanweld.registration.gauss_newton import MIN_MEAN_CONSTRAINT, Spectrum
from scanweld.registration.photometric.residuals import (
    FREEDOM,
    Brightness,
    Eliminated,
    LitPoints,
    LitTarget,
    PhotometricSums,
    eliminate_brightness,
    estimate_brightness,
    half_grey,
    photometric_sums,
    reference_rows,
)

logger = logging.getLogger(__name__)

PARTS = 8
"""Contiguous shares of the image whose sums are kept apart: neighbours have common errors, shares hardly."""

MAX_POINTS = 20_000
"""Points whose brightness is compared."""

SIGNIFICANCE = 4.0
"""Standard errors above zero that make texture."""

MAX_STD_PIXELS = 0.5
"""A motion is fixed by brightness when its standard deviation is below this."""

MIN_SAMPLES = 50
"""With fewer there is no telling texture from noise."""

CONVERGED_PIXELS, MEAN_DEPTH_M = 0.02, 1.0
"""A step that moves the image less than this, at this depth, is the last of its level."""

LOSS_TOLERANCE = 1.01
"""The photometric loss after a move, over that before, is at most this: other points may be in view."""

FILL_ITERATIONS = 10
"""Most iterations on each level where brightness moves what geometry leaves free."""


@dataclass(frozen=True)
class Photometry:
    """The brightness of the points that are aligned, and of the image that they are aligned with.

    Attributes
    ----------
    intensities : (N,) float32, 0..255, of the source points
    grey : (H, W) float32, 0..255, the target at its finest level
    index_map : (H, W) int32 of the source's view, below 0 where it is empty
    intensity_rows : (M,) float32, of all filled pixels of the view, row-major
    rows : (N,) int64, which of them the source points are; None for all
    """

    intensities: Float32
    grey: Float32
    index_map: Int32
    intensity_rows: Float32
    rows: Int64 | None = None

    @cached_property
    def pixels(self) -> Int64:
        """(N,) row-major pixels of the source points in their view."""
        filled = np.flatnonzero(self.index_map.ravel() >= 0)
        return np.asarray(filled if self.rows is None else filled[self.rows])

    @cached_property
    def pictures(self) -> list[tuple[Float32, Bool]]:
        """The source's view, level by level: grey images and where they are filled."""
        filled = self.index_map >= 0
        grey = np.zeros(filled.shape, np.float32)
        grey[filled] = self.intensity_rows
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
    return max(1.0, float(np.trace(_solve(information, scatter))) / len(information))


def refine_observed(
    T_target_source: Float64, points: LitPoints, target: LitTarget, geometry: Geometry, gates: Gates
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

    def light(x: Float64, parts: int = 1) -> Eliminated:
        T = se3.exp(x) @ T_target_source
        sums = photometric_sums(points, target, T, brightness, gates.distance_m, gates.min_cosine, parts)
        return eliminate_brightness(sums, brightness)

    shares = geometry(T_target_source, PARTS)
    H_g, g_g = shares.information.sum(axis=0), shares.gradient.sum(axis=0)
    x_g = -_solve(H_g, g_g)
    phi_g = dispersion(H_g, shares.gradient + shares.information @ x_g)
    H_g, g_g = H_g / phi_g, g_g / phi_g
    change, phis = 0.0, []
    for first in (0, 1):  # every second share, and the others
        H_held, g_held = shares.information[first::2].sum(axis=0) / phi_g, shares.gradient[first::2].sum(axis=0) / phi_g
        H_rest = H_g - H_held
        x = -_solve(H_rest, g_g - g_held)
        seen = light(x, PARTS)
        phis.append(dispersion(seen.information, seen.scores_at(-_solve(H_rest + seen.information, seen.gradient))))
        step = -_solve(H_rest + seen.information / phis[-1], seen.gradient / phis[-1])
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
        step = -_solve(H_g + H_p, g_g + H_g @ x + g_p)
        x = se3.log(se3.exp(step) @ se3.exp(x))
    return Refinement(se3.exp(x) @ T_target_source, words, True, H_p * phi_g)


def fill_free(
    T_target_source: Float64,
    points: LitPoints,
    targets: Sequence[LitTarget],
    photometry: Photometry,
    stride: int,
    geometry: Geometry,
    parts: Spectrum,
    gates: Gates,
) -> Refinement:
    """Move along the directions that geometry leaves free, and no others, until the brightness agrees.

    Parameters
    ----------
    targets : finest level first
    stride : `points` are every so many of those of `photometry`
    parts : of the geometry; its free directions are moved along, its observable ones keep the geometric answer
    """
    step = max(1, -(-len(points) // MAX_POINTS))
    points = points.every(step)
    pixels = photometry.pixels[::stride][::step]
    free, fixed = parts.basis[:, ~parts.observable], parts.basis[:, parts.observable]
    before = estimate_brightness(points, targets[0], T_target_source, gates.distance_m, gates.min_cosine)
    if before is None:
        return Refinement(T_target_source, "too few points with brightness")
    directions = np.eye(free.shape[1])
    while True:
        moving = free @ directions
        T = _slide(T_target_source, points, targets, photometry, pixels, geometry, moving, fixed, gates)
        after = estimate_brightness(points, targets[0], T, gates.distance_m, gates.min_cosine)
        if after is None:
            return Refinement(T_target_source, "too few points with brightness")
        light = photometric_sums(points, targets[0], T, after, gates.distance_m, gates.min_cosine, PARTS)
        at_start = replace(before, scale=after.scale)
        dark = photometric_sums(points, targets[0], T_target_source, at_start, gates.distance_m, gates.min_cosine)
        if _mean_loss(light) > LOSS_TOLERANCE * _mean_loss(dark):
            return Refinement(T_target_source, "brightness fits no better than before")
        eliminated = eliminate_brightness(light, after)
        phi = dispersion(moving.T @ eliminated.information @ moving, eliminated.scores @ moving)
        found = _textured(points, targets[0], photometry, pixels, T, after, moving, phi, gates)
        if found.shape[1] == directions.shape[1]:
            break
        if found.shape[1] == 0:
            return Refinement(T_target_source, "no texture along the free directions")
        directions = directions @ found
    # Basis: what geometry fixes, what brightness fixes, the rest.
    rest = free @ np.linalg.svd(directions)[0][:, directions.shape[1] :]
    basis = np.concatenate([rest, moving, fixed], axis=1)
    here = np.linalg.inv(basis)[rest.shape[1] : rest.shape[1] + moving.shape[1]]
    added = here.T @ (moving.T @ eliminated.information @ moving) @ here / phi
    observable = np.arange(6) >= rest.shape[1]
    values = np.concatenate(
        [np.zeros(rest.shape[1]), np.full(moving.shape[1], MIN_MEAN_CONSTRAINT), parts.values[parts.observable]]
    )
    words = f"{moving.shape[1]} of {free.shape[1]} free directions from brightness"
    return Refinement(T, words, True, added, Spectrum(values, basis, observable))


def _mean_loss(sums: PhotometricSums) -> float:
    """Return the robust loss of a point; infinite without any."""
    return float(sums.loss.sum() / sums.matched.sum()) if sums.matched.any() else np.inf


def _slide(
    T_target_source: Float64,
    points: LitPoints,
    targets: Sequence[LitTarget],
    photometry: Photometry,
    pixels: Int64,
    geometry: Geometry,
    moving: Float64,
    fixed: Float64,
    gates: Gates,
) -> Float64:
    """Minimise the photometric loss along `moving` (6, K), coarse to fine, and the geometric one along `fixed`."""
    T = T_target_source
    width = photometry.index_map.shape[1]
    v, u = np.divmod(pixels, width)
    for level in range(min(len(targets), len(photometry.pictures)) - 1, -1, -1):
        picture, _ = photometry.pictures[level]
        row, column = np.minimum(v >> level, picture.shape[0] - 1), np.minimum(u >> level, picture.shape[1] - 1)
        lit = replace(points, intensities=picture[row, column]).every(max(1, 4**level // 2))
        target = targets[level]
        gate_m = gates.distance_m * 2**level
        brightness = estimate_brightness(lit, target, T, gate_m, gates.min_cosine)
        if brightness is None:
            continue
        for _ in range(FILL_ITERATIONS):
            eliminated = eliminate_brightness(
                photometric_sums(lit, target, T, brightness, gate_m, gates.min_cosine), brightness
            )
            x = -moving @ _solve(moving.T @ eliminated.information @ moving, moving.T @ eliminated.gradient)
            T, brightness = se3.exp(x) @ T, eliminated.brightness_at(x)
            motion = np.abs(x[:3]).max() + np.abs(x[3:]).max() * MEAN_DEPTH_M
            if motion * target.surface.camera.fx < CONVERGED_PIXELS * MEAN_DEPTH_M:
                break
        if fixed.shape[1]:
            sums = geometry(T, 1)
            H, g = sums.information[0], sums.gradient[0]
            T = se3.exp(-fixed @ _solve(fixed.T @ H @ fixed, fixed.T @ g)) @ T
    return T


def _textured(
    points: LitPoints,
    target: LitTarget,
    photometry: Photometry,
    pixels: Int64,
    T_target_source: Float64,
    brightness: Brightness,
    moving: Float64,
    phi: float,
    gates: Gates,
) -> Float64:
    """Return the directions (K, M), orthonormal in the coordinates of `moving`, along which there is texture.

    Noise has gradients, too, but those of the two images are independent: products of the slopes of one with those of
    the other average to what is there for both, as for :func:`~..verification.noise_directions`.
    """
    picture, filled = photometry.pictures[0]
    v, u = np.divmod(pixels, picture.shape[1])
    inner = (u > 0) & (u < picture.shape[1] - 1) & (v > 0) & (v < picture.shape[0] - 1)
    u, v = np.where(inner, u, 1), np.where(inner, v, 1)
    inner &= filled[v, u - 1] & filled[v, u + 1] & filled[v - 1, u] & filled[v + 1, u]
    rows = reference_rows(points, target, T_target_source, brightness, gates.distance_m, gates.min_cosine)
    inner = inner[rows.seen]
    if inner.sum() < MIN_SAMPLES:
        return np.zeros((moving.shape[1], 0))
    u, v = u[rows.seen], v[rows.seen]
    slope_u, slope_v = (picture[v, u + 1] - picture[v, u - 1]) / 2, (picture[v + 1, u] - picture[v - 1, u]) / 2
    camera = target.surface.camera
    p = rows.points_m
    d = np.stack([-slope_u * camera.fx / p[:, 2], -slope_v * camera.fy / p[:, 2], np.zeros(len(p))], axis=1)
    d[:, 2] = -(d[:, 0] * p[:, 0] + d[:, 1] * p[:, 1]) / p[:, 2]
    of_model = brightness.gain * np.concatenate([d, np.cross(p, d)], axis=1)[inner] @ moving
    of_frame = rows.jacobian[inner, :6] @ moving
    weights = (FREEDOM + 1) / (FREEDOM + (rows.residuals[inner] / brightness.scale) ** 2)
    weights /= weights.sum()
    # What gain and offset explain is no motion.
    lit = np.stack([rows.model[inner], np.ones(int(inner.sum()))], axis=1)
    for slopes in (of_model, of_frame):
        slopes -= lit @ _solve(lit.T @ (lit * weights[:, None]), lit.T @ (slopes * weights[:, None]))
    product = (of_model * weights[:, None]).T @ of_frame
    values, vectors = np.linalg.eigh((product + product.T) / 2)
    a, b = of_model @ vectors, of_frame @ vectors
    error = np.sqrt(weights**2 @ (a * b - values) ** 2)
    count = float(rows.seen.sum())
    std_m = brightness.scale * np.sqrt(phi / (count * np.maximum(values, 1e-12)))
    std_pixels = std_m * camera.fx / float(np.median(p[:, 2]))
    return np.asarray(vectors[:, (values > SIGNIFICANCE * error) & (std_pixels < MAX_STD_PIXELS)])


def _solve(H: Float64, g: Float64) -> Float64:
    """Return H^-1 g; directions without any information stay zero."""
    return np.asarray(np.linalg.lstsq(H, g, rcond=1e-10)[0])
