"""A walk through a sequence, frame by frame, and what is counted on the way."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scanweld.arrays import Float64
from scanweld.checkup.first_look import FirstLook
from scanweld.datasets.base import LiveSequence, RgbdSequence
from scanweld.datasets.gyroscope import gyroscope_of
from scanweld.datasets.images import check_depth_unit
from scanweld.datasets.playback import Clock, play
from scanweld.datasets.stream import stream
from scanweld.errors import DatasetError, UnreadableFrameError
from scanweld.geometry.frame import Frame
from scanweld.runs.checkpoint.identity import digest_of
from scanweld.slam.system import Slam
from scanweld.trajectory import FrameResult

logger = logging.getLogger(__name__)

AfterFrame = Callable[[Slam, Frame | None, FrameResult], None]

UNIT_CHECK_FRAMES = 5
"""Frames whose depth is looked at for a wrong unit."""


@dataclass(slots=True)
class Tally:
    """What is counted while frames go by."""

    num_points_input: int = 0
    content: int = 0  # checksum of what the frames show
    median_depth_m: float = 0.0  # of the first frame with depth
    unit_doubted: bool = False
    warnings: list[str] = field(default_factory=list)

    def warn(self, message: str) -> None:
        logger.warning(message)
        self.warnings.append(message)

    def count(self, index: int, frame: Frame, depth_scale: float) -> None:
        """Count what a frame measured, and doubt the unit of the first ones once."""
        depth_m = frame.depth_m
        self.content = digest_of(frame, self.content)
        self.num_points_input += int(np.count_nonzero(depth_m))
        if index < UNIT_CHECK_FRAMES and not self.unit_doubted and depth_m.any():
            self.median_depth_m = float(np.median(depth_m[depth_m > 0]))
            advice = check_depth_unit(self.median_depth_m, depth_scale)
            if advice:
                self.unit_doubted = True
                self.warn(advice)


def process_all(
    slam: Slam,
    sequence: RgbdSequence,
    tally: Tally,
    given: list[Float64 | None] | None,
    after_frame: AfterFrame,
    clock: Clock | None = None,
    look: FirstLook | None = None,
) -> None:
    """Walk through a sequence: track each frame, or take its given T_world_camera; with a clock, at its pace."""
    gyroscope = gyroscope_of(sequence)
    turned = None if gyroscope is None else gyroscope.orientations(sequence.timestamps_s)
    if clock is None or isinstance(sequence, LiveSequence):
        # Two frames ahead: a prepared one of 640x480 holds 20 MB.
        source = stream(sequence, 2, prepare=slam.prepare, first=len(slam.results))
    else:
        source = play(sequence, prepare=slam.prepare, clock=clock)
    last_read: int | None = None
    with contextlib.closing(source) as records:
        for record in records:
            if record.frame is not None:
                last_read = record.index
            elif not record.dropped and last_read is not None and not _can_be_read(sequence, last_read):
                raise DatasetError(
                    f"{sequence.name}: frame {record.index} cannot be read ({record.error}), and frame {last_read} "
                    "not any more; is the recording still there?"
                )
            pose = given[record.index] if given is not None else None
            if record.dropped:
                result = slam.drop(record.timestamp_s, record.error)
            elif record.frame is None:
                tally.warn(f"frame {record.index} is skipped: {record.error}")
                result = slam.skip(record.timestamp_s, record.error)
            elif given is not None and pose is None:
                result = slam.skip(record.timestamp_s, "no given pose")
            else:
                tally.count(record.index, record.frame, sequence.depth_scale)
                for finding in look.see(record.index, record.frame) if look else ():
                    tally.warn(str(finding))
                result = slam.process(
                    record.frame,
                    pyramid=record.prepared,
                    T_world_camera=pose,
                    orientation=None if turned is None else turned[record.index],
                )
            after_frame(slam, record.frame, result)


def _can_be_read(sequence: RgbdSequence, index: int) -> bool:
    try:
        sequence.read(index)
    except UnreadableFrameError:
        return False
    return True
