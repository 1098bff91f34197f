"""The map seen from a pose: an index map for tracking and fusion, and pictures for people."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scanweld.arrays import Float32, Float64, Int32, Int64, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import intrinsics_array
from scanweld.geometry.views import ModelView
from scanweld.mapping import kernels
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import get_num_threads, run_ranges

FARTHEST_M = 2000.0
"""Micrometres up to here fit the depth buffer's keys."""

VIEW_MARGIN_PIXELS = 64.0
"""Surfels this far outside the image are kept for a camera that moves a little."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """Surfels that a camera may see, listed chunk by chunk.

    ids (chunks * CHUNK,) int32 of which chunk c uses the first counts[c] from c * CHUNK on.
    """

    ids: Int32
    counts: Int64


def find_candidates(
    surfels: SurfelMap,
    T_world_camera: Float64,
    camera: PinholeCamera,
    *,
    margin_pixels: float = VIEW_MARGIN_PIXELS,
    far_m: float = FARTHEST_M,
) -> Candidates:
    """List the surfels that project into the image or within a margin of it."""
    count = len(surfels)
    chunks = -(-count // kernels.CHUNK)
    ids, counts = np.empty(chunks * kernels.CHUNK, np.int32), np.zeros(chunks, np.int64)
    transform, intrinsics = _camera_arrays(T_world_camera, camera)
    positions = surfels.arrays.positions
    margin, far = np.float32(margin_pixels), np.float32(far_m)

    def body(start: int, stop: int) -> None:
        kernels.cull(
            start,
            stop,
            positions,
            count,
            transform,
            intrinsics,
            camera.width,
            camera.height,
            margin,
            far,
            ids,
            counts,
        )

    run_ranges(chunks, body)
    return Candidates(ids, counts)


def render_index_map(
    surfels: SurfelMap,
    candidates: Candidates,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float,
) -> tuple[Int32, Int64]:
    """Splat each candidate into one pixel, the nearest wins, stable ones before specks within the noise.

    Returns the index map (H, W) int32, -1 where empty, and how many pixels of each row are filled (H,).
    """
    chunks = len(candidates.counts)
    # More than four buffers cost more to clear and merge than their threads gain.
    parts = _even_shares(candidates.counts, min(get_num_threads(), 4)) if chunks else []
    buffers = np.full((max(1, len(parts)), *camera.shape), kernels.EMPTY, np.int64)
    transform, intrinsics = _camera_arrays(T_world_camera, camera)
    arrays, stable = surfels.arrays, np.float32(stable_confidence)

    def splat(first: int, last: int) -> None:
        for part in range(first, last):
            start, stop = parts[part]
            kernels.splat(
                start, stop, arrays.positions, arrays.normals, arrays.confidences, candidates.ids, candidates.counts,
                transform, intrinsics, stable, buffers[part],
            )  # fmt: skip

    run_ranges(len(parts), splat)
    index_map, row_counts = np.empty(camera.shape, np.int32), np.empty(camera.height, np.int64)
    run_ranges(camera.height, lambda start, stop: kernels.resolve(start, stop, buffers, index_map, row_counts))
    return index_map, row_counts


def _even_shares(counts: Int64, parts: int) -> list[tuple[int, int]]:
    """Split the chunks into contiguous ranges with about equally many candidates: those in view lie close together."""
    total = np.cumsum(counts)
    bounds = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts, side="left") + 1
    bounds = np.unique(np.concatenate([[0], np.minimum(bounds, len(counts)), [len(counts)]]))
    return list(pairwise(bounds.tolist()))


def render_model_view(
    surfels: SurfelMap,
    candidates: Candidates,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float = 0.0,
    *,
    intensities: bool = True,
) -> ModelView:
    """Return the visible surfels, one at most per pixel, in row-major order of the pixels."""
    index_map, row_counts = render_index_map(surfels, candidates, T_world_camera, camera, stable_confidence)
    offsets = np.concatenate([[0], np.cumsum(row_counts)])
    total = int(offsets[-1])
    positions, normals = np.empty((3, total), np.float32), np.empty((3, total), np.float32)
    confidences = np.empty(total, np.float32)
    grey = np.empty(total if intensities else 0, np.float32)
    arrays = surfels.arrays

    def body(start: int, stop: int) -> None:
        kernels.gather_view(
            start, stop, index_map, offsets, arrays.positions, arrays.normals, arrays.confidences,
            positions, normals, confidences,
        )  # fmt: skip
        if intensities:
            kernels.gather_intensities(start, stop, index_map, offsets, arrays.colors, grey)

    run_ranges(camera.height, body)
    return ModelView(
        T_world_camera, camera, positions, normals, confidences, index_map, stable_confidence,
        grey if intensities else None,
    )  # fmt: skip


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
    candidates = find_candidates(surfels, T_world_camera, camera)
    listed = [
        candidates.ids[c * kernels.CHUNK : c * kernels.CHUNK + count] for c, count in enumerate(candidates.counts)
    ]
    order = np.concatenate(listed) if listed else np.zeros(0, np.int32)
    order = np.ascontiguousarray(order[surfels.confidences[order] >= min_confidence])
    depth = np.full(camera.shape, np.inf, np.float32)
    rgb = np.full((*camera.shape, 3), background, np.float32)
    normals = np.zeros((*camera.shape, 3), np.float32)
    transform, intrinsics = _camera_arrays(T_world_camera, camera)
    arrays = surfels.arrays
    rows = 60

    def body(start: int, stop: int) -> None:
        kernels.splat_discs(
            start, stop, arrays.positions, arrays.normals, arrays.colors, arrays.radii, order,
            transform, intrinsics, rows, depth, rgb, normals,
        )  # fmt: skip

    run_ranges(-(-camera.height // rows), body)
    return Picture(depth, np.clip(np.rint(rgb), 0, 255).astype(np.uint8), normals)


def _camera_arrays(T_world_camera: Float64, camera: PinholeCamera) -> tuple[Float32, Float32]:
    return se3.inverse(T_world_camera)[:3].astype(np.float32), intrinsics_array(camera)
