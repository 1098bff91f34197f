"""Trajectories, and what happened to each frame on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_transforms
from scanweld.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Camera poses over time.

    Attributes
    ----------
    timestamps_s : (N,) float64, strictly increasing [s]
    T_world_camera : (N, 4, 4) float64

    Raises
    ------
    InvalidInputError
        When the shapes do not match, a value is not finite, a rotation is not one, or time does not increase.
    """

    timestamps_s: Float64
    T_world_camera: Float64

    def __post_init__(self) -> None:
        times, poses = np.array(self.timestamps_s, np.float64), np.array(self.T_world_camera, np.float64)
        if times.ndim != 1 or poses.shape != (len(times), 4, 4):
            raise InvalidInputError(
                f"trajectory: expected timestamps (N,) and poses (N, 4, 4), got {times.shape} and {poses.shape}"
            )
        if not np.isfinite(times).all():
            raise InvalidInputError("trajectory: a timestamp is not finite")
        if (np.diff(times) <= 0).any():
            at = int(np.argmax(np.diff(times) <= 0)) + 1
            raise InvalidInputError(
                f"trajectory: timestamps must increase strictly, row {at} has {times[at]:.6f} after {times[at - 1]:.6f}"
            )
        poses = as_transforms(poses, "trajectory: pose")
        times.flags.writeable = poses.flags.writeable = False
        object.__setattr__(self, "timestamps_s", times)
        object.__setattr__(self, "T_world_camera", poses)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @property
    def positions_m(self) -> Float64:
        """Camera centres (N, 3) in the world frame [m]."""
        return self.T_world_camera[:, :3, 3]

    @property
    def path_length_m(self) -> float:
        """Sum of the distances between consecutive camera centres [m]."""
        return float(np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1).sum())

    def subset(self, selection: npt.ArrayLike | slice) -> Trajectory:
        """Return the trajectory of the selected rows."""
        chosen = selection if isinstance(selection, slice) else np.asarray(selection)
        if not isinstance(chosen, slice) and chosen.size == 0:
            chosen = chosen.astype(np.intp)  # an empty list is an array of floats
        return Trajectory(self.timestamps_s[chosen], self.T_world_camera[chosen])


class FrameState(Enum):
    """What became of a frame."""

    TRACKING = "tracking"
    LOST = "lost"  # its pose is the motion model's; it was not fused
    RELOCALISED = "relocalised"
    UNREADABLE = "unreadable"  # it could not be decoded; its pose is interpolated
    DROPPED = "dropped"  # it was not looked at, to keep pace with the recording; its pose is interpolated


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameResult:
    """What happened to one frame, and why. All counts and errors are those of the last tracking iteration.

    Attributes
    ----------
    index : position in the run, from 0
    timestamp_s : [s]
    state : see :class:`FrameState`
    status : the aligner's status in lower case, "" where no alignment ran
    T_world_camera : (4, 4), in the world of its submap
    rmse_m : root mean square point-to-plane distance of the inliers [m]
    loss : mean robust loss of the matched points at the last iteration, in units of the noise (dimensionless)
    num_inliers : matched points with a residual below the robust threshold
    overlap : matched points over all points of the map that were tracked against, 0..1
    num_surfels : size of the map after the frame
    stage_ms : wall time by stage [ms]
    note : one line for a person when the state is not TRACKING or the status not "converged", else ""
    submap : the map that the frame is in; what was never joined with the main one is in a world of its own
    """

    index: int
    timestamp_s: float
    state: FrameState
    T_world_camera: Float64
    status: str = ""
    rmse_m: float = 0.0
    loss: float = 0.0
    num_inliers: int = 0
    overlap: float = 0.0
    num_surfels: int = 0
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    submap: int = 0
