"""Dense RGB-D SLAM: one frame's walk through tracking, mapping and loop closure."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Float64, as_transform
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.loop_closure.joining import Join
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser, NoLoopCloser
from scanweld.mapping.mapper import SurfelMapper
from scanweld.mapping.pipelined import PipelinedMapper
from scanweld.parallel import limited_threads
from scanweld.refinement.config import RefinementConfig
from scanweld.refinement.refine import Refinement, refine_keyframes
from scanweld.registration.result import RegistrationResult, Status
from scanweld.slam.config import SlamConfig
from scanweld.slam.frame_log import FrameLog
from scanweld.slam.health import HealthConfig, TrackingHealth, is_near
from scanweld.slam.motion import POSED, UNSEEN, ConstantVelocity, trajectory_of
from scanweld.slam.rotation_aid import RotationAid, as_rotation
from scanweld.slam.stages import DeferringLoopCloser, DeferringMapper, LoopCloser, Mapper, Tracker
from scanweld.slam.submaps import Atlas, SubmapConfig, in_one_world, main_submap
from scanweld.state import Stateful
from scanweld.tracking.dynamics import DynamicsConfig, MotionDetector, leave_out, track_static
from scanweld.tracking.tracker import FrameToModelTracker
from scanweld.trajectory import FrameResult, FrameState, Trajectory


class Slam(Stateful):
    """Dense SLAM whose stages are given, each behind a Protocol; without `dynamics` the scene is taken to stand still.

    The world frame is that of the first frame unless `T_world_first` says otherwise. A camera that is lost for good
    begins a submap with a world of its own (:mod:`~.submaps`): `map` and `trajectory` are those of the main one, which
    has the most measured frames.
    """

    STATE: ClassVar = {
        "loop_closer": Stateful, "atlas": Stateful, "_results": Stateful, "_num_surfels": int, "_uncounted": int,
        "_last_posed": int, "_health": Stateful, "_dynamics": Stateful | None, "_moving": Bool | None,
        "_motion": Stateful, "_rotation": Stateful,
    }  # fmt: skip
    MADE = frozenset({"tracker", "surfaces", "_T_world_first", "_last_tracked"})

    def __init__(
        self,
        *,
        tracker: Tracker,
        mapper: Mapper,
        loop_closer: LoopCloser | None = None,
        surfaces: SurfaceConfig | None = None,
        health: HealthConfig | None = None,
        submaps: SubmapConfig | None = None,
        dynamics: DynamicsConfig | None = None,
        T_world_first: npt.ArrayLike | None = None,
    ) -> None:
        self.tracker = tracker
        self.loop_closer = loop_closer or NoLoopCloser()
        self.atlas = Atlas(mapper, self.loop_closer, submaps)
        self.surfaces = surfaces or SurfaceConfig()
        self._results = FrameLog()
        self._num_surfels = 0  # of the map at hand, as far as is known: see `_count`
        self._uncounted = 0  # the first frame whose map has not been counted
        self._last_posed = -1  # the frame that the camera was last tracked in
        self._health = TrackingHealth(health)
        self._dynamics = MotionDetector(dynamics) if dynamics else None
        self._moving: Bool | None = None  # pixels (H, W) that move in the frame at hand
        self._motion = ConstantVelocity()
        self._rotation = RotationAid()
        self._last_tracked: tuple[SurfacePyramid, int] | None = None  # and the number of that frame
        self._T_world_first = _near_pose(np.eye(4) if T_world_first is None else T_world_first, "T_world_first")

    @property
    def mapper(self) -> Mapper:
        """That of the submap that the camera is in."""
        return self.atlas.mapper

    @property
    def results(self) -> FrameLog:
        """One per frame; each is of the submap that the camera was in."""
        self._count()
        return self._results

    @property
    def map(self) -> Any:
        """The map of the main submap, finished; to be asked for anew after each frame, which may be fused into it."""
        return self.maps[main_submap(self._results)]

    @property
    def maps(self) -> dict[int, Any]:
        """The map of each submap, finished, by its number in the results."""
        self.finish()
        return {submap: mapper.map for submap, mapper in self.atlas.mappers.items()}

    @property
    def unjoined(self) -> tuple[int, ...]:
        """The submaps whose place in the world of the main one is not known."""
        self.finish()
        return tuple(submap for submap in self.atlas.mappers if submap != main_submap(self._results))

    @property
    def main_results(self) -> list[FrameResult]:
        """The results, finished, in the world of the main submap; frames of other submaps are LOST there."""
        self.finish()
        return in_one_world(self.results, main_submap(self._results))

    @property
    def trajectory(self) -> Trajectory:
        """One pose per processed frame, finished; LOST stretches are interpolated where tracking was regained."""
        return trajectory_of(self.main_results)

    @property
    def num_closures(self) -> int:
        """Number of loops closed so far."""
        return self.loop_closer.num_closures

    @property
    def num_joins(self) -> int:
        """Number of submaps joined with others so far."""
        return self.atlas.num_joins

    @property
    def keyframe_frames(self) -> list[int] | None:
        """The frame of each keyframe; None where the loop closer keeps none."""
        database = getattr(self.loop_closer, "database", None)
        return None if database is None else [keyframe.frame_index for keyframe in database.keyframes]

    @property
    def loops(self) -> list[tuple[int, int]]:
        """Pairs of keyframes that loops tie together."""
        return list(getattr(self.loop_closer, "loops", ()))

    def finish(self) -> None:
        """Do at once what stages put off so that no frame has to wait: for use after the last one.

        The properties above that say so do it first. Asked for between two frames they bring a loop about some frames
        earlier than it would have been closed; `results` and `mapper.map` are as they are.
        """
        while isinstance(self.loop_closer, DeferringLoopCloser):
            found = self.loop_closer.conclude()
            if found is None:
                break
            self._follow(found)
        for mapper in self.atlas.mappers.values():
            if isinstance(mapper, DeferringMapper):
                mapper.finish()

    def prepare(self, frame: Frame) -> SurfacePyramid:
        """Compute the surfaces of a frame as `process` does, with the caller's thread alone.

        They depend on the frame and the configuration only: another thread may prepare the next frame meanwhile.
        """
        with limited_threads(1):
            return build_pyramid(frame, self.surfaces)

    def process(
        self,
        frame: Frame,
        *,
        pyramid: SurfacePyramid | None = None,
        T_world_camera: Float64 | None = None,
        orientation: Float64 | None = None,
    ) -> FrameResult:
        """Take one frame through the system; with a given pose (4, 4) it is fused there and not tracked.

        `pyramid` is what :meth:`prepare` made of the frame; without it that is done here. `orientation` is
        R_reference_camera (3, 3) as a gyroscope has it; the reference is its own, but the same for all frames. The
        arrays of a frame must not change before the next call has returned: it may still be fused until then.

        Raises
        ------
        InvalidInputError
            When the timestamp does not increase, the given pose or orientation is no rigid transform, or the pyramid
            is that of another frame.
        """
        clock = _Stopwatch()
        self._check_time(frame.timestamp_s)
        if pyramid is not None and pyramid.frame is not frame:
            raise InvalidInputError(
                f"pyramid: it is that of the frame at {pyramid.frame.timestamp_s:.6f} s, expected the one at "
                f"{frame.timestamp_s:.6f} s that is processed; pass what prepare(frame) returned"
            )
        if T_world_camera is not None:
            T_world_camera = _near_pose(T_world_camera, "T_world_camera")
            if self.atlas.active != 0:
                self._enter(0)  # given poses are in the world of the run
        orientation = None if orientation is None else as_rotation(orientation, "orientation")
        pyramid = pyramid or build_pyramid(frame, self.surfaces)
        clock.lap("surfaces")
        predicted = self._motion.predict(frame.timestamp_s) if T_world_camera is None else T_world_camera
        turned = self._rotation.predict(frame.timestamp_s, predicted, orientation)
        predicted = turned if T_world_camera is None else T_world_camera
        view = self.mapper.view(predicted, frame.camera)
        clock.lap("view")
        moved, self._moving = self._moving, None
        if moved is not None and moved.shape != frame.camera.shape:
            moved = None
        if T_world_camera is not None:
            result = self._begun_anew(pyramid, self._placed(frame, T_world_camera))
        elif not self._has_map:
            result = self._first(pyramid, predicted)
        else:
            result = self._begun_anew(pyramid, self._tracked(pyramid, view, predicted, moved))
        clock.lap("track")
        self._count()
        if result.state is not FrameState.LOST:  # a lost frame is never fused
            self.mapper.fuse(pyramid, result.T_world_camera, keyframe=self.loop_closer.keyframe, moving=self._moving)
            if self._dynamics:
                self._dynamics.remember(pyramid, result.T_world_camera)
            partly = result.status == Status.DEGENERATE.value
            self._motion.observe(frame.timestamp_s, result.T_world_camera, partly=partly)
            surely = result.status == Status.CONVERGED.value
            self._rotation.observe(frame.timestamp_s, result.T_world_camera, surely=surely)
            clock.lap("fuse")
        elif self._has_map:
            result = replace(result, T_world_camera=self._rotation.turn(self._motion.miss(frame.timestamp_s)))
        result = self._keep(replace(result, stage_ms=clock.laps_ms))
        if result.state is not FrameState.LOST and T_world_camera is None:  # what was given is not corrected
            self._close_loops(pyramid if self._moving is None else leave_out(pyramid, self._moving), result)
            clock.lap("loop")
        return self._results[-1]

    def skip(self, timestamp_s: float, reason: str) -> FrameResult:
        """Note a frame that could not be read; its pose is the motion model's."""
        self._check_time(timestamp_s)
        return self._keep(
            FrameResult(
                index=len(self._results),
                timestamp_s=timestamp_s,
                state=FrameState.UNREADABLE,
                T_world_camera=self._motion.miss(timestamp_s) if self._has_map else self._T_world_first,
                note=reason,
            )
        )

    def drop(self, timestamp_s: float, reason: str) -> FrameResult:
        """Note a frame that is not looked at, to keep pace; to the motion model it is none at all."""
        self._check_time(timestamp_s)
        return self._keep(
            FrameResult(
                index=len(self._results),
                timestamp_s=timestamp_s,
                state=FrameState.DROPPED,
                T_world_camera=self._motion.predict(timestamp_s) if self._has_map else self._T_world_first,
                note=reason,
            )
        )

    def refine(
        self, camera: PinholeCamera, config: RefinementConfig | None = None, *, apply: bool = True
    ) -> Refinement:
        """Adjust the keyframes of the main submap together; map and trajectory move with them where that fits better.

        For use after the last frame. A calibration changes nothing here: the map is then to be made again with the
        camera and depth of the result, as `run_sequence(..., calibrate=True)` does.

        Parameters
        ----------
        camera : of the frames
        config : what is estimated, and how; by default poses alone
        apply : move map and trajectory; without it the answer is only returned
        """
        self.finish()
        database = getattr(self.loop_closer, "database", None)  # other loop closers may keep no keyframes
        main = main_submap(self._results)
        everything = () if database is None else database.keyframes
        keyframes = [keyframe for keyframe in everything if self._results.submap(keyframe.frame_index) == main]
        refined = refine_keyframes(keyframes, camera, config)
        if apply and refined.better and not refined.recalibrated and database is not None:
            poses = [keyframe.T_world_camera for keyframe in everything]
            for index, pose in zip(refined.keyframe_ids.tolist(), refined.T_world_camera, strict=True):
                poses[index] = pose
            database.move(poses)
            self.atlas.mappers[main].apply(refined.correction)
            mine = self._results.frames_in(main)
            times_s = np.array([self._results[index].timestamp_s for index in mine])
            self._results.move(mine, refined.corrections_at(times_s))
        return refined

    def _tracked(self, pyramid: SurfacePyramid, view: ModelView, predicted: Float64, moved: Bool | None) -> FrameResult:
        """Align a frame with the map where it is expected; a lost camera is looked for among the known places, too.

        `moved` : pixels (H, W) that moved in the frame before, or None.
        """
        frame, lost_for = pyramid.frame, self._lost_for()
        if lost_for > _SHORT_LOSS:
            result = self._found_again(pyramid, predicted)
            if result.state is not FrameState.LOST:
                return result
        if self._dynamics:
            aligned, moving = track_static(self.tracker.track, self._dynamics, pyramid, view, predicted, moved)
        else:
            aligned, moving = self.tracker.track(pyramid, view, predicted), None
        by_gyroscope = not np.array_equal(self._motion.predict(frame.timestamp_s), predicted)
        if aligned.status is Status.DEGENERATE:
            rotation = predicted[:3, :3] if by_gyroscope else None
            aligned = self._motion.weigh(frame.timestamp_s, aligned, rotation)
        if lost_for > _SHORT_LOSS and not (aligned.status.success and is_near(aligned.T_target_source, predicted)):
            return result  # the camera may be anywhere: what fits far from the guess fits by chance
        result = self._judged(frame, predicted, aligned)
        if result.state is not FrameState.LOST:
            self._moving = moving
        if result.state is FrameState.LOST and 0 < lost_for <= _SHORT_LOSS:
            found = self._found_again(pyramid, predicted)
            result = found if found.state is not FrameState.LOST else result
        if result.state is FrameState.LOST and lost_for == 0 and by_gyroscope:
            T_model = self._motion.predict(frame.timestamp_s)
            return self._tracked(pyramid, self.mapper.view(T_model, frame.camera), T_model, moved)
        return result

    def _lost_for(self) -> int:
        """Number of frames since the camera was last tracked, without those that were dropped."""
        return sum(result.state is not FrameState.DROPPED for result in self._results[self._last_posed + 1 :])

    def _found_again(self, pyramid: SurfacePyramid, predicted: Float64) -> FrameResult:
        """Look for a lost camera among the places that are known, and align it with the map there."""
        frame = pyramid.frame
        submap, found = self.atlas.look_for(pyramid)
        start = found.T_target_source
        if found.status.success:
            aligned = self.tracker.track(pyramid, self.atlas.mappers[submap].view(start, frame.camera), start)
        if not (found.status.success and aligned.status.has_pose):
            return self._judged(frame, predicted, aligned if found.status.success else found)
        self._health = TrackingHealth(self._health.config)  # what was usual was so elsewhere
        if submap != self.atlas.active:
            self._enter(submap)
        elif self._motion.carried(frame.timestamp_s, start):
            self._motion.forget()
        return self._judged(frame, start, aligned)

    def _begun_anew(self, pyramid: SurfacePyramid, result: FrameResult) -> FrameResult:
        """Begin a submap where a lost camera was looked for in vain long enough."""
        if not self.atlas.gives_up(result, pyramid):
            return result
        T_world_camera = self.atlas.begin(pyramid, result.index)
        if T_world_camera is None:
            return result
        self._enter(self.atlas.active)
        note = f"no known place for {self.atlas.config.patience_s:g} s: submap {self.atlas.active} begins here"
        return replace(self._placed(pyramid.frame, T_world_camera), note=note)

    def _enter(self, submap: int) -> None:
        """Go on in another submap: what was usual, and how the camera moved, was in another world."""
        self._num_surfels = 0
        self.atlas.enter(submap)
        self._health, self._motion = TrackingHealth(self._health.config), ConstantVelocity()
        self._rotation.forget()
        if self._dynamics:
            self._dynamics.forget()

    @property
    def _has_map(self) -> bool:
        return self._num_surfels > 0 or len(self.mapper.map) > 0

    def _count(self) -> None:
        """Note how large the map is after the last frame that was fused; a mapper that is still at it is waited for."""
        for index in range(self._uncounted, len(self._results)):
            surfels = len(self.atlas.mappers[self._results.submap(index)].map)
            self._results.set_num_surfels(index, surfels)
        self._uncounted, self._num_surfels = len(self._results), len(self.mapper.map)

    def _close_loops(self, pyramid: SurfacePyramid, result: FrameResult) -> None:
        """Let the loop closer look at a tracked frame, and do what follows."""
        self._last_tracked = pyramid, result.index
        found = self.loop_closer.process(pyramid, result)
        if found is not None:
            self._follow(found)

    def _follow(self, found: MapCorrection | Join) -> None:
        if isinstance(found, Join):
            self._join(found)
        else:
            self.mapper.apply(found)
            self._correct(found)

    def _join(self, join: Join) -> None:
        """Make one of two submaps, unless the last frame does not fit the map of the other one where it should be."""
        if self._last_tracked is None:
            return
        pyramid, index = self._last_tracked
        T_world_camera = self._results[index].T_world_camera
        other, T_other_here = self.atlas.other(join)
        start = T_other_here @ T_world_camera
        view = self.atlas.mappers[other].view(start, pyramid.frame.camera)
        aligned = self.tracker.track(pyramid, view, start)
        if not (aligned.status.success and is_near(aligned.T_target_source, start)):
            return
        # The whole map knows better than a pair of keyframes how the two worlds lie to each other.
        T_other_here = aligned.T_target_source @ se3.inverse(T_world_camera)
        T = T_other_here if other == join.kept else se3.inverse(T_other_here)
        self._correct(self.atlas.join(replace(join, T_kept_joined=T)))
        self._results.rename(join.joined, join.kept)

    def _correct(self, correction: MapCorrection) -> None:
        """Move the frames so far and the camera with their keyframes, as the map was."""
        if self._dynamics:
            self._dynamics.forget()
        self._results.follow(correction)
        now = next(iter(correction.T_new_old[correction.keyframe_ids == self.loop_closer.keyframe]), None)
        if now is not None:
            self._motion.move(now)
            self._rotation.move(now)

    def _first(self, pyramid: SurfacePyramid, predicted: Float64) -> FrameResult:
        """Start the map, unless there is nothing to start it with."""
        seen = int(np.count_nonzero(pyramid.levels[0].surface[..., 6]))
        share = seen / pyramid.levels[0].depth_m.size
        # Frames at given poses may have left the map empty: the world is theirs then.
        start = self._placed(pyramid.frame, predicted if self._last_posed >= 0 else self._T_world_first)
        if share < MIN_FIRST_SHARE:
            return replace(
                start, state=FrameState.LOST, note=f"no map yet, and only {share:.1%} of the depth is usable"
            )
        return start

    def _placed(self, frame: Frame, T_world_camera: Float64) -> FrameResult:
        return FrameResult(
            index=len(self._results),
            timestamp_s=frame.timestamp_s,
            state=FrameState.TRACKING,
            T_world_camera=T_world_camera,
        )

    def _judged(self, frame: Frame, predicted: Float64, aligned: RegistrationResult) -> FrameResult:
        """Turn an alignment into a state: no answer, or none to be believed, means LOST and the motion model's pose."""
        doubt = self._health.doubt(aligned, predicted) if aligned.status.has_pose else ""
        lost = bool(doubt) or not aligned.status.has_pose
        if not lost:
            self._health.observe(aligned, predicted)
        looked_at = (r.state for r in reversed(self._results) if r.state not in UNSEEN)
        was_lost = next(looked_at, None) is FrameState.LOST
        state = FrameState.LOST if lost else FrameState.RELOCALISED if was_lost else FrameState.TRACKING
        return FrameResult(
            index=len(self._results),
            timestamp_s=frame.timestamp_s,
            state=state,
            status=aligned.status.value,
            T_world_camera=predicted if lost else aligned.T_target_source,
            rmse_m=aligned.rmse_m,
            loss=aligned.loss,
            num_inliers=aligned.num_inliers,
            overlap=aligned.overlap,
            note=doubt or aligned.note,
        )

    def _check_time(self, timestamp_s: float) -> None:
        if not math.isfinite(timestamp_s):
            raise InvalidInputError(f"frame: timestamp {timestamp_s} s is not a time")
        if self._results and timestamp_s <= self._results[-1].timestamp_s:
            raise InvalidInputError(
                f"frame: timestamp {timestamp_s:.6f} s does not follow {self._results[-1].timestamp_s:.6f} s"
            )

    def _keep(self, result: FrameResult) -> FrameResult:
        result = replace(result, submap=self.atlas.active, num_surfels=self._num_surfels)
        self._last_posed = len(self._results) if result.state in POSED else self._last_posed
        self._results.append(result, self.loop_closer.keyframe)
        return result


_SHORT_LOSS = 2
"""Frames after which a lost camera may be anywhere: the motion model is asked no longer, the known places are."""

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
        "mapper": PipelinedMapper(SurfelMapper(config.fusion, config.map)),
        "loop_closer": KeyframeLoopCloser(config.loop_closing) if config.loop_closer == "keyframes" else NoLoopCloser(),
        "surfaces": config.surfaces,
        "health": config.health,
        "submaps": config.submaps,
        "dynamics": config.dynamics,
    }
    unknown = set(stages) - {*parts, "T_world_first"}
    if unknown:
        raise InvalidInputError(f"build_slam: unknown stage {sorted(unknown)[0]!r}; stages are {sorted(parts)}")
    return Slam(**{**parts, **stages})
