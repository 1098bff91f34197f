"""The operations on the map by compiled kernels, over all threads; see :class:`~.backends.MapBackend`."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scanweld.arrays import Float32, Float64, Int32, Int64, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import intrinsics_array
from scanweld.mapping import kernels
from scanweld.mapping.backends.arrays import DepthBuffers, IndexMap, Measurement
from scanweld.mapping.storage.kernels import PAGE, ROWS
from scanweld.mapping.storage.pages import PagePool
from scanweld.parallel import get_num_threads, run_ranges


def index_map(
    pages: PagePool,
    slots: Int32,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float,
    buffers: DepthBuffers,
) -> IndexMap:
    """Find the nearest surfel at each pixel."""
    # More than four buffers cost more to clear and merge than their threads gain.
    parts = _even_shares(pages.counts[slots], min(get_num_threads(), 4))
    depths = buffers.take(max(1, len(parts)), camera.shape)
    landed = np.empty(len(slots) * PAGE, np.int32)
    transform, intrinsics = se3.inverse(T_world_camera)[:3].astype(np.float32), intrinsics_array(camera)
    stable = np.float32(stable_confidence)

    def splat(first: int, last: int) -> None:
        for part in range(first, last):
            start, stop = parts[part]
            kernels.splat_pages(
                start, stop, slots, pages.counts, pages.pool, transform, intrinsics, stable, camera.width,
                camera.height, landed, depths[part].reshape(-1),
            )  # fmt: skip

    run_ranges(len(parts), splat)
    numbers = np.empty(camera.shape, np.int32)
    run_ranges(camera.height, lambda start, stop: kernels.resolve(start, stop, depths, numbers))
    buffers.give_back(depths)
    flat, places, won = numbers.reshape(-1), np.empty(len(landed), np.uint8), np.empty(len(slots), np.int32)
    run_ranges(
        len(slots),
        lambda start, stop: kernels.list_winners(start, stop, slots, pages.counts, flat, landed, places, won),
    )
    return IndexMap(numbers, slots, won, places, landed)


def _even_shares(counts: Int32, parts: int) -> list[tuple[int, int]]:
    """Split the pages into contiguous ranges with about equally many surfels."""
    if len(counts) == 0:
        return []
    total = np.cumsum(counts)
    bounds = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts, side="left") + 1
    bounds = np.unique(np.concatenate([[0], np.minimum(bounds, len(counts)), [len(counts)]]))
    return list(pairwise(bounds.tolist()))


def _room(seen: IndexMap) -> tuple[Int64, Int32, Float32]:
    """Return what a view is written to: offsets (P + 1,), the row at which the surfels of each page begin, rows
    (H, W), -1 so far, and values (8, N), undefined so far; see the kernel `show_pages`."""
    offsets = np.concatenate([[0], np.cumsum(seen.won, dtype=np.int64)])
    return offsets, np.full(seen.numbers.shape, -1, np.int32), np.empty((8, int(offsets[-1])), np.float32)


def show(pages: PagePool, seen: IndexMap) -> tuple[Int32, Float32]:
    """Return the view of an index map."""
    offsets, rows, values = _room(seen)
    flat, pool = rows.reshape(-1), pages.pool

    def body(start: int, stop: int) -> None:
        kernels.show_pages(start, stop, seen.slots, seen.places, seen.pixels, seen.won, offsets, pool, flat, values)

    run_ranges(len(seen.slots), body)
    return rows, values


def merge(pages: PagePool, seen: IndexMap, frame: Measurement, limits: Float32) -> tuple[UInt8, Int32, Float32]:
    """Merge the surfels that are seen with what their pixels measure, in place."""
    camera, transform = frame.camera, frame.T_world_camera[:3].astype(np.float32)
    merged = np.zeros(camera.shape, np.uint8)
    offsets, rows, values = _room(seen)

    def body(start: int, stop: int) -> None:
        kernels.merge_pages(
            start, stop, seen.slots, pages.counts, seen.places, seen.pixels, seen.won, offsets,
            frame.surface.reshape(-1), frame.color.reshape(-1), frame.weights.reshape(-1), transform, limits,
            camera.width, camera.height, frame.frame_id, pages.pool, pages.whole, pages.dirty, merged.reshape(-1),
            rows.reshape(-1), values,
        )  # fmt: skip

    run_ranges(len(seen.slots), body)
    return merged, rows, values


def new_surfels(
    rows: Int32, values: Float32, merged: UInt8, frame: Measurement, limits: Float32, anchor: int
) -> Float32:
    """Make surfels of the pixels whose measurement is not in the map."""
    camera, surface, transform = frame.camera, frame.surface, frame.T_world_camera[:3].astype(np.float32)
    intrinsics = intrinsics_array(camera)
    pending, counts = np.empty(camera.shape, np.int32), np.empty(camera.height, np.int32)

    def cover(start: int, stop: int) -> None:
        kernels.cover_rows(
            start, stop, rows, values, merged, surface.reshape(-1), frame.moving, transform, intrinsics, limits,
            pending, counts,
        )  # fmt: skip

    run_ranges(camera.height, cover)
    firsts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    surfels = np.empty((ROWS, int(firsts[-1])), np.float32)
    whole = surfels.view(np.int32)

    def make(start: int, stop: int) -> None:
        kernels.new_surfels(
            start, stop, pending, counts, firsts, surface, frame.color, frame.weights, transform, frame.frame_id,
            anchor, surfels, whole,
        )  # fmt: skip

    run_ranges(camera.height, make)
    return surfels
