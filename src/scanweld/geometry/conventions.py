"""Pose conventions of other programs, as converters with names.

Here a camera has x right, y down, z forward, and a pose `T_world_camera` (..., 4, 4) maps points from it to the world.
The world of a run has the axes of its first camera. Others differ in two ways, which are two questions.

What axes has the camera?

    x right, y down, z forward     scanweld, OpenCV, ROS "optical frames", COLMAP, TUM, Open3D
    x right, y up, z backward      OpenGL, Blender, glTF, ARKit, NeRF
    x forward, y left, z up        ROS body (REP 103)

From where to where?

    camera -> world                scanweld, ROS, TUM, KITTI, Redwood, NeRF's and Blender's "camera to world"
    world -> camera                Open3D's "extrinsic", COLMAP, OpenGL's "view matrix"

:func:`change_camera` answers the first by a matrix of this module, :func:`to_extrinsic` and :func:`from_extrinsic` the
second. :func:`change_world` turns the world, for instance so that z is up. Each has its inverse, and both directions
of the usual pairs have names.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3


def _rotation(rows: list[list[int]]) -> Float64:
    T = np.eye(4)
    T[:3, :3] = rows
    T.flags.writeable = False
    return T


T_OPTICAL_OPENGL = _rotation([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
"""From x right, y up, z backward to x right, y down, z forward; its own inverse."""

T_OPTICAL_BODY = _rotation([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""From x forward, y left, z up (ROS, REP 103) to x right, y down, z forward (its "optical" frames)."""

T_BODY_OPTICAL = _rotation([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""The inverse: columns are x right, y down and z forward in a frame with x forward, y left, z up."""


def change_camera(T_world_camera: npt.ArrayLike, T_camera_new: npt.ArrayLike) -> Float64:
    """Return T_world_new (..., 4, 4): poses of the same camera with other axes (a mount, too: any rigid transform)."""
    return np.asarray(_poses(T_world_camera) @ np.asarray(T_camera_new, np.float64))


def change_world(T_world_camera: npt.ArrayLike, T_new_world: npt.ArrayLike) -> Float64:
    """Return T_new_camera (..., 4, 4): the same poses in a world with other axes or another origin.

    With T_BODY_OPTICAL the world of a run gets z up, x forward (as the first camera looked), y left; with
    T_OPTICAL_OPENGL y up.
    """
    return np.asarray(np.asarray(T_new_world, np.float64) @ _poses(T_world_camera))


def to_opengl(T_world_camera: npt.ArrayLike) -> Float64:
    """Return camera-to-world poses (..., 4, 4) of a camera with x right, y up, z backward; the world stays."""
    return change_camera(T_world_camera, T_OPTICAL_OPENGL)


def from_opengl(T_world_opengl: npt.ArrayLike) -> Float64:
    """Return T_world_camera (..., 4, 4) of poses as :func:`to_opengl` makes them."""
    return change_camera(T_world_opengl, T_OPTICAL_OPENGL)


def to_ros_body(T_world_camera: npt.ArrayLike) -> Float64:
    """Return poses (..., 4, 4) of the body with x forward, y left, z up in a world with z up (REP 103).

    Camera and world are both turned: a camera that stands upright and looks along x is the identity.
    """
    return change_world(change_camera(T_world_camera, T_OPTICAL_BODY), T_BODY_OPTICAL)


def from_ros_body(T_world_body: npt.ArrayLike) -> Float64:
    """Return T_world_camera (..., 4, 4) of poses as :func:`to_ros_body` makes them."""
    return change_world(change_camera(T_world_body, T_BODY_OPTICAL), T_OPTICAL_BODY)


def to_extrinsic(T_world_camera: npt.ArrayLike) -> Float64:
    """Return T_camera_world (..., 4, 4): Open3D's extrinsic, COLMAP's pose."""
    return se3.inverse(_poses(T_world_camera))


def from_extrinsic(T_camera_world: npt.ArrayLike) -> Float64:
    """Return T_world_camera (..., 4, 4) of world-to-camera matrices."""
    return se3.inverse(_poses(T_camera_world))


def to_opengl_view(T_world_camera: npt.ArrayLike) -> Float64:
    """Return OpenGL's view matrices (..., 4, 4): from the world to a camera with x right, y up, z backward."""
    return se3.inverse(to_opengl(T_world_camera))


def from_opengl_view(view: npt.ArrayLike) -> Float64:
    """Return T_world_camera (..., 4, 4) of OpenGL's view matrices, written as they multiply columns from the left."""
    return from_opengl(se3.inverse(_poses(view)))


def _poses(T: npt.ArrayLike) -> Float64:
    poses = np.asarray(T, np.float64)
    if poses.shape[-2:] != (4, 4):
        raise InvalidInputError(f"poses: expected shape (..., 4, 4), got {poses.shape}")
    return poses
