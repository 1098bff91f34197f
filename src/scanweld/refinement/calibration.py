"""What self-calibration may change: four intrinsics and one number of the depth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera

VALUES = ("fx", "fy", "cx", "cy", "inverse depth offset")
"""Of a calibration, in the order of the columns of the Jacobian."""

PARAMETERS = ("focal length", "aspect ratio", "cx", "cy", "inverse depth offset")
"""What is estimated: where fx / fy is not determined it stays, and both focal lengths change together."""


@dataclass(frozen=True, slots=True)
class DepthCorrection:
    """1 / z' = 1 / z + b: what a wrong zero of the disparity does to depth; planes stay planes.

    A factor on all depths is not part of it: the same factor on the path explains it as well, so no sequence shows it.

    Attributes
    ----------
    inverse_depth_offset_per_m : b [1/m]; 0.01 brings what is measured at 1 m nearer by 1 %, at 3 m by 3 %
    """

    inverse_depth_offset_per_m: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.inverse_depth_offset_per_m):
            raise InvalidInputError(f"depth correction: expected a number, got {self.inverse_depth_offset_per_m}")

    def apply(self, depth_m: Float32) -> Float32:
        """Return the corrected depth (H, W) float32 [m]; 0 stays invalid, and what would be beyond infinity becomes."""
        if self.inverse_depth_offset_per_m == 0:
            return depth_m
        below = 1 + np.float32(self.inverse_depth_offset_per_m) * depth_m
        return np.where(below > 0.1, depth_m / np.maximum(below, np.float32(0.1)), np.float32(0))


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera and what is wrong with its depth."""

    camera: PinholeCamera
    depth: DepthCorrection = field(default_factory=DepthCorrection)

    def stepped(self, delta: Float64) -> Calibration:
        """Add (5,) to the values, in the order of VALUES."""
        c, (fx, fy, cx, cy, offset) = self.camera, delta.tolist()
        camera = replace(c, fx=c.fx + fx, fy=c.fy + fy, cx=c.cx + cx, cy=c.cy + cy)
        return Calibration(camera, DepthCorrection(self.depth.inverse_depth_offset_per_m + offset))

    def resized(self, camera: PinholeCamera, before: PinholeCamera) -> PinholeCamera:
        """Return `camera` with the change from `before` to this calibration, which are of images of another size."""
        sx, sy = camera.width / before.width, camera.height / before.height
        mine = self.camera
        return replace(
            camera,
            fx=camera.fx * mine.fx / before.fx,
            fy=camera.fy * mine.fy / before.fy,
            cx=camera.cx + (mine.cx - before.cx) * sx,
            cy=camera.cy + (mine.cy - before.cy) * sy,
        )


def values_of_parameters(camera: PinholeCamera) -> Float64:
    """Return (5, 5), how the values change with the parameters: fx = f, fy = f a, and the others are themselves.

    Focal length and aspect ratio are shares of what they are.
    """
    slopes = np.eye(5)
    slopes[:2, :2] = [[camera.fx, 0], [camera.fy, camera.fy]]
    return slopes


def relative_units(camera: PinholeCamera, median_depth_m: float) -> Float64:
    """Return (5,) that turns parameters into relative errors of a point's place: a share of its depth."""
    return np.array([1, 1, 1 / camera.fx, 1 / camera.fy, median_depth_m])
