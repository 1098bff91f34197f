"""The sequence of a container or a capture: what a format gives is a function that reads frame i."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.datasets.base import no_readable_frame, readable_frames
from scanweld.errors import DatasetError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.trajectory import Trajectory

logger = logging.getLogger(__name__)

FrameSource: TypeAlias = Callable[[int], tuple[Float32, UInt8 | None]]
"""index -> depth (H, W) [m] with 0 = invalid, and colour (H, W, 3) RGB or None; raises UnreadableFrameError.

It is called with 0 <= index < number of frames, in any order, by any thread.
"""

POSE_TOLERANCE = 1e-3
"""Largest departure from a rotation that single precision and printing with few digits explain."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedSequence:
    """A sequence whose frames a function reads; see :class:`~scanweld.datasets.base.RgbdSequence`.

    Raises
    ------
    DatasetError
        When there is no frame, or time does not increase from frame to frame.
    """

    name: str
    camera: PinholeCamera
    timestamps_s: Float64
    frame_source: FrameSource
    depth_scale: float
    ground_truth: Trajectory | None = None

    def __post_init__(self) -> None:
        times = np.array(self.timestamps_s, dtype=np.float64)
        if times.ndim != 1 or len(times) == 0:
            raise DatasetError(f"{self.name}: the sequence has no frame")
        if not _increase(times):
            raise DatasetError(f"{self.name}: time must be finite and increase from frame to frame", fault="time-order")
        times.flags.writeable = False
        object.__setattr__(self, "timestamps_s", times)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int) -> Frame:
        """Decode frame `index`; raises UnreadableFrameError when it is damaged."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        depth_m, color = self.frame_source(index)
        return Frame(float(self.timestamps_s[index]), depth_m, color, self.camera)

    def __iter__(self) -> Iterator[Frame]:
        return readable_frames(self)


def require_a_readable_frame(sequence: RecordedSequence) -> RecordedSequence:
    """Return the sequence after decoding its first intact frame.

    Raises
    ------
    DatasetError
        When there is none.
    """
    fault = ""
    for index in range(len(sequence)):
        try:
            sequence.read(index)
        except UnreadableFrameError as error:
            fault = fault or str(error)
            continue
        return sequence
    raise no_readable_frame(sequence.name, len(sequence), fault)


def times_or_rate(times_s: npt.ArrayLike, rate_hz: float, where: Path | str) -> Float64:
    """Return the recorded times (N,) [s] if they increase, else those of a constant rate, with a warning."""
    times = np.asarray(times_s, dtype=np.float64)
    if _increase(times):
        return times
    if np.any(times != times[:1]):  # all the same, mostly 0, is how a recorder says that it has none
        logger.warning("%s: the recorded times do not increase; frames are taken at %g a second", where, rate_hz)
    return np.arange(len(times)) / rate_hz


def known_poses(times_s: Float64, matrices: Float64, where: Path | str) -> Trajectory | None:
    """Return the ground truth of recorded matrices (N, 4, 4); those with a value that is not finite are left out.

    Raises
    ------
    DatasetError
        When a finite one is no rigid transform.
    """
    finite = np.isfinite(matrices.reshape(-1, 16)).all(axis=1)
    if not finite.all():
        logger.warning(
            "%s: %d of %d true poses are not finite and left out", where, int((~finite).sum()), len(matrices)
        )
    if not finite.any():
        return None
    poses = matrices[finite].astype(np.float64)
    rotations = poses[:, :3, :3]
    with np.errstate(all="ignore"):  # absurd entries are refused below
        defect = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
        upright = np.linalg.det(rotations) > 0
    last_row = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1)
    good = (defect <= POSE_TOLERANCE) & upright & (last_row <= POSE_TOLERANCE)
    if not good.all():
        at = int(np.flatnonzero(finite)[np.argmin(good)])
        raise DatasetError(f"{where}: the true pose of frame {at} is not a rigid transform; is the file damaged?")
    u, _, vt = np.linalg.svd(rotations)
    poses[:, :3, :3] = u @ vt
    poses[:, 3] = [0, 0, 0, 1]
    return Trajectory(times_s[finite], poses)


def require_rate(rate_hz: object, where: Path | str) -> float:
    """Return a frame rate after checking that it is a positive number.

    Raises
    ------
    DatasetError
        When it is not.
    """
    if isinstance(rate_hz, (int, float)) and not isinstance(rate_hz, bool) and 0 < rate_hz < 1e300:
        return float(rate_hz)
    raise DatasetError(f"{where}: expected a positive number of frames a second, got {rate_hz!r}")


def _increase(times: Float64) -> bool:
    return bool(np.isfinite(times).all() and (np.diff(times) > 0).all())
