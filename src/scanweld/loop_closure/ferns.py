"""Randomised ferns: what a frame looks like as a whole, in a few hundred bytes, compared in microseconds.

A fern is a handful of yes-or-no tests on a tiny image; its answers are a small number, and the share of ferns that
answer alike says how similar two frames are. A frame is described without searching it for anything, so this works on
blank walls, in the dark and without colour; it holds for nearby views only.

Source: B. Glocker, J. Shotton, A. Criminisi, S. Izadi, "Real-time RGB-D camera relocalization via randomized ferns for
keyframe encoding", TVCG 2015. Two things differ: depth and grey values have ferns of their own, so that either can be
compared alone; and grey values are compared with each other and not with thresholds, so that exposure does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, UInt8
from scanweld.config import check_ranges, setting
from scanweld.geometry.depth import SurfacePyramid

_SIZE = (40, 30)  # of the image that is tested (width, height)
_BLUR_PX = 2.0  # of it
_TESTS = 4  # of a fern
_NEAREST_M, _FARTHEST_M = 0.5, 4.5  # thresholds on depth
_RATIO = 1.15  # one place is behind another from this ratio of their depths on
_MIN_MEASURED = 0.2  # share of measured depth around a place, below which it has none


@dataclass(frozen=True, slots=True, kw_only=True)
class FernConfig:
    """How frames are encoded."""

    count: int = setting(500, "ferns on depth, and as many on colour; raise for a finer measure", low=16, high=10_000)
    seed: int = setting(0, "seed of the tests", low=0)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class FernCode:
    """What the ferns answered for one frame.

    Attributes
    ----------
    depth : (M,) uint8, four bits each
    grey : (M,) uint8, four bits each; zeros where `has_grey` is False
    has_grey : whether the frame had colour
    """

    depth: UInt8
    grey: UInt8
    has_grey: bool


class Ferns:
    """A fixed set of ferns: the same configuration gives the same codes, everywhere."""

    def __init__(self, config: FernConfig | None = None) -> None:
        self.config = config or FernConfig()
        rng = np.random.default_rng(self.config.seed)
        shape = (self.config.count, _TESTS)
        width, height = _SIZE
        # A test compares the values at two places of the image, or, with depth, every other one with a threshold.
        self._depth_places, self._depth_others, self._grey_places, self._grey_others = rng.integers(
            0, width * height, (4, *shape)
        )
        self._thresholds_m = rng.uniform(_NEAREST_M, _FARTHEST_M, shape).astype(np.float32)
        self._absolute = np.arange(_TESTS) % 2 == 0

    def encode(self, pyramid: SurfacePyramid) -> FernCode:
        """Return the code of a frame."""
        depth = _small_depth(pyramid.levels[0].depth_m).ravel()
        other = np.where(self._absolute, self._thresholds_m, np.float32(_RATIO) * depth[self._depth_others])
        depth_code = _packed(depth[self._depth_places] > other)
        if pyramid.frame.color is None:
            return FernCode(depth_code, np.zeros_like(depth_code), False)
        grey = _small_grey(pyramid.frame.color).ravel()
        return FernCode(depth_code, _packed(grey[self._grey_places] > grey[self._grey_others]), True)


def similarities(code: FernCode, depth: UInt8, grey: UInt8, has_grey: Bool) -> Float64:
    """Return the share (K,) of ferns that answer for a frame as they did for each of K others, 0..1.

    Where both frames have colour, half of it comes from colour; else all of it from depth.

    Parameters
    ----------
    code : of the frame
    depth, grey, has_grey : of the others, (K, M), (K, M) and (K,)
    """
    from_depth: Float64 = np.count_nonzero(depth == code.depth, axis=1) / len(code.depth)
    if not code.has_grey:
        return from_depth
    from_grey = np.count_nonzero(grey == code.grey, axis=1) / len(code.grey)
    return np.asarray(np.where(has_grey, (from_depth + from_grey) / 2, from_depth))


def _packed(answers: Bool) -> UInt8:
    return np.asarray(answers @ (1 << np.arange(_TESTS)), np.uint8)


def _small_depth(depth_m: Float32) -> Float32:
    """Return the mean of the measured depth around each place of the small image [m], 0 where hardly any is."""
    import cv2

    both = [
        cv2.GaussianBlur(cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA), (0, 0), _BLUR_PX)
        for image in (depth_m, (depth_m > 0).astype(np.float32))
    ]
    return np.where(both[1] >= _MIN_MEASURED, both[0] / np.maximum(both[1], np.float32(1e-6)), np.float32(0))


def _small_grey(color: UInt8) -> Array:
    import cv2

    small = cv2.resize(color, _SIZE, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), _BLUR_PX))
