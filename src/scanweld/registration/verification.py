"""Whether a pose is possible: points moved by it must not stand where the other view saw free space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.geometry.depth import SurfaceLevel

SAMPLES = 6000
"""Points that are compared: a share of 0.5 is known to 1.3 % (two standard deviations)."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Shares of the compared points, those that project onto a pixel with a surface.

    Attributes
    ----------
    compared : number of compared points
    agree : share on the surface, within four standard deviations of the depth noise
    conflict : share in front of it, where the other camera looked through
    hidden : share behind it, which occlusion allows
    """

    compared: int
    agree: float
    conflict: float
    hidden: float


def check_against_depth(
    positions_m: Float32, normals: Float32, T_target_source: Float64, target: SurfaceLevel
) -> Agreement:
    """Compare points (3, N) with normals (3, N), source frame, with the depth of a target view.

    On true poses of static scenes at most 3 % of the compared points stand in free space, recorded or rendered. In
    wrong minima of the alignment it is mostly 9 % or more, though up to 80 % of the points may lie on a surface: the
    walls of a room agree with themselves in many places (docs/decisions/0003-verification.md).
    """
    stride = max(1, positions_m.shape[1] // SAMPLES)
    rotation, translation = (
        T_target_source[:3, :3].astype(np.float32),
        T_target_source[:3, 3].astype(np.float32),
    )
    p = rotation @ positions_m[:, ::stride] + translation[:, None]
    n = rotation @ normals[:, ::stride]
    camera = target.camera
    z = np.maximum(p[2], np.float32(1e-6))
    u = np.floor(camera.fx * p[0] / z + camera.cx + 0.5)
    v = np.floor(camera.fy * p[1] / z + camera.cy + 0.5)
    inside = (p[2] > 0.01) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    p, n = p[:, inside], n[:, inside]
    q = target.surface[v[inside].astype(np.int64), u[inside].astype(np.int64)].T
    valid = q[6] > 0
    p, n, q = p[:, valid], n[:, valid], q[:, valid]
    compared = int(valid.sum())
    if compared == 0:
        return Agreement(0, 0.0, 0.0, 0.0)
    sigma = 1 / q[6]
    along = np.abs((q[3:6] * (p - q[:3])).sum(axis=0))
    gap = q[2] - p[2]
    agree = (along < 4 * sigma) & (np.abs(gap) < 0.1) & ((n * q[3:6]).sum(axis=0) > 0.5)
    far = np.maximum(0.05, 6 * sigma)
    conflict = ~agree & (gap > far)
    hidden = ~agree & (gap < -far)
    return Agreement(compared, float(agree.mean()), float(conflict.mean()), float(hidden.mean()))
