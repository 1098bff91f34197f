"""From a depth image to surfaces: bilateral filter, pyramid, vertices, normals, and how noisy they are."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Array, Float32, UInt8
from scanweld.config import check_ranges, setting
from scanweld.errors import InvalidInputError
from scanweld.geometry import kernels
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.parallel import run_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """How depth becomes surfaces."""

    max_depth_m: float = setting(8.0, "depth beyond this is invalid [m]; raise for halls, costs noise", low=0.1)
    noise_floor_m: float = setting(0.0012, "depth noise at noise_nearest_m [m]; raise for a worse sensor", low=1e-6)
    noise_growth: float = setting(0.0019, "growth of the noise with the square of the depth [1/m]", low=0.0)
    noise_nearest_m: float = setting(0.4, "depth of the least noise [m]", low=0.0)
    max_noise_scale: float = setting(
        8.0, "the noise is scaled by what each image shows, from 1 to this; 1 trusts the numbers above", low=1.0
    )
    normal_radius: int = setting(
        2,
        "window radius of the normals [pixels; of fine images more]; raise for noise, lower for detail",
        low=1,
        high=8,
    )
    min_cosine: float = setting(0.15, "surfaces seen more flatly than this cosine have no normal", low=0.01, high=1.0)
    levels: int = setting(3, "pyramid levels; raise for fast motion", low=1, high=6)
    bilateral: bool = setting(False, "smooth the depth before taking normals; slower")

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def noise(self) -> Float32:
        """sigma(z) = n[0] + n[1] (z - n[2])^2, axial noise of Nguyen et al. 2012 (eq. 5), before it is scaled."""
        return np.array([self.noise_floor_m, self.noise_growth, self.noise_nearest_m], np.float32)


@dataclass(frozen=True, slots=True)
class SurfaceLevel:
    """One pyramid level.

    Attributes
    ----------
    camera : intrinsics of this level
    depth_m : (H, W) float32, 0 invalid [m]
    surface : (H, W, 8) float32, camera frame: vertex [m], unit normal towards the camera, 1 / sigma [1/m],
        surfel radius [m]; the last five are 0 where there is no normal
    """

    camera: PinholeCamera
    depth_m: Float32
    surface: Float32

    @property
    def vertices_m(self) -> Float32:
        """(H, W, 3) view, 0 where invalid [m, camera frame]."""
        return self.surface[..., 0:3]

    @property
    def normals(self) -> Float32:
        """(H, W, 3) view, 0 where invalid [camera frame]."""
        return self.surface[..., 3:6]


@dataclass(frozen=True, slots=True)
class SurfacePyramid:
    """A frame and its surfaces, finest level first.

    Attributes
    ----------
    frame : what was seen
    levels : its surfaces
    grey : (H, W) float32, 0..255, brightness of the finest level; None where there is none to track with
    """

    frame: Frame
    levels: tuple[SurfaceLevel, ...]
    grey: Float32 | None = None


GRAIN_PX = 1 << 16
"""Pixels that a thread gets at least: fewer are worked off (in a quarter of a millisecond) before it has woken up."""


def build_pyramid(frame: Frame, config: SurfaceConfig | None = None) -> SurfacePyramid:
    """Compute vertices and normals of a frame at each pyramid level."""
    config = config or SurfaceConfig()
    depth = frame.depth_m
    if float(depth.max(initial=0.0)) > config.max_depth_m:
        depth = depth * (depth <= np.float32(config.max_depth_m))
    scale = noise_scale(depth, config)
    config = replace(config, noise_floor_m=config.noise_floor_m * scale, noise_growth=config.noise_growth * scale)
    camera = frame.camera
    levels = []
    for level in range(config.levels):
        if level > 0:
            if min(depth.shape) < 16:
                break
            depth, camera = half_size(depth, camera)
        smooth = bilateral_filter(depth, config) if config.bilateral and level == 0 else depth
        levels.append(SurfaceLevel(camera, smooth, surface_image(smooth, camera, config)))
        depth = smooth
    return SurfacePyramid(frame, tuple(levels), None if frame.color is None else luminance(frame.color))


def luminance(color: UInt8) -> Float32:
    """Return the grey image (H, W) float32, 0..255, of a colour image (H, W, 3) uint8."""
    rgb = as_kernel_input(color, np.uint8).reshape(len(color), -1)
    grey = np.empty(color.shape[:2], np.float32)
    run_ranges(len(grey), lambda start, stop: kernels.grey_rows(start, stop, rgb, grey), grain=_grain(grey))
    return grey


def noise_scale(depth_m: Float32, config: SurfaceConfig) -> float:
    """Estimate how much noisier an image is than the configured model, from 1 to `max_noise_scale`.

    Inverse depth is linear along rows and columns of a plane, so the bends between three pixels three apart are noise
    almost everywhere; their median is compared with the model's (median absolute deviation).
    """
    depth = as_kernel_input(depth_m, np.float32)
    ratios = np.empty(depth.size // 8 + sum(depth.shape), np.float32)
    count = kernels.bend_ratios(depth, config.noise, ratios)
    if count < 100:
        return 1.0
    typical = 1.4826 * float(np.median(ratios[:count])) / math.sqrt(6)
    return min(max(typical, 1.0), config.max_noise_scale)


def surface_image(depth_m: Float32, camera: PinholeCamera, config: SurfaceConfig) -> Float32:
    """Return the surface image (H, W, 8) of a depth image; see :class:`SurfaceLevel`."""
    if depth_m.shape != camera.shape:
        raise InvalidInputError(f"depth has shape {depth_m.shape}, the camera {camera.shape}")
    depth = as_kernel_input(depth_m, np.float32)
    surface = np.empty((*depth.shape, 8), np.float32)
    values = surface.reshape(len(surface), -1)
    intrinsics = intrinsics_array(camera)
    noise, radius, cosine = config.noise, window_radius(camera, config), np.float32(config.min_cosine)

    def rows(start: int, stop: int) -> None:
        kernels.surface_rows(start, stop, depth, intrinsics, radius, noise, cosine, values)

    run_ranges(depth.shape[0], rows, grain=_grain(depth))
    return surface


USUAL_FOCAL_PX = 525.0
"""Focal length of the usual depth camera, 640 pixels wide."""


def window_radius(camera: PinholeCamera, config: SurfaceConfig) -> int:
    """Return the radius of the window that normals are from [pixels]: as many as configured, or where pixels are finer
    than usual, more.

    Depth noise does not shrink with the pixels: over a window of half the width, normals scatter twice as far.
    """
    return max(config.normal_radius, round(config.normal_radius * max(camera.fx, camera.fy) / USUAL_FOCAL_PX))


def half_size(depth_m: Float32, camera: PinholeCamera, relative_band: float = 0.03) -> tuple[Float32, PinholeCamera]:
    """Halve a depth image without averaging across an edge; an odd last row or column is dropped.

    Returns the image (H // 2, W // 2) and its camera, whose pixel centres lie between four of the old ones.
    """
    depth = as_kernel_input(depth_m, np.float32)
    half = np.empty((depth.shape[0] // 2, depth.shape[1] // 2), np.float32)
    band = np.float32(relative_band)
    run_ranges(
        half.shape[0], lambda start, stop: kernels.halve_depth(start, stop, depth, band, half), grain=_grain(half)
    )
    smaller = PinholeCamera(
        camera.fx / 2,
        camera.fy / 2,
        (camera.cx + 0.5) / 2 - 0.5,
        (camera.cy + 0.5) / 2 - 0.5,
        half.shape[1],
        half.shape[0],
    )
    return half, smaller


def bilateral_filter(
    depth_m: Float32, config: SurfaceConfig | None = None, *, radius: int = 3, space_sigma: float = 2.0
) -> Float32:
    """Smooth depth (H, W) [m] where neighbours agree within the noise (Tomasi and Manduchi 1998)."""
    config = config or SurfaceConfig()
    depth = as_kernel_input(depth_m, np.float32)
    smooth = np.empty_like(depth)
    noise, sigma, factor = config.noise, np.float32(space_sigma), np.float32(3)

    def rows(start: int, stop: int) -> None:
        kernels.bilateral_rows(start, stop, depth, radius, sigma, noise, factor, smooth)

    run_ranges(depth.shape[0], rows)
    return smooth


def _grain(image: Array) -> int:
    """Rows of an image that a thread gets at least."""
    return max(1, GRAIN_PX // int(image.shape[1]))


def as_kernel_input(image: Array, dtype: npt.DTypeLike) -> Array:
    """Return an image as a contiguous, writeable array, copied only if need be.

    Kernels are compiled for one layout; a view of a BGR image or a read-only buffer would compile them anew.
    """
    return np.require(image, dtype, ("C", "W"))


def intrinsics_array(camera: PinholeCamera) -> Float32:
    """(4,) float32: fx, fy, cx, cy, as kernels take them."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
