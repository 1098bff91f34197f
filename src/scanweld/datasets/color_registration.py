"""Colour as the depth camera sees it, where the two were recorded at different sizes or by different lenses."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, UInt8
from scanweld.datasets.images import resize_color
from scanweld.geometry.camera import PinholeCamera

_SAME = 1e-6


class ColorToDepth:
    """Resample colour images to the pixels of the depth camera.

    A depth pixel (u, v) with depth z is the point p = z K_depth^-1 (u, v, 1); its colour is found at
    K_color T_color_depth p, between four pixels. Where the two cameras share a centre, the place does not depend on z.
    Otherwise a pixel without depth is looked up at infinity; what the colour camera does not see because something is
    in front of it gets the colour of that. Pixels outside of the colour image are black. A colour image that is finer
    than the depth image is first made smaller by averaging, so that nothing is skipped.

    Parameters
    ----------
    color_camera, depth_camera : intrinsics of the two images
    T_color_depth : (4, 4), moves points of the depth camera to the colour camera; None where the two coincide
    """

    def __init__(
        self, color_camera: PinholeCamera, depth_camera: PinholeCamera, T_color_depth: Float64 | None = None
    ) -> None:
        self._shape, self._depth_camera = color_camera.shape, depth_camera
        T = np.eye(4) if T_color_depth is None else T_color_depth
        self._same = np.abs(T - np.eye(4)).max() < _SAME and color_camera == depth_camera
        # A depth pixel covers this many colour pixels a side.
        finer = min(color_camera.fx / depth_camera.fx, color_camera.fy / depth_camera.fy)
        self._small = color_camera.scaled(1 / finer) if finer > 1 else color_camera
        self._turn: Float64 = T[:3, :3]
        self._shift_m: Float64 = T[:3, 3]

    # Tables are made with the first images, not before: the header of a damaged file may claim any size.
    @cached_property
    def _rays(self) -> Float64:
        """Of the colour camera (H, W, 3), for depth 1."""
        return np.asarray(self._depth_camera.rays() @ self._turn.T)

    @cached_property
    def _table(self) -> tuple[Float32, Bool] | None:
        """Places and which are outside, where they do not depend on depth."""
        if np.abs(self._shift_m).max() > _SAME:
            return None
        places = self._places(self._rays)
        return places, self._is_outside(places)

    @property
    def color_shape(self) -> tuple[int, int]:
        """(height, width) of the colour images."""
        return self._shape

    def __call__(self, color: UInt8, depth_m: Float32) -> UInt8:
        """Return the colour (H, W, 3) of every pixel of `depth_m` (H, W)."""
        import cv2

        if self._same:
            return color
        if self._small.shape != color.shape[:2]:
            color = resize_color(color, self._small.shape)
        if self._table is not None:
            places, outside = self._table
        else:
            z = depth_m[..., None].astype(np.float64)
            places = self._places(np.where(z > 0, z * self._rays + self._shift_m, self._rays))
            outside = self._is_outside(places)
        seen: UInt8 = cv2.remap(
            color, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).reshape(*depth_m.shape, 3)
        seen[outside] = 0
        return seen

    def _is_outside(self, places: Float32) -> Bool:
        """Which pixels (H, W, 2) are not in the smaller colour image."""
        limits = np.array(self._small.shape[::-1], dtype=np.float32) - np.float32(0.5)
        return np.asarray(((places < -0.5) | (places >= limits)).any(axis=-1))

    def _places(self, points: Float64) -> Float32:
        """Pixels (H, W, 2) of the smaller colour image that points (H, W, 3) of the colour camera fall on."""
        camera = self._small
        with np.errstate(divide="ignore", invalid="ignore"):
            u = camera.fx * points[..., 0] / points[..., 2] + camera.cx
            v = camera.fy * points[..., 1] / points[..., 2] + camera.cy
        places = np.stack([u, v], axis=-1)
        places[~(np.isfinite(places).all(axis=-1) & (points[..., 2] > 0))] = -1e6
        # Far outside is outside: OpenCV's fixed-point coordinates have 16 bits before the point.
        return np.clip(places, -30000, 30000).astype(np.float32)
