"""One frame of a scene: exact depth at the pixel centres, and colour with smoothed edges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, UInt8, as_transform
from scanweld.datasets.synthetic.casting import cast_rays, shade_rays
from scanweld.datasets.synthetic.scene import Scene
from scanweld.geometry.camera import PinholeCamera

EXPOSURE = 2.0
_WHITE = np.float32(1.0 / EXPOSURE)
_LEVELS = 4096
_SUBPIXELS = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))


def render_frame(scene: Scene, camera: PinholeCamera, T_world_camera: npt.ArrayLike) -> tuple[UInt8, Float32]:
    """Render what a camera sees.

    Depth is that of the ray through the pixel's centre, exact to rounding. Colour is lit by lights fixed in
    the world, without highlights, so a point has the same colour from everywhere; pixels on the edge between
    two primitives take the mean of four samples.

    Returns
    -------
    color : (H, W, 3) uint8, sRGB
    depth_m : (H, W) float32, distance along the optical axis [m], 0 where nothing is hit
    """
    T = as_transform(T_world_camera, "T_world_camera")
    origin, angle = T[:3, 3], 1.0 / camera.fx
    rows, columns = np.divmod(np.arange(camera.height * camera.width), camera.width)
    directions = _directions(camera, T, columns, rows)
    distance, hit = cast_rays(scene, origin, directions)
    light = shade_rays(scene, origin, directions, distance, hit, angle)
    at_edge = np.flatnonzero(_edges(hit.reshape(camera.shape), light.reshape(*camera.shape, 3)))
    if len(at_edge):
        du, dv = np.array(_SUBPIXELS).T[:, :, None]
        directions = _directions(camera, T, (columns[at_edge] + du).ravel(), (rows[at_edge] + dv).ravel())
        around, around_hit = cast_rays(scene, origin, directions)
        samples = shade_rays(scene, origin, directions, around, around_hit, angle).reshape(len(du), -1, 3)
        # Bright lamps are clipped before the mean, or their edges would stay jagged.
        light[at_edge] = np.minimum(samples, _WHITE).mean(axis=0)
    # The directions have a component of 1 along the optical axis, so t is the depth.
    depth_m = np.where(hit >= 0, distance, 0.0).astype(np.float32).reshape(camera.shape)
    return _develop(light).reshape(*camera.shape, 3), depth_m


def _directions(camera: PinholeCamera, T_world_camera: Float64, u: Array, v: Array) -> Float64:
    """World directions (N, 3) of the rays through pixels (u, v), 1 along the optical axis."""
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    rays = np.empty((len(x), 3))
    for axis, (a, b, c) in enumerate(T_world_camera[:3, :3]):
        rays[:, axis] = a * x + b * y + c
    return rays


def _edges(hit: Int32, light: Float32) -> Bool:
    """Pixels (H, W) whose neighbour shows another primitive, of visibly different colour."""
    edge = np.zeros(hit.shape, dtype=np.bool_)
    level = np.sqrt(np.minimum(light, _WHITE))  # about as the eye sees it
    for marked, ids, shown in ((edge, hit, level), (edge.T, hit.T, level.transpose(1, 0, 2))):
        row, column = np.nonzero(ids[1:] != ids[:-1])
        visible = np.abs(shown[row + 1, column] - shown[row, column]).max(axis=1) > 0.05
        row, column = row[visible], column[visible]
        marked[row, column] = True
        marked[row + 1, column] = True
    return edge


def _tone_curve() -> UInt8:
    """Table from linear light, 0..1 in steps, to sRGB: a soft shoulder above 0.7, then the sRGB curve."""
    x = np.linspace(0.0, 1.0, _LEVELS) * 1.6
    x = np.where(x < 0.6, x, 0.6 + 0.4 * (1 - np.exp(-(x - 0.6) / 0.4)))
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * np.clip(encoded, 0, 1)).astype(np.uint8))


_TONE = _tone_curve()


def _develop(light: Float32) -> UInt8:
    """Map linear light to 8-bit sRGB."""
    index = np.clip(light * np.float32(EXPOSURE / 1.6 * (_LEVELS - 1)), 0, _LEVELS - 1).astype(np.int32)
    return np.asarray(_TONE[index])
