"""Dense RGB-D SLAM: one frame's walk through tracking, mapping and loop closure."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_transform
from scanweld.config import check_ranges, section, setting
from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.loop_closure.loop_closer import NoLoopCloser
from scanweld.mapping.fusion import FusionConfig
from scanweld.mapping.mapper import SurfelMapper
from scanweld.registration.result import RegistrationResult
from scanweld.slam.motion import POSED, ConstantVelocity, trajectory_of
from scanweld.tracking.tracker import FrameToModelTracker, TrackingConfig
from scanweld.trajectory import FrameResult, FrameState, Trajectory


class Tracker(Protocol):
    """Finds the camera's pose against the map."""

    def track(self, pyramid: SurfacePyramid, view: ModelView, T_world_camera: Float64) -> RegistrationResult:
        """Align a frame with the map as seen from the predicted pose; T_target_source is T_world_camera."""
        ...


class Mapper(Protocol):
    """Keeps the map."""

    @property
    def map(self) -> Any:
        """The map; anything with a length."""
        ...

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as seen from a pose."""
        ...

    def fuse(self, pyramid: SurfacePyramid, T_world_camera: Float64) -> object:
        """Merge a frame into the map."""
        ...

    def apply(self, correction: MapCorrection) -> None:
        """Move the map with its keyframes."""
        ...


class LoopCloser(Protocol):
    """Recognises places and corrects the map."""

    def process(self, pyramid: SurfacePyramid, result: FrameResult) -> MapCorrection | None:
        """Look at a tracked frame; return a correction when a loop was closed."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamConfig:
    """Everything that a run depends on besides its input."""

    seed: int = setting(0, "seed of whatever is random", low=0)
    surfaces: SurfaceConfig = section(SurfaceConfig, "how depth becomes surfaces")
    tracking: TrackingConfig = section(TrackingConfig, "how a frame is aligned with the map")
    fusion: FusionConfig = section(FusionConfig, "how a frame is merged into the map")

    def __post_init__(self) -> None:
        check_ranges(self)


class Slam:
    """Dense SLAM whose stages are given, each behind a Protocol.

    The world frame is that of the first frame unless `T_world_first` says otherwise.
    """

    def __init__(
        self,
        *,
        tracker: Tracker,
        mapper: Mapper,
        loop_closer: LoopCloser | None = None,
        surfaces: SurfaceConfig | None = None,
        T_world_first: npt.ArrayLike | None = None,
    ) -> None:
        self.tracker = tracker
        self.mapper = mapper
        self.loop_closer = loop_closer or NoLoopCloser()
        self.surfaces = surfaces or SurfaceConfig()
        self.results: list[FrameResult] = []
        self._motion = ConstantVelocity()
        self._T_world_first = _near_pose(np.eye(4) if T_world_first is None else T_world_first, "T_world_first")

    @property
    def map(self) -> Any:
        """The mapper's map."""
        return self.mapper.map

    @property
    def trajectory(self) -> Trajectory:
        """One pose per processed frame, LOST stretches interpolated where tracking was regained."""
        return trajectory_of(self.results)

    def process(self, frame: Frame, *, T_world_camera: Float64 | None = None) -> FrameResult:
        """Take one frame through the system; with a given pose (4, 4) it is fused there and not tracked.

        Raises
        ------
        InvalidInputError
            When the timestamp does not increase, or the given pose is no rigid transform.
        """
        clock = _Stopwatch()
        self._check_time(frame.timestamp_s)
        if T_world_camera is not None:
            T_world_camera = _near_pose(T_world_camera, "T_world_camera")
        pyramid = build_pyramid(frame, self.surfaces)
        clock.lap("surfaces")
        predicted = self._motion.predict(frame.timestamp_s) if T_world_camera is None else T_world_camera
        view = self.mapper.view(predicted, frame.camera)
        clock.lap("view")
        if T_world_camera is not None:
            result = self._placed(frame, T_world_camera)
        elif len(self.mapper.map) == 0:
            result = self._first(pyramid, predicted)
        else:
            result = self._judged(frame, predicted, self.tracker.track(pyramid, view, predicted))
        clock.lap("track")
        if result.state is not FrameState.LOST:  # a lost frame is never fused
            self.mapper.fuse(pyramid, result.T_world_camera)
            self._motion.observe(frame.timestamp_s, result.T_world_camera)
            clock.lap("fuse")
            correction = self.loop_closer.process(pyramid, result)
            if correction is not None:
                self.mapper.apply(correction)
            clock.lap("loop")
        return self._keep(replace(result, num_surfels=len(self.mapper.map), stage_ms=clock.laps_ms))

    def skip(self, timestamp_s: float, reason: str) -> FrameResult:
        """Note a frame that could not be read; its pose is the motion model's."""
        self._check_time(timestamp_s)
        return self._keep(
            FrameResult(
                index=len(self.results),
                timestamp_s=timestamp_s,
                state=FrameState.UNREADABLE,
                T_world_camera=self._motion.miss(timestamp_s) if len(self.mapper.map) else self._T_world_first,
                num_surfels=len(self.mapper.map),
                note=reason,
            )
        )

    def _first(self, pyramid: SurfacePyramid, predicted: Float64) -> FrameResult:
        """Start the map, unless there is nothing to start it with."""
        seen = int(np.count_nonzero(pyramid.levels[0].surface[..., 6]))
        share = seen / pyramid.levels[0].depth_m.size
        # Frames at given poses may have left the map empty: the world is theirs then.
        begun = any(result.state in POSED for result in self.results)
        start = self._placed(pyramid.frame, predicted if begun else self._T_world_first)
        if share < MIN_FIRST_SHARE:
            return replace(
                start, state=FrameState.LOST, note=f"no map yet, and only {share:.1%} of the depth is usable"
            )
        return start

    def _placed(self, frame: Frame, T_world_camera: Float64) -> FrameResult:
        return FrameResult(
            index=len(self.results),
            timestamp_s=frame.timestamp_s,
            state=FrameState.TRACKING,
            T_world_camera=T_world_camera,
        )

    def _judged(self, frame: Frame, predicted: Float64, aligned: RegistrationResult) -> FrameResult:
        """Turn an alignment into a state: no answer means LOST, and the motion model's pose."""
        lost = not aligned.status.has_pose
        looked_at = (r.state for r in reversed(self.results) if r.state is not FrameState.UNREADABLE)
        was_lost = next(looked_at, None) is FrameState.LOST
        state = FrameState.LOST if lost else FrameState.RELOCALISED if was_lost else FrameState.TRACKING
        return FrameResult(
            index=len(self.results),
            timestamp_s=frame.timestamp_s,
            state=state,
            status=aligned.status.value,
            T_world_camera=self._motion.miss(frame.timestamp_s) if lost else aligned.T_target_source,
            rmse_m=aligned.rmse_m,
            loss=aligned.loss,
            num_inliers=aligned.num_inliers,
            overlap=aligned.overlap,
            note=aligned.note,
        )

    def _check_time(self, timestamp_s: float) -> None:
        if not math.isfinite(timestamp_s):
            raise InvalidInputError(f"frame: timestamp {timestamp_s} s is not a time")
        if self.results and timestamp_s <= self.results[-1].timestamp_s:
            raise InvalidInputError(
                f"frame: timestamp {timestamp_s:.6f} s does not follow {self.results[-1].timestamp_s:.6f} s"
            )

    def _keep(self, result: FrameResult) -> FrameResult:
        self.results.append(result)
        return result


FARTHEST_M = 1e4
"""Largest coordinate of a given pose [m]: maps are float32, which has steps of 1 mm there."""


def _near_pose(transform: npt.ArrayLike, name: str) -> Float64:
    T = as_transform(transform, name)
    if np.abs(T[:3, 3]).max() > FARTHEST_M:
        raise InvalidInputError(
            f"{name}: {np.abs(T[:3, 3]).max():.0f} m from the origin, expected at most {FARTHEST_M:.0f} m, where a "
            "float32 map begins to lose millimetres; subtract an offset from all poses"
        )
    return T


MIN_FIRST_SHARE = 0.02
"""Share of the first image that must have surfaces for a map to start."""


class _Stopwatch:
    """Wall time between laps [ms]."""

    def __init__(self) -> None:
        self.laps_ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps_ms[name] = (now - self._last) * 1e3
        self._last = now


def build_slam(camera: PinholeCamera, config: SlamConfig | None = None, **stages: Any) -> Slam:
    """Assemble the default system for a camera; `stages` (tracker, mapper, loop_closer) replace its parts.

    Names in a configuration become classes here and nowhere else.
    """
    config = config or SlamConfig()
    parts: dict[str, Any] = {
        "tracker": FrameToModelTracker(config.tracking),
        "mapper": SurfelMapper(config.fusion),
        "loop_closer": NoLoopCloser(),
        "surfaces": config.surfaces,
    }
    unknown = set(stages) - {*parts, "T_world_first"}
    if unknown:
        raise InvalidInputError(f"build_slam: unknown stage {sorted(unknown)[0]!r}; stages are {sorted(parts)}")
    return Slam(**{**parts, **stages})
