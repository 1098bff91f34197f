"""The map seen from a pose: an index map for tracking and fusion, and pictures for people."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from scanweld.arrays import Float32, Float64, Int32, Int64, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import intrinsics_array
from scanweld.geometry.views import ModelView
from scanweld.mapping import kernels
from scanweld.mapping.storage.kernels import PAGE
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import get_num_threads, run_ranges

FARTHEST_M = 2000.0
"""Micrometres up to here fit the depth buffer's keys."""

NEAREST_M = 0.01
"""What is nearer than this is not drawn."""

VIEW_MARGIN_PIXELS = 64.0
"""Surfels this far outside the image are kept for a camera that moves a little."""


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


class DepthBuffers:
    """Depth buffers, one a thread, that are kept from frame to frame: to clear new ones costs a millisecond."""

    def __init__(self) -> None:
        self._buffers: Int64 = np.empty((0, 0, 0), np.int64)

    def take(self, count: int, shape: tuple[int, int]) -> Int64:
        """Return empty buffers (count, H, W); whoever takes them gives them back empty."""
        buffers, self._buffers = self._buffers, np.empty((0, 0, 0), np.int64)
        if buffers.shape != (count, *shape):
            buffers = np.full((count, *shape), kernels.EMPTY, np.int64)
        return buffers

    def give_back(self, buffers: Int64) -> None:
        """Keep empty buffers for the next time."""
        self._buffers = buffers


@dataclass(frozen=True, slots=True)
class IndexMap:
    """Which surfel is seen at each pixel from a pose, and which surfels of each page are seen.

    Attributes
    ----------
    numbers : (H, W) int32, number of the surfel, -1 where there is none
    slots : (P,) int32, the pages that were looked at
    won : (P,) int32, how many surfels of each are seen; those of page s are from s * PAGE on in the next two
    places : (P * PAGE,) uint8, where they are in their page
    pixels : (P * PAGE,) int32, where they are seen, row-major
    """

    numbers: Int32
    slots: Int32
    won: Int32
    places: UInt8
    pixels: Int32

    def room(self) -> tuple[Int64, Int32, Float32]:
        """Return what a view is written to: offsets (P + 1,), the row at which the surfels of each page begin, rows
        (H, W), -1 so far, and values (8, N), undefined so far; see the kernel `show_pages`."""
        offsets = np.concatenate([[0], np.cumsum(self.won, dtype=np.int64)])
        return offsets, np.full(self.numbers.shape, -1, np.int32), np.empty((8, int(offsets[-1])), np.float32)


def render_index_map(
    surfels: SurfelMap,
    candidates: Int32,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float,
    depth_buffers: DepthBuffers | None = None,
) -> IndexMap:
    """Splat each surfel of the candidate pages into one pixel, the nearest wins, stable ones before specks."""
    depth_buffers = depth_buffers or DepthBuffers()
    pages = surfels.pages
    # More than four buffers cost more to clear and merge than their threads gain.
    parts = _even_shares(pages.counts[candidates], min(get_num_threads(), 4))
    buffers = depth_buffers.take(max(1, len(parts)), camera.shape)
    landed = np.empty(len(candidates) * PAGE, np.int32)
    transform, intrinsics = _camera_arrays(T_world_camera, camera)
    stable = np.float32(stable_confidence)

    def splat(first: int, last: int) -> None:
        for part in range(first, last):
            start, stop = parts[part]
            kernels.splat_pages(
                start, stop, candidates, pages.counts, pages.pool, transform, intrinsics, stable,
                camera.width, camera.height, landed, buffers[part].reshape(-1),
            )  # fmt: skip

    run_ranges(len(parts), splat)
    numbers = np.empty(camera.shape, np.int32)
    run_ranges(camera.height, lambda start, stop: kernels.resolve(start, stop, buffers, numbers))
    depth_buffers.give_back(buffers)
    flat, places, won = numbers.reshape(-1), np.empty(len(landed), np.uint8), np.empty(len(candidates), np.int32)
    run_ranges(
        len(candidates),
        lambda start, stop: kernels.list_winners(start, stop, candidates, pages.counts, flat, landed, places, won),
    )
    return IndexMap(numbers, candidates, won, places, landed)


def _even_shares(counts: Int32, parts: int) -> list[tuple[int, int]]:
    """Split the pages into contiguous ranges with about equally many surfels."""
    if len(counts) == 0:
        return []
    total = np.cumsum(counts)
    bounds = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts, side="left") + 1
    bounds = np.unique(np.concatenate([[0], np.minimum(bounds, len(counts)), [len(counts)]]))
    return list(pairwise(bounds.tolist()))


def as_view(
    rows: Int32, values: Float32, T_world_camera: Float64, camera: PinholeCamera, stable_confidence: float
) -> ModelView:
    """Return rows (H, W) and values (8, N), see the kernel `show_page`, as a view."""
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
    offsets, rows, values = seen.room()
    flat, pool = rows.reshape(-1), surfels.pages.pool

    def show(start: int, stop: int) -> None:
        kernels.show_pages(start, stop, seen.slots, seen.places, seen.pixels, seen.won, offsets, pool, flat, values)

    run_ranges(len(seen.slots), show)
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
    for slots in pages.batches(pages.cull(frustum(T_world_camera, camera, VIEW_MARGIN_PIXELS, FARTHEST_M))):
        run_ranges(-(-camera.height // rows), partial(body, slots=slots))
    return Picture(depth, np.clip(np.rint(rgb), 0, 255).astype(np.uint8), normals)


def _camera_arrays(T_world_camera: Float64, camera: PinholeCamera) -> tuple[Float32, Float32]:
    return se3.inverse(T_world_camera)[:3].astype(np.float32), intrinsics_array(camera)
