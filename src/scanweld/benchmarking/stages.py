"""Where the time of a frame goes: every stage of the SLAM loop by itself, one after the other."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from scanweld.benchmarking.machine import Machine
from scanweld.datasets.base import RgbdSequence
from scanweld.errors import DatasetError, UnreadableFrameError
from scanweld.geometry.depth import SurfacePyramid, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.geometry.views import ModelView
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser
from scanweld.mapping.mapper import SurfelMapper
from scanweld.slam.config import SlamConfig
from scanweld.slam.system import build_slam
from scanweld.tracking.tracker import FrameToModelTracker

STAGES = ("decode", "surfaces", "view", "track", "fuse", "loop", "other")
"""In the order of a frame's walk; other: motion model, moving things, health."""

VIEWED_BYTES, FUSED_BYTES = 32, 48
"""Of a surfel: a pixel of the model image; and position to colour, radius, confidence and when it was last seen."""

SETTLING_FRAMES = 5
"""Frames at the start that are not counted: caches fill, the map begins."""


@dataclass(frozen=True, slots=True)
class StageCost:
    """What a stage takes of a frame: medians over the frames.

    Attributes
    ----------
    name : one of STAGES
    wall_ms, cpu_ms : time that passes, and that all threads together compute [ms]
    bytes_moved : least traffic, every array that the stage reads or writes counted once; 0 where there is no estimate
    over_floor : wall time over that of copying as many bytes; None where there is no estimate
    """

    name: str
    wall_ms: float
    cpu_ms: float
    bytes_moved: float
    over_floor: float | None


@dataclass(slots=True)
class _Clock:
    """Seconds and bytes of the stages of the frame at hand."""

    wall_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    cpu_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    bytes_moved: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def clear(self) -> None:
        for kept in (self.wall_s, self.cpu_s, self.bytes_moved):
            kept.clear()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.wall_s[name] += time.perf_counter() - wall
        self.cpu_s[name] += time.process_time() - cpu


class _TimedTracker(FrameToModelTracker):
    def __init__(self, clock: _Clock, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._clock = clock

    def track(self, pyramid: SurfacePyramid, view: ModelView, *arguments: Any, **options: Any) -> Any:
        with self._clock.stage("track"):
            result = super().track(pyramid, view, *arguments, **options)
        surfaces = sum(level.surface.nbytes for level in pyramid.levels)
        self._clock.bytes_moved["track"] += surfaces + VIEWED_BYTES * len(view) + _size(pyramid.grey)
        return result


class _TimedMapper(SurfelMapper):
    def __init__(self, clock: _Clock, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._clock = clock
        self._seen = 0

    def view(self, *arguments: Any, **options: Any) -> ModelView:
        with self._clock.stage("view"):
            seen = super().view(*arguments, **options)
        self._seen = len(seen)
        if seen is not self.last_seen:  # what fusion saw costs nothing more
            self._clock.bytes_moved["view"] += self._seen * (FUSED_BYTES + VIEWED_BYTES) + seen.index_map.nbytes
        return seen

    def fuse(self, pyramid: SurfacePyramid, *arguments: Any, **options: Any) -> Any:
        before = len(self.map)
        with self._clock.stage("fuse"):
            counts = super().fuse(pyramid, *arguments, **options)
        level = pyramid.levels[0]
        frame = level.surface.nbytes + _size(pyramid.frame.color) + 4 * level.depth_m.size  # and the index map
        # What is seen is read and written back, and shown in the model image; what is new is written.
        new = max(0, len(self.map) - before)
        self._clock.bytes_moved["fuse"] += frame + FUSED_BYTES * (2 * self._seen + new) + VIEWED_BYTES * self._seen
        return counts


class _TimedLoopCloser(KeyframeLoopCloser):
    def __init__(self, clock: _Clock, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._clock = clock

    def process(self, pyramid: SurfacePyramid, *arguments: Any, **options: Any) -> Any:
        with self._clock.stage("loop"):
            return super().process(pyramid, *arguments, **options)


def profile_stages(
    sequence: RgbdSequence,
    machine: Machine,
    config: SlamConfig | None = None,
    *,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> list[StageCost]:
    """Run SLAM over a sequence, one stage after the other, and return what each stage takes, in order.

    In a run, decoding and surfaces of the next frame overlap with the rest: this is what they cost, not what a frame
    takes there.

    Raises
    ------
    DatasetError
        When fewer frames can be decoded than are needed to settle.
    """
    config = config or SlamConfig()
    clock = _Clock()
    stages: dict[str, Any] = {
        "tracker": _TimedTracker(clock, config.tracking), "mapper": _TimedMapper(clock, config.fusion),
    }  # fmt: skip
    if config.loop_closer == "keyframes":
        stages["loop_closer"] = _TimedLoopCloser(clock, config.loop_closing)
    slam = build_slam(sequence.camera, config, **stages)
    frames: list[_Clock] = []
    for index in range(len(sequence)):
        clock.clear()
        try:
            with clock.stage("decode"):
                frame = sequence.read(index)
        except UnreadableFrameError:
            continue
        with clock.stage("surfaces"):
            pyramid = build_pyramid(frame, slam.surfaces)
        _count_preparation(clock, frame, pyramid)
        with clock.stage("other"):
            slam.process(frame, pyramid=pyramid)
        for seconds in (clock.wall_s, clock.cpu_s):  # the stages within are no part of it
            seconds["other"] -= sum(seconds.get(name, 0.0) for name in ("view", "track", "fuse", "loop"))
        frames.append(_Clock(dict(clock.wall_s), dict(clock.cpu_s), dict(clock.bytes_moved)))
        progress(index + 1, len(sequence))
    counted = frames[SETTLING_FRAMES:]
    if not counted:
        raise DatasetError(
            f"{sequence.name}: {len(frames)} of {len(sequence)} frames can be decoded, a profile needs more than "
            f"{SETTLING_FRAMES}"
        )
    return [_cost(name, counted, machine) for name in STAGES]


def _count_preparation(clock: _Clock, frame: Frame, pyramid: SurfacePyramid) -> None:
    """Count the traffic of decoding and of the surfaces."""
    color = _size(frame.color)
    clock.bytes_moved["decode"] = frame.depth_m.nbytes + color
    levels = sum(level.surface.nbytes + level.depth_m.nbytes for level in pyramid.levels)
    clock.bytes_moved["surfaces"] = levels + color + _size(pyramid.grey)


def _cost(name: str, frames: list[_Clock], machine: Machine) -> StageCost:
    wall_ms = 1e3 * median(frame.wall_s.get(name, 0.0) for frame in frames)
    cpu_ms = 1e3 * median(frame.cpu_s.get(name, 0.0) for frame in frames)
    moved = float(median(frame.bytes_moved.get(name, 0.0) for frame in frames))
    return StageCost(name, wall_ms, cpu_ms, moved, wall_ms / machine.floor_ms(moved) if moved else None)


def _size(image: np.ndarray[Any, Any] | None) -> int:
    return 0 if image is None else int(image.nbytes)
