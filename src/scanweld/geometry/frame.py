"""One RGB-D frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Bool, Float32, UInt8
from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True)
class Frame:
    """Registered depth and colour at one moment. It holds no pose: poses are what is estimated.

    Attributes
    ----------
    timestamp_s : time [s]
    depth_m : (H, W) float32, distance along the optical axis [m]; 0 is invalid
    color : (H, W, 3) uint8 RGB, or None
    camera : intrinsics of both images
    """

    timestamp_s: float
    depth_m: Float32
    color: UInt8 | None
    camera: PinholeCamera

    def __post_init__(self) -> None:
        if self.depth_m.dtype != np.float32:
            raise InvalidInputError(f"frame: depth_m must be float32 [m], got {self.depth_m.dtype}")
        if self.depth_m.shape != self.camera.shape:
            raise InvalidInputError(f"frame: depth has shape {self.depth_m.shape}, the camera {self.camera.shape}")
        # Kernels test masks, never NaN. A NaN reaches both ends, so one comparison finds every kind.
        low, high = float(self.depth_m.min()), float(self.depth_m.max())
        if not (low >= 0 and high < np.inf):
            raise InvalidInputError(
                f"frame: depth_m must be finite and not negative, got {low} to {high} m; set invalid pixels to 0"
            )
        if self.color is not None and (self.color.shape != (*self.camera.shape, 3) or self.color.dtype != np.uint8):
            raise InvalidInputError(
                f"frame: color must be (H, W, 3) uint8 of the size of the depth {self.camera.shape}, "
                f"got {self.color.shape} {self.color.dtype}"
            )

    def without(self, mask: Bool) -> Frame:
        """Return the frame without depth where `mask` (H, W) bool is true: such pixels are not tracked and not mapped.

        Raises
        ------
        InvalidInputError
            When the mask is not boolean or not of the depth's size.
        """
        if mask.shape != self.depth_m.shape or mask.dtype != np.bool_:
            raise InvalidInputError(
                f"frame: expected a bool mask of the depth's shape {self.depth_m.shape}, got {mask.shape} {mask.dtype}"
            )
        return replace(self, depth_m=np.where(mask, np.float32(0), self.depth_m))
