"""Where the camera is expected next, and where it was while nobody saw it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.trajectory import FrameResult, FrameState, Trajectory

POSED = (FrameState.TRACKING, FrameState.RELOCALISED)
"""States whose pose was measured."""


CARRIED = 3.0
"""Times the speed before a loss: a camera that is found further away was moved in another way than before."""

FARTHEST_AHEAD = 4.0
"""A motion is carried on for at most so many times as long as it was seen: beyond that it is a guess about a guess.

It also bounds the harm of two timestamps that are too near to each other, as recorders write them: 33 ms of motion
within 0.5 ms would be carried on a hundredfold.
"""


class ConstantVelocity:
    """Predicts that the camera goes on as it last moved; without measurements it slows down and stops."""

    def __init__(self, decay: float = 0.8) -> None:
        self.decay = decay
        self._T_world_camera: Float64 = np.eye(4)
        self._timestamp_s: float | None = None
        self._velocity: Float64 = np.zeros(6)  # twist per second, in the camera's own frame
        self._seen_velocity = self._velocity  # before misses slowed it down
        self._seen_for_s = 0.0  # how long the motion was that the velocity comes from
        self._measured: tuple[float, Float64] | None = None  # when and where the camera was last seen

    def predict(self, timestamp_s: float) -> Float64:
        """Return T_world_camera (4, 4) at a time."""
        if self._timestamp_s is None:
            return self._T_world_camera.copy()
        elapsed = min(timestamp_s - self._timestamp_s, FARTHEST_AHEAD * self._seen_for_s)
        return np.asarray(self._T_world_camera @ se3.exp(self._velocity * elapsed))

    def observe(self, timestamp_s: float, T_world_camera: Float64, *, partly: bool = False) -> None:
        """Take in a measured pose.

        One that is `partly` this model's own guess would only confirm that: the velocity stays what it was.
        """
        if self._measured is not None and timestamp_s > self._measured[0] and not partly:
            # From measurement to measurement: what misses were guessed in between is no motion of the camera.
            step = se3.inverse(self._measured[1]) @ T_world_camera
            self._seen_for_s = timestamp_s - self._measured[0]
            self._velocity = self._seen_velocity = se3.log(step) / self._seen_for_s
        self._measured = timestamp_s, T_world_camera
        self._T_world_camera, self._timestamp_s = T_world_camera, timestamp_s

    def move(self, T_new_old: Float64) -> None:
        """Take over that the world around the camera has moved (4, 4)."""
        self._T_world_camera = T_new_old @ self._T_world_camera
        if self._measured is not None:
            self._measured = self._measured[0], T_new_old @ self._measured[1]

    def carried(self, timestamp_s: float, T_world_camera: Float64) -> bool:
        """Whether a camera that is found here was carried off while nobody looked: it never moved so fast before."""
        if self._measured is None or timestamp_s <= self._measured[0]:
            return False
        motion = se3.log(se3.inverse(self._measured[1]) @ T_world_camera) / (timestamp_s - self._measured[0])
        return any(
            float(np.linalg.norm(motion[part])) > CARRIED * float(np.linalg.norm(self._seen_velocity[part]))
            for part in (slice(3), slice(3, 6))
        )

    def forget(self) -> None:
        """Expect a camera that stands still: how it came to where it is was not seen."""
        self._velocity = np.zeros(6)
        self._measured = None

    def miss(self, timestamp_s: float) -> Float64:
        """Go on without a measurement, slower each time; returns T_world_camera (4, 4)."""
        T_world_camera = self.predict(timestamp_s)
        self._T_world_camera, self._timestamp_s = T_world_camera, timestamp_s
        self._velocity = self._velocity * self.decay
        return T_world_camera


def trajectory_of(results: Sequence[FrameResult], *, tracked_only: bool = False) -> Trajectory:
    """Return one pose per frame; unmeasured poses between two measured ones are interpolated in time.

    With `tracked_only` the unmeasured frames are left out.
    """
    if tracked_only:
        results = [result for result in results if result.state in POSED]
    times = np.array([result.timestamp_s for result in results], np.float64)
    poses = np.array([result.T_world_camera for result in results], np.float64).reshape(-1, 4, 4)
    measured = np.array([k for k, result in enumerate(results) if result.state in POSED], np.int64)
    for before, after in pairwise(measured):
        if after - before > 1:
            inner = slice(before + 1, after)
            fraction = (times[inner] - times[before]) / (times[after] - times[before])
            poses[inner] = se3.interpolate(poses[before], poses[after], fraction)
    return Trajectory(times, poses)
