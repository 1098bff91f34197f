"""Colours of surfels: as they were seen, or what is known of them."""

from __future__ import annotations

from enum import Enum

import numpy as np

from scanweld.arrays import Float32, UInt8


class Coloring(Enum):
    """What the colour of a surfel shows."""

    RGB = "RGB"
    NORMAL = "normal"
    CONFIDENCE = "confidence"
    AGE = "age"


FULL_CONFIDENCE = 100.0
"""Confidence of the last colour: where it stops growing unless a run was configured otherwise."""

_RAMP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float32)
"""Viridis (van der Walt and Smith, 2015) at five places: even steps look even, also in grey."""


def ramp(shares: Float32) -> UInt8:
    """Return colours (N, 3) for shares (N,) from 0, dark violet, to 1, yellow."""
    places = np.clip(shares, 0, 1) * (len(_RAMP) - 1)
    below = np.minimum(places.astype(np.int32), len(_RAMP) - 2)
    part = (places - below)[:, None]
    colors: UInt8 = (_RAMP[below] * (1 - part) + _RAMP[below + 1] * part + np.float32(0.5)).astype(np.uint8)
    return colors


def normal_colors(normals: Float32) -> UInt8:
    """Return colours (N, 3) for unit normals (N, 3): each axis from -1, dark, to 1, bright."""
    colors: UInt8 = np.clip(normals * np.float32(127.5) + np.float32(128), 0, 255).astype(np.uint8)
    return colors


def confidence_colors(confidences: Float32) -> UInt8:
    """Return colours (N, 3) for confidences (N,), on a logarithmic scale: the first few measurements matter most."""
    return ramp(np.log1p(np.maximum(confidences, 0), dtype=np.float32) / np.log1p(np.float32(FULL_CONFIDENCE)))


def age_colors(created: Float32, newest: float) -> UInt8:
    """Return colours (N, 3) for the frames (N,) that made surfels: from the first frame, dark, to `newest`."""
    return ramp(np.asarray(created, np.float32) / np.float32(max(newest, 1.0)))
