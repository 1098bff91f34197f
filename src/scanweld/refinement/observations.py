"""Which keyframe sees which surfel, and the residuals there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig, build_pyramid, intrinsics_array
from scanweld.geometry.frame import Frame
from scanweld.loop_closure.keyframes import Keyframe
from scanweld.parallel import run_ranges
from scanweld.refinement import kernels
from scanweld.refinement.calibration import Calibration
from scanweld.refinement.surfels import Cameras, Surfels, no_surfels, surfels_in
from scanweld.registration.photometric.residuals import FREEDOM, MIN_SCALE

HELD_EVERY, BLOCK_CELLS = 4, 4
"""One in four blocks of 4x4 cells is held out."""

SURFACES_KEPT_BYTES = 256e6
"""Surfaces of keyframes are kept up to this, and made anew from depth beyond it."""


@dataclass(frozen=True, slots=True)
class Observations:
    """M sightings of surfels, ordered by keyframe, then surfel.

    Attributes
    ----------
    surfel, keyframe, pixel : (M,) int32; pixel is row-major
    seen : (M, 3) float32, measured normals, world frame
    rows : (M, CHANNELS, COLUMNS) float32, see :func:`.kernels.observe`
    """

    surfel: Int32
    keyframe: Int32
    pixel: Int32
    seen: Float32
    rows: Float32

    def __len__(self) -> int:
        return len(self.surfel)

    def only(self, chosen: Array) -> Observations:
        """Select by a mask."""
        return Observations(*(getattr(self, n)[chosen] for n in ("surfel", "keyframe", "pixel", "seen", "rows")))


class Views:
    """The images of keyframes, as one calibration after the other makes surfaces of them."""

    def __init__(self, keyframes: Sequence[Keyframe], surfaces: SurfaceConfig) -> None:
        self._keyframes = keyframes
        self._config = replace(surfaces, levels=1)
        self._made: dict[int, Float32] = {}
        self._made_with: Calibration | None = None
        height, width = keyframes[0].camera.shape
        self._room = int(SURFACES_KEPT_BYTES / (32 * height * width))
        self.noise = surfaces.noise
        self.lit = [keyframe.grey is not None for keyframe in keyframes]

    def __len__(self) -> int:
        return len(self._keyframes)

    def grey(self, index: int) -> Float32:
        """Brightness (H, W) float32, 0..255; zeros where there is none."""
        keyframe = self._keyframes[index]
        if keyframe.grey is None:
            return np.zeros(keyframe.camera.shape, np.float32)
        return keyframe.grey.astype(np.float32)

    def begin(self, calibration: Calibration) -> None:
        """Make surfaces with this calibration from now on."""
        if calibration != self._made_with:
            self._made, self._made_with = {}, calibration

    def surface(self, index: int) -> Float32:
        """The surface image (H, W, 8) of a keyframe."""
        made = self._made.get(index)
        if made is None:
            assert self._made_with is not None
            made = surface_of(self._keyframes[index], self._made_with, self._config)
            if index < self._room:
                self._made[index] = made
        return made

    def median_depth_m(self) -> float:
        """Median over the keyframes of their median depth [m]."""
        medians = [
            np.median(k.depth_steps[k.depth_steps > 0]) * k.depth_step_m for k in self._keyframes if k.depth_steps.any()
        ]
        return float(np.median(medians)) if medians else 1.0


def surface_of(keyframe: Keyframe, calibration: Calibration, config: SurfaceConfig) -> Float32:
    """Return the surface image (H, W, 8) of a keyframe with a calibration in place of its camera."""
    depth = calibration.depth.apply(keyframe.frame().depth_m)
    return build_pyramid(Frame(keyframe.timestamp_s, depth, None, calibration.camera), config).levels[0].surface


def sample_surfels(views: Views, T_camera_world: Float64, cell_px: int, gate_m: float, min_cosine: float) -> Surfels:
    """Cover what the keyframes see with surfels, one keyframe after the other."""
    surfels = no_surfels()
    for k in range(len(views)):
        seen = observe_one(views, k, T_camera_world[k], surfels, gate_m, min_cosine)
        surfels = surfels.joined(
            surfels_in(
                views.surface(k), se3.inverse(T_camera_world[k]), k, seen.pixel, cell_px, BLOCK_CELLS, HELD_EVERY
            )
        )
    return surfels


def observe(
    views: Views, cameras: Cameras, surfels: Surfels, gate_m: float, min_cosine: float, *, lit: bool = True
) -> Observations:
    """Find every surfel in every keyframe; without `lit` brightness has no weight."""
    views.begin(cameras.calibration)
    parts: list[Observations | None] = [None] * len(views)

    def body(start: int, stop: int) -> None:
        for k in range(start, stop):
            parts[k] = observe_one(views, k, cameras.T_camera_world[k], surfels, gate_m, min_cosine, lit=lit)

    run_ranges(len(views), body)
    found = [part for part in parts if part is not None]
    return Observations(
        *(np.concatenate([getattr(part, n) for part in found]) for n in ("surfel", "keyframe", "pixel", "seen", "rows"))
    )


def observe_one(
    views: Views,
    index: int,
    T_camera_world: Float64,
    surfels: Surfels,
    gate_m: float,
    min_cosine: float,
    *,
    lit: bool = False,
) -> Observations:
    """Find every surfel in one keyframe."""
    assert views._made_with is not None
    count = len(surfels)
    which, pixels = np.empty(count, np.int32), np.empty(count, np.int32)
    seen = np.empty((count, 3), np.float32)
    rows = np.empty((count, kernels.CHANNELS, kernels.COLUMNS), np.float32)
    found = kernels.observe(
        surfels.positions_m.astype(np.float32), surfels.normals.astype(np.float32), surfels.tangents(),
        T_camera_world[:3].astype(np.float32), views.surface(index), views.grey(index),
        intrinsics_array(views._made_with.camera), views.noise, np.array([gate_m, min_cosine], np.float32),
        lit and views.lit[index], which, pixels, seen, rows,
    )  # fmt: skip
    world = seen[:found] @ T_camera_world[:3, :3].astype(np.float32)  # the transpose turns back
    return Observations(
        which[:found].copy(), np.full(found, index, np.int32), pixels[:found].copy(), world, rows[:found].copy()
    )


@dataclass(frozen=True, slots=True)
class Fit:
    """Observations whose surfels are where the residuals want them; weights are in the last column.

    Attributes
    ----------
    observations : rows in standard deviations, weighted, of surfels that at least two keyframes see
    losses : (M, CHANNELS) float64, robust loss
    offsets_m : (S,), how far each surfel moved along its normal
    grey_sigma : scale of the differences of brightness [grey levels]
    """

    observations: Observations
    losses: Float64
    offsets_m: Float64
    grey_sigma: float


def fit_surfels(observations: Observations, count: int, robust_sigma: float) -> Fit:
    """Move surfels along their normals, and choose the brightness differences, to fit what the keyframes see.

    Each is a robust mean in closed form: iteratively reweighted, Huber's weights for distances, Student's t for
    brightness, whose scale is the median absolute deviation of all residuals.
    """
    often = np.bincount(observations.surfel, minlength=count) >= 2
    observations = observations.only(often[observations.surfel])
    rows, surfel = observations.rows, observations.surfel
    slope, distance = rows[:, 0, 11].astype(np.float64), rows[:, 0, 12].astype(np.float64)
    offsets = np.zeros(count)
    residual = distance
    for _ in range(3):
        weight = _huber(residual, robust_sigma)
        pull = np.bincount(surfel, weight * slope * distance, count)
        offsets = -pull / np.maximum(np.bincount(surfel, weight * slope**2, count), 1e-12)
        residual = distance + slope * offsets[surfel]
    losses = np.zeros((len(surfel), kernels.CHANNELS))
    size = np.abs(residual)
    losses[:, 0] = np.where(size <= robust_sigma, size**2 / 2, robust_sigma * (size - robust_sigma / 2))
    rows = rows.copy()
    rows[:, 0, 12], rows[:, 0, 13] = residual, _huber(residual, robust_sigma)
    lit = rows[:, 1, 13] > 0
    sigma = 1.0
    if lit.any():
        sigma = _fit_brightness(rows, losses, surfel, lit, count)
    return Fit(replace(observations, rows=rows), losses, offsets, sigma)


def _fit_brightness(rows: Float32, losses: Float64, surfel: Int32, lit: Bool, count: int) -> float:
    """Bring the brightness rows to residuals in standard deviations with weights; returns the scale."""
    owner = surfel[lit]
    values = rows[lit, 1:, 12].astype(np.float64)
    weights = np.ones_like(values)
    sigma, residuals = 1.0, np.empty_like(values)
    for _ in range(4):
        for c in range(2):
            total = np.bincount(owner, weights[:, c], count)
            mean = np.bincount(owner, weights[:, c] * values[:, c], count) / np.maximum(total, 1e-12)
            residuals[:, c] = values[:, c] - mean[owner]
        sigma = max(MIN_SCALE, 1.4826 * float(np.median(np.abs(residuals))))
        weights = (FREEDOM + 1) / (FREEDOM + (residuals / sigma) ** 2)
    rows[:, 1:, :12] /= np.float32(sigma)
    rows[lit, 1:, 12] = residuals / sigma
    rows[lit, 1:, 13] = weights
    losses[lit, 1:] = 0.5 * (FREEDOM + 1) * np.log1p((residuals / sigma) ** 2 / FREEDOM)
    return sigma


def fitted_surfels(surfels: Surfels, fit: Fit) -> Surfels:
    """Return the surfels at their offsets, with the means of the measured normals."""
    o = fit.observations
    total = np.stack([np.bincount(o.surfel, o.seen[:, a], len(surfels)) for a in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1)
    known = length > 1e-6
    normals = np.where(known[:, None], total / np.maximum(length, 1e-6)[:, None], surfels.normals)
    # Along the old normal: that is what the offset was solved for.
    return replace(surfels, positions_m=surfels.positions_m + fit.offsets_m[:, None] * surfels.normals, normals=normals)


def bounds_of(keyframe: Array, count: int) -> Int64:
    """Return where the observations of each keyframe begin and end (K + 1,)."""
    return np.searchsorted(keyframe, np.arange(count + 1)).astype(np.int64)


def _huber(residual: Float64, threshold: float) -> Float64:
    return np.asarray(np.minimum(1.0, threshold / np.maximum(np.abs(residual), 1e-12)))
