"""Pinhole camera.

x right, y down, z forward. An integer pixel coordinate is a pixel centre, so the image spans
[-0.5, width - 0.5) x [-0.5, height - 0.5). Arrays are (H, W); pixels are (u, v).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Float32, Float64
from scanweld.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """Intrinsics in pixels: u = fx x / z + cx, v = fy y / z + cy.

    Raises
    ------
    InvalidInputError
        When a focal length or a size is not positive, or a value is not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if not np.isfinite(values).all():
            raise InvalidInputError(f"camera: intrinsics must be finite, got {values}")
        if self.fx <= 0 or self.fy <= 0:
            hint = " (ICL-NUIM files print fy = -480: negate it, its images are upright)" if self.fy < 0 else ""
            raise InvalidInputError(f"camera: focal lengths must be positive, got {self.fx}, {self.fy}{hint}")
        if self.width < 1 or self.height < 1:
            raise InvalidInputError(f"camera: expected a size of at least 1x1, got {self.width}x{self.height}")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image array."""
        return self.height, self.width

    @property
    def matrix(self) -> Float64:
        """K (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def scaled(self, scale: float) -> PinholeCamera:
        """Return the camera of the image resized by `scale`.

        Pixel centres keep their rays: cx' = (cx + 0.5) s - 0.5.
        """
        width, height = round(self.width * scale), round(self.height * scale)
        if width < 1 or height < 1:
            raise InvalidInputError(f"camera: {self.width}x{self.height} scaled by {scale} is empty")
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(
            self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5, width, height
        )

    def project(self, points_m: npt.ArrayLike) -> tuple[Float64, Bool]:
        """Project camera-frame points (..., 3) [m] to pixels (..., 2) (u, v) and say which lie in the image.

        A point in the image has z > 0 and rounds to a pixel; the pixels of other points are set to -1.
        """
        points = np.asarray(points_m, dtype=np.float64)
        z = points[..., 2]
        in_front = z > 0
        safe = np.where(in_front, z, 1.0)
        u = self.fx * points[..., 0] / safe + self.cx
        v = self.fy * points[..., 1] / safe + self.cy
        inside = in_front & (u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5)
        return np.where(inside[..., None], np.stack([u, v], axis=-1), -1.0), inside

    def rays(self) -> Float64:
        """Directions (H, W, 3) through the pixel centres, z = 1."""
        u = (np.arange(self.width) - self.cx) / self.fx
        v = (np.arange(self.height) - self.cy) / self.fy
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = u
        rays[..., 1] = v[:, None]
        return rays

    def back_project(self, depth_m: Float32) -> Float32:
        """Return the vertex map (H, W, 3) float32 [m, camera frame] of a depth image (H, W) [m]; invalid is 0."""
        if depth_m.shape != self.shape:
            raise InvalidInputError(f"camera: depth has shape {depth_m.shape}, the camera {self.shape}")
        return (self.rays() * depth_m[..., None]).astype(np.float32)
