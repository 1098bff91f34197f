"""What an RGB-D sequence is, and the one that reads files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.datasets.gyroscope import Gyroscope, gyroscope_of
from scanweld.datasets.images import read_color, read_depth_png
from scanweld.errors import DatasetError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.trajectory import Trajectory

logger = logging.getLogger(__name__)

DepthReader: TypeAlias = Callable[[Path, tuple[int, int], float], Float32]
"""(path, (height, width), units per metre) -> depth (H, W) [m], 0 = invalid; raises UnreadableFrameError."""


@runtime_checkable
class RgbdSequence(Protocol):
    """Registered depth and colour over time, read one frame at a time.

    Reading a frame keeps nothing in memory, may happen in any order, and on another thread.
    """

    @property
    def name(self) -> str:
        """What a run of this sequence is called."""
        ...

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of every frame."""
        ...

    @property
    def depth_scale(self) -> float:
        """Units per metre of the stored depth (for messages; frames are in metres)."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True T_world_camera at its own timestamps, which need not be those of the frames, or None."""
        ...

    @property
    def timestamps_s(self) -> Float64:
        """Time of every frame (N,), strictly increasing [s]."""
        ...

    def __len__(self) -> int:
        """Return the number of frames, unreadable ones included."""
        ...

    def read(self, index: int) -> Frame:
        """Return frame `index`, 0 <= index < len(self).

        Raises
        ------
        UnreadableFrameError
            When it cannot be decoded; the other frames may well be readable.
        """
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield the readable frames in order; each unreadable one is logged and left out."""
        ...


@runtime_checkable
class LiveSequence(RgbdSequence, Protocol):
    """A camera: its frames come when they come, once, and have no end. What it says of times and length is so far."""

    def live(self) -> Iterator[Frame]:
        """Yield the newest frame whenever one is asked for; those that nobody asked for in time are dropped."""
        ...

    def close(self) -> None:
        """Let go of the camera; `live` ends."""
        ...


def readable_frames(sequence: RgbdSequence) -> Iterator[Frame]:
    """Yield the frames of a sequence that can be decoded; log the others.

    Raises
    ------
    DatasetError
        At the end, when no frame at all could be decoded.
    """
    fault = ""
    num_read = 0
    for index in range(len(sequence)):
        try:
            frame = sequence.read(index)
        except UnreadableFrameError as error:
            logger.warning("frame %d is left out: %s", index, error)
            fault = fault or str(error)
            continue
        num_read += 1
        yield frame
    if num_read == 0:
        raise no_readable_frame(sequence.name, len(sequence), fault)


def no_readable_frame(name: str, count: int, first_fault: str) -> DatasetError:
    """Return the error for a sequence in which no frame can be decoded."""
    return DatasetError(f"{name}: none of the {count} frames can be decoded; the first: {first_fault}")


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """Where one frame is.

    Attributes
    ----------
    timestamp_s : [s]
    depth : depth file
    color : colour file, registered to the depth, or None
    """

    timestamp_s: float
    depth: Path
    color: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FileSequence:
    """A sequence of image files; see :class:`RgbdSequence`. The formats differ only in how they fill it.

    Raises
    ------
    DatasetError
        When there is no frame, or time does not increase from frame to frame.
    """

    name: str
    camera: PinholeCamera
    frames: tuple[FrameFiles, ...]
    depth_scale: float
    ground_truth: Trajectory | None = None
    depth_reader: DepthReader = read_depth_png
    gyroscope: Gyroscope | None = None

    def __post_init__(self) -> None:
        if not self.frames:
            raise DatasetError(f"{self.name}: the sequence has no frame")
        for before, after in zip(self.frames, self.frames[1:], strict=False):
            if not after.timestamp_s > before.timestamp_s:
                raise DatasetError(
                    f"{self.name}: time must increase from frame to frame; {after.depth.name} has "
                    f"{after.timestamp_s:.6f} s after {before.timestamp_s:.6f} s",
                    fault="time-order",
                )

    @property
    def timestamps_s(self) -> Float64:
        """Time of every frame (N,) [s]."""
        return np.array([files.timestamp_s for files in self.frames], dtype=np.float64)

    def __len__(self) -> int:
        return len(self.frames)

    def read(self, index: int) -> Frame:
        """Decode frame `index`; raises UnreadableFrameError when one of its files is damaged or missing."""
        files = self.frames[index]
        depth_m = self.depth_reader(files.depth, self.camera.shape, self.depth_scale)
        color = None if files.color is None else read_color(files.color, self.camera.shape)
        return Frame(files.timestamp_s, depth_m, color, self.camera)

    def __iter__(self) -> Iterator[Frame]:
        return readable_frames(self)


@dataclass(frozen=True, slots=True)
class WrappedSequence:
    """The frames of `base` as they are; what wraps a sequence differs from it in a method or two."""

    base: RgbdSequence

    @property
    def name(self) -> str:
        """Name of the sequence underneath."""
        return self.base.name

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of every frame."""
        return self.base.camera

    @property
    def depth_scale(self) -> float:
        """Units per metre of the stored depth."""
        return self.base.depth_scale

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses of the sequence underneath, at their own times."""
        return self.base.ground_truth

    @property
    def gyroscope(self) -> Gyroscope | None:
        """What the gyroscope of the sequence underneath measured, at its own times."""
        return gyroscope_of(self.base)

    @property
    def timestamps_s(self) -> Float64:
        """Time of every frame (N,) [s]."""
        return self.base.timestamps_s

    def __len__(self) -> int:
        return len(self.base)

    def read(self, index: int) -> Frame:
        """Read frame `index`."""
        return self.base.read(index)

    def __iter__(self) -> Iterator[Frame]:
        return readable_frames(self)
