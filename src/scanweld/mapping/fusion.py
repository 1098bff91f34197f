"""Point-based fusion (Keller et al. 2013): associate, merge, append, and remove what does not last."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.config import check_ranges, section, setting
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid, as_kernel_input, intrinsics_array
from scanweld.mapping import kernels
from scanweld.mapping.merging import MergingConfig
from scanweld.mapping.rendering import Candidates, render_index_map
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import run_ranges


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
    min_cosine: float = setting(0.5, "merged normals agree at least this well; lower for noise", low=-1.0, high=1.0)
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


def fuse(
    surfels: SurfelMap,
    candidates: Candidates,
    pyramid: SurfacePyramid,
    T_world_camera: Float64,
    frame_id: int,
    config: FusionConfig,
    index_map: Int32 | None = None,
    moving: Bool | None = None,
) -> FusionCounts:
    """Merge a frame into the map, in place; `index_map` (H, W) is that of the pose where it is known already.

    Pixels in `moving` (H, W) add nothing to the map, and surfels that they lie on are demoted.
    """
    level = pyramid.levels[0]
    camera, surface = level.camera, level.surface
    color = pyramid.frame.color
    if color is None:
        color = np.full((*camera.shape, 3), 160, np.uint8)
    color = as_kernel_input(color, np.uint8)
    alpha, most = radial_weight(camera), np.float32(config.max_confidence)
    transform, intrinsics = T_world_camera[:3].astype(np.float32), intrinsics_array(camera)
    parameters = np.array(
        [config.gate_sigma, config.gate_floor_m, config.min_cosine, config.free_space_margin_m, config.spread_pixels],
        np.float32,
    )
    if index_map is None:
        index_map, _ = render_index_map(surfels, candidates, T_world_camera, camera, config.stable_confidence)
    action, row_counts = np.empty(camera.shape, np.uint8), np.empty(camera.height, np.int64)
    a = surfels.arrays

    def associate(start: int, stop: int) -> None:
        kernels.associate_rows(
            start,
            stop,
            index_map,
            surface,
            transform,
            intrinsics,
            parameters,
            a.positions,
            a.normals,
            row_counts,
            action,
        )

    def merge(start: int, stop: int) -> None:
        kernels.merge_rows(
            start, stop, action, index_map, surface, color, alpha, transform, most, frame_id,
            a.positions, a.normals, a.colors, a.radii, a.confidences, a.last_seen,
        )  # fmt: skip

    # Two passes: every decision sees the map as it was, whichever thread comes first.
    run_ranges(camera.height, associate)
    if moving is not None:
        demote(surfels, index_map, action, row_counts, moving)
    run_ranges(camera.height, merge)
    offsets = len(surfels) + np.concatenate([[0], np.cumsum(row_counts)])
    new = int(offsets[-1]) - len(surfels)
    b = surfels.reserve(new)

    def append(start: int, stop: int) -> None:
        kernels.append_rows(
            start, stop, action, offsets, surface, color, alpha, transform, frame_id,
            b.positions, b.normals, b.colors, b.radii, b.confidences, b.created, b.last_seen,
        )  # fmt: skip

    run_ranges(camera.height, append)
    surfels.extend(new)
    interval = max(config.clean_interval, len(surfels) // TIDIED_PER_FRAME)
    removed = tidy(surfels, index_map, frame_id, config) if frame_id % interval == 0 else 0
    return FusionCounts(new, removed)


MOVED_CONFIDENCE = 1.0
"""Confidence of a surfel that something moving lies on: that of one measurement (Keller et al. 2013, sec. 6)."""


def demote(surfels: SurfelMap, index_map: Int32, action: UInt8, row_counts: Int64, moving: Bool) -> None:
    """Take the `moving` pixels (H, W) out of the frame's actions, and the confidence of the surfels they lie on.

    What they look through still counts as seen through. `action` (H, W) and `row_counts` (H,) are changed.
    """
    lies_on = index_map[moving & ((action & kernels.MERGE) > 0)]
    confidences = surfels.arrays.confidences
    confidences[lies_on] = np.minimum(confidences[lies_on], np.float32(MOVED_CONFIDENCE))
    action[moving] &= kernels.SEEN_THROUGH
    row_counts[:] = np.count_nonzero(action & kernels.APPEND, axis=1)


TIDIED_PER_FRAME = 20_000
"""A large map is tidied less often: sorting costs this many surfels a frame on average, about 1 ms on two cores."""


def tidy(surfels: SurfelMap, index_map: Int32, frame_id: int, config: FusionConfig) -> int:
    """Drop surfels that stayed unstable for too long, or that free space has eaten up; returns how many.

    The others are put into an order that is quick to walk: first those in view, as the image shows them, then the
    rest as they were. Neighbours in the image that are neighbours in memory halve the time of view and fusion.
    """
    confidences = surfels.confidences
    late = (confidences < config.stable_confidence) & (frame_id - surfels.created > config.unstable_frames)
    kept = ~(late | (confidences <= 0))
    removed = len(surfels) - int(np.count_nonzero(kept))
    visible = index_map[index_map >= 0]
    visible = visible[kept[visible]]
    kept[visible] = False
    surfels.keep(np.concatenate([visible, np.flatnonzero(kept)]))
    return removed
