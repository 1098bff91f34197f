"""Keyframes: the frames that are remembered, small enough to keep thousands of them, and when a frame becomes one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Float64, UInt8
from scanweld.config import check_ranges, section, setting
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfaceConfig, SurfaceLevel, SurfacePyramid, build_pyramid, half_size
from scanweld.geometry.frame import Frame
from scanweld.loop_closure.ferns import FernCode, FernConfig, Ferns
from scanweld.tracking.image_features import FrameFeatures, ImageFeatureConfig, detect

_STEPS = 65535  # of the stored depth


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeConfig:
    """What is kept of a keyframe, and when a frame becomes one."""

    max_width_px: int = setting(
        320, "images are halved until they are no wider [px]; raise for accuracy, costs memory and time", low=80
    )
    features: ImageFeatureConfig = section(lambda: ImageFeatureConfig(count=500), "image features of a keyframe")
    ferns: FernConfig = section(FernConfig, "codes of whole frames")
    surfaces: SurfaceConfig = section(SurfaceConfig, "how the depth of a keyframe becomes surfaces")
    min_usable: float = setting(
        0.1, "frames with surfaces on a smaller share of the image are no keyframes; lower for sparse depth",
        low=0.001, high=1.0,
    )  # fmt: skip
    max_similarity: float = setting(
        0.6, "share of ferns below which a frame is unlike all keyframes, so becomes one; raise for more keyframes",
        low=0.0, high=1.0,
    )  # fmt: skip
    max_shift: float = setting(
        0.15, "motion since the last keyframe, in median depths, that makes a new one; lower for more keyframes",
        low=0.01,
    )  # fmt: skip
    max_turn_rad: float = setting(
        0.26, "turn since the last keyframe [rad] that makes a new one; lower for more keyframes", low=0.01
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class Sighting:
    """What place recognition and verification need to know of a frame.

    Attributes
    ----------
    pyramid : the frame at the size of a keyframe, its colour reduced to grey, with its surfaces
    features : of the reduced image
    code : of the frame
    """

    pyramid: SurfacePyramid
    features: FrameFeatures
    code: FernCode

    @property
    def usable(self) -> float:
        """Share of the image that has surfaces."""
        return usable_share(self.pyramid)


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A remembered frame; immutable, but for :func:`dataclasses.replace` when the map moves.

    About 270 kB (267 400 bytes): at 320x240 pixels 154 kB of depth and 77 kB of grey values, 36 kB of 500 features,
    1 kB of code. The database keeps another 9 kB of each.

    Attributes
    ----------
    index : in its database
    frame_index : in the sequence
    timestamp_s : time [s]
    T_world_camera : (4, 4), where the camera is thought to have been
    camera : intrinsics of the stored images
    depth_steps : (H, W) uint16, depth in units of `depth_step_m`, 0 invalid
    depth_step_m : the largest depth is 65535 of these [m]
    grey : (H, W) uint8, or None for a frame without colour
    features : places in the camera's frame, which do not depend on `T_world_camera`
    code : of the frame
    """

    index: int
    frame_index: int
    timestamp_s: float
    T_world_camera: Float64
    camera: PinholeCamera
    depth_steps: Array
    depth_step_m: float
    grey: UInt8 | None
    features: FrameFeatures
    code: FernCode

    @property
    def num_bytes(self) -> int:
        """Memory of the arrays [bytes]."""
        f = self.features
        arrays = (self.depth_steps, f.pixels, f.points_m, f.sigma_m, f.descriptors, self.code.depth, self.code.grey)
        return sum(array.nbytes for array in arrays) + (0 if self.grey is None else self.grey.nbytes)

    def frame(self) -> Frame:
        """Return the stored images as a frame."""
        depth = self.depth_steps.astype(np.float32) * np.float32(self.depth_step_m)
        color = None if self.grey is None else _as_color(self.grey)
        return Frame(self.timestamp_s, depth, color, self.camera)

    def pyramid(self, surfaces: SurfaceConfig | None = None) -> SurfacePyramid:
        """Return the stored images with their surfaces."""
        return build_pyramid(self.frame(), surfaces)

    def sighting(self, surfaces: SurfaceConfig | None = None) -> Sighting:
        """Return what place recognition needs to know of the stored frame."""
        return Sighting(self.pyramid(surfaces), self.features, self.code)


def sighting_of(pyramid: SurfacePyramid, ferns: Ferns, config: KeyframeConfig | None = None) -> Sighting:
    """Reduce a frame, find its features and encode it."""
    config = config or KeyframeConfig()
    reduced = reduced_pyramid(pyramid, config)
    return Sighting(reduced, detect(reduced, config.features), ferns.encode(reduced))


def keyframe_of(sighting: Sighting, T_world_camera: Float64, *, index: int, frame_index: int) -> Keyframe:
    """Keep what is needed of a frame that was seen from `T_world_camera`."""
    frame, f = sighting.pyramid.frame, sighting.features
    step = max(float(frame.depth_m.max()), 1e-3) / _STEPS
    return Keyframe(
        index=index,
        frame_index=frame_index,
        timestamp_s=frame.timestamp_s,
        T_world_camera=np.array(T_world_camera, np.float64),
        camera=frame.camera,
        depth_steps=np.rint(frame.depth_m / np.float32(step)).astype(np.uint16),
        depth_step_m=step,
        grey=None if frame.color is None else np.ascontiguousarray(frame.color[..., 0]),
        features=f,
        code=sighting.code,
    )


def reduced_pyramid(pyramid: SurfacePyramid, config: KeyframeConfig) -> SurfacePyramid:
    """Return the frame at the size of a keyframe, in grey; surfaces that are there already are taken over."""
    frame = pyramid.frame
    for count, level in enumerate(pyramid.levels):
        if level.camera.width <= config.max_width_px:
            return SurfacePyramid(_reduced(frame, level, count), pyramid.levels[count:])
    count, level = len(pyramid.levels) - 1, pyramid.levels[-1]
    while level.camera.width > config.max_width_px:
        depth, camera = half_size(level.depth_m, level.camera)
        count, level = count + 1, SurfaceLevel(camera, depth, level.surface)
    return build_pyramid(_reduced(frame, level, count), config.surfaces)


def keyframe_reason(
    pyramid: SurfacePyramid, T_world_camera: Float64, last: Keyframe | None, similarity: float, config: KeyframeConfig
) -> str:
    """Say why a tracked frame becomes a keyframe; "" when it does not.

    Parameters
    ----------
    last : the newest keyframe, None when there is none
    similarity : of the frame to the keyframe that it is most similar to
    """
    if usable_share(pyramid) < config.min_usable:
        return ""
    if last is None:
        return "the first"
    if similarity < config.max_similarity:
        return f"unlike all keyframes: {similarity:.0%} of the ferns agree with the nearest"
    motion = se3.inverse(last.T_world_camera) @ T_world_camera
    shift, turn = (float(size) for size in motion_size(pyramid, motion))
    if shift > config.max_shift:
        return f"moved by {shift:.0%} of the depth"
    return f"turned by {np.rad2deg(turn):.0f} degrees" if turn > config.max_turn_rad else ""


def motion_size(pyramid: SurfacePyramid, motion: Float64) -> tuple[Float64, Float64]:
    """Return the shift of motions (..., 4, 4), in median depths of a frame, and their turn [rad]."""
    depth = pyramid.levels[0].depth_m[::4, ::4]
    median = float(np.median(depth[depth > 0])) if depth.any() else np.inf
    return np.linalg.norm(motion[..., :3, 3], axis=-1) / median, se3.rotation_angle_rad(motion)


def usable_share(pyramid: SurfacePyramid) -> float:
    """Return the share of the image that has surfaces."""
    level = pyramid.levels[0]
    return float(np.count_nonzero(level.surface[::4, ::4, 6]) / level.depth_m[::4, ::4].size)


def _reduced(frame: Frame, level: SurfaceLevel, halvings: int) -> Frame:
    """Return the grey frame of a level whose camera was halved so often; odd last rows and columns are dropped."""
    import cv2

    if frame.color is None:
        return Frame(frame.timestamp_s, level.depth_m, None, level.camera)
    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    height, width = level.camera.shape
    if halvings:
        whole = grey[: height << halvings, : width << halvings]
        grey = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return Frame(frame.timestamp_s, level.depth_m, _as_color(grey), level.camera)


def _as_color(grey: UInt8) -> UInt8:
    import cv2

    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB))
