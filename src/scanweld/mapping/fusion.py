"""Point-based fusion (Keller et al. 2013): associate, merge, append, and remove what does not last."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int32
from scanweld.config import check_ranges, section, setting
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid, as_kernel_input
from scanweld.geometry.views import ModelView
from scanweld.mapping.backends import backend
from scanweld.mapping.backends.arrays import DepthBuffers, Measurement
from scanweld.mapping.merging import MergingConfig
from scanweld.mapping.rendering import as_view, render_index_map
from scanweld.mapping.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfig:
    """When a measurement and a surfel are the same, and which surfels stay."""

    gate_sigma: float = setting(
        3.0,
        "a measurement merges within this many standard deviations of the depth noise; raise for noise",
        low=0.1,
    )
    gate_floor_m: float = setting(
        0.005, "and always within this [m]; raise for a wrong camera model, lower for fine detail", low=0.0
    )
    min_cosine: float = setting(0.5, "merged normals agree at least this well; lower for noise", low=-0.9, high=1.0)
    spread_pixels: float = setting(
        1.0, "a surfel this near a pixel's centre covers it [pixels]; raise for a smaller map", low=0.5, high=1.5
    )
    stable_confidence: float = setting(3.0, "a surfel of this confidence is stable; raise for clutter", low=0.0)
    unstable_frames: int = setting(
        40,
        "a surfel still unstable after this many frames is removed; raise to keep what is seen briefly",
        low=1,
    )
    max_confidence: float = setting(100.0, "confidence stops growing here; lower for maps that follow change", low=1.0)
    free_space_margin_m: float = setting(
        0.05, "a surfel this far in front of what is seen through it loses confidence [m]", low=0.0
    )
    merging: MergingConfig = section(MergingConfig, "which layers become one surface when a loop is closed")
    clean_interval: int = setting(8, "frames between removals; lower saves memory, costs time", low=1)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class FusionCounts:
    """What one frame did to the map."""

    appended: int
    removed: int


@lru_cache(maxsize=8)
def radial_weight(camera: PinholeCamera) -> Float32:
    """Return the weight of a measurement at each pixel (H, W), 1 on the optical axis at any depth.

    alpha = exp(-gamma^2 / (2 * 0.6^2)), gamma the distance to the principal point over the largest such distance
    (Keller et al. 2013, sec. 4.2).
    """
    u, v = np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy
    squared = u[None, :] ** 2 + v[:, None] ** 2
    largest = squared.max() or 1.0  # an image of one pixel
    weight: Float32 = np.exp(-squared / largest / (2 * 0.6**2)).astype(np.float32)
    weight.flags.writeable = False
    return weight


NOTHING_MOVES = np.zeros((0, 0), np.bool_)
"""A mask of no image."""


def fuse(
    surfels: SurfelMap,
    candidates: Int32,
    pyramid: SurfacePyramid,
    T_world_camera: Float64,
    frame_id: int,
    config: FusionConfig,
    moving: Bool | None = None,
    depth_buffers: DepthBuffers | None = None,
) -> tuple[FusionCounts, ModelView]:
    """Merge a frame into the map, in place; returns what happened, and the map as it was seen, without what is new.

    Pixels in `moving` (H, W) add nothing to the map, and surfels that they lie on are demoted to the confidence of one
    measurement (Keller et al. 2013, sec. 6).
    """
    level = pyramid.levels[0]
    camera, surface = level.camera, level.surface
    color = pyramid.frame.color
    if color is None:
        color = np.full((*camera.shape, 3), 160, np.uint8)
    color = as_kernel_input(color, np.uint8)
    alpha, moving = radial_weight(camera), NOTHING_MOVES if moving is None else as_kernel_input(moving, np.bool_)
    weights = alpha if moving is NOTHING_MOVES else np.where(moving, -alpha, alpha)
    weights.flags.writeable = False  # as `alpha` is: another kind of array would be another compilation
    frame = Measurement(T_world_camera, camera, surface, color, weights, moving, frame_id)
    limits = np.array([
        config.gate_sigma, config.gate_floor_m, config.min_cosine, config.free_space_margin_m, config.spread_pixels,
        config.max_confidence,
    ], np.float32)  # fmt: skip
    seen = render_index_map(surfels, candidates, T_world_camera, camera, config.stable_confidence, depth_buffers)
    merged, rows, values = backend().merge(surfels.pages, seen, frame, limits)
    new = backend().new_surfels(rows, values, merged, frame, limits, surfels.anchor)
    surfels.pages.add(new)
    counted = FusionCounts(new.shape[1], tidy(surfels, frame_id, config))
    return counted, as_view(rows, values, T_world_camera, camera, config.stable_confidence)


def tidy(surfels: SurfelMap, frame_id: int, config: FusionConfig) -> int:
    """Drop surfels that stayed unstable for too long, or that free space has eaten up; returns how many.

    Only pages are looked at where a surfel may have to go.
    """
    if frame_id % config.clean_interval != 0:
        return 0
    pages = surfels.pages
    late, dirty = (
        pages.on_probation_since(frame_id - config.unstable_frames),
        np.flatnonzero(pages.dirty.view(np.bool_)),
    )
    slots = np.union1d(late, dirty)
    return surfels.clean(slots, frame_id, config.unstable_frames, config.stable_confidence)
