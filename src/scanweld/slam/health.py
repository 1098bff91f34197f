"""Whether a tracked pose is to be believed: not by one threshold, but by what is usual for this camera and this map."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import ClassVar

import numpy as np

from scanweld.arrays import Float64
from scanweld.config import check_ranges, setting
from scanweld.geometry import se3
from scanweld.registration.result import RegistrationResult
from scanweld.state import Stateful


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthConfig:
    """When an alignment is no longer believed although it has a pose."""

    window: int = setting(60, "tracked frames that tell what is usual; raise for steadier scenes", low=5)
    unusual: float = setting(
        6.0,
        "robust standard deviations from the usual residual or overlap that are a sign of being lost; lower to be "
        "suspicious sooner",
        low=1.0,
    )
    least_overlap: float = setting(
        0.2, "share of the map in view that a frame must match to be free of suspicion", low=0.0, high=1.0
    )
    leap: float = setting(
        4.0, "times the usual change of the motion from frame to frame that is a sign of being lost", low=1.0
    )
    signs: int = setting(2, "signs (residual, overlap, leap) that together mean LOST", low=1, high=3)

    def __post_init__(self) -> None:
        check_ranges(self)


_LEAST_FRAMES = 10  # before which nothing is usual yet
_NEAR_M, _NEAR_RAD = 0.1, 0.1
_LEAST_SPREAD = 0.1  # of the median: a perfectly steady value is no reason to be alarmed by a small change
_LEAST_LEAP_M, _LEAST_LEAP_RAD = 0.03, 0.05  # per frame: less is no leap, however steady the camera was


class TrackingHealth(Stateful):
    """Keeps the distribution of what tracking reports, and looks for signs that it has slipped."""

    STATE: ClassVar = {"_rmse": deque[float], "_overlap": deque[float], "_leaps": deque[tuple[float, float]]}
    MADE = frozenset({"config"})

    def __init__(self, config: HealthConfig | None = None) -> None:
        self.config = config or HealthConfig()
        self._rmse: deque[float] = deque(maxlen=self.config.window)
        self._overlap: deque[float] = deque(maxlen=self.config.window)
        self._leaps: deque[tuple[float, float]] = deque(maxlen=self.config.window)

    def doubt(self, aligned: RegistrationResult, T_predicted: Float64) -> str:
        """Say why an alignment with a pose is not believed; "" when it is.

        Parameters
        ----------
        aligned : T_target_source is T_world_camera
        T_predicted : (4, 4), where the motion model expected the camera
        """
        if len(self._rmse) < _LEAST_FRAMES:
            return ""
        signs = []
        high = _limit(self._rmse, self.config.unusual)
        if aligned.rmse_m > high:
            signs.append(f"residual {aligned.rmse_m:.4f} m, usually below {high:.4f} m")
        low = _limit(self._overlap, -self.config.unusual)
        if aligned.overlap < max(low, self.config.least_overlap):
            signs.append(f"overlap {aligned.overlap:.0%}, usually above {max(low, self.config.least_overlap):.0%}")
        shift, turn = _leap(aligned.T_target_source, T_predicted)
        usual_shift, usual_turn = (median(leaps) for leaps in zip(*self._leaps, strict=True))
        if shift > max(self.config.leap * usual_shift, _LEAST_LEAP_M) or turn > max(
            self.config.leap * usual_turn, _LEAST_LEAP_RAD
        ):
            signs.append(f"{shift:.3f} m and {np.rad2deg(turn):.1f} degrees from where the motion was going")
        return "; ".join(signs) if len(signs) >= self.config.signs else ""

    def observe(self, aligned: RegistrationResult, T_predicted: Float64) -> None:
        """Take in an alignment that was believed."""
        self._rmse.append(aligned.rmse_m)
        self._overlap.append(aligned.overlap)
        self._leaps.append(_leap(aligned.T_target_source, T_predicted))


def is_near(T_world_camera: Float64, T_predicted: Float64) -> bool:
    """Whether a pose is where it was expected, give or take a hand's breadth."""
    shift, turn = _leap(T_world_camera, T_predicted)
    return shift < _NEAR_M and turn < _NEAR_RAD


def _leap(T: Float64, T_predicted: Float64) -> tuple[float, float]:
    motion = se3.inverse(T_predicted) @ T
    return float(np.linalg.norm(motion[:3, 3])), float(se3.rotation_angle_rad(motion))


def _limit(values: deque[float], deviations: float) -> float:
    """Return the median plus so many robust standard deviations."""
    middle = median(values)
    spread = max(1.4826 * median(abs(value - middle) for value in values), _LEAST_SPREAD * middle)
    return middle + deviations * spread
