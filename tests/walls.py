"""Rendered views of a flat wall in memory: texture as a function of the place on it, sensor noise, exposure."""

from __future__ import annotations

import numpy as np

import scanweld as sw
from rendered import CAMERA
from scanweld.datasets.synthetic import NOISE_MODELS, degrade_depth

DISTANCE_M = 1.5


def texture(x_m: np.ndarray, y_m: np.ndarray, shortest_m: float = 0.04) -> np.ndarray:
    """Sum of 12 waves in random directions, the longest 10 times as long as the shortest: 128 on average, about 25 of
    standard deviation."""
    rng = np.random.default_rng(0)
    value = np.full(np.shape(x_m), 128.0)
    for length in np.geomspace(shortest_m, 10 * shortest_m, 12):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        value = value + 10 * np.sin(2 * np.pi / length * (np.cos(angle) * x_m + np.sin(angle) * y_m) + phase)
    return value


def lamps(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """The light of two lamps on a plain wall: half of it is left about a metre away."""
    first = 80 / (1 + ((x_m - 0.3) ** 2 + (y_m + 0.25) ** 2) / 0.8**2)
    return 80 + first + 40 / (1 + ((x_m + 0.6) ** 2 + (y_m - 0.3) ** 2) / 0.5**2)


def wall_frame(
    T_world_camera: np.ndarray,
    *,
    textured: bool,
    timestamp_s: float = 0.0,
    seed: int = 0,
    depth_noise: str = "kinect",
    grey_noise: float = 2.0,
    gain: float = 1.0,
    offset: float = 0.0,
    stripes: bool = False,
    lit: bool = False,
    shortest_m: float = 0.04,
    camera: sw.PinholeCamera = CAMERA,
) -> sw.Frame:
    """The wall z = 1.5 m of the world, seen by a camera; `stripes` leave the texture constant along y, `lit` is by
    lamps."""
    rng = np.random.default_rng(1000 + seed)
    rays = camera.rays() @ T_world_camera[:3, :3].T
    depth = ((DISTANCE_M - T_world_camera[2, 3]) / rays[..., 2]).astype(np.float32)
    places = T_world_camera[:3, 3] + depth[..., None] * rays
    y = np.zeros(depth.shape) if stripes else places[..., 1]
    grey = texture(places[..., 0], y, shortest_m) if textured else 128.0
    if lit:
        grey = lamps(places[..., 0], places[..., 1])
    grey = gain * grey + offset + grey_noise * rng.standard_normal(depth.shape)
    color = np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    if depth_noise != "none":
        depth = degrade_depth(depth, camera, NOISE_MODELS[depth_noise], rng)
    return sw.Frame(timestamp_s, depth, color, camera)
