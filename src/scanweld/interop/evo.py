"""evo (https://github.com/MichaelGrupp/evo): trajectories."""

from __future__ import annotations

from typing import Any

import numpy as np

from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.interop import imported
from scanweld.trajectory import Trajectory


def to_evo(trajectory: Trajectory) -> Any:
    """Return an `evo.core.trajectory.PoseTrajectory3D`; its quaternions are w x y z, its poses T_world_camera.

    Raises
    ------
    MissingDependencyError
        When evo is not installed.
    """
    evo = imported("evo.core.trajectory", "evo")
    xyzw = se3.quaternion_xyzw_from_rotation(trajectory.T_world_camera[:, :3, :3])
    return evo.PoseTrajectory3D(
        positions_xyz=trajectory.positions_m.copy(),
        orientations_quat_wxyz=np.roll(xyzw, 1, axis=1),
        timestamps=trajectory.timestamps_s.copy(),
    )


def from_evo(trajectory: Any) -> Trajectory:
    """Return the poses of a PoseTrajectory3D.

    Raises
    ------
    InvalidInputError
        When it has no timestamps (a PosePath3D), or they do not increase.
    """
    if not hasattr(trajectory, "timestamps"):
        raise InvalidInputError("the path of evo has no timestamps; PoseTrajectory3D has")
    poses = np.array([np.asarray(pose) for pose in trajectory.poses_se3]).reshape(-1, 4, 4)
    return Trajectory(np.asarray(trajectory.timestamps, np.float64), poses)
