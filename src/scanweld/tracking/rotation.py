"""How far a camera has turned, from two small grey images: another start for when the prediction fails.

A turn moves the image by a homography that needs no depth (Lovegrove and Davison 2010), so whole images can be compared
at once. Shifts of a thumbnail find turns of many of its pixels, and Gauss-Newton on the turn refines them, coarse to
fine. Translation is left out: it moves what is far by little, and the dense alignment that follows knows better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float32, Float64
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.registration.photometric.residuals import half_grey

LARGEST_PIXELS = 80
"""Width of the finest image that is compared."""

LEVELS = 3
"""Sizes that are compared, each half of the one before."""

MAX_SHIFT = 0.5
"""Shifts of the thumbnail up to this share of its size are tried."""

MIN_OVERLAP = 0.25
"""Smallest share of an image that must be common."""

MIN_PIXELS = 20
"""Fewer common pixels are not compared."""

MIN_CORRELATION = 0.7
"""A turn that leaves less in common is no proposal: right ones of rendered and recorded rooms have 0.9 and more."""

STARTS = 3
"""Best shifts that are refined."""

ITERATIONS = 8
"""Gauss-Newton steps on each size."""


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small grey image: grey (H, W) float32, where it is filled (H, W), and its intrinsics."""

    grey: Float32
    filled: Bool
    camera: PinholeCamera


@dataclass(frozen=True, slots=True)
class Turn:
    """R_target_source (3, 3) and the correlation of the images after it, -1 to 1."""

    rotation: Float64
    correlation: float


def thumbnails(grey: Float32, filled: Bool, camera: PinholeCamera) -> list[Thumbnail]:
    """Shrink an image (H, W) to LEVELS sizes, finest first, at most LARGEST_PIXELS wide."""
    grey, share = np.where(filled, grey, np.float32(0)), filled.astype(np.float32)
    sizes: list[Thumbnail] = []
    while len(sizes) < LEVELS and min(grey.shape) >= 8:
        if grey.shape[1] <= LARGEST_PIXELS:
            f = grey.shape[1] / camera.width
            scaled = PinholeCamera(
                camera.fx * f, camera.fy * f, (camera.cx + 0.5) * f - 0.5, (camera.cy + 0.5) * f - 0.5,
                grey.shape[1], grey.shape[0],
            )  # fmt: skip
            sizes.append(Thumbnail(np.asarray(grey / np.maximum(share, 1e-6), np.float32), share > 0.5, scaled))
        grey, share = half_grey(grey), half_grey(share)
    return sizes


def find_turns(source: list[Thumbnail], target: list[Thumbnail]) -> list[Turn]:
    """Return turns that make two images alike, best first; none where there is none.

    Parameters
    ----------
    source, target : as of :func:`thumbnails`, of equal size and intrinsics
    """
    if not source or len(source) != len(target):
        return []
    turns: list[Turn] = []
    for rotation in _shifts(source[-1], target[-1]):
        turn = Turn(rotation, -1.0)
        for a, b in zip(reversed(source), reversed(target), strict=True):
            turn = _refined(a, b, turn.rotation)
        if turn.correlation < MIN_CORRELATION:
            continue
        if not any(np.trace(turn.rotation.T @ other.rotation) > 1 + 2 * np.cos(DISTINCT_RAD) for other in turns):
            turns.append(turn)
    return sorted(turns, key=lambda turn: -turn.correlation)


DISTINCT_RAD = 0.03
"""Turns closer than this are the same."""


def _shifts(source: Thumbnail, target: Thumbnail) -> list[Float64]:
    """Return the turns that belong to the shifts of highest correlation, and no turn."""
    height, width = source.grey.shape
    most_u, most_v = int(MAX_SHIFT * width), int(MAX_SHIFT * height)
    scores = np.full((2 * most_v + 1, 2 * most_u + 1), -1.0)
    for dv in range(-most_v, most_v + 1):
        for du in range(-most_u, most_u + 1):
            here = np.s_[max(0, -dv) : height - max(0, dv), max(0, -du) : width - max(0, du)]
            there = np.s_[max(0, dv) : height - max(0, -dv), max(0, du) : width - max(0, -du)]
            both = source.filled[here] & target.filled[there]
            if both.sum() >= max(MIN_OVERLAP * height * width, MIN_PIXELS):
                scores[dv + most_v, du + most_u] = _correlation(source.grey[here][both], target.grey[there][both])
    found = [np.eye(3)]
    camera = source.camera
    for _ in range(STARTS):
        dv, du = divmod(int(np.argmax(scores)), scores.shape[1])
        if scores[dv, du] <= 0:
            break
        scores[max(0, dv - 1) : dv + 2, max(0, du - 1) : du + 2] = -1.0
        # Moving the image by (du, dv) pixels turns the rays about -y by du / fx and about x by dv / fy.
        angle_u, angle_v = np.arctan((du - most_u) / camera.fx), np.arctan((dv - most_v) / camera.fy)
        found.append(se3.exp(np.array([0, 0, 0, -angle_v, angle_u, 0.0]))[:3, :3])
    return found


def _refined(source: Thumbnail, target: Thumbnail, rotation: Float64) -> Turn:
    """Minimise the differences of standardised brightness over the turn, R <- exp(phi) R."""
    rays = source.camera.rays()[source.filled]
    values = source.grey[source.filled].astype(np.float64)
    best = Turn(rotation, -1.0)
    camera = target.camera
    for _ in range(ITERATIONS):
        moved = rays @ rotation.T
        z = np.where(moved[:, 2] > 0.1, moved[:, 2], np.inf)
        u, v = camera.fx * moved[:, 0] / z + camera.cx, camera.fy * moved[:, 1] / z + camera.cy
        inside = np.isfinite(z) & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)
        row, column = v[inside].astype(np.int64), u[inside].astype(np.int64)
        square = target.filled[row, column] & target.filled[row + 1, column + 1]
        square &= target.filled[row, column + 1] & target.filled[row + 1, column]
        inside[inside] = square
        if inside.sum() < max(MIN_OVERLAP * values.size, MIN_PIXELS):
            break
        row, column, p = row[square], column[square], moved[inside]
        e, f = u[inside] - column, v[inside] - row
        i00, i01 = target.grey[row, column], target.grey[row, column + 1]
        i10, i11 = target.grey[row + 1, column], target.grey[row + 1, column + 1]
        top, low = i00 + e * (i01 - i00), i10 + e * (i11 - i10)
        seen, mine = top + f * (low - top), values[inside]
        correlation = _correlation(mine, seen)
        if correlation <= best.correlation:
            break
        best = Turn(rotation, correlation)
        slope_u, slope_v = ((1 - f) * (i01 - i00) + f * (i11 - i10)), low - top
        d = np.stack([slope_u * camera.fx / p[:, 2], slope_v * camera.fy / p[:, 2], np.zeros(len(p))], axis=1)
        d[:, 2] = -(d[:, 0] * p[:, 0] + d[:, 1] * p[:, 1]) / p[:, 2]
        jacobian = np.concatenate([np.cross(p, d), -mine[:, None], -np.ones((len(p), 1))], axis=1)
        gain = float(np.sqrt(seen.var() / max(mine.var(), 1e-12)))
        residuals = seen - gain * mine - (seen.mean() - gain * mine.mean())
        scale = max(1.0, 1.4826 * float(np.median(np.abs(residuals))))
        weights = 1 / (1 + (residuals / scale) ** 2)
        step = np.linalg.lstsq(jacobian.T @ (jacobian * weights[:, None]), -jacobian.T @ (weights * residuals), 1e-9)[0]
        rotation = se3.exp(np.concatenate([np.zeros(3), step[:3]]))[:3, :3] @ rotation
    return best


def _correlation(a: Float64 | Float32, b: Float64 | Float32) -> float:
    """Return the correlation coefficient of two rows; 0 where one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 1e-9 else 0.0
