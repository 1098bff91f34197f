"""Photometric residuals of moved points: their rows, their sums, and their scale in this frame.

A point of brightness I_model, moved to p, is seen at the pixel pi(p) of a frame whose exposure may differ by a gain and
an offset: r = gain I_model + offset - I(pi(p)) (Steinbruecker et al. 2011; affine brightness as in Engel et al. 2015).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int64
from scanweld.geometry.depth import SurfaceLevel, intrinsics_array
from scanweld.parallel import run_ranges
from scanweld.registration.photometric import kernels

FREEDOM = 5.0
"""Degrees of freedom of Student's t, as Kerl et al. 2013 measured for photometric residuals."""

SCALE_SAMPLES = 1200
"""Points that the scale and the brightness are estimated from."""

MIN_SAMPLES = 50
"""With fewer of them seen there is no estimate."""

MIN_SCALE = 0.5
"""Smallest scale of the residuals [grey levels]: rounding alone gives 0.3."""

GAIN_STD = 0.3
"""How far exposure is expected to change the gain; what holds it where everything is equally bright."""


@dataclass(frozen=True, slots=True)
class Brightness:
    """I_frame = gain I_model + offset, up to residuals of a robust standard deviation [grey levels]."""

    gain: float = 1.0
    offset: float = 0.0
    scale: float = 10.0

    @property
    def model(self) -> Float32:
        """What the kernel takes."""
        return np.array([self.gain, self.offset, 1 / self.scale, FREEDOM], np.float32)


@dataclass(frozen=True, slots=True)
class LitPoints:
    """Points with brightness: positions, normals (3, N), intensities (N,) float32, source frame."""

    positions_m: Float32
    normals: Float32
    intensities: Float32

    def every(self, stride: int) -> LitPoints:
        """A strided copy."""
        return LitPoints(
            self.positions_m[:, ::stride].copy(), self.normals[:, ::stride].copy(), self.intensities[::stride].copy()
        )

    def __len__(self) -> int:
        return len(self.intensities)


@dataclass(frozen=True, slots=True)
class LitTarget:
    """A pyramid level with brightness: grey (H, W) float32 in 0..255."""

    surface: SurfaceLevel
    grey: Float32


@dataclass(frozen=True, slots=True)
class PhotometricSums:
    """Normal equations of K parts of the points, brightness eliminated or not (columns: motion, gain, offset).

    information (K, 8, 8), gradient (K, 8), matched (K,).
    """

    information: Float64
    gradient: Float64
    matched: Int64


def half_grey(grey: Float32) -> Float32:
    """Return the means of 2x2 blocks (H // 2, W // 2); an odd last row or column is dropped."""
    height, width = grey.shape[0] // 2 * 2, grey.shape[1] // 2 * 2
    even = grey[:height, :width]
    return np.ascontiguousarray((even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4)


_UPPER = np.triu_indices(kernels.COLUMNS)


def photometric_sums(
    points: LitPoints,
    target: LitTarget,
    T_target_source: Float64,
    brightness: Brightness,
    parts: int = 1,
) -> PhotometricSums:
    """Sum the photometric normal equations of `parts` contiguous shares of the points.

    Which of them the frame sees was decided before (:func:`seen_points`): a small motion does not change that.
    """
    bounds = np.linspace(0, len(points), parts + 1).astype(np.int64)
    partials = np.empty((parts, kernels.SUMS))
    transform = T_target_source[:3].astype(np.float32)
    intrinsics = intrinsics_array(target.surface.camera)
    model = brightness.model

    def body(start: int, stop: int) -> None:
        kernels.photometric_sums(
            start, stop, bounds, points.positions_m, points.normals, points.intensities, transform, target.grey,
            intrinsics, model, partials,
        )  # fmt: skip

    run_ranges(parts, body)
    full = np.zeros((parts, kernels.COLUMNS, kernels.COLUMNS))
    rows, columns = _UPPER
    full[:, rows, columns] = partials[:, :45]
    full[:, columns, rows] = partials[:, :45]
    return PhotometricSums(full[:, :8, :8], full[:, :8, 8], partials[:, 45].astype(np.int64))


def seen_points(
    points: LitPoints, target: LitTarget, T_target_source: Float64, gate_m: float, min_cosine: float
) -> tuple[LitPoints, Float32]:
    """Return the M points that the frame sees, and its brightness there (M,).

    The surface behind the pixel of such a point is within `gate_m` of it, and the cosine of their normals is above
    `min_cosine`, as in :func:`sightings`.
    """
    # One more than there are: the kernel writes every point where the next seen one goes.
    values, frame = np.empty((7, len(points) + 1), np.float32), np.empty(len(points) + 1, np.float32)
    seen = kernels.list_seen(
        points.positions_m, points.normals, points.intensities, T_target_source[:3].astype(np.float32),
        target.surface.surface.reshape(-1, 8), target.grey, intrinsics_array(target.surface.camera),
        np.array([gate_m, min_cosine], np.float32), values, frame,
    )  # fmt: skip
    values = np.ascontiguousarray(values[:, :seen])
    return LitPoints(values[:3], values[3:6], values[6]), frame[:seen]


@dataclass(frozen=True, slots=True)
class PhotometricRows:
    """What NumPy makes of the residuals, for few points and for tests.

    Attributes
    ----------
    jacobian : (M, 8), of the motion, the gain and the offset [grey levels]
    residuals : (M,) [grey levels]
    seen : (N,) bool, the M points that count
    model, frame : (M,) intensities
    points_m : (M, 3), target frame
    """

    jacobian: Float64
    residuals: Float64
    seen: Bool
    model: Float64
    frame: Float64
    points_m: Float64


@dataclass(frozen=True, slots=True)
class Sightings:
    """What a frame shows of points: `seen` (N,) says which M count; points_m (M, 3), target frame; model, frame (M,)
    intensities; slopes (2, M), across and down [grey levels per pixel]."""

    seen: Bool
    points_m: Float64
    model: Float64
    frame: Float64
    slopes: Float64


def sightings(
    points: LitPoints, target: LitTarget, T_target_source: Float64, gate_m: float, min_cosine: float
) -> Sightings:
    """Look up the brightness of points in the frame, in NumPy and in double precision; for few points and for tests."""
    camera, grey = target.surface.camera, target.grey
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    p = points.positions_m.T.astype(np.float64) @ R.T + t
    n = points.normals.T.astype(np.float64) @ R.T
    z = np.where(p[:, 2] > 1e-3, p[:, 2], np.inf)
    u, v = camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy
    seen = np.isfinite(z) & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)
    at = np.floor(np.where(seen, v, 0) + 0.5).astype(np.int64), np.floor(np.where(seen, u, 0) + 0.5).astype(np.int64)
    q = target.surface.surface[at].astype(np.float64)
    seen &= (q[:, 6] > 0) & (((p - q[:, :3]) ** 2).sum(axis=1) < gate_m**2) & ((n * q[:, 3:6]).sum(axis=1) > min_cosine)
    p, u, v, model = p[seen], u[seen], v[seen], points.intensities[seen].astype(np.float64)
    column, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    e, f = u - column, v - row
    corners = [[grey[row + j, column + i].astype(np.float64) for i in (0, 1)] for j in (0, 1)]
    frame = (1 - f) * ((1 - e) * corners[0][0] + e * corners[0][1]) + f * ((1 - e) * corners[1][0] + e * corners[1][1])
    slope_u = (1 - f) * (corners[0][1] - corners[0][0]) + f * (corners[1][1] - corners[1][0])
    slope_v = (1 - e) * (corners[1][0] - corners[0][0]) + e * (corners[1][1] - corners[0][1])
    return Sightings(seen, p, model, frame, np.stack([slope_u, slope_v]))


def reference_rows(
    points: LitPoints,
    target: LitTarget,
    T_target_source: Float64,
    brightness: Brightness,
    gate_m: float,
    min_cosine: float,
) -> PhotometricRows:
    """Compute in NumPy what the kernel `photometric_rows` computes, in double precision and without weights."""
    at = sightings(points, target, T_target_source, gate_m, min_cosine)
    camera, p, (slope_u, slope_v) = target.surface.camera, at.points_m, at.slopes
    d = np.zeros_like(p)
    d[:, 0], d[:, 1] = -slope_u * camera.fx / p[:, 2], -slope_v * camera.fy / p[:, 2]
    d[:, 2] = -(d[:, 0] * p[:, 0] + d[:, 1] * p[:, 1]) / p[:, 2]
    jacobian = np.concatenate([d, np.cross(p, d), at.model[:, None], np.ones((len(p), 1))], axis=1)
    residuals = brightness.gain * at.model + brightness.offset - at.frame
    return PhotometricRows(jacobian, residuals, at.seen, at.model, at.frame, p)


def estimate_brightness(
    points: LitPoints, target: LitTarget, T_target_source: Float64, gate_m: float, min_cosine: float
) -> Brightness | None:
    """Fit gain, offset and the scale of the residuals at a pose, from a sample of the points.

    Robust regression with Student's t and the median absolute deviation as the scale; None where too little is seen.
    """
    few = points.every(max(1, len(points) // SCALE_SAMPLES))
    few, seen_brightness = seen_points(few, target, T_target_source, gate_m, min_cosine)
    model, frame = few.intensities.astype(np.float64), seen_brightness.astype(np.float64)
    if len(model) < MIN_SAMPLES:
        return None
    gain, offset = 1.0, _median(frame - model)
    scale = MIN_SCALE
    for _ in range(4):
        residuals = gain * model + offset - frame
        scale = max(MIN_SCALE, 1.4826 * _median(np.abs(residuals - _median(residuals))))
        weights = (FREEDOM + 1) / (FREEDOM + (residuals / scale) ** 2) / scale**2
        total = weights.sum()
        mean_model, mean_frame = (weights @ model) / total, (weights @ frame) / total
        spread = weights @ (model - mean_model) ** 2 + 1 / GAIN_STD**2
        gain = float((weights @ ((model - mean_model) * (frame - mean_frame)) + 1 / GAIN_STD**2) / spread)
        offset = float(mean_frame - gain * mean_model)
    return Brightness(gain, offset, scale)


def _median(values: Float64) -> float:
    """Return the upper median: `np.median` takes longer for its checks than to find it."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


@dataclass(frozen=True, slots=True)
class Eliminated:
    """Normal equations of the motion alone: gain and offset follow it.

    Attributes
    ----------
    information : (6, 6), Schur complement of the brightness
    scores : (K, 6), of each part; they add up to the gradient
    brightness : where the sums were formed
    """

    information: Float64
    scores: Float64
    brightness: Brightness
    sums: PhotometricSums
    mix: Float64
    corner: Float64
    pull: Float64

    @property
    def gradient(self) -> Float64:
        """(6,)."""
        return np.asarray(self.scores.sum(axis=0))

    def scores_at(self, x: Float64) -> Float64:
        """Return the scores (K, 6) that are left after a step x (6,) and the brightness that belongs to it."""
        left = self.sums.gradient + self.sums.information @ np.concatenate([x, self._rise(x)])
        return np.asarray(left[:, :6] - left[:, 6:] @ self.mix.T)

    def brightness_at(self, x: Float64) -> Brightness:
        """Return the brightness that belongs to a step x (6,) of the motion."""
        gain, offset = self._rise(x)
        return replace(
            self.brightness, gain=self.brightness.gain + float(gain), offset=self.brightness.offset + float(offset)
        )

    def _rise(self, x: Float64) -> Float64:
        """Solve for the steps of gain and offset."""
        gradient = self.sums.gradient[:, 6:].sum(axis=0) + self.pull
        slope = self.sums.information[:, 6:, :6].sum(axis=0)
        return np.asarray(-np.linalg.solve(self.corner, gradient + slope @ x))


def eliminate_brightness(sums: PhotometricSums, brightness: Brightness) -> Eliminated:
    """Remove gain and offset from the sums by the Schur complement."""
    H, g = sums.information.sum(axis=0), sums.gradient
    corner = H[6:, 6:] + np.diag([1 / GAIN_STD**2, 1e-9])
    pull = np.array([(brightness.gain - 1) / GAIN_STD**2, 0.0])
    mix = np.linalg.solve(corner, H[6:, :6]).T
    scores = g[:, :6] - (g[:, 6:] + pull / len(g)) @ mix.T
    return Eliminated(H[:6, :6] - mix @ H[6:, :6], scores, brightness, sums, mix, corner, pull)
