"""What crosses between mapping, tracking and loop closure: the map seen from a pose, and a change of its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float32, Float64, Int32, Int64
from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera


class ModelView:
    """The surfels that a camera sees, one at most per pixel, as rows of equal length N.

    Neighbouring rows are mostly neighbours in the image; `index_map` leads through them in the order of its pixels.

    Attributes
    ----------
    T_world_camera : (4, 4), where the map was looked at from
    camera : the intrinsics it was looked at with
    positions_m : (3, N) float32, world frame [m]
    normals : (3, N) float32, world frame, unit, towards the camera
    confidences : (N,) float32
    index_map : (H, W) int32, the row of the surfel behind each pixel, -1 where none
    intensities : (N,) float32, luminance 0..255, or None where the mapper does not give it
    stable_confidence : from this confidence on a surfel is stable
    """

    T_world_camera: Float64
    camera: PinholeCamera
    positions_m: Float32
    normals: Float32
    confidences: Float32
    index_map: Int32
    stable_confidence: float
    intensities: Float32 | None

    def __init__(
        self,
        T_world_camera: Float64,
        camera: PinholeCamera,
        positions_m: Float32,
        normals: Float32,
        confidences: Float32,
        index_map: Int32,
        stable_confidence: float = 0.0,
        intensities: Float32 | None = None,
    ) -> None:
        self.T_world_camera, self.camera, self.index_map = T_world_camera, camera, index_map
        self.positions_m, self.normals, self.confidences = positions_m, normals, confidences
        self.stable_confidence, self.intensities = stable_confidence, intensities
        if index_map.max(initial=-1) >= len(self):  # kernels would read beyond the end
            raise InvalidInputError(
                f"index_map: it holds row {index_map.max()} of a view of {len(self)} rows; it is for rows of the view, "
                "not for numbers of the map's surfels"
            )

    def __len__(self) -> int:
        return int(self.positions_m.shape[1])

    @property
    def pixels(self) -> Int64:
        """(N,) int64, row-major, the pixel of each row."""
        seen = np.flatnonzero(self.index_map >= 0)
        pixels = np.zeros(len(self), np.int64)
        pixels[self.index_map.reshape(-1)[seen]] = seen
        return pixels


@dataclass(frozen=True, slots=True)
class MapCorrection:
    """How the frames of keyframes moved when a loop was closed.

    Attributes
    ----------
    keyframe_ids : (K,) int32
    T_new_old : (K, 4, 4), maps old world coordinates of what is anchored to a keyframe to new ones
    """

    keyframe_ids: Int32
    T_new_old: Float64
