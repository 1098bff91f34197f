"""Parts and smaller versions of a sequence; they wrap any :class:`~scanweld.datasets.base.RgbdSequence`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64
from scanweld.datasets.base import RgbdSequence, WrappedSequence
from scanweld.datasets.images import MIN_SIDE_PX, require_scale, resize_color, resize_depth
from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame


@dataclass(frozen=True, slots=True)
class SelectedSequence(WrappedSequence):
    """The frames of `base` at `indices`, in that order; timestamps and ground truth stay as they are."""

    indices: Sequence[int]

    @property
    def timestamps_s(self) -> Float64:
        """Time of the selected frames (N,) [s]."""
        return self.base.timestamps_s[np.asarray(self.indices, np.int64)]

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, index: int) -> Frame:
        """Decode the selected frame `index`."""
        return self.base.read(self.indices[index])


@dataclass(frozen=True, slots=True)
class ResizedSequence(WrappedSequence):
    """The frames of `base` with depth, colour and intrinsics resized by `scale`.

    Raises
    ------
    InvalidInputError
        When the scale is not within (0, 4], or leaves fewer than 32 pixels of the shorter side.
    """

    scale: float

    def __post_init__(self) -> None:
        require_scale(self.scale)
        _require_size(self.base.camera, self.scale)

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of the resized images."""
        return self.base.camera.scaled(self.scale)

    def read(self, index: int) -> Frame:
        """Decode and resize frame `index`."""
        frame, camera = self.base.read(index), self.camera
        color = None if frame.color is None else resize_color(frame.color, camera.shape)
        return Frame(frame.timestamp_s, resize_depth(frame.depth_m, camera.shape), color, camera)


def _require_size(camera: PinholeCamera, scale: float) -> None:
    side = min(camera.width, camera.height)
    if scale >= 1 or round(side * scale) >= MIN_SIDE_PX:
        return
    smallest = math.ceil(1000 * MIN_SIDE_PX / side) / 1000
    fix = f"use {smallest:g} or more" if smallest < 1 else "such images cannot be made smaller"
    raise InvalidInputError(
        f"scale: {scale:g} would make the {camera.width}x{camera.height} images {round(camera.width * scale)}x"
        f"{round(camera.height * scale)}, with less than {MIN_SIDE_PX} pixels on the shorter side; {fix}"
    )


def select(sequence: RgbdSequence, frames: str | slice) -> RgbdSequence:
    """Return the frames A:B[:STEP] of a sequence, by position as in Python; a missing end means to the end.

    Raises
    ------
    InvalidInputError
        When the text is no such range, the step is not positive, or no frame is left.
    """
    chosen = parse_frames(frames) if isinstance(frames, str) else frames
    if chosen.step is not None and chosen.step < 1:
        raise InvalidInputError(f"frames: the step must be at least 1, got {chosen.step}")
    indices = range(*chosen.indices(len(sequence)))
    if len(indices) == 0:
        raise InvalidInputError(f"frames: {_text(chosen)} selects none of the {len(sequence)} frames")
    return SelectedSequence(sequence, indices)


def parse_frames(text: str) -> slice:
    """Turn "A:B[:STEP]" into a slice; A and B may be left out.

    Raises
    ------
    InvalidInputError
        When the text is anything else.
    """
    parts = text.split(":")
    try:
        if len(parts) not in (2, 3):
            raise ValueError
        start, stop, step = (int(part) if part.strip() else None for part in (*parts, "")[:3])
    except ValueError:
        raise InvalidInputError(
            f"frames: expected A:B or A:B:STEP, for example 0:200 or 100::2, got '{text}'"
        ) from None
    return slice(start, stop, step)


def _text(chosen: slice) -> str:
    start, stop = ("" if end is None else end for end in (chosen.start, chosen.stop))
    return f"{start}:{stop}" + ("" if chosen.step is None else f":{chosen.step}")
