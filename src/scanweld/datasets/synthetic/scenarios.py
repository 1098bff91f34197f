"""What goes wrong in recordings, done to a sequence on purpose: each function wraps one and returns another.

They compose: ``relight(blackout(sequence, 100, 60), 200, gain=0.6)``. Nothing is written and nothing is kept; a frame
is altered when it is read, and timestamps, intrinsics and ground truth stay those of the sequence underneath. The
functions that change where the camera is take and return a :class:`~scanweld.trajectory.Trajectory`, to be rendered
with ``SyntheticSequence(config, trajectory=...)``. For every n-th frame there is
:func:`scanweld.datasets.selection.select`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import as_transform
from scanweld.datasets.base import RgbdSequence, WrappedSequence
from scanweld.datasets.gyroscope import Gyroscope
from scanweld.errors import InvalidInputError, UnreadableFrameError
from scanweld.geometry import se3
from scanweld.geometry.frame import Frame
from scanweld.trajectory import Trajectory

Alteration = Callable[[int, Frame], Frame]
"""(index, frame) -> the frame as it is to be seen; it may raise UnreadableFrameError."""


@dataclass(frozen=True, slots=True)
class AlteredSequence(WrappedSequence):
    """The frames of `base`, each passed through `alter` when it is read."""

    alter: Alteration

    def read(self, index: int) -> Frame:
        """Read and alter frame `index`."""
        return self.alter(index, self.base.read(index))


@dataclass(frozen=True, slots=True)
class GyroscopeSequence(WrappedSequence):
    """The frames of `base` with a gyroscope beside them."""

    measured: Gyroscope | None

    @property
    def gyroscope(self) -> Gyroscope | None:
        """What it measured."""
        return self.measured


def simulate_gyroscope(
    trajectory: Trajectory,
    *,
    rate_hz: float = 400.0,
    noise_rad_s: float = 0.005,
    bias_rad_s: npt.ArrayLike = (0.0, 0.0, 0.0),
    R_camera_imu: npt.ArrayLike | None = None,
    seed: int = 0,
) -> Gyroscope:
    """Return what a gyroscope on the camera of a path measures: exact rates, a bias and white noise.

    Between two poses the camera turns evenly. A sensor that is worn on the camera at an angle has its `R_camera_imu`.

    Parameters
    ----------
    trajectory : T_world_camera, at least two poses
    rate_hz : about so many samples a second, as many in each interval between poses
    noise_rad_s : standard deviation of each sample; good MEMS sensors have 0.005 at 400 Hz
    bias_rad_s : (3,), added to every sample, axes of the sensor
    R_camera_imu : (3, 3), from the axes of the sensor to those of the camera; identity by default
    seed : of the noise
    """
    R_axes = np.eye(3) if R_camera_imu is None else np.asarray(R_camera_imu, np.float64)
    R, times = trajectory.T_world_camera[:, :3, :3], trajectory.timestamps_s
    elapsed = np.diff(times)
    rates = se3.log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / elapsed[:, None]
    count = max(2, round(float(np.median(elapsed)) * rate_hz))
    within = np.linspace(1e-3, 1 - 1e-3, count)  # to both ends: rates that leap from pose to pose are not smoothed
    at = (times[:-1, None] + elapsed[:, None] * within).ravel()
    samples = np.repeat(rates, count, axis=0) @ R_axes + np.asarray(bias_rad_s, np.float64)
    noise = np.random.default_rng(seed).normal(0.0, noise_rad_s, samples.shape)
    # It was on before the first image and after the last one.
    whole = np.concatenate([[times[0] - 1e-3], at, [times[-1] + 1e-3]])
    samples = (samples + noise)[[0, *range(len(samples)), -1]]
    return Gyroscope(whole, samples, R_axes)


def blackout(sequence: RgbdSequence, start: int, count: int = 1) -> AlteredSequence:
    """Cover the lens for `count` frames from `start`: no depth, and black."""
    covered = _stretch(sequence, start, count)

    def alter(index: int, frame: Frame) -> Frame:
        if index not in covered:
            return frame
        black = None if frame.color is None else np.zeros_like(frame.color)
        return replace(frame, depth_m=np.zeros_like(frame.depth_m), color=black)

    return AlteredSequence(sequence, alter)


def unreadable(sequence: RgbdSequence, indices: Collection[int]) -> AlteredSequence:
    """Damage single frames, so that reading them raises UnreadableFrameError."""
    damaged = frozenset(indices)

    def alter(index: int, frame: Frame) -> Frame:
        if index in damaged:
            raise UnreadableFrameError(f"frame {index} of {sequence.name} is damaged on purpose")
        return frame

    return AlteredSequence(sequence, alter)


def relight(
    sequence: RgbdSequence, start: int, count: int | None = None, *, gain: float = 1.0, offset: float = 0.0
) -> AlteredSequence:
    """Change the exposure from frame `start` on (for `count` frames): colour becomes gain * colour + offset, clipped.

    `offset` is in steps of the 8-bit image. Depth stays as it is.
    """
    changed = _stretch(sequence, start, len(sequence) - start if count is None else count)

    def alter(index: int, frame: Frame) -> Frame:
        if index not in changed or frame.color is None:
            return frame
        level = np.clip(np.rint(gain * frame.color.astype(np.float32) + offset), 0, 255)
        return replace(frame, color=level.astype(np.uint8))

    return AlteredSequence(sequence, alter)


def carried(
    trajectory: Trajectory, at: int, to: int, count: int = 60, *, T_shift: npt.ArrayLike | None = None
) -> Trajectory:
    """Carry the camera elsewhere: poses 0..at, `count` frames on the way, then on from pose `to` to the end.

    With :func:`blackout` of frames `at` to `at + count` the camera is kidnapped; without, the same path is walked
    with open eyes, which is the run to compare with.

    Parameters
    ----------
    trajectory : the path, at a constant rate
    at, to : the last pose before is `at` - 1, the first one afterwards `to`, before or after `at`
    count : frames on the way, interpolated between the two
    T_shift : (4, 4), moves the camera in its own frame after it was set down, so that it does not see quite what it
        saw when it was there before

    Returns
    -------
    Trajectory
        `at` + `count` + len(trajectory) - `to` poses; the clock goes on at the rate it had.

    Raises
    ------
    InvalidInputError
        When a pose is not on the path or `count` is negative.
    """
    size = len(trajectory)
    if not (1 <= at <= size and 0 <= to < size and count >= 0 and size >= 2):
        raise InvalidInputError(f"carried: at = {at}, to = {to}, count = {count} do not fit a path of {size} poses")
    shift = np.eye(4) if T_shift is None else as_transform(T_shift, "T_shift")
    T = trajectory.T_world_camera
    after = T[to:] @ shift
    fraction = np.arange(1, count + 1) / (count + 1)
    last, first = (np.broadcast_to(end, (count, 4, 4)) for end in (T[at - 1], after[0]))
    poses = np.concatenate([T[:at], se3.interpolate(last, first, fraction), after])
    step_s = (trajectory.timestamps_s[-1] - trajectory.timestamps_s[0]) / (size - 1)
    times = trajectory.timestamps_s[0] + np.arange(len(poses)) * step_s
    return Trajectory(np.round(times, 6), poses)


def find_carries(
    trajectory: Trajectory,
    num: int,
    *,
    earliest: int,
    distance_m: float = 2.0,
    turn_deg: float = 60.0,
    tolerance: float = 0.1,
) -> list[tuple[int, int]]:
    """Find `num` pairs (at, to) for :func:`carried` that are about `distance_m` and `turn_deg` apart.

    `at` begins at `earliest`, and the pairs are spread evenly over those that keep both within `tolerance` of what is
    asked.

    Raises
    ------
    InvalidInputError
        When the path has fewer such pairs.
    """
    T = trajectory.T_world_camera
    pairs = []
    for at in range(earliest, len(T)):
        motion = se3.inverse(T[at - 1]) @ T
        distance = np.linalg.norm(motion[:, :3, 3], axis=1) / distance_m - 1
        turn = np.degrees(se3.rotation_angle_rad(motion)) / turn_deg - 1
        misfit = np.maximum(np.abs(distance), np.abs(turn))
        to = int(np.argmin(misfit))
        if misfit[to] <= tolerance:
            pairs.append((at, to))
    if len(pairs) < num:
        raise InvalidInputError(
            f"find_carries: {len(pairs)} poses of the path from {earliest} on have another {distance_m:g} m and "
            f"{turn_deg:g} degrees away, {num} were asked for; take a longer path or another distance"
        )
    return [pairs[k] for k in np.linspace(0, len(pairs) - 1, num).astype(int)]


def _stretch(sequence: RgbdSequence, start: int, count: int) -> range:
    if not (start >= 0 and count >= 0 and start + count <= len(sequence)):
        raise InvalidInputError(
            f"{sequence.name}: frames {start} to {start + count} asked for, it has {len(sequence)}; take a part of it"
        )
    return range(start, start + count)
