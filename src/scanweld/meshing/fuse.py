"""From frames with poses to a mesh."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig, noise_scale
from scanweld.geometry.frame import Frame
from scanweld.geometry.mesh import TriangleMesh
from scanweld.meshing.cleaning import with_small_holes_filled, without_small_pieces
from scanweld.meshing.config import MeshConfig
from scanweld.meshing.extraction import extract_mesh
from scanweld.meshing.volume import SurfaceFrame, TsdfVolume

logger = logging.getLogger(__name__)

PosedFrame: TypeAlias = tuple[Frame | SurfaceFrame, npt.ArrayLike]

PIXELS_PER_VOXEL = 2.0
"""Default spacing of the grid, in pixels at the usual depth: finer is slower, coarser loses what was seen."""

SIGMAS_PER_VOXEL = 0.5
"""And at least so many standard deviations of the depth noise: finer shows noise, and tears surfaces where it is."""

NEW_TURN_RAD, NEW_SHIFT = np.radians(0.5), 0.005
"""A frame shows something new when the camera has turned by so much, or moved by such a share of the usual depth."""


def mesh_from_frames(frames: Iterable[PosedFrame], *, voxel_m: float, config: MeshConfig | None = None) -> TriangleMesh:
    """Fuse frames with their T_world_camera into a mesh.

    Parameters
    ----------
    frames : (frame, T_world_camera) pairs, read once and one at a time
    voxel_m : spacing of the grid [m]
    config : how; its own spacing is not used

    Raises
    ------
    InvalidInputError
        When no frame has a surface, or the grid would take more memory than it may.
    """
    volume = TsdfVolume(voxel_m, config)
    for frame, T_world_camera in frames:
        volume.integrate(frame, T_world_camera)
    return finished_mesh(volume)


def finished_mesh(volume: TsdfVolume) -> TriangleMesh:
    """Return the surface in a grid without crumbs, with small holes closed as configured, and with normals.

    Raises
    ------
    InvalidInputError
        When there is none.
    """
    config = volume.config
    whole = extract_mesh(volume)
    mesh = without_small_pieces(whole, config.least_component)
    if len(mesh) == 0 and len(whole):
        logger.warning("the mesh is all pieces of fewer than %d triangles; they are kept", config.least_component)
        mesh = whole
    if len(mesh) == 0:
        raise InvalidInputError("there is no surface to mesh: no frame has depth with normals within max_depth_m")
    return with_small_holes_filled(mesh, config.fill_holes_m).with_normals()


def voxel_for(frames: Iterable[Frame], surfaces: SurfaceConfig) -> float:
    """Return a spacing of the grid [m] that suits frames: PIXELS_PER_VOXEL at the median depth, or SIGMAS_PER_VOXEL of
    the depth noise there where that is more.

    Raises
    ------
    InvalidInputError
        When no frame has depth.
    """
    frames = list(frames)
    z = median_depth_m(frames, surfaces.max_depth_m)
    focal = min(min(frame.camera.fx, frame.camera.fy) for frame in frames)
    scale = float(np.median([noise_scale(frame.depth_m, surfaces) for frame in frames]))
    floor, growth, nearest = surfaces.noise.tolist()
    sigma = scale * (floor + growth * (z - nearest) ** 2)
    return float(f"{max(PIXELS_PER_VOXEL * z / focal, SIGMAS_PER_VOXEL * sigma):.2g}")


def median_depth_m(frames: Iterable[Frame], max_depth_m: float) -> float:
    """Return the median of the frames' median depths [m], of what is not further away than a limit.

    Raises
    ------
    InvalidInputError
        When no frame has depth.
    """
    near = [frame.depth_m[(frame.depth_m > 0) & (frame.depth_m <= max_depth_m)] for frame in frames]
    medians = [float(np.median(depth)) for depth in near if len(depth)]
    if not medians:
        raise InvalidInputError(f"there is no depth up to {max_depth_m:g} m to mesh")
    return float(np.median(medians))


def frames_with_news(T_world_camera: Float64, usual_depth_m: float) -> Int64:
    """Return rows of poses (N, 4, 4) that differ from the last one returned: a camera that stands adds only time."""
    kept: list[int] = []
    for row, T in enumerate(T_world_camera):
        if kept:
            T_last_this = se3.inverse(T_world_camera[kept[-1]]) @ T
            turn = float(se3.rotation_angle_rad(T_last_this))
            if turn < NEW_TURN_RAD and np.linalg.norm(T_last_this[:3, 3]) < NEW_SHIFT * usual_depth_m:
                continue
        kept.append(row)
    return np.array(kept, np.int64)


Progress: TypeAlias = Callable[[int, int], None]
"""Called with the number of frames done and the number of all."""
