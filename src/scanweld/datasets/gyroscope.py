"""Gyroscopes: rates of turn beside the images, and the orientations that follow from them.

A folder in the layout of TUM RGB-D (ETH3D's, too) may hold

    imu.txt             `timestamp wx wy wz [ax ay az]` a line: seconds on the clock of the images, rad/s along the axes
                        of the sensor; further columns are passed over, lines with # are comments
    R_camera_imu.txt    optional, 3x3: rotates vectors from the sensor's axes to those of the camera; else these agree

Only the rates are used. They need not be exact: SLAM estimates their bias, and leaves them alone while they know no
better than the motion so far (:mod:`scanweld.slam.rotation_aid`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from scanweld.arrays import Float64
from scanweld.errors import DatasetError, InvalidInputError
from scanweld.geometry import se3

_TOLERANCE = 1e-3  # of a rotation that was printed with few digits
_FASTEST_RAD_S = 1e4  # no camera turns so fast, and raw units of a sensor do
_MAX_BYTES = 1 << 28  # of a text: two hours at 400 samples a second
_ABSURD = 1e15  # seconds in any unit; differences of larger ones say nothing


@dataclass(frozen=True, slots=True, eq=False)
class Gyroscope:
    """Rates of turn over time.

    Attributes
    ----------
    timestamps_s : (N,), strictly increasing, on the clock of the images [s]
    rates_rad_s : (N, 3), about the axes of the sensor [rad/s]
    R_camera_imu : (3, 3), from the axes of the sensor to those of the camera

    Raises
    ------
    InvalidInputError
        When the shapes do not match, a value is not finite, time does not increase, or the rotation is none.
    """

    timestamps_s: Float64
    rates_rad_s: Float64
    R_camera_imu: Float64

    def __post_init__(self) -> None:
        times, rates, R = (np.array(a, np.float64) for a in (self.timestamps_s, self.rates_rad_s, self.R_camera_imu))
        if times.ndim != 1 or len(times) < 2 or rates.shape != (len(times), 3):
            raise InvalidInputError(
                f"gyroscope: expected two or more timestamps (N,) and rates (N, 3), got {times.shape} and {rates.shape}"
            )
        if not (np.abs(times) < _ABSURD).all():
            raise InvalidInputError("gyroscope: a timestamp is not finite, or absurd")
        if not (np.abs(rates) < _FASTEST_RAD_S).all():
            raise InvalidInputError(
                f"gyroscope: a rate is not finite, or above {_FASTEST_RAD_S:g} rad/s; another unit?"
            )
        if (np.diff(times) <= 0).any():
            at = int(np.argmax(np.diff(times) <= 0)) + 1
            raise InvalidInputError(
                f"gyroscope: time must increase, sample {at} has {times[at]:.6f} s after {times[at - 1]:.6f} s"
            )
        is_near = R.shape == (3, 3) and bool((np.abs(R) < 2).all())  # no larger numbers are multiplied
        if not is_near or not np.allclose(R @ R.T, np.eye(3), atol=_TOLERANCE) or np.linalg.det(R) < 0:
            raise InvalidInputError("gyroscope: R_camera_imu is no rotation (3, 3)")
        for name, value in (("timestamps_s", times), ("rates_rad_s", rates), ("R_camera_imu", R)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def orientations(self, timestamps_s: Float64) -> list[Float64 | None]:
        """Return R_reference_camera (3, 3) at each time, None where there are no samples around it.

        The reference is the camera at the first sample. Rates are linear between samples; each piece turns by its mean.
        """
        wanted = np.asarray(timestamps_s, np.float64)
        inside = (wanted >= self.timestamps_s[0]) & (wanted <= self.timestamps_s[-1])
        times = np.union1d(self.timestamps_s, wanted[inside])
        rates = np.stack([np.interp(times, self.timestamps_s, self.rates_rad_s[:, k]) for k in range(3)], axis=1)
        turns = se3.exp_so3((rates[:-1] + rates[1:]) / 2 * np.diff(times)[:, None] @ self.R_camera_imu.T)
        at: dict[float, Float64] = {}
        R, needed = np.eye(3), set(wanted[inside].tolist())
        for time, turn in zip(times.tolist(), [np.eye(3), *turns], strict=True):
            R = R @ turn
            if time in needed:
                at[time] = R
        return [at.get(time) for time in wanted.tolist()]


@runtime_checkable
class HasGyroscope(Protocol):
    """A sequence that may have a gyroscope; others need no such attribute."""

    @property
    def gyroscope(self) -> Gyroscope | None:
        """What the gyroscope measured, or None."""
        ...


def gyroscope_of(sequence: object) -> Gyroscope | None:
    """Return the gyroscope of a sequence, None where it has none."""
    return sequence.gyroscope if isinstance(sequence, HasGyroscope) else None


def read_gyroscope(folder: Path) -> Gyroscope | None:
    """Read imu.txt of a folder, None where there is none.

    Raises
    ------
    DatasetError
        When the file holds anything else.
    """
    path, axes = folder / "imu.txt", folder / "R_camera_imu.txt"
    if not path.is_file():
        return None
    try:
        rows = _table(path)
        if rows.shape[1] < 4:
            raise ValueError(f"{rows.shape[1]} columns")
        R = _table(axes).reshape(3, 3) if axes.is_file() else np.eye(3)
        return Gyroscope(rows[:, 0], rows[:, 1:4], R)
    except (OSError, ValueError) as fault:  # InvalidInputError is a ValueError
        raise DatasetError(
            f"{path}: expected lines `timestamp wx wy wz [ax ay az]` of increasing time, and a rotation in "
            f"{axes.name} if it is there: {fault}; remove the file to do without"
        ) from fault


def _table(path: Path) -> Float64:
    """Return the rows of numbers of a text file; raises ValueError where it holds anything else, or nothing."""
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"larger than {_MAX_BYTES >> 20} MiB")
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.partition("#")[0].strip()]
    if not lines:
        raise ValueError("empty")
    return np.loadtxt(lines, dtype=np.float64, comments="#", ndmin=2)
