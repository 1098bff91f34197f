"""Run SLAM over a sequence, frame by frame, through the public interface only."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import scanweld as sw
from scanweld.geometry import se3

POSED = (sw.FrameState.TRACKING, sw.FrameState.RELOCALISED)
Array = np.ndarray[Any, Any]


@dataclass
class Run:
    """What happened.

    Attributes
    ----------
    truth : T_world_camera of every frame
    changed_while_lost : frames that were LOST and after which the map was not what it had been
    maps : positions (N, 3) [m, world frame of the run] after the frames that were asked for
    """

    slam: sw.Slam
    truth: sw.Trajectory
    seconds: float = 0.0
    changed_while_lost: list[int] = field(default_factory=list)
    maps: dict[int, Array] = field(default_factory=dict)

    @property
    def results(self) -> list[sw.FrameResult]:
        return self.slam.results

    @property
    def lost(self) -> Array:
        """Numbers of the LOST frames."""
        return np.array([r.index for r in self.results if r.state is sw.FrameState.LOST], dtype=np.int64)

    @property
    def points_m(self) -> Array:
        """Positions of the surfels (N, 3), world frame of the run [m]."""
        return np.ascontiguousarray(self.slam.map.positions_m.T, dtype=np.float64)

    @property
    def normals(self) -> Array:
        return np.ascontiguousarray(self.slam.map.normals.T, dtype=np.float64)

    def ate(self, frames: Any = slice(None)) -> Any:
        """Trajectory error over some of the frames, after alignment."""
        return sw.ate(self.slam.trajectory.subset(frames), self.truth)

    @property
    def T_truth_map(self) -> Array:
        """Where the run's world frame is, by the mean over its measured poses as they are now.

        Orientations count, so a short or straight path will do, where the alignment of positions has a free axis.
        """
        posed = np.array([r.index for r in self.results if r.state in POSED])
        T = self.truth.T_world_camera[posed] @ se3.inverse(self.slam.trajectory.T_world_camera[posed])
        middle = T[len(T) // 2]
        mean: Array = middle @ se3.exp(se3.log(se3.inverse(middle) @ T).mean(axis=0))
        return mean

    def T_truth_run(self, index: int) -> Array:
        """Where the run's world frame was at frame `index`, by the pose that it had then."""
        T: Array = self.truth.T_world_camera[index] @ se3.inverse(self.results[index].T_world_camera)
        return T


def run(sequence: sw.RgbdSequence, *, keep_maps: tuple[int, ...] = (), true_poses: bool = False, **stages: Any) -> Run:
    """Run the default system, or one with some `stages` replaced, over a sequence with ground truth.

    With `true_poses` nothing is tracked: the map is what the best tracking would make.
    """
    assert sequence.ground_truth is not None
    slam = sw.build_slam(sequence.camera, sw.SlamConfig(), **stages)
    result = Run(slam, sequence.ground_truth)
    before = fingerprint(slam.map)
    for index in range(len(sequence)):
        try:
            frame = sequence.read(index)
        except sw.UnreadableFrameError as error:
            slam.skip(float(sequence.timestamps_s[index]), str(error))
            continue
        start = time.perf_counter()
        outcome = slam.process(frame, T_world_camera=result.truth.T_world_camera[index] if true_poses else None)
        result.seconds += time.perf_counter() - start
        after = fingerprint(slam.map)
        if outcome.state is sw.FrameState.LOST and after != before:
            result.changed_while_lost.append(index)
        before = after
        if index in keep_maps:
            result.maps[index] = result.points_m
    return result


def fingerprint(surfels: sw.SurfelMap) -> int:
    """A number that changes when a surfel does."""
    code = len(surfels)
    for row in (*surfels.positions_m, *surfels.normals, surfels.confidences):
        code = zlib.crc32(np.ascontiguousarray(row).data, code)
    return code


@dataclass(frozen=True)
class Remembered:
    """A sequence whose frames are read once and kept; the sequences of one scenario share what they have in common."""

    base: sw.RgbdSequence
    _frames: dict[int, sw.Frame] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.base.name

    @property
    def camera(self) -> sw.PinholeCamera:
        return self.base.camera

    @property
    def depth_scale(self) -> float:
        return self.base.depth_scale

    @property
    def ground_truth(self) -> sw.Trajectory | None:
        return self.base.ground_truth

    @property
    def timestamps_s(self) -> Array:
        return self.base.timestamps_s

    def __len__(self) -> int:
        return len(self.base)

    def read(self, index: int) -> sw.Frame:
        if index not in self._frames:
            self._frames[index] = self.base.read(index)
        return self._frames[index]

    def __iter__(self) -> Any:
        return (self.read(index) for index in range(len(self)))
