"""Whether colour belongs to depth: where a near thing ends before a far one, the picture nearly always has an edge.

The brims of near things are found in the depth, edges in the colour, and it is asked how well the ones lie on the
others: as they are; after the colour was moved and zoomed, which would help if it were not registered; and with colour
of another moment, which would help if it were not synchronised.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float32, Int64, UInt8
from scanweld.checkup.findings import Figures, Finding, Judgement, Level

JUMP = 1.12
"""Ratio of the depths of a far thing and a near one."""

_WINDOW_PX = 9  # within which the far one is found: stereo cameras lose what is beside an edge
_SAME = 1.04
_FAR = np.float32(1e6)
_MOST_POINTS = 3000  # of a frame
_LEAST_POINTS = 600  # of all frames: fewer tell nothing

LEAST_WIDTH = 300
"""Pixels: in a smaller image what a stereo camera loses beside edges is too large a part of it."""

ZOOMS = (0.80, 0.85, 0.90, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2, 1.25)
MOST_SHIFT = 0.06
"""Zooms and the largest shift that are tried, the latter as a share of the width."""

LEAST_MISPLACED = 0.03
"""Root mean square shift of the pixels that is told of, as a share of the width."""

LEAST_GAIN = 3.0
"""So many standard deviations over wrong shifts must a better place be better."""

LATE_GAIN = 1.5
"""The same for colour of another moment."""

LATE_SHARE = 0.7
"""Late colour of a camera that moves steadily looks like colour aside: it is late when that explains so much of it."""

LEAST_LAG = 2
"""Frames; less is the rest that pairing by time stamps leaves."""


@dataclass(frozen=True, slots=True)
class Brim:
    """The brims of near things in one frame.

    Attributes
    ----------
    points : (N, 2) int64, pixels (u, v)
    edges : colour edges (H, W) of this frame (0) and of some before and after it, of mean 0
    """

    points: Int64
    edges: Mapping[int, Float32]


def depth_brim(depth_m: Float32) -> Int64:
    """Return the pixels (N, 2) of near things that end before something far."""
    import cv2

    depth = cv2.medianBlur(depth_m, 5)  # specks and single holes have brims, too
    window, beside = np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8), np.ones((3, 3), np.uint8)
    filled = np.where(depth > 0, depth, _FAR)
    ends = cv2.dilate(filled, beside) > JUMP * depth
    far_behind = cv2.dilate(depth, window) > JUMP * depth
    nearest = depth < _SAME * cv2.erode(filled, window)
    rows = np.argwhere((depth > 0) & ends & far_behind & nearest)[:, ::-1]
    return np.ascontiguousarray(rows[:: max(1, len(rows) // _MOST_POINTS)])


def color_edges(gray: UInt8) -> Float32:
    """Return how much of an edge each pixel of a picture (H, W) is, less the mean."""
    import cv2

    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    steep = cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    edges = steep / (steep + np.float32(np.quantile(steep, 0.8) + 1e-3))
    return np.asarray(edges - edges.mean(), np.float32)


def check_brims(brims: list[Brim]) -> Judgement:
    """Say whether colour is registered to depth, and of the same moment."""
    names = ("color_misplaced", "color_misplaced_sigmas", "color_lag_frames", "color_lag_sigmas")
    num_points = sum(len(brim.points) for brim in brims)
    if num_points < _LEAST_POINTS or next(iter(brims[0].edges.values())).shape[1] < LEAST_WIDTH:
        return [], dict.fromkeys(names)
    surfaces = {zoom: np.sum([_shifted_scores(brim, zoom) for brim in brims], axis=0) / num_points for zoom in ZOOMS}
    reach = surfaces[1.0].shape[0] // 2
    as_is, spread = float(surfaces[1.0][reach, reach]), float(np.std(surfaces[1.0]))
    if not spread > 0:  # pictures without any edge
        return [], dict.fromkeys(names)
    zoom = max(ZOOMS, key=lambda z: float(np.max(surfaces[z])))
    dy, dx = np.array(np.unravel_index(np.argmax(surfaces[zoom]), surfaces[zoom].shape)) - reach
    moved_score = float(np.max(surfaces[zoom]))
    height, width = next(iter(brims[0].edges.values())).shape
    misplaced = float(np.hypot(np.hypot(dx, dy), (zoom - 1) * np.hypot(width, height) / np.sqrt(12))) / width
    lag, lag_score = _best_lag(brims, as_is)
    figures: Figures = {
        "color_misplaced": misplaced,
        "color_misplaced_sigmas": (moved_score - as_is) / spread,
        "color_lag_frames": float(lag),
        "color_lag_sigmas": (lag_score - as_is) / spread,
    }
    aside = misplaced > LEAST_MISPLACED and moved_score - as_is > LEAST_GAIN * spread
    late = abs(lag) >= LEAST_LAG and lag_score - as_is > LATE_GAIN * spread
    if late and lag_score - as_is > LATE_SHARE * (moved_score - as_is):
        return [_late(lag)], figures
    return ([_aside(zoom, dx / width, dy / width)] if aside else []), figures


def _shifted_scores(brim: Brim, zoom: float) -> Float32:
    """Return the sum of the edges below the brims after a zoom about the centre, for every shift (dy, dx)."""
    import cv2

    edges = brim.edges[0]
    height, width = edges.shape
    reach = round(MOST_SHIFT * width)
    centre = np.array([width - 1, height - 1]) / 2
    u, v = np.rint((brim.points - centre) * zoom + centre).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    counts = np.zeros((height, width), np.float32)
    np.add.at(counts, (v[inside], u[inside]), 1.0)
    padded = cv2.copyMakeBorder(edges, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0.0)
    return np.asarray(cv2.matchTemplate(padded, counts, cv2.TM_CCORR), np.float32)


def _best_lag(brims: list[Brim], as_is: float) -> tuple[int, float]:
    """Return the number of frames that colour is best taken from later, and how well the brims lie on its edges."""
    scores = {0: as_is}
    num_points = sum(len(brim.points) for brim in brims)
    for lag in sorted({lag for brim in brims for lag in brim.edges}):
        some = [brim for brim in brims if lag in brim.edges]
        count = sum(len(brim.points) for brim in some)
        if 2 * count >= num_points:  # what the lag changes, on the frames that have it
            scores[lag] = as_is + sum(_score(brim, lag) - _score(brim, 0) for brim in some) / count
    best = max(scores, key=lambda lag: scores[lag])
    return best, scores[best]


def _score(brim: Brim, lag: int) -> float:
    return float(brim.edges[lag][brim.points[:, 1], brim.points[:, 0]].sum())


def _late(lag: int) -> Finding:
    side, comes = ("later", "late") if lag > 0 else ("earlier", "early")
    seen = f"edges of depth lie on those of the colour {abs(lag)} frames {side}: colour comes {comes}"
    return Finding("unsynchronised", Level.ERROR, seen, "pair the images by the time they were taken, on one clock")


def _aside(zoom: float, dx: float, dy: float) -> Finding:
    seen = (
        f"edges of depth lie {dx:+.1%} right and {dy:+.1%} down (of the width) in the colour image, and "
        f"{zoom:.2f} times as large"
    )
    advice = "record with colour registered to depth, or warp one onto the other with both calibrations"
    return Finding("unregistered", Level.ERROR, seen, advice)
