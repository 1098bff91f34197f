"""What the checks of stages look at: some frames of a rendered room, small, with true poses and without noise."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np

from scanweld.arrays import Float64
from scanweld.datasets.synthetic.sequence import RenderConfig, SyntheticSequence
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.geometry.views import ModelView

CAMERA = PinholeCamera(131.25, 131.25, 79.5, 59.5, 160, 120)

ELSEWHERE = se3.exp([40.0, -25.0, 10.0, 0.3, -0.5, 0.2])
"""Moves a place so far that no camera sees both it and where it was."""


@lru_cache(maxsize=2)
def _sequence(scene: str) -> SyntheticSequence:
    return SyntheticSequence(RenderConfig(scene=scene, width=CAMERA.width, height=CAMERA.height))


@lru_cache(maxsize=64)
def _surfaces(scene: str, index: int) -> SurfacePyramid:
    return build_pyramid(_sequence(scene).read(index))


def room(index: int) -> SurfacePyramid:
    """Frame `index` of a walk through a furnished room; 2 cm and half a degree lie between two of them."""
    return copy.deepcopy(_surfaces("room", index))  # what is under test may change it


def room_pose(index: int) -> Float64:
    """T_world_camera of that frame; the world is that of the room, not that of a camera."""
    pose: Float64 = _sequence("room").ground_truth.T_world_camera[index]
    return pose


def corridor() -> SurfacePyramid:
    """A frame of another building."""
    return copy.deepcopy(_surfaces("corridor", 0))


def dark() -> SurfacePyramid:
    """A frame without depth, as with a hand before the sensor."""
    frame = room(0).frame
    return build_pyramid(replace(frame, depth_m=np.zeros_like(frame.depth_m)))


def wall(distance_m: float = 1.5) -> SurfacePyramid:
    """A blank wall that the camera looks at squarely."""
    depth_m = np.full(CAMERA.shape, distance_m, np.float32)
    return build_pyramid(Frame(0.0, depth_m, np.full((*CAMERA.shape, 3), 128, np.uint8), CAMERA))


def as_map(pyramid: SurfacePyramid, T_world_camera: Float64) -> ModelView:
    """Return the view of a map that holds exactly what a frame shows, each pixel a stable surfel."""
    level = pyramid.levels[0]
    valid = level.surface[..., 6] > 0
    index_map = np.full(valid.shape, -1, np.int32)
    index_map[valid] = np.arange(np.count_nonzero(valid))
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3:]
    positions_m = (R @ level.vertices_m[valid].T + t).astype(np.float32)
    normals = (R @ level.normals[valid].T).astype(np.float32)
    grey = None if pyramid.grey is None else pyramid.grey[valid]
    confidences = np.full(len(normals.T), 10, np.float32)
    return ModelView(T_world_camera, level.camera, positions_m, normals, confidences, index_map, 3.0, grey)
