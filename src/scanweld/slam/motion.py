"""Where the camera is expected next, and where it was while nobody saw it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.registration.result import RegistrationResult
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult, FrameState, Trajectory

POSED = (FrameState.TRACKING, FrameState.RELOCALISED)
"""States whose pose was measured."""

UNSEEN = (FrameState.UNREADABLE, FrameState.DROPPED)
"""States of frames that nobody has looked at."""


CARRIED = 3.0
"""Times the speed before a loss: a camera that is found further away was moved in another way than before."""

FARTHEST_AHEAD = 4.0
"""A motion is carried on for at most so many times as long as it was seen: beyond that it is a guess about a guess.

It also bounds the harm of two timestamps that are too near to each other, as recorders write them: 33 ms of motion
within 0.5 ms would be carried on a hundredfold.
"""


FASTEST = 3.0
"""Standard deviation [m/s, rad/s] of the velocity of a camera of which nothing is known."""

FARTHEST_OFF = 0.5
"""Standard deviation [m, rad] of a predicted pose at most."""

SHORTEST_S = 0.02
"""Two frames are counted as at least so far apart: between stamps that are nearly equal nothing could change, and what
is seen would be taken for known already."""

STEADIEST = 0.02
"""The velocity of a camera that has stood still changes by so much [m/s, rad/s] in a second: it will be taken up."""


class ConstantVelocity(Stateful):
    """Predicts that the camera goes on as it moved: a Kalman filter that takes its noises from the track itself.

    The state is the pose, perturbed in the camera's own frame, T <- T exp(x), and the velocity, which changes at random
    from frame to frame (:class:`Unsteadiness`). What a measurement leaves free is as sure as the camera moved evenly
    before, and no surer; without any measurement the camera slows down and stops. While poses are measured in full the
    last step says best where the next one begins, and the filter's smoother velocity waits for when they are not.
    """

    STATE: ClassVar = {
        "_T_world_camera": Float64, "_timestamp_s": float | None, "_velocity": Float64, "_covariance": Float64,
        "_seen_velocity": Float64, "_seen_for_s": float, "_measured": tuple[float, Float64] | None, "_in_full": bool,
        "_weighed": tuple[Float64, Float64, Float64] | None, "_unsteadiness": Stateful,
    }  # fmt: skip
    MADE = frozenset({"decay"})

    def __init__(self, decay: float = 0.8) -> None:
        self.decay = decay
        self._T_world_camera: Float64 = np.eye(4)
        self._timestamp_s: float | None = None
        self._velocity: Float64 = np.zeros(6)  # twist per second
        self._covariance = _covariance(np.zeros(6), np.full(6, FASTEST**2))
        self._unsteadiness = Unsteadiness()
        self._seen_velocity = self._velocity  # from one measured pose to the next
        self._seen_for_s = 0.0  # how long that motion was
        self._measured: tuple[float, Float64] | None = None  # when and where the camera was last seen
        self._in_full = False  # whether the last frame was measured, and left nothing free
        # A weighed pose, the change of the state that it is, and the covariance afterwards.
        self._weighed: tuple[Float64, Float64, Float64] | None = None

    def predict(self, timestamp_s: float) -> Float64:
        """Return T_world_camera (4, 4) at a time."""
        if self._measured is None or not self._in_full:
            return self._filtered(timestamp_s)
        return np.asarray(self._measured[1] @ se3.exp(self._seen_velocity * self._ahead_s(timestamp_s)))

    def weigh(
        self, timestamp_s: float, aligned: RegistrationResult, rotation: Float64 | None = None
    ) -> RegistrationResult:
        """Complete an alignment by what the motion knows better: all of what is free, a part of what is weakly held.

        `aligned` : T_target_source is T_world_camera, `information` belongs to its left perturbation. `rotation` is
        R_world_camera (3, 3) where something better than this model predicted it. :meth:`observe` knows the answer.
        """
        if not aligned.unobservable:
            return aligned
        predicted, covariance = self._filtered(timestamp_s), self._covariance_at(timestamp_s)
        if rotation is not None:
            predicted[:3, :3] = rotation
        to_world = se3.adjoint(aligned.T_target_source)
        information = to_world.T @ aligned.information @ to_world
        innovation = se3.log(se3.inverse(predicted) @ aligned.T_target_source)
        # (P + R)^-1 from an information R^-1 that may be singular; the trace counts what it knows.
        inverse = np.linalg.solve(np.eye(6) + information @ covariance[:6, :6], information)
        known = max(1.0, float(np.trace(inverse @ covariance[:6, :6])))
        # A camera that moves otherwise than expected along what is seen does so along what is not.
        covariance = covariance * max(1.0, float(innovation @ inverse @ innovation) / known)
        gain = covariance[:, :6] @ np.linalg.solve(np.eye(6) + information @ covariance[:6, :6], information)
        change = gain @ innovation
        answer = predicted @ se3.exp(change[:6])
        self._weighed = answer, change, covariance - gain @ covariance[:6]
        return replace(aligned, T_target_source=answer)

    def observe(self, timestamp_s: float, T_world_camera: Float64, *, partly: bool = False) -> None:
        """Take in a measured pose.

        One that is `partly` this model's own guess would only confirm that: it counts as what :meth:`weigh` made of it.
        """
        before, self._measured = self._measured, (timestamp_s, T_world_camera)
        missed = before is None or self._timestamp_s != before[0]
        elapsed_s = 0.0 if before is None else timestamp_s - before[0]
        if partly:
            if self._weighed is not None and np.array_equal(self._weighed[0], T_world_camera):
                self._velocity = self._velocity + self._weighed[1][6:]
                self._covariance = self._weighed[2]
            self._T_world_camera = T_world_camera
            self._unsteadiness.interrupt()
        elif before is None or elapsed_s <= 0:
            self._restart(T_world_camera, self._velocity, FASTEST**2)
        else:
            step = se3.log(se3.inverse(before[1]) @ T_world_camera)
            if missed:
                # From measurement to measurement: what misses were guessed in between is no motion of the camera.
                self._seen_velocity = step / elapsed_s
                self._restart(T_world_camera, self._seen_velocity, 2 * self._unsteadiness.jitter / elapsed_s**2)
            else:
                self._correct(timestamp_s, T_world_camera)
                # Where motions were free before, the step has their errors of many frames in it.
                self._seen_velocity = step / elapsed_s if self._in_full else self._velocity
            if self._in_full or missed:
                self._unsteadiness.observe(step, elapsed_s)
        if elapsed_s > 0:
            self._seen_for_s = elapsed_s
        self._timestamp_s, self._in_full, self._weighed = timestamp_s, not partly, None

    def _restart(self, T_world_camera: Float64, velocity: Float64, variance: Float64 | float) -> None:
        """Begin anew with a measured pose and a velocity of some variance."""
        self._T_world_camera, self._velocity = T_world_camera, velocity
        self._covariance = _covariance(self._unsteadiness.jitter, np.full(6, variance))
        self._unsteadiness.interrupt()

    def _correct(self, timestamp_s: float, T_world_camera: Float64) -> None:
        """Correct the state by a pose that is measured in full."""
        predicted, covariance = self._filtered(timestamp_s), self._covariance_at(timestamp_s)
        jitter = np.diag(self._unsteadiness.jitter)
        gain = np.linalg.solve(covariance[:6, :6] + jitter, covariance[:6]).T
        change = gain @ se3.log(se3.inverse(predicted) @ T_world_camera)
        self._T_world_camera = predicted @ se3.exp(change[:6])
        self._velocity = self._velocity + change[6:]
        self._covariance = covariance - gain @ covariance[:6]

    def _filtered(self, timestamp_s: float) -> Float64:
        return np.asarray(self._T_world_camera @ se3.exp(self._velocity * self._ahead_s(timestamp_s)))

    def _ahead_s(self, timestamp_s: float) -> float:
        """How far ahead of the last frame the motion is carried on [s]."""
        if self._timestamp_s is None:
            return 0.0
        return min(timestamp_s - self._timestamp_s, FARTHEST_AHEAD * self._seen_for_s)

    def _covariance_at(self, timestamp_s: float) -> Float64:
        """Return the covariance (12, 12) of the prediction: the velocity changes, then the pose follows it."""
        elapsed_s = SHORTEST_S if self._timestamp_s is None else max(timestamp_s - self._timestamp_s, SHORTEST_S)
        covariance = self._covariance + _covariance(np.zeros(6), self._unsteadiness.change(elapsed_s))
        follow = np.eye(12)
        follow[:6, 6:] = elapsed_s * np.eye(6)
        covariance = follow @ covariance @ follow.T
        # However long nothing was seen: what is known of the free directions must not drown what is seen of the others.
        most = np.repeat([FARTHEST_OFF**2, FASTEST**2], 6)
        scale = np.sqrt(np.minimum(1.0, most / np.maximum(np.diag(covariance), 1e-12)))
        return np.asarray(covariance * np.outer(scale, scale))

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
        self._velocity, self._in_full = np.zeros(6), False
        self._covariance = _covariance(np.zeros(6), np.full(6, FASTEST**2))
        self._measured = self._weighed = None
        self._seen_velocity, self._seen_for_s = np.zeros(6), 0.0
        self._unsteadiness.interrupt()

    def miss(self, timestamp_s: float) -> Float64:
        """Go on without a measurement, slower each time; returns T_world_camera (4, 4)."""
        T_world_camera = self.predict(timestamp_s)
        self._covariance = self._covariance_at(timestamp_s)
        self._velocity = (self._seen_velocity if self._in_full else self._velocity) * self.decay
        self._T_world_camera, self._timestamp_s = T_world_camera, timestamp_s
        self._in_full, self._weighed = False, None
        return T_world_camera


class Unsteadiness(Stateful):
    """How unevenly a camera moves, and how much its measured poses jitter, from the track of the last seconds.

    A step differs from the one before by a change of the velocity and by the jitter of three poses, d = c + n0 - 2 n1 +
    n2: its variance is var(c) + 6 var(n), and the covariance with the next one -4 var(n). Both for translations and
    for rotations, each alike along all axes.
    """

    WINDOW = 60
    """Steps that are remembered."""

    LEAST = 10
    """Fewer tell nothing yet."""

    STATE: ClassVar = {
        "_differences": deque[tuple[float, Float64, Float64 | None]],
        "_last": tuple[float, Float64, Float64 | None] | None,
    }

    def __init__(self) -> None:
        self._differences: deque[tuple[float, Float64, Float64 | None]] = deque(maxlen=self.WINDOW)
        self._last: tuple[float, Float64, Float64 | None] | None = None  # time, step, difference

    def observe(self, step: Float64, elapsed_s: float) -> None:
        """Take in the motion (6,) from one measured pose to the next."""
        difference = None
        if self._last is not None:
            difference = step - self._last[1] * (elapsed_s / self._last[0])
            self._differences.append((elapsed_s, difference, self._last[2]))
        self._last = elapsed_s, step, difference

    def interrupt(self) -> None:
        """The next step does not follow the last one."""
        self._last = None

    @property
    def jitter(self) -> Float64:
        """Variances (6,) of a measured pose [m^2, rad^2]."""
        return self._variances()[1]

    def change(self, elapsed_s: float) -> Float64:
        """Return the variances (6,) of the change of the velocity in a time [m^2/s^2, rad^2/s^2]."""
        return self._variances()[0] * elapsed_s

    def _variances(self) -> tuple[Float64, Float64]:
        if len(self._differences) < self.LEAST:
            return np.full(6, FASTEST**2), np.zeros(6)
        times, differences = np.array([d[0] for d in self._differences]), np.array([d[1] for d in self._differences])
        pairs = np.array([d[1] * d[2] for d in self._differences if d[2] is not None]).reshape(-1, 6)
        variance = _alike(differences**2)
        jitter = np.clip(-_alike(pairs) / 4, 0, variance / 6) if len(pairs) else np.zeros(6)
        change = (variance - 6 * jitter) / np.mean(times) ** 3
        return np.maximum(change, STEADIEST**2), np.asarray(jitter)


def _alike(squares: Float64) -> Float64:
    """Return the mean (6,) of rows (N, 6), the same for the three translations and for the three rotations."""
    return np.repeat([squares[:, :3].mean(), squares[:, 3:].mean()], 3)


def _covariance(of_pose: Float64, of_velocity: Float64) -> Float64:
    return np.diag(np.concatenate([of_pose, of_velocity]))


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
