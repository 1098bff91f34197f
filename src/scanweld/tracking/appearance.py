"""Whether two views look alike where an alignment says that they show the same surface.

Depth alone cannot tell one corner of a room from another; what is painted on the walls can. The grey values of the
pixels that agree in depth are compared by their normalised correlation, so that exposure, gain and white balance do not
matter. Images are first reduced (the alignment may be a few pixels off) and their local mean is subtracted, because
lamps and shadows make any two rooms brighter above than below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.frame import Frame

_WIDTH_PX = 160  # of the reduced images: coarse enough for an alignment that is a few pixels off
_MEAN_PX = 5.0  # standard deviation of the local mean's window, reduced pixels
_SAMPLES = 20_000  # about so many pixels of the source are looked at
_CLIP = 2.0  # in root mean squares: a highlight is no more than any other edge

MIN_COMPARED = 200
"""Fewer pixels tell nothing."""

MIN_CONTRAST = 2.0
"""Root mean square of the texture [grey levels] below which the noise of the image says more than the scene."""


@dataclass(frozen=True, slots=True)
class Appearance:
    """How alike the pixels look that lie on the same surface.

    Attributes
    ----------
    compared : number of pixels
    contrast : the lesser of the two images' texture over them, root mean square [grey levels]
    correlation : of the two textures, -1..1; 0 where nothing was compared
    """

    compared: int
    contrast: float
    correlation: float

    @property
    def telling(self) -> bool:
        """Whether there is enough texture to tell one place from another."""
        return self.compared >= MIN_COMPARED and self.contrast >= MIN_CONTRAST

    @property
    def words(self) -> str:
        """The correlation in words."""
        return f"they do not look alike: the correlation of their texture is {self.correlation:.2f}"


def compare_appearance(source: SurfacePyramid, target: SurfacePyramid, T_target_source: Float64) -> Appearance:
    """Compare the grey values of the source's pixels with those where the alignment puts them, on common surfaces.

    A frame without colour, or without a common surface, leaves nothing to compare.
    """
    import cv2

    if source.frame.color is None or target.frame.color is None:
        return Appearance(0, 0.0, 0.0)
    seen, again = _common_pixels(source, target, T_target_source)
    if len(seen) == 0:
        return Appearance(0, 0.0, 0.0)
    textures = []
    for frame, pixels in ((source.frame, seen), (target.frame, again)):
        image = texture(frame)
        scale = np.array([image.shape[1] / frame.camera.width, image.shape[0] / frame.camera.height])
        places = ((pixels + 0.5) * scale - 0.5).astype(np.float32)
        values = cv2.remap(image, places[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        textures.append(_clipped(values[:, 0].astype(np.float64)))
    (a, contrast_a), (b, contrast_b) = textures
    power = float(np.sqrt((a @ a) * (b @ b)))
    return Appearance(len(seen), min(contrast_a, contrast_b), float(a @ b) / power if power > 0 else 0.0)


def texture(frame: Frame) -> Float32:
    """Return the grey values less their local mean, about 160 pixels wide."""
    import cv2

    assert frame.color is not None
    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = min(1.0, _WIDTH_PX / frame.camera.width)
    if scale < 1.0:
        size = (round(scale * frame.camera.width), max(1, round(scale * frame.camera.height)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), _MEAN_PX), np.float32)


def _common_pixels(source: SurfacePyramid, target: SurfacePyramid, T_target_source: Float64) -> tuple[Float64, Float64]:
    """Return the pixels (M, 2) of the source, and where they are in the target, that lie on the same surface."""
    surface = source.levels[0].surface
    stride = max(1, round(float(np.sqrt(surface.shape[0] * surface.shape[1] / _SAMPLES))))
    v, u = stride * np.array(np.nonzero(surface[::stride, ::stride, 6] > 0))
    rows = surface[v, u].astype(np.float64)
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    points, normals = rows[:, :3] @ R.T + t, rows[:, 3:6] @ R.T
    pixels, inside = target.levels[0].camera.project(points)
    u, v, points, normals, pixels = u[inside], v[inside], points[inside], normals[inside], pixels[inside]
    column, row = np.floor(pixels + 0.5).astype(np.int64).T
    facing = target.levels[0].surface[row, column].astype(np.float64)
    across = np.abs(((points - facing[:, :3]) * facing[:, 3:6]).sum(axis=1))
    same = (across * facing[:, 6] < 4) & (np.abs(facing[:, 2] - points[:, 2]) < 0.1)
    same &= (facing[:, 6] > 0) & ((normals * facing[:, 3:6]).sum(axis=1) > 0.5)
    return np.stack([u, v], axis=1)[same].astype(np.float64), pixels[same]


def _clipped(values: Float64) -> tuple[Float64, float]:
    """Return the values about their mean, clipped at `_CLIP` root mean squares, and that."""
    centred = values - values.mean()
    contrast = float(np.sqrt(np.mean(centred**2)))
    clipped = np.clip(centred, -_CLIP * contrast, _CLIP * contrast)
    return clipped - clipped.mean(), contrast
