"""The map and the path as a browser draws them: few enough points, 16-bit coordinates, z up."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanweld.arrays import Array, Bool, Float64, Int64
from scanweld.geometry import se3

MAX_POINTS = 250_000
"""Points that a page holds: 18 bytes each in the file."""

LEAST_CONFIDENCE = 2.0
"""What was seen about once is mostly noise at edges, and left out where most of the map was seen more often."""

_CANDIDATES = 4 * MAX_POINTS
_SEED = 0


@dataclass(frozen=True, slots=True)
class Points:
    """Points that stand for a map.

    Attributes
    ----------
    position_m : (N, 3), world frame
    normal : (N, 3), zero where unknown
    color : (N, 3) uint8 RGB
    radius_m, confidence : (N,)
    spacing_m : that they were thinned to; 0 where all were kept
    total : how many points they stand for
    left_out : how many of these were not looked at, since they were seen about once or are nowhere
    """

    position_m: Float64
    normal: Float64
    color: Array
    radius_m: Float64
    confidence: Float64
    spacing_m: float
    total: int
    left_out: int


def select_points(columns: Mapping[str, Array], count: int = MAX_POINTS) -> Points:
    """Thin a map evenly to at most `count` points, the most confident of each cell, in random order.

    In random order any first part of them is a coarser map, which a slow machine can draw while the view moves.
    """
    position = np.column_stack([np.asarray(columns[axis], np.float64) for axis in "xyz"])
    total = len(position)
    confidence = np.asarray(columns.get("confidence", np.ones(total)), np.float64)
    sound = np.isfinite(position).all(axis=1)
    if sound.any() and np.median(confidence[sound]) > 2 * LEAST_CONFIDENCE:
        sound &= confidence >= LEAST_CONFIDENCE
    chosen = np.flatnonzero(sound)
    rng = np.random.default_rng(_SEED)
    if len(chosen) > _CANDIDATES:
        chosen = rng.choice(chosen, _CANDIDATES, replace=False)
    chosen = chosen[np.argsort(-confidence[chosen], kind="stable")]
    kept, spacing = _one_per_cell(position[chosen], count)
    chosen = rng.permutation(chosen[kept])

    def stacked(names: tuple[str, ...], default: float) -> Array:
        if not all(name in columns for name in names):
            return np.full((len(chosen), len(names)), default)
        return np.column_stack([np.asarray(columns[name])[chosen] for name in names])

    return Points(
        position_m=position[chosen],
        normal=stacked(("nx", "ny", "nz"), 0.0).astype(np.float64),
        color=stacked(("red", "green", "blue"), 160).astype(np.uint8),
        radius_m=stacked(("radius",), 0.0)[:, 0].astype(np.float64),
        confidence=confidence[chosen],
        spacing_m=spacing,
        total=total,
        left_out=total - int(sound.sum()),
    )


def _one_per_cell(position_m: Float64, count: int) -> tuple[Int64, float]:
    """Return the first point of every occupied cell, with cells as small as `count` allows, and their size [m]."""
    if len(position_m) <= count:
        return np.arange(len(position_m)), 0.0
    low = position_m.min(axis=0)
    extent = float(np.ptp(position_m, axis=0).max())
    size = max(extent, 1e-9) / np.sqrt(count)
    kept = np.empty(0, np.int64)
    for _ in range(8):
        cell = np.floor((position_m - low) / size).astype(np.int64)
        side = cell.max(axis=0) + 1
        _, first = np.unique((cell[:, 0] * side[1] + cell[:, 1]) * side[2] + cell[:, 2], return_index=True)
        kept = np.sort(first)
        if 0.85 * count <= len(kept) <= count:
            break
        size *= float(np.clip(np.sqrt(len(kept) / (0.95 * count)), 0.5, 2.0))  # surfaces: cells go with 1 / size^2
    return kept[:count], float(size)


def display_frame(points_m: Float64, T_world_camera: Float64) -> Float64:
    """Return T_display_world: z against the cameras' downward axes, the middle of the map at the origin."""
    up = -T_world_camera[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, -1.0, 0.0])
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(side, up)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up])
    T = np.eye(4)
    T[:3, :3] = rotation
    if len(points_m):
        turned = points_m @ rotation.T
        low, high = np.percentile(turned, [1, 99], axis=0)
        T[:3, 3] = -(low + high) / 2
    return T


def encode_scene(
    points: Points,
    T_world_camera: Float64,
    known: Bool,
    *,
    camera: Mapping[str, float] | None,
    keyframes: Int64,
    loops: Int64,
) -> tuple[dict[str, Any], str]:
    """Return the scene as JSON values, and the points as base64 text.

    Parameters
    ----------
    points : what to show
    T_world_camera : (F, 4, 4), pose of every frame shown
    known : (F,), which of them are poses of their own
    camera : width, height, fx, fy of the frustum, or None
    keyframes, loops : indices (K,) and (L, 2) into the frames shown

    Notes
    -----
    Points are written column by column: x y z as uint16 between `low` and `high`, radius and confidence as uint8
    between 0 and `max_radius_m` and `max_confidence`, RGB as uint8, the normal as int8.
    """
    T_display_world = display_frame(points.position_m, T_world_camera)
    position = se3.transform_points(T_display_world, points.position_m) if len(points.position_m) else np.zeros((0, 3))
    normal = points.normal @ T_display_world[:3, :3].T
    low, high = (position.min(axis=0), position.max(axis=0)) if len(position) else (np.zeros(3), np.ones(3))
    max_radius = max(float(np.percentile(points.radius_m, 99)) if len(position) else 0.0, 1e-6)
    max_confidence = max(float(points.confidence.max()) if len(position) else 0.0, 1e-6)
    grid = np.round((position - low) / np.maximum(high - low, 1e-9) * 65535).astype("<u2")
    blob = b"".join(
        [
            grid.tobytes(),
            _bytes(points.radius_m, max_radius),
            _bytes(points.confidence, max_confidence),
            points.color.tobytes(),
            np.round(np.clip(normal, -1, 1) * 127).astype(np.int8).tobytes(),
        ]
    )
    poses = T_display_world @ T_world_camera
    inner_low, inner_high = np.percentile(position, [1, 99], axis=0) if len(position) else (low, high)
    scene = {
        "count": len(position),
        "total": points.total,
        "low": low.tolist(),
        "high": high.tolist(),
        "inner": [inner_low.tolist(), inner_high.tolist()],
        "leftOut": points.left_out,
        "spacing": points.spacing_m,
        "maxRadius": max_radius,
        "maxConfidence": max_confidence,
        "hasNormals": bool(np.any(points.normal)),
        "positions": floats(poses[:, :3, 3]),
        "rotations": floats(poses[:, :3, :3]),
        "known": known.astype(int).tolist(),
        "camera": dict(camera) if camera else {"width": 4, "height": 3, "fx": 3.5, "fy": 3.5},
        "keyframes": keyframes.tolist(),
        "loops": loops.tolist(),
    }
    return scene, base64.b64encode(blob).decode("ascii")


def floats(values: Array) -> str:
    """Return numbers as base64 of little-endian float32."""
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode("ascii")


def _bytes(values: Float64, highest: float) -> bytes:
    return np.round(np.clip(values / highest, 0, 1) * 255).astype(np.uint8).tobytes()
