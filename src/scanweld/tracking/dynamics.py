"""What moves in a frame, so that it is neither tracked nor mapped (Keller et al. 2013, sec. 6).

Seeds are pixels in space that was empty: no stable surfel confirms their surface, and an earlier view saw through the
place where they stand. A surface that merely comes into view for the first time has no such witness, and neither has
an edge or a thin thing that the map knows. From the seeds, regions grow over the depth image along connected surface
that the map does not confirm.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, UInt8
from scanweld.config import check_ranges, setting
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfaceLevel, SurfacePyramid, as_kernel_input, intrinsics_array
from scanweld.geometry.views import ModelView
from scanweld.parallel import run_ranges
from scanweld.registration.result import RegistrationResult, Status
from scanweld.state import Stateful
from scanweld.tracking import kernels


@dataclass(frozen=True, slots=True, kw_only=True)
class DynamicsConfig:
    """What counts as moving."""

    memory_frames: int = setting(
        90, "a place seen empty within so many frames can be moved into; raise for slow things, 0: static", low=0
    )
    margin_m: float = setting(
        0.05, "something moving stands at least this far inside the empty space [m]; raise for a jerky camera", low=0.0
    )
    sigmas: float = setting(4.0, "and beyond it by so many standard deviations of the depth; raise for noise", low=0.0)
    min_share: float = setting(
        0.002,
        "smaller regions are left alone [share of the image]; raise where small things flicker",
        low=0.0,
        high=1.0,
    )
    reach_m: float = setting(
        0.15, "a region grows this far beyond its seeds [m]; raise for slow things, lower where it leaks", low=0.0
    )
    max_step: float = setting(
        0.02, "a region grows over steps up to this share of the depth; lower where it leaks", low=0.0, high=1.0
    )
    min_cosine: float = setting(
        0.5, "a region grows where normals agree this well; raise where it leaks", low=-1.0, high=1.0
    )

    def __post_init__(self) -> None:
        check_ranges(self)


MIN_COLUMNS = 120
"""The search runs on the coarsest pyramid level with at least so many columns: a person takes ten and more there."""

MEMORIES = 6
"""Views that are remembered: evenly spread over the memory."""

SUPPORT_SIGMAS, SUPPORT_FLOOR_M = 3.0, 0.02
"""A surfel within so many standard deviations of a surface, and always within this, confirms it."""


@dataclass(frozen=True, slots=True)
class _EmptySpace:
    """How far a view saw: empty_until_m (H, W) float32, certain even one pixel aside; 0 where nothing is known."""

    T_camera_world: Float64
    camera: PinholeCamera
    empty_until_m: Float32


class MotionDetector(Stateful):
    """Finds what moves in the frames of a sequence, in front of what the map and the last views have seen."""

    STATE: ClassVar = {"_memory": deque[_EmptySpace], "_frames": int}
    MADE = frozenset({"config"})

    def __init__(self, config: DynamicsConfig | None = None) -> None:
        self.config = config or DynamicsConfig()
        self._memory: deque[_EmptySpace] = deque(maxlen=MEMORIES)
        self._frames = 0

    def find(self, pyramid: SurfacePyramid, view: ModelView, T_world_camera: Float64) -> Bool | None:
        """Return the pixels (H, W) that show something moving, or None where nothing does.

        Parameters
        ----------
        pyramid : the frame
        view : the map as seen from about `T_world_camera`
        T_world_camera : (4, 4), where the frame was taken
        """
        level = search_level(pyramid)
        if not self._memory or self._memory[-1].camera != level.camera:
            return None
        moving = find_moving(level, view, T_world_camera, list(self._memory), self.config)
        return None if moving is None else refine(moving, level, pyramid.levels[0])

    def remember(self, pyramid: SurfacePyramid, T_world_camera: Float64) -> None:
        """Keep in mind what a frame saw through; call it once for every frame that is fused."""
        level = search_level(pyramid)
        if self._memory and self._memory[-1].camera != level.camera:
            self.forget()
        interval = max(1, self.config.memory_frames // MEMORIES)
        if self.config.memory_frames > 0 and self._frames % interval == 0:
            self._memory.append(empty_space(level, T_world_camera, self.config.sigmas))
        self._frames += 1

    def forget(self) -> None:
        """Forget the earlier views: after a correction of the map they are somewhere else."""
        self._memory.clear()
        self._frames = 0


def search_level(pyramid: SurfacePyramid) -> SurfaceLevel:
    """Return the coarsest level that is fine enough to search."""
    fine = [level for level in pyramid.levels if level.camera.width >= MIN_COLUMNS]
    return fine[-1] if fine else pyramid.levels[0]


def empty_space(level: SurfaceLevel, T_world_camera: Float64, sigmas: float) -> _EmptySpace:
    """Return how far a view saw, less `sigmas` of its noise: the nearest over each pixel and its eight neighbours.

    A pixel without a normal, as on the edge of something, tells nothing, and neither do its neighbours.
    """
    surface = level.surface
    known = surface[..., 6] > 0
    far = np.where(known, surface[..., 2] - np.float32(sigmas) / np.where(known, surface[..., 6], np.float32(1)), 0)
    padded = np.pad(far.astype(np.float32), 1)
    across = np.minimum(np.minimum(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
    nearest = np.minimum(np.minimum(across[:-2], across[1:-1]), across[2:])
    return _EmptySpace(se3.inverse(T_world_camera), level.camera, nearest)


def find_moving(
    level: SurfaceLevel,
    view: ModelView,
    T_world_camera: Float64,
    memory: list[_EmptySpace],
    config: DynamicsConfig,
) -> Bool | None:
    """Return the moving pixels (H, W) of one level, or None where there are none."""
    camera, surface = level.camera, level.surface
    intrinsics, sigmas = intrinsics_array(camera), np.float32(config.sigmas)
    supported = _supported(level, view, T_world_camera)
    empty_until = np.stack([past.empty_until_m for past in memory])
    transforms = np.stack([(past.T_camera_world @ T_world_camera)[:3] for past in memory]).astype(np.float32)
    state, margin = np.empty(camera.shape, np.uint8), np.float32(config.margin_m)

    def classify(start: int, stop: int) -> None:
        kernels.classify_rows(
            start, stop, surface, supported, intrinsics, empty_until, transforms, margin, sigmas, state
        )  # fmt: skip

    run_ranges(camera.height, classify)
    moving, queue = np.zeros(camera.shape, np.bool_), np.empty(state.size, np.int32)
    marked = kernels.grow_regions(
        surface, state, np.float32(1 / camera.fx), np.float32(config.max_step), sigmas, np.float32(config.min_cosine),
        max(1, round(config.min_share * state.size)), np.float32(config.reach_m),
        queue, np.empty(camera.shape, np.float32), moving,
    )  # fmt: skip
    return moving if marked else None


def _supported(level: SurfaceLevel, view: ModelView, T_world_camera: Float64) -> UInt8:
    """Return where (H, W) a stable surfel confirms the surface; about four surfels are asked per pixel."""
    supported = np.zeros(level.camera.shape, np.uint8)
    factor = max(1, round(view.camera.width / level.camera.width))
    stride = max(1, factor * factor // 4)
    transform, intrinsics = se3.inverse(T_world_camera)[:3].astype(np.float32), intrinsics_array(level.camera)
    parameters = np.array([SUPPORT_SIGMAS, SUPPORT_FLOOR_M], np.float32)
    stable = np.float32(view.stable_confidence)
    positions_m, confidences = (as_kernel_input(side, np.float32) for side in (view.positions_m, view.confidences))

    def body(start: int, stop: int) -> None:
        kernels.mark_supported(
            start, stop, stride, positions_m, confidences, stable, transform, intrinsics,
            level.surface, parameters, supported,
        )  # fmt: skip

    run_ranges(-(-len(confidences) // stride), body)
    return supported


def refine(moving: Bool, level: SurfaceLevel, finest: SurfaceLevel, max_step: float = 0.05) -> Bool:
    """Carry a mask from `level` to the finest one; `max_step`: share of the depth within which neighbours belong."""
    factor = max(1, round(finest.camera.width / level.camera.width))
    mask = np.empty(finest.camera.shape, np.bool_)
    depth, coarse = as_kernel_input(finest.depth_m, np.float32), as_kernel_input(level.depth_m, np.float32)
    step = np.float32(max_step)

    def body(start: int, stop: int) -> None:
        kernels.refine_rows(start, stop, depth, moving, coarse, factor, step, mask)

    run_ranges(mask.shape[0], body)
    return mask


def leave_out(pyramid: SurfacePyramid, mask: Bool) -> SurfacePyramid:
    """Return the pyramid without the surfaces of the masked pixels (H, W), on every level, for another alignment."""
    levels = []
    for level in pyramid.levels:
        height, width = level.camera.shape
        if mask.shape != (height, width):  # the pyramid's next level: a pixel is masked when one of its four was
            blocks = mask[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
            mask = np.asarray(blocks.any(axis=(1, 3)))
        surface = level.surface.copy()
        surface[mask, 3:] = 0
        levels.append(replace(level, depth_m=np.where(mask, np.float32(0), level.depth_m), surface=surface))
    return SurfacePyramid(pyramid.frame, tuple(levels), pyramid.grey)


MIN_MASKED, MAX_MASKED = 0.005, 0.5
"""Fewer new pixels are not worth a second alignment; more may be a wrong pose, and leave too little to align."""


def track_static(
    track: Callable[[SurfacePyramid, ModelView, Float64], RegistrationResult],
    detector: MotionDetector,
    pyramid: SurfacePyramid,
    view: ModelView,
    T_world_camera: Float64,
    moved: Bool | None = None,
) -> tuple[RegistrationResult, Bool | None]:
    """Track a frame by what does not move: without what moved before, and again without what is found to move now.

    Parameters
    ----------
    track : a tracker's method; it takes the frame, the view and the predicted pose
    pyramid, view, T_world_camera : what `track` takes
    moved : (H, W), what moved in the last frame, or None

    Returns
    -------
    The result, and the pixels (H, W) that move, or None; without a pose nobody knows, and it is None.
    """
    left_out = np.zeros(view.camera.shape, np.bool_) if moved is None else widened(moved)
    result = track(pyramid if moved is None else leave_out(pyramid, left_out), view, T_world_camera)
    if result.status is Status.DEGENERATE and moved is None:
        return result, None  # a pose that slides along the scene shows still things moving
    T = result.T_target_source if result.status.has_pose else T_world_camera
    moving = detector.find(pyramid, view, T)
    if moving is not None and MIN_MASKED < float((moving & ~left_out).mean()) < MAX_MASKED:
        # From the prediction again: what moves may have taken the first answer with it.
        again = track(leave_out(pyramid, left_out | widened(moving)), view, T_world_camera)
        # What was lost is found again by no less than a full answer.
        if again.status is Status.CONVERGED or (again.status.has_pose and result.status.has_pose):
            result, moving = again, detector.find(pyramid, view, again.T_target_source)
    return result, moving if result.status.has_pose else None


def widened(mask: Bool, share: float = 0.025) -> Bool:
    """Return the mask (H, W) with a margin, a share of the image's width: things move between two frames."""
    margin = max(1, round(share * mask.shape[1]))
    for axis in (0, 1):
        sums = np.cumsum(np.pad(mask, [(margin + 1, margin) if a == axis else (0, 0) for a in (0, 1)]), axis, np.int32)
        size, window = mask.shape[axis], 2 * margin + 1
        mask = np.take(sums, range(window, window + size), axis) > np.take(sums, range(size), axis)
    return mask
