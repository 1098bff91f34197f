"""A closed walk again and again, for runs that are longer than what was rendered."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

import scanweld as sw
from scanweld.arrays import Array, Float64
from scanweld.datasets.base import WrappedSequence


@dataclass(frozen=True)
class Laps(WrappedSequence):
    """The part of a sequence until it is back where it began, again and again, for `count` frames."""

    count: int

    @cached_property
    def round(self) -> int:
        """Frames of one lap; what a rendered round overlaps itself by is left out, or the camera would leap."""
        assert self.base.ground_truth is not None
        places = self.base.ground_truth.T_world_camera[:, :3, 3]
        half = len(places) // 2
        return half + int(np.linalg.norm(places[half:] - places[0], axis=1).argmin())

    @cached_property
    def timestamps_s(self) -> Float64:  # type: ignore[override]
        """Time of every frame: each lap begins one frame after the one before."""
        times = self.base.timestamps_s[: self.round]
        period = times[-1] - times[0] + np.median(np.diff(times))
        laps, frames = np.divmod(np.arange(self.count), len(times))
        return np.asarray(times[frames] + laps * period)

    @property
    def ground_truth(self) -> sw.Trajectory:
        """The same poses in every lap."""
        truth = self.base.ground_truth
        assert truth is not None
        return sw.Trajectory(self.timestamps_s, truth.T_world_camera[np.arange(self.count) % self.round])

    def __len__(self) -> int:
        return self.count

    def read(self, index: int) -> sw.Frame:
        """Decode a frame; its time is that of its lap."""
        return replace(self.base.read(index % self.round), timestamp_s=float(self.timestamps_s[index]))


@dataclass(frozen=True)
class InMemory(WrappedSequence):
    """A sequence whose frames are read once, and kept in 5 bytes a pixel."""

    @cached_property
    def frames(self) -> list[tuple[Array, Array | None]]:
        """Depth [1/5000 m] and colour of every frame."""
        frames = (self.base.read(k) for k in range(len(self.base)))
        return [(np.rint(frame.depth_m * 5000).astype(np.uint16), frame.color) for frame in frames]

    def read(self, index: int) -> sw.Frame:
        """Return a frame as it is kept."""
        depth, color = self.frames[index]
        depth_m = depth.astype(np.float32) / np.float32(5000)
        return sw.Frame(float(self.timestamps_s[index]), depth_m, color, self.camera)


@lru_cache(maxsize=1)
def rendered_walk(config: sw.RenderConfig, frames: int) -> Laps:
    """Return a walk by what it is rendered from: any process can open it, and keeps one round of it in memory."""
    return Laps(InMemory(sw.SyntheticSequence(config)), frames)
