"""What a gyroscope adds to the motion model: where the camera has turned to since it was last seen.

A constant velocity knows nothing of a jerk; a gyroscope measures it. It takes the place of the predicted rotation, and
no more: the depth still decides where the camera is. Its bias is the mean of what it says beyond what is tracked. A
gyroscope that is wrong (other axes, another clock, stuck) is told by its own errors: it is asked only while these are
smaller than those of the motion model.
"""

from __future__ import annotations

from collections import deque
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_transform
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.state import Stateful

_WINDOW = 30  # frames that tell how good it is
_LEAST_FRAMES = 5  # before which nothing is known of it
_SMALL_RAD = 0.005  # an error that does no harm, however good the motion model is
_BIAS_FRAMES = 100  # over which the bias is averaged
_MOST_BIAS_RAD_S = 0.2  # far more than sensors have: a steady turn that is measured wrongly must not pass for a bias


def as_rotation(rotation: npt.ArrayLike, name: str) -> Float64:
    """Return a rotation (3, 3) float64, checked and re-orthonormalised; raises InvalidInputError."""
    R = np.asarray(rotation, np.float64)
    if R.shape != (3, 3):
        raise InvalidInputError(f"{name}: expected shape (3, 3), got {R.shape}")
    T = np.eye(4)
    T[:3, :3] = R
    return as_transform(T, name)[:3, :3]


class RotationAid(Stateful):
    """Follows a gyroscope's orientation, its bias and its errors."""

    STATE: ClassVar = {
        "bias_rad_s": Float64, "_num_compared": int, "_errors_rad": deque[tuple[float, float]],
        "_last": tuple[float, Float64] | None, "_turned": Float64, "_seen": tuple[float, Float64, Float64] | None,
        "_R_model": Float64,
    }  # fmt: skip

    def __init__(self) -> None:
        self.bias_rad_s: Float64 = np.zeros(3)
        self._num_compared = 0
        self._errors_rad: deque[tuple[float, float]] = deque(maxlen=_WINDOW)  # of the gyroscope, of the motion model
        self._last: tuple[float, Float64] | None = None  # time and orientation, as they were given
        self._turned: Float64 = np.eye(3)  # the orientation without bias, in a reference of its own
        self._seen: tuple[float, Float64, Float64] | None = None  # time, R_world_camera, and what `_turned` was then
        self._R_model: Float64 = np.eye(3)

    @property
    def trusted(self) -> bool:
        """Whether it has been better than the motion model of late, or good enough."""
        if len(self._errors_rad) < _LEAST_FRAMES:
            return False
        mine, model = np.mean(np.array(self._errors_rad), axis=0)  # not the median: it is the jerks that count
        return bool(mine <= max(model, _SMALL_RAD))

    def predict(self, timestamp_s: float, T_model: Float64, orientation: Float64 | None) -> Float64:
        """Return the pose (4, 4) of the motion model with the rotation that was measured, where that is trusted.

        `orientation` : R_reference_camera (3, 3) at this time; None where it was not measured.
        """
        self._R_model = T_model[:3, :3]
        if orientation is None:
            self._last = self._seen = None
            return T_model
        if self._last is not None:
            step = self._last[1].T @ orientation
            self._turned = self._turned @ step @ se3.exp_so3(-self.bias_rad_s * (timestamp_s - self._last[0]))
        self._last = timestamp_s, orientation
        return self.turn(T_model)

    def turn(self, T_world_camera: Float64) -> Float64:
        """Return a pose (4, 4) turned to where the camera looks now; as it is where nothing trusted says so."""
        measured = self._measured()
        if measured is None or not self.trusted:
            return T_world_camera
        T = T_world_camera.copy()
        T[:3, :3] = measured
        return T

    def observe(self, timestamp_s: float, T_world_camera: Float64, *, surely: bool) -> None:
        """Take in a measured pose; one that is not sure teaches nothing about the gyroscope."""
        R, measured = T_world_camera[:3, :3], self._measured()
        if measured is not None and self._seen is not None and surely:
            error = se3.log_so3(R.T @ measured)
            self._errors_rad.append((float(np.linalg.norm(error)), float(se3.rotation_angle_rad(R.T @ self._R_model))))
            self._num_compared += 1
            rate = error / (timestamp_s - self._seen[0])
            bias = self.bias_rad_s + rate / min(self._num_compared, _BIAS_FRAMES)
            self.bias_rad_s = np.clip(bias, -_MOST_BIAS_RAD_S, _MOST_BIAS_RAD_S)
        self._seen = None if self._last is None else (timestamp_s, R, self._turned)

    def move(self, T_new_old: Float64) -> None:
        """Take over that the world around the camera has moved (4, 4)."""
        if self._seen is not None:
            self._seen = self._seen[0], T_new_old[:3, :3] @ self._seen[1], self._seen[2]

    def forget(self) -> None:
        """Go on in another world."""
        self._seen = None

    def _measured(self) -> Float64 | None:
        """R_world_camera (3, 3) now, by the gyroscope and where the camera was last seen."""
        if self._seen is None:
            return None
        return np.asarray(self._seen[1] @ self._seen[2].T @ self._turned)
