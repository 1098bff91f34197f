"""What a depth camera does to a perfect depth image.

Sources
-------
- C. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking",
  3DIMPVT 2012: axial noise sigma_z = 0.0012 + 0.0019 (z - 0.4)^2, loss at grazing angles.
- J. Barron, J. Malik, "Intrinsic scene properties from a single RGB-D image", CVPR 2013, and A. Handa et al.,
  "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM" (ICL-NUIM), ICRA 2014: lateral shift of
  the pixels, then quantisation of the disparity.
- K. Khoshelham, S. Oude Elberink, "Accuracy and resolution of Kinect depth data", Sensors 2012: the depth
  step z^2 / (8 f b).
- L. Keselman et al., "Intel RealSense stereoscopic depth cameras", CVPR workshops 2017, and
  A. Grunnet-Jepsen, J. Sweetser, J. Woodfill, "Best-known-methods for tuning Intel RealSense D400 depth
  cameras", 2018: sigma_z = z^2 sigma_d / (f b), noise that neighbours share because blocks are matched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, UInt8
from scanweld.geometry.camera import PinholeCamera

SENSOR_WIDTH = 640
"""Noise is that of a sensor 640 pixels wide, whatever the size of the image made from it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Parameters of a depth camera. Pixels are those of a sensor 640 pixels wide.

    Attributes
    ----------
    baseline_m : between projector (or second camera) and camera [m]
    disparity_step_px : disparity is rounded to multiples of this
    axial_m : (c0, c1, z0), sigma_z = c0 + c1 (z - z0)^2 [m]
    correlation_px : standard deviation of the blur of the axial noise; 0 is independent pixels
    lateral_px : standard deviation of the pixel shift
    edge_dropout : probability that a pixel within two pixels of a depth edge is lost
    hole_fraction : share of a surface at 3 m that is lost in speckles; grows with z^2
    grazing_deg : angles between ray and normal at which loss begins, and is certain
    range_m : nearest and farthest depth
    color_sigma : noise of the colours, in steps of 1/255
    """

    baseline_m: float
    disparity_step_px: float
    axial_m: tuple[float, float, float]
    correlation_px: float
    lateral_px: float
    edge_dropout: float
    hole_fraction: float
    grazing_deg: tuple[float, float]
    range_m: tuple[float, float]
    color_sigma: float


NOISE_MODELS: dict[str, NoiseModel | None] = {
    "none": None,
    "kinect": NoiseModel(
        baseline_m=0.075,
        disparity_step_px=1 / 8,
        axial_m=(0.0012, 0.0019, 0.4),
        correlation_px=0.0,
        lateral_px=0.5,
        edge_dropout=0.35,
        hole_fraction=0.0,
        grazing_deg=(75.0, 84.0),
        range_m=(0.4, 8.0),
        color_sigma=2.5,
    ),
    "realsense": NoiseModel(
        baseline_m=0.05,
        disparity_step_px=1 / 32,
        axial_m=(0.0008, 0.0032, 0.0),
        correlation_px=2.0,
        lateral_px=0.3,
        edge_dropout=0.6,
        hole_fraction=0.03,
        grazing_deg=(68.0, 80.0),
        range_m=(0.2, 6.0),
        color_sigma=2.0,
    ),
}
"""Noise models by name."""

EDGE_RATIO = 0.04
"""Neighbours whose depths differ by more than this share of the nearer one lie on different surfaces."""


def degrade_depth(depth_m: Float32, camera: PinholeCamera, model: NoiseModel, rng: np.random.Generator) -> Float32:
    """Return the depth image (H, W) [m] as `model` would have measured the exact `depth_m`; 0 is invalid.

    Order: shadow of the projector, edges, grazing surfaces and speckles lost; pixels shifted sideways; axial
    noise; disparity quantised; range cut.
    """
    valid = (depth_m > 0) & (depth_m < 1e6)
    exact = np.where(valid, depth_m, 0).astype(np.float64)
    scale = camera.width / SENSOR_WIDTH
    edge = depth_edges(exact)
    keep = valid & ~_shadowed(exact, camera, model)
    keep &= ~(_widen(edge, max(1, round(2 * scale))) & (rng.random(exact.shape) < model.edge_dropout))
    keep &= ~_grazing(exact, camera, model, rng)
    if model.hole_fraction > 0:
        keep &= ~_speckles(exact, model, scale, rng)
    z = _shift_sideways(exact, edge, model.lateral_px * scale, rng)
    z = z + axial_sigma_m(z, model) * _correlated_noise(exact.shape, model.correlation_px * scale, rng)
    z = quantise_disparity(z, camera, model)
    keep &= (z >= model.range_m[0]) & (z <= model.range_m[1])
    return np.where(keep, z, 0).astype(np.float32)


def degrade_color(color: UInt8, model: NoiseModel, rng: np.random.Generator) -> UInt8:
    """Return the colour image with Gaussian noise."""
    noise = rng.standard_normal(color.shape, dtype=np.float32) * model.color_sigma
    return np.asarray(np.clip(np.rint(color + noise), 0, 255).astype(np.uint8))


def axial_sigma_m(depth_m: Float64, model: NoiseModel) -> Float64:
    """Standard deviation [m] of the depth noise at a depth (Nguyen et al. 2012, eq. 3)."""
    c0, c1, z0 = model.axial_m
    return np.asarray(c0 + c1 * (depth_m - z0) ** 2)


def quantise_disparity(depth_m: Float64, camera: PinholeCamera, model: NoiseModel) -> Float64:
    """Round the disparity f b / z to the sensor's step (Khoshelham & Oude Elberink 2012); 0 stays 0."""
    focal_px = camera.fx * SENSOR_WIDTH / camera.width
    reach = focal_px * model.baseline_m / model.disparity_step_px
    safe = np.where(depth_m > 0.05, depth_m, 1.0)
    steps = np.maximum(np.rint(reach / safe), 1.0)
    return np.where(depth_m > 0.05, reach / steps, 0.0)


def depth_edges(depth_m: Float64) -> Bool:
    """Pixels (H, W) with a neighbour on another surface."""
    edge = np.zeros(depth_m.shape, dtype=np.bool_)
    for axis in (0, 1):
        a = np.moveaxis(depth_m, axis, 0)
        jump = np.abs(a[1:] - a[:-1]) > EDGE_RATIO * np.minimum(a[1:], a[:-1])
        marked = np.moveaxis(edge, axis, 0)
        marked[1:] |= jump
        marked[:-1] |= jump
    return edge


def _widen(mask: Bool, radius: int) -> Bool:
    """Grow a mask by `radius` pixels in the four directions."""
    grown = mask.copy()
    for step in range(1, radius + 1):
        grown[step:] |= mask[:-step]
        grown[:-step] |= mask[step:]
        grown[:, step:] |= mask[:, :-step]
        grown[:, :-step] |= mask[:, step:]
    return grown


def _shadowed(depth_m: Float64, camera: PinholeCamera, model: NoiseModel) -> Bool:
    """Pixels that the projector, to the right of the camera, cannot see past something nearer.

    A pixel u is lit at the projector's column u - f b / z. Something to its right whose column is smaller
    stands in the way, so the shadow lies to the left of near objects.
    """
    columns = np.arange(camera.width) - camera.fx * model.baseline_m / np.maximum(depth_m, 0.1)
    columns[depth_m <= 0] = np.inf
    blocked = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    # Rounding of one pixel is no shadow: a slanted surface may compress its columns.
    return np.asarray(columns > blocked + 1.0)


def _grazing(depth_m: Float64, camera: PinholeCamera, model: NoiseModel, rng: np.random.Generator) -> Bool:
    """Pixels lost because the surface is seen edge-on; the probability rises between the two angles."""
    points = camera.rays() * depth_m[..., None]
    across, down = np.empty_like(points), np.empty_like(points)
    across[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    across[:, 0], across[:, -1], down[0], down[-1] = across[:, 1], across[:, -2], down[1], down[-2]
    normal = np.cross(across, down)
    lengths = np.linalg.norm(normal, axis=-1) * np.linalg.norm(points, axis=-1)
    cosine = np.abs((normal * points).sum(axis=-1)) / np.maximum(lengths, 1e-12)
    angle = np.rad2deg(np.arccos(np.minimum(cosine, 1.0)))
    low, high = model.grazing_deg
    return np.asarray(rng.random(depth_m.shape) < (angle - low) / (high - low))


def _correlated_noise(shape: tuple[int, ...], blur_px: float, rng: np.random.Generator) -> Float64:
    """Gaussian noise (H, W) of unit variance; neighbours share it over `blur_px`."""
    noise = rng.standard_normal(shape)
    if blur_px < 0.3:
        return noise
    import cv2

    blurred = np.asarray(cv2.GaussianBlur(noise, (0, 0), blur_px), dtype=np.float64)
    radius = int(np.ceil(4 * blur_px))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / blur_px) ** 2)
    kernel /= kernel.sum()
    blurred /= (kernel**2).sum()  # the 2-D kernel's energy is the square of the 1-D one's
    # Most of the noise is shared, a little is each pixel's own.
    return np.asarray(np.sqrt(0.8) * blurred + np.sqrt(0.2) * rng.standard_normal(shape))


def _speckles(depth_m: Float64, model: NoiseModel, scale: float, rng: np.random.Generator) -> Bool:
    """Blobs without a match: where a smooth random field exceeds a threshold that falls with depth."""
    from scipy.special import ndtri

    field = _correlated_noise(depth_m.shape, 3.0 * scale, rng)
    share = np.clip(model.hole_fraction * (depth_m / 3.0) ** 2, 1e-6, 0.5)
    return np.asarray(field > -ndtri(share))


def _shift_sideways(depth_m: Float64, edge: Bool, sigma_px: float, rng: np.random.Generator) -> Float64:
    """Read every pixel at a randomly shifted place: bilinear inside surfaces, the nearest pixel at edges."""
    height, width = depth_m.shape
    rows, columns = np.mgrid[0:height, 0:width]
    v = np.clip(rows + sigma_px * rng.standard_normal(depth_m.shape), 0, height - 1)
    u = np.clip(columns + sigma_px * rng.standard_normal(depth_m.shape), 0, width - 1)
    nearest = depth_m[np.rint(v).astype(np.int64), np.rint(u).astype(np.int64)]
    top = np.minimum(v.astype(np.int64), max(height - 2, 0))
    left = np.minimum(u.astype(np.int64), max(width - 2, 0))
    bottom, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
    b, a = v - top, u - left
    upper = (1 - a) * depth_m[top, left] + a * depth_m[top, right]
    lower = (1 - a) * depth_m[bottom, left] + a * depth_m[bottom, right]
    mixed = edge[top, left] | edge[bottom, right] | (nearest <= 0)
    return np.asarray(np.where(mixed, nearest, (1 - b) * upper + b * lower), dtype=np.float64)
