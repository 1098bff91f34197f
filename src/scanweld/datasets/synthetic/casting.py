"""Cast and shade rays: the typed face of the kernels, on all threads."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float32, Float64, Int32
from scanweld.datasets.synthetic import kernels
from scanweld.datasets.synthetic.scene import Scene
from scanweld.parallel import run_ranges


def cast_rays(scene: Scene, origin_m: Float64, directions: Float64) -> tuple[Float64, Int32]:
    """Return the nearest hit of each ray origin + t direction.

    Parameters
    ----------
    origin_m : (3,) world frame [m]
    directions : (N, 3) world frame, of any length

    Returns
    -------
    distance : (N,) t in multiples of the direction's length; `kernels.FAR` where nothing is hit
    hit : (N,) int32 row of the primitive, -1 where nothing is hit
    """
    count = len(directions)
    distance, hit = np.empty(count), np.empty(count, np.int32)
    origin, rays = np.ascontiguousarray(origin_m, np.float64), np.ascontiguousarray(directions, np.float64)
    shapes = np.ascontiguousarray(scene.integers[:, 0])
    tapers = np.ascontiguousarray(scene.scalars[:, 4])

    def body(start: int, stop: int) -> None:
        kernels.cast(origin, rays, start, stop, scene.bounds, scene.links, shapes, tapers, scene.affine, distance, hit)

    run_ranges(count, body)
    return distance, hit


def shade_rays(
    scene: Scene,
    origin_m: Float64,
    directions: Float64,
    distance: Float64,
    hit: Int32,
    pixel_angle_rad: float,
) -> Float32:
    """Return the linear light (N, 3) float32 that comes along the rays of :func:`cast_rays`."""
    count = len(directions)
    color = np.empty((count, 3), np.float32)
    origin, rays = np.ascontiguousarray(origin_m, np.float64), np.ascontiguousarray(directions, np.float64)

    def body(start: int, stop: int) -> None:
        kernels.shade(
            origin, rays, start, stop, pixel_angle_rad, distance, hit, scene.integers, scene.scalars,
            scene.affine, scene.colors, scene.lights, scene.shadow, scene.ambient, color,
        )  # fmt: skip

    run_ranges(count, body)
    return color
