"""A mesh as a camera would see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float32, Float64, Int32, UInt8, as_transform
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import intrinsics_array
from scanweld.geometry.mesh import TriangleMesh
from scanweld.meshing.rendering import kernels
from scanweld.parallel import run_ranges

NEAR_M = 0.01
"""Triangles nearer than this are not drawn."""


@dataclass(frozen=True, slots=True)
class MeshView:
    """What a camera sees of a mesh.

    Attributes
    ----------
    camera, T_world_camera : who sees it
    depth_m : (H, W) float32, 0 where there is no surface [m]
    triangle : (H, W) int32, row of the triangle, -1 for none
    normals : (H, W, 3) float32, world frame, 0 where there is none
    color : (H, W, 3) uint8, white where there is no surface, grey where the mesh has no colours
    """

    camera: PinholeCamera
    T_world_camera: Float64
    depth_m: Float32
    triangle: Int32
    normals: Float32
    color: UInt8

    def shaded(self) -> UInt8:
        """Return a picture (H, W, 3) of the shape, lit from a place above and to the left of the camera.

        Surfaces that are seen from behind are blue.
        """
        rays = self.camera.rays() @ self.T_world_camera[:3, :3].T
        lamp = rays + self.T_world_camera[:3, :3] @ [0.25, 0.35, 0.0]
        towards = -np.einsum("hwd,hwd->hw", self.normals, rays / np.linalg.norm(rays, axis=-1, keepdims=True))
        lit = -np.einsum("hwd,hwd->hw", self.normals, lamp / np.linalg.norm(lamp, axis=-1, keepdims=True))
        light = 0.25 + 0.75 * np.abs(lit)[..., None]
        tint = np.where((towards < 0)[..., None], np.array([90.0, 110.0, 170.0]), 230.0)
        image: Float64 = np.where((self.triangle >= 0)[..., None], tint * light, 255.0)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def render_mesh(mesh: TriangleMesh, T_world_camera: npt.ArrayLike, camera: PinholeCamera) -> MeshView:
    """Draw a mesh from a pose (4, 4), with a depth buffer; both sides of triangles are seen.

    Raises
    ------
    InvalidInputError
        When the pose is no rigid transform.
    """
    T = as_transform(T_world_camera, "T_world_camera")
    points = se3.transform_points(se3.inverse(T), mesh.vertices_m).astype(np.float32)
    depth, hit = np.full(camera.shape, np.inf, np.float32), np.full(camera.shape, -1, np.int32)
    shares = np.zeros((*camera.shape, 2), np.float32)
    intrinsics = intrinsics_array(camera)

    def draw(start: int, stop: int) -> None:
        kernels.draw_triangles(start, stop, points, mesh.triangles, intrinsics, np.float32(NEAR_M), depth, hit, shares)

    run_ranges(camera.height, draw, grain=32)
    seen = hit >= 0
    corners = mesh.triangles[hit[seen]]
    second, third = shares[seen].T
    weights = np.stack([1 - second - third, second, third], axis=1)
    normals, color = np.zeros((*camera.shape, 3), np.float32), np.full((*camera.shape, 3), 255, np.uint8)
    vertex_normals = mesh.normals if mesh.normals is not None else mesh.with_normals().normals
    assert vertex_normals is not None
    mixed = np.einsum("nk,nkd->nd", weights, vertex_normals[corners])
    normals[seen] = mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-9)
    if mesh.colors is None:
        color[seen] = 180
    else:
        color[seen] = np.clip(np.rint(np.einsum("nk,nkd->nd", weights, mesh.colors[corners])), 0, 255)
    return MeshView(camera, T, np.where(seen, depth, np.float32(0)), hit, normals, color)
