"""Brightness along the motions that geometry leaves free, and what it is worth there.

A wall that is brighter under the lamp tells the motion as bricks do, only less exactly: its slopes of a few grey levels
in ten pixels drown in the noise of single pixels. A noisy picture looks steeper than it is, so its steps come out too
short and far too sure. Hence slopes of the model are multiplied with those of the frame, whose noise is another
(instrumental variables, as in :func:`~..verification.noise_directions`), and the pictures are compared at several
sizes, of which the one that knows most has the last word. The covariance of the answer follows from the residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3
from scanweld.registration.gauss_newton import MIN_MEAN_CONSTRAINT, Spectrum
from scanweld.registration.photometric.refinement import (
    MAX_POINTS,
    PARTS,
    Gates,
    Geometry,
    Photometry,
    Refinement,
    dispersion,
    solve_or_zero,
)
from scanweld.registration.photometric.residuals import (
    FREEDOM,
    Brightness,
    LitPoints,
    LitTarget,
    PhotometricRows,
    estimate_brightness,
    reference_rows,
)

SIGNIFICANCE = 4.0
"""Standard errors above zero that make texture."""

MAX_STD_PIXELS = 0.5
"""Brightness moves along a motion when its standard deviation is below this."""

FIXED_STD_PIXELS = 0.03
"""And fixes it below this: bricks do so to 0.01 pixels, the light of lamps on a plain wall to 0.1, and stays a hint."""

MIN_SAMPLES = 50
"""With fewer points there is no telling texture from noise."""

CONVERGED_PIXELS = 0.02
"""A step that moves the image less than this is the last of its level."""

LOSS_TOLERANCE = 1.01
"""The mean photometric loss after a move, over that before, is at most this: other points may be in view."""

ITERATIONS = 10
"""Most iterations on each level."""

GOLDEN = 0.5 * (5**0.5 - 1)
"""Multiples of it modulo 1 spread evenly."""


@dataclass(frozen=True, slots=True)
class _Level:
    """Points with the brightness and the slopes (2, N) [grey levels per pixel] that the source's view has there."""

    points: LitPoints
    slopes: Float64
    target: LitTarget
    gates: Gates


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Sums along K motions.

    Attributes
    ----------
    slopes : (K, K), products of the slopes of both pictures
    scores : (PARTS, K), products of the model's slopes and the residuals, of each share of the image
    covariance : (K, K), of the sum of the scores, were all residuals independent
    textured : (K, M), the directions along which the pictures have slopes in common
    pixels_per_m : at the depth of the points
    """

    slopes: Float64
    scores: Float64
    covariance: Float64
    textured: Float64
    pixels_per_m: float

    @property
    def step(self) -> Float64:
        """(K,), to where the brightness agrees; without texture that may be anywhere, and is no place to go."""
        along = self.textured
        score = along.T @ self.scores.sum(axis=0)
        return np.asarray(-along @ np.linalg.lstsq(along.T @ self.slopes @ along, score, rcond=1e-10)[0])  # no symmetry

    @property
    def information(self) -> Float64:
        """(K, K), calibrated by how the shares of the image scatter."""
        phi = dispersion(self.covariance, self.scores)
        return np.asarray(self.slopes.T @ solve_or_zero(phi * self.covariance, self.slopes))


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
    levels = list(_levels(points, targets, photometry, photometry.pixels[::stride], gates))
    free, fixed = parts.basis[:, ~parts.observable], parts.basis[:, parts.observable]
    directions = np.eye(free.shape[1])
    while True:
        moving = free @ directions
        T, information, textured, pixels_per_m = _slide(T_target_source, levels, geometry, moving, fixed)
        if not textured.shape[1]:
            return Refinement(T_target_source, "no texture along the free directions")
        values, vectors = np.linalg.eigh(textured.T @ information @ textured)
        std_pixels = pixels_per_m / np.sqrt(np.maximum(values, 1e-12))
        found = textured @ vectors[:, std_pixels < MAX_STD_PIXELS]
        if found.shape[1] == directions.shape[1]:
            break
        if found.shape[1] == 0:
            return Refinement(T_target_source, "no texture along the free directions")
        directions = directions @ found
    if not _fits(levels[0], T, T_target_source):
        return Refinement(T_target_source, "brightness fits no better than before")
    # Basis: what nothing fixes, what brightness tells, what geometry fixes.
    directions, moving = directions @ found, moving @ found
    rest = free @ np.linalg.svd(directions)[0][:, directions.shape[1] :]
    basis = np.concatenate([rest, moving, fixed], axis=1)
    here = np.linalg.inv(basis)[rest.shape[1] : rest.shape[1] + moving.shape[1]]
    sure = std_pixels < FIXED_STD_PIXELS
    observable = np.concatenate([np.zeros(rest.shape[1], np.bool_), sure, np.ones(fixed.shape[1], np.bool_)])
    known = np.concatenate([np.where(sure, MIN_MEAN_CONSTRAINT, 0.0), parts.values[parts.observable]])
    values = np.concatenate([np.zeros(rest.shape[1]), known])
    words = f"{int(sure.sum())} of {free.shape[1]} free directions from brightness"
    if not sure.all():
        words += f", {int((~sure).sum())} within {std_pixels.max():.2f} pixels"
    added = here.T @ (found.T @ information @ found) @ here
    return Refinement(T, words, True, added, Spectrum(values, basis, observable))


def _levels(
    points: LitPoints, targets: Sequence[LitTarget], photometry: Photometry, pixels: Int64, gates: Gates
) -> Iterator[_Level]:
    """Yield the levels, finest first; about two points for each pixel, spread so that they prefer no part of it."""
    v, u = np.divmod(pixels, photometry.view.index_map.shape[1])
    for number, (target, (picture, filled)) in enumerate(zip(targets, photometry.pictures, strict=False)):
        size = 2**number
        stride = max(1.0, len(pixels) / MAX_POINTS, size * size / 2)
        k = np.arange(int(len(pixels) / stride))
        rows = np.minimum(((k + (k * GOLDEN) % 1) * stride).astype(np.int64), len(pixels) - 1)
        x, y = (u[rows] + 0.5) / size - 0.5, (v[rows] + 0.5) / size - 0.5
        height, width = picture.shape
        column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        inner = (column > 0) & (column < width - 1) & (row > 0) & (row < height - 1)
        rows, x, y, column, row = (a[inner] for a in (rows, x, y, column, row))
        inner = filled[row, column - 1] & filled[row, column + 1] & filled[row - 1, column] & filled[row + 1, column]
        inner &= filled[row, column]
        rows, x, y, column, row = (a[inner] for a in (rows, x, y, column, row))
        slope_u = (picture[row, column + 1].astype(np.float64) - picture[row, column - 1]) / 2
        slope_v = (picture[row + 1, column].astype(np.float64) - picture[row - 1, column]) / 2
        values = picture[row, column] + slope_u * (x - column) + slope_v * (y - row)
        lit = LitPoints(points.positions_m[:, rows], points.normals[:, rows], values.astype(np.float32))
        yield _Level(lit, np.stack([slope_u, slope_v]), target, replace(gates, distance_m=gates.distance_m * size))


def _slide(
    T_target_source: Float64, levels: Sequence[_Level], geometry: Geometry, moving: Float64, fixed: Float64
) -> tuple[Float64, Float64, Float64, float]:
    """Go along `moving` (6, K) to where the brightness agrees, coarse to fine, and along `fixed` as geometry says.

    Returns the pose, the information (K, K), the directions (K, M) with texture, and the pixels [finest] of a metre.
    """
    T = T_target_source
    best, size = (T, np.zeros((moving.shape[1],) * 2), np.zeros((moving.shape[1], 0)), 1.0), -np.inf
    for level in reversed(levels):
        light = _light(level, T)
        for _ in range(ITERATIONS):
            evidence = None if light is None else _compare(level, T, light, moving)
            if evidence is None:
                break
            x = moving @ evidence.step
            T = se3.exp(x) @ T
            motion = np.abs(x[:3]).max() + np.abs(x[3:]).max() / evidence.pixels_per_m * level.target.surface.camera.fx
            light = _light(level, T)
            if motion * evidence.pixels_per_m < CONVERGED_PIXELS:
                break
        if fixed.shape[1]:
            sums = geometry(T, 1)
            H, g = sums.information[0], sums.gradient[0]
            T = se3.exp(-fixed @ solve_or_zero(fixed.T @ H @ fixed, fixed.T @ g)) @ T
        evidence = None if light is None else _compare(level, T, light, moving)
        if evidence is not None:
            information = evidence.information
            known = float(np.linalg.slogdet(information + 1e-6 * np.eye(len(information)))[1])
            if known > size:
                finest = levels[0].target.surface.camera.fx / level.target.surface.camera.fx
                best, size = (T, information, evidence.textured, evidence.pixels_per_m * finest), known
        T = best[0]
    return best


def _light(level: _Level, T_target_source: Float64) -> Brightness | None:
    return estimate_brightness(
        level.points, level.target, T_target_source, level.gates.distance_m, level.gates.min_cosine
    )


def _rows(level: _Level, T_target_source: Float64, light: Brightness) -> PhotometricRows:
    gates = level.gates
    return reference_rows(level.points, level.target, T_target_source, light, gates.distance_m, gates.min_cosine)


def _fits(level: _Level, T_after: Float64, T_before: Float64) -> bool:
    """Whether the brightness agrees after a move as well as before, or better."""
    after, before = _light(level, T_after), _light(level, T_before)
    if after is None or before is None:
        return False
    losses = [
        float(np.log1p((_rows(level, T, light).residuals / after.scale) ** 2 / FREEDOM).mean())
        for T, light in ((T_after, after), (T_before, before))
    ]
    return losses[0] <= LOSS_TOLERANCE * losses[1]


def _compare(level: _Level, T_target_source: Float64, light: Brightness, moving: Float64) -> _Evidence | None:
    """Sum the brightness of a level along `moving` (6, K); None where too little is seen."""
    rows = _rows(level, T_target_source, light)
    if len(rows.residuals) < MIN_SAMPLES:
        return None
    camera = level.target.surface.camera
    p, (slope_u, slope_v) = rows.points_m, level.slopes[:, rows.seen]
    d = np.stack([-slope_u * camera.fx / p[:, 2], -slope_v * camera.fy / p[:, 2], np.zeros(len(p))], axis=1)
    d[:, 2] = -(d[:, 0] * p[:, 0] + d[:, 1] * p[:, 1]) / p[:, 2]
    of_model = light.gain * np.concatenate([d, np.cross(p, d)], axis=1) @ moving
    of_frame = rows.jacobian[:, :6] @ moving
    weights = (FREEDOM + 1) / (FREEDOM + (rows.residuals / light.scale) ** 2)
    weights /= weights.sum()
    # What gain and offset explain is no motion.
    lit = np.stack([rows.model, np.ones(len(rows.model))], axis=1)
    weighted = lit * weights[:, None]
    corner = lit.T @ weighted
    of_model = of_model - lit @ solve_or_zero(corner, weighted.T @ of_model)
    of_frame = of_frame - lit @ solve_or_zero(corner, weighted.T @ of_frame)
    residuals = rows.residuals - lit @ solve_or_zero(corner, weighted.T @ rows.residuals)
    instruments = of_model * weights[:, None]
    product = instruments.T @ of_frame
    scores = instruments * residuals[:, None]
    bounds = np.linspace(0, len(scores), PARTS + 1).astype(np.int64)
    values, vectors = np.linalg.eigh((product + product.T) / 2)
    error = np.sqrt(weights**2 @ (of_model @ vectors * (of_frame @ vectors) - values) ** 2)
    return _Evidence(
        product,
        np.stack([scores[a:b].sum(axis=0) for a, b in pairwise(bounds)]),
        scores.T @ scores,
        vectors[:, values > SIGNIFICANCE * error],
        camera.fx / float(np.median(p[:, 2])),
    )
