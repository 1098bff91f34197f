"""What the operations on the map take and return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.geometry.camera import PinholeCamera
from scanweld.mapping.kernels import EMPTY
from scanweld.mapping.storage.kernels import PAGE

FARTHEST_M = 2000.0
"""Micrometres up to here fit the depth buffer's keys."""

NEAREST_M = 0.01
"""What is nearer than this is not drawn."""


class DepthBuffers:
    """Depth buffers, one a thread, that are kept from frame to frame: to clear new ones costs a millisecond."""

    def __init__(self) -> None:
        self._buffers: Int64 = np.empty((0, 0, 0), np.int64)

    def take(self, count: int, shape: tuple[int, int]) -> Int64:
        """Return empty buffers (count, H, W); whoever takes them gives them back empty."""
        buffers, self._buffers = self._buffers, np.empty((0, 0, 0), np.int64)
        if buffers.shape != (count, *shape):
            buffers = np.full((count, *shape), EMPTY, np.int64)
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

    def winners(self) -> tuple[Int64, Int32]:
        """Return the numbers (N,) of the surfels that are seen, page by page, and their pixels (N,)."""
        listed = np.arange(PAGE) < self.won[:, None]
        first = np.repeat(self.slots.astype(np.int64), self.won) * PAGE
        return first + self.places.reshape(-1, PAGE)[listed], self.pixels.reshape(-1, PAGE)[listed]


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a frame measures at its pixels.

    Attributes
    ----------
    T_world_camera : (4, 4)
    camera : its intrinsics
    surface : (H, W, 8) float32, see `SurfaceLevel.surface`
    color : (H, W, 3) uint8
    weights : (H, W) float32; negative where something moves, which adds nothing to the map
    moving : (H, W) bool, or of another height where nothing moves
    frame_id : number of the frame
    """

    T_world_camera: Float64
    camera: PinholeCamera
    surface: Float32
    color: UInt8
    weights: Float32
    moving: Bool
    frame_id: int
