"""Open3D: clouds, meshes, cameras, RGB-D images and trajectories.

Open3D's pixels, its camera axes and its metres are ours; its extrinsics are world-to-camera
(:func:`scanweld.geometry.conventions.to_extrinsic`), its colours are fractions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Array, as_colors
from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.conventions import from_extrinsic, to_extrinsic
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.frame import Frame
from scanweld.geometry.mesh import TriangleMesh
from scanweld.geometry.point_cloud import PointCloud
from scanweld.interop import imported
from scanweld.io.columns import HasColumns, cloud_from_columns
from scanweld.trajectory import Trajectory

EXTRA = "open3d"


def to_open3d(thing: PointCloud | TriangleMesh | PinholeCamera | Frame | HasColumns) -> Any:
    """Return Open3D's counterpart.

    =====================  ==================================================================
    PointCloud, SurfelMap  `geometry.PointCloud` with normals and colours (a 2-D cloud has z = 0)
    TriangleMesh           `geometry.TriangleMesh` with vertex normals and colours
    PinholeCamera          `camera.PinholeCameraIntrinsic`
    Frame                  `geometry.RGBDImage`, depth as float32 in metres, colour as uint8
    =====================  ==================================================================

    A Frame without colour gets a grey one: Open3D knows no RGB-D image without.

    Raises
    ------
    MissingDependencyError
        When Open3D is not installed.
    InvalidInputError
        When there is no counterpart.
    """
    o3d = imported("open3d", EXTRA)
    if isinstance(thing, PinholeCamera):
        c = thing
        return o3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
    if isinstance(thing, Frame):
        color = thing.color if thing.color is not None else np.full((*thing.depth_m.shape, 3), 160, np.uint8)
        image = o3d.geometry.RGBDImage()
        image.color = o3d.geometry.Image(np.ascontiguousarray(color))
        image.depth = o3d.geometry.Image(np.ascontiguousarray(thing.depth_m))
        return image
    vectors = o3d.utility.Vector3dVector
    if isinstance(thing, TriangleMesh):
        mesh = o3d.geometry.TriangleMesh()
        mesh.vertices = vectors(thing.vertices_m.astype(np.float64))
        mesh.triangles = o3d.utility.Vector3iVector(thing.triangles)
        if thing.normals is not None:
            mesh.vertex_normals = vectors(thing.normals.astype(np.float64))
        if thing.colors is not None:
            mesh.vertex_colors = vectors(thing.colors / 255.0)
        return mesh
    cloud = _cloud_of(thing)
    made = o3d.geometry.PointCloud()
    made.points = vectors(_three(cloud.points_m))
    if cloud.normals is not None:
        made.normals = vectors(_three(cloud.normals))
    if cloud.colors is not None:
        made.colors = vectors(cloud.colors / 255.0)
    return made


def from_open3d(
    thing: Any, *, camera: PinholeCamera | None = None, timestamp_s: float = 0.0, depth_scale: float = 1.0
) -> PointCloud | TriangleMesh | PinholeCamera | Frame | Trajectory:
    """Return our counterpart of a cloud, mesh, intrinsic, RGB-D image or trajectory of Open3D, legacy or tensor.

    Parameters
    ----------
    thing : told by the attributes it has
    camera : intrinsics of an RGB-D image, which has none itself
    timestamp_s : time of an RGB-D image [s]
    depth_scale : units per metre of its depth

    Raises
    ------
    InvalidInputError
        When there is no counterpart, or an RGB-D image comes without camera.
    """
    if hasattr(thing, "intrinsic_matrix"):
        (fx, _, cx), (_, fy, cy), _ = np.asarray(thing.intrinsic_matrix).tolist()
        return PinholeCamera(fx, fy, cx, cy, int(thing.width), int(thing.height))
    if hasattr(thing, "depth") and hasattr(thing, "color"):
        return _frame(thing, camera, timestamp_s, depth_scale)
    if hasattr(thing, "parameters"):
        return trajectory_from_open3d(thing)
    if hasattr(thing, "to_legacy"):
        thing = thing.to_legacy()
    if hasattr(thing, "triangles") and hasattr(thing, "vertices"):
        normals, colors = np.asarray(thing.vertex_normals), np.asarray(thing.vertex_colors)
        return TriangleMesh(
            np.asarray(thing.vertices, np.float32),
            np.asarray(thing.triangles, np.int32),
            normals.astype(np.float32) if len(normals) else None,
            as_colors(colors) if len(colors) else None,
        )
    if hasattr(thing, "points"):
        return as_cloud(thing)
    raise InvalidInputError(f"{type(thing).__name__}: has no counterpart here; clouds, meshes, cameras and images have")


def trajectory_to_open3d(trajectory: Trajectory, camera: PinholeCamera) -> Any:
    """Return a `camera.PinholeCameraTrajectory`; timestamps are not kept.

    Raises
    ------
    MissingDependencyError
        When Open3D is not installed.
    """
    o3d = imported("open3d", EXTRA)
    parameters = []
    for extrinsic in to_extrinsic(trajectory.T_world_camera):
        one = o3d.camera.PinholeCameraParameters()
        one.intrinsic, one.extrinsic = to_open3d(camera), extrinsic
        parameters.append(one)
    made = o3d.camera.PinholeCameraTrajectory()
    made.parameters = parameters
    return made


def trajectory_from_open3d(trajectory: Any, *, frames_per_second: float = 30.0) -> Trajectory:
    """Return the poses of a `camera.PinholeCameraTrajectory`, which has no times, at a steady rate."""
    extrinsics = np.array([np.asarray(one.extrinsic) for one in trajectory.parameters]).reshape(-1, 4, 4)
    return Trajectory(np.arange(len(extrinsics)) / frames_per_second, from_extrinsic(extrinsics))


def _frame(image: Any, camera: PinholeCamera | None, timestamp_s: float, depth_scale: float) -> Frame:
    if camera is None:
        raise InvalidInputError("an RGB-D image of Open3D has no intrinsics: give camera=")
    if not depth_scale > 0:
        raise InvalidInputError(f"depth_scale: expected units per metre, got {depth_scale}")
    depth = _pixels(image.depth)
    depth_m = (depth.reshape(depth.shape[:2]) / np.float32(depth_scale)).astype(np.float32)
    color = _pixels(image.color)
    if color.ndim == 2 or color.shape[-1] == 1:  # convert_rgb_to_intensity, Open3D's default
        color = np.repeat(color.reshape(*color.shape[:2], 1), 3, axis=2)
    if color.dtype != np.uint8:
        color = np.clip(np.rint(color * 255), 0, 255).astype(np.uint8)
    valid = np.isfinite(depth_m) & (depth_m > 0)
    return Frame(timestamp_s, np.where(valid, depth_m, np.float32(0)), np.ascontiguousarray(color), camera)


def _pixels(image: Any) -> Array:
    if hasattr(image, "as_tensor"):
        image = image.as_tensor().cpu().numpy()
    return np.asarray(image)


def _cloud_of(thing: Any) -> PointCloud:
    if isinstance(thing, PointCloud) or not hasattr(thing, "columns"):
        return as_cloud(thing)
    return cloud_from_columns(Path("map"), thing.columns())


def _three(values: Array) -> Array:
    """Return points (N, 3); 2-D ones get z = 0."""
    return values if values.shape[1] == 3 else np.column_stack([values, np.zeros(len(values))])
