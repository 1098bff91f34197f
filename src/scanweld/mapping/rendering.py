"""The map seen from a pose: an index map for tracking and fusion, and pictures for people."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from scanweld.arrays import Float32, Float64, Int32, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import intrinsics_array
from scanweld.geometry.views import ModelView
from scanweld.mapping import kernels
from scanweld.mapping.backends import backend
from scanweld.mapping.backends.arrays import FARTHEST_M, NEAREST_M, DepthBuffers, IndexMap
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import run_ranges

VIEW_MARGIN_PIXELS = 1.0
"""Surfels this far outside the image are looked at: they are rounded to pixels."""

DISC_MARGIN_PIXELS = 64.0
"""Discs this far outside the image may reach into it."""


def frustum(T_world_camera: Float64, camera: PinholeCamera, margin_pixels: float, far_m: float) -> Float64:
    """Return the planes (6, 4) around what a camera sees, in the world: n . x + d >= 0 is inside."""
    left, right = -margin_pixels - camera.cx, camera.width + margin_pixels - camera.cx
    top, bottom = -margin_pixels - camera.cy, camera.height + margin_pixels - camera.cy
    fx, fy = camera.fx, camera.fy
    planes = np.array([
        [fx, 0, -left, 0], [-fx, 0, right, 0], [0, fy, -top, 0], [0, -fy, bottom, 0], [0, 0, 1, -NEAREST_M],
        [0, 0, -1, far_m],
    ])  # fmt: skip
    return np.asarray(planes @ se3.inverse(T_world_camera))


def find_candidates(
    surfels: SurfelMap,
    T_world_camera: Float64,
    camera: PinholeCamera,
    *,
    margin_pixels: float = VIEW_MARGIN_PIXELS,
    far_m: float = FARTHEST_M,
) -> Int32:
    """List the pages that may hold surfels in the image or within a margin of it, as slots (P,)."""
    return surfels.pages_in(frustum(T_world_camera, camera, margin_pixels, far_m))


def render_index_map(
    surfels: SurfelMap,
    candidates: Int32,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float,
    depth_buffers: DepthBuffers | None = None,
) -> IndexMap:
    """Splat each surfel of the candidate pages into one pixel, the nearest wins, stable ones before specks."""
    return backend().index_map(
        surfels.pages, candidates, T_world_camera, camera, stable_confidence, depth_buffers or DepthBuffers()
    )


def as_view(
    rows: Int32, values: Float32, T_world_camera: Float64, camera: PinholeCamera, stable_confidence: float
) -> ModelView:
    """Return rows (H, W) and values (8, N), see :class:`~.backends.MapBackend`, as a view."""
    return ModelView(T_world_camera, camera, values[0:3], values[3:6], values[6], rows, stable_confidence, values[7])


def render_model_view(
    surfels: SurfelMap,
    candidates: Int32,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float = 0.0,
    depth_buffers: DepthBuffers | None = None,
) -> ModelView:
    """Return the visible surfels, one at most per pixel."""
    seen = render_index_map(surfels, candidates, T_world_camera, camera, stable_confidence, depth_buffers)
    rows, values = backend().show(surfels.pages, seen)
    return as_view(rows, values, T_world_camera, camera, stable_confidence)


BACKGROUND = 216
"""Grey of a picture where nothing was mapped: white objects stand out from it, and so do black ones."""


@dataclass(frozen=True, slots=True)
class Picture:
    """The map as a person sees it: depth (H, W) float32 [m], inf where empty; color (H, W, 3) uint8; normals
    (H, W, 3) float32, world frame, 0 where empty."""

    depth_m: Float32
    color: UInt8
    normals: Float32

    def normal_colors(self, T_world_camera: Float64, background: int = BACKGROUND) -> UInt8:
        """Normals in the camera frame as colours (H, W, 3): x, -y, -z from -1..1 to 0..255."""
        seen = np.isfinite(self.depth_m)
        in_camera = self.normals @ T_world_camera[:3, :3].astype(np.float32)
        colors = np.clip(np.rint((in_camera * np.array([1, -1, -1], np.float32) + 1) * 127.5), 0, 255)
        colors[~seen] = background
        return np.asarray(colors, dtype=np.uint8)


def render_picture(
    surfels: SurfelMap,
    T_world_camera: Float64,
    camera: PinholeCamera,
    *,
    min_confidence: float = 0.0,
    background: int = BACKGROUND,
) -> Picture:
    """Draw the surfels as discs, nearest on top."""
    pages = surfels.pages
    depth = np.full(camera.shape, np.inf, np.float32)
    rgb = np.full((*camera.shape, 3), background, np.float32)
    normals = np.zeros((*camera.shape, 3), np.float32)
    transform, intrinsics = _camera_arrays(T_world_camera, camera)
    rows, least = 60, np.float32(min_confidence)

    def body(start: int, stop: int, slots: Int32) -> None:
        kernels.splat_discs(
            start, stop, slots, pages.counts, pages.pool, least, transform, intrinsics, rows, depth, rgb, normals
        )

    # Part by part: all of a map may be in view, and more than fits in memory.
    for slots in pages.batches(pages.cull(frustum(T_world_camera, camera, DISC_MARGIN_PIXELS, FARTHEST_M))):
        run_ranges(-(-camera.height // rows), partial(body, slots=slots))
    return Picture(depth, np.clip(np.rint(rgb), 0, 255).astype(np.uint8), normals)


def _camera_arrays(T_world_camera: Float64, camera: PinholeCamera) -> tuple[Float32, Float32]:
    return se3.inverse(T_world_camera)[:3].astype(np.float32), intrinsics_array(camera)
