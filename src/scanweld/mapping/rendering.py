"""The map seen from a pose: an index map for tracking and fusion, and pictures for people."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from scanweld.arrays import Float32, Float64, Int32, Int64, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import intrinsics_array
from scanweld.geometry.views import ModelRows, ModelView
from scanweld.mapping import kernels
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
    """Which surfel is seen at each pixel from a pose.

    Attributes
    ----------
    numbers : (H, W) int32, number of the surfel, -1 where there is none
    row_counts : (H,) int64, filled pixels of each row
    slots : (P,) int32, the pages that were looked at
    landed : (P * PAGE,) int32, the pixel of each of their surfels, -1 for none
    """

    numbers: Int32
    row_counts: Int64
    slots: Int32
    landed: Int32


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
    landed = np.empty(len(candidates) * kernels.PAGE, np.int32)
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
    numbers, row_counts = np.empty(camera.shape, np.int32), np.empty(camera.height, np.int64)
    run_ranges(camera.height, lambda start, stop: kernels.resolve(start, stop, buffers, numbers, row_counts))
    depth_buffers.give_back(buffers)
    return IndexMap(numbers, row_counts, candidates, landed)


def shade(surfels: SurfelMap, seen: IndexMap) -> Float32:
    """Return the model image (H, W, 8): position, normal, confidence and luminance, undefined where none is seen."""
    pages, image = surfels.pages, np.empty((*seen.numbers.shape, 8), np.float32)
    numbers, flat = seen.numbers.reshape(-1), image.reshape(-1)

    def body(start: int, stop: int) -> None:
        kernels.shade_pages(start, stop, seen.slots, pages.counts, seen.landed, numbers, pages.pool, flat)

    run_ranges(len(seen.slots), body)
    return image


def _even_shares(counts: Int32, parts: int) -> list[tuple[int, int]]:
    """Split the pages into contiguous ranges with about equally many surfels."""
    if len(counts) == 0:
        return []
    total = np.cumsum(counts)
    bounds = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts, side="left") + 1
    bounds = np.unique(np.concatenate([[0], np.minimum(bounds, len(counts)), [len(counts)]]))
    return list(pairwise(bounds.tolist()))


class SurfelView(ModelView):
    """The map seen from a pose, as a model image; rows are taken from it when they are asked for."""

    def __init__(
        self,
        T_world_camera: Float64,
        camera: PinholeCamera,
        seen: IndexMap,
        image: Float32,
        stable_confidence: float,
    ) -> None:
        self.T_world_camera, self.camera, self.stable_confidence = T_world_camera, camera, stable_confidence
        self.seen, self.image, self.index_map = seen, image, seen.numbers
        self._offsets = np.concatenate([[0], np.cumsum(seen.row_counts)])

    def __len__(self) -> int:
        return int(self._offsets[-1])

    @cached_property
    def pixels(self) -> Int32:
        """(N,) int32, row-major pixels of the rows."""
        pixels = np.empty(len(self), np.int32)

        def body(start: int, stop: int) -> None:
            kernels.list_pixels(start, stop, self.index_map, self._offsets, pixels)

        run_ranges(self.camera.height, body)
        return pixels

    @cached_property
    def positions_m(self) -> Float32:  # type: ignore[override]
        """(3, N) float32, world frame [m]."""
        return np.ascontiguousarray(self._values[:, 0:3].T)

    @cached_property
    def normals(self) -> Float32:  # type: ignore[override]
        """(3, N) float32, world frame, unit."""
        return np.ascontiguousarray(self._values[:, 3:6].T)

    @cached_property
    def confidences(self) -> Float32:  # type: ignore[override]
        """(N,) float32."""
        return np.take(self.image[..., 6].reshape(-1), self.pixels)

    @cached_property
    def intensities(self) -> Float32:  # type: ignore[override]
        """(N,) float32, luminance 0..255 (ITU-R BT.601)."""
        return np.take(self.image[..., 7].reshape(-1), self.pixels)

    def take(self, rows: Int64) -> ModelRows:
        """Return some of the rows (M,), in the given order; the others are not read."""
        values = np.take(self.image.reshape(-1, 8), self.pixels[rows], axis=0).T.copy()
        return ModelRows(values[0:3], values[3:6], values[6], values[7])

    @cached_property
    def _values(self) -> Float32:
        return np.take(self.image.reshape(-1, 8), self.pixels, axis=0)


def render_model_view(
    surfels: SurfelMap,
    candidates: Int32,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float = 0.0,
    depth_buffers: DepthBuffers | None = None,
) -> SurfelView:
    """Return the visible surfels, one at most per pixel, in row-major order of the pixels."""
    seen = render_index_map(surfels, candidates, T_world_camera, camera, stable_confidence, depth_buffers)
    return SurfelView(T_world_camera, camera, seen, shade(surfels, seen), stable_confidence)


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
    candidates, pages = find_candidates(surfels, T_world_camera, camera), surfels.pages
    depth = np.full(camera.shape, np.inf, np.float32)
    rgb = np.full((*camera.shape, 3), background, np.float32)
    normals = np.zeros((*camera.shape, 3), np.float32)
    transform, intrinsics = _camera_arrays(T_world_camera, camera)
    rows, least = 60, np.float32(min_confidence)

    def body(start: int, stop: int) -> None:
        kernels.splat_discs(
            start, stop, candidates, pages.counts, pages.pool, least, transform, intrinsics, rows, depth, rgb, normals
        )

    run_ranges(-(-camera.height // rows), body)
    return Picture(depth, np.clip(np.rint(rgb), 0, 255).astype(np.uint8), normals)


def _camera_arrays(T_world_camera: Float64, camera: PinholeCamera) -> tuple[Float32, Float32]:
    return se3.inverse(T_world_camera)[:3].astype(np.float32), intrinsics_array(camera)
