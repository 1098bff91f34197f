"""What pictures show: motion blur, exposure, and how fast the camera moves."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64, UInt8
from scanweld.checkup.findings import Finding, Judgement, Level

MOST_SPREAD_PX = 2.5
"""Pixels of an image of at most 480 that sharp edges may spread over; 1 is the sharpest."""

MOST_GAIN = 1.2
"""Factor by which the brightness of a place may change from frame to frame."""

MOST_DISPLACEMENT = 0.08
"""Share of the width by which features may move from frame to frame."""

_FASTEST = 0.75  # what three quarters of the steps stay below: a leap or a wrong match is no pace

_CONTRAST = 40.0  # grey levels between the two sides of an edge that is looked at
_REACH_PX = 8
_SHARPEST = 0.95
_LEAST_EDGES = 50


def edge_spread(gray: UInt8) -> float:
    """Return over how many pixels the sharpest edges of a picture spread, in the direction where they do so most.

    An edge that spreads over n pixels rises by 1 / n of its contrast from one pixel to the next. NaN where a picture
    has too few edges in both directions.
    """
    import cv2

    spreads = []
    for across in (1, 0):
        image = gray.astype(np.float32) if across else gray.T.astype(np.float32)
        image = cv2.blur(image, (1, 3))  # along the edge: against noise
        window = np.ones((1, 2 * _REACH_PX + 1), np.uint8)
        contrast = (cv2.dilate(image, window) - cv2.erode(image, window))[:, _REACH_PX:-_REACH_PX]
        rise = np.abs(np.diff(image, axis=1, append=image[:, -1:]))
        steepest = (rise == cv2.dilate(rise, window))[:, _REACH_PX:-_REACH_PX]  # whose window has the whole edge
        edges = (contrast > _CONTRAST) & steepest
        if edges.sum() >= _LEAST_EDGES:
            rises = rise[:, _REACH_PX:-_REACH_PX][edges] / contrast[edges]
            spreads.append(1 / float(np.quantile(rises, _SHARPEST)))
    return max(spreads) if spreads else np.nan


def check_sharpness(spreads_px: Float64) -> Judgement:
    """Look at how far the sharpest edges of each picture spread; NaN is a picture without edges."""
    known = spreads_px[np.isfinite(spreads_px)]
    if len(known) == 0:
        return [], {"edge_spread_px": None}
    usual = float(np.median(known))
    if usual <= MOST_SPREAD_PX:
        return [], {"edge_spread_px": usual}
    blurred = float((known > MOST_SPREAD_PX).mean())
    seen = f"the sharpest edges spread over {usual:.1f} pixels (of a small image), in {blurred:.0%} of the pictures"
    advice = "more light, a shorter exposure, a slower hand; clean or focus the lens"
    return [Finding("motion-blur", Level.WARNING, seen, advice)], {"edge_spread_px": usual}


def check_exposure(gains: Float64) -> Judgement:
    """Look at the factors by which brightness changed from frame to frame; NaN where no feature was found again."""
    changes = np.exp(np.abs(np.log(gains[np.isfinite(gains)])))
    if len(changes) == 0:
        return [], {"brightness_factor": None}
    largest = float(changes.max())
    if largest <= MOST_GAIN:
        return [], {"brightness_factor": largest}
    jumps = int((changes > MOST_GAIN).sum())
    seen = (
        f"the brightness of the same places changes by up to a factor of {largest:.2f} from one frame to the next, in "
        f"{jumps} of {len(changes)} steps looked at"
    )
    advice = "fix exposure, gain and white balance of the camera; avoid lamps that flicker"
    return [Finding("exposure", Level.WARNING, seen, advice)], {"brightness_factor": largest}


def check_pace(displacements: Float64) -> Judgement:
    """Look at how far features moved from frame to frame, as shares of the width; NaN where none was found again."""
    known = displacements[np.isfinite(displacements)]
    if len(known) == 0:
        return [], {"displacement": None}
    fast = float(np.quantile(known, _FASTEST))
    if fast <= MOST_DISPLACEMENT:
        return [], {"displacement": fast}
    seen = f"from frame to frame the picture moves by {fast:.0%} of its width and more in a quarter of the steps"
    advice = "move more slowly, record at a higher rate, or use every frame (no step in --frames)"
    return [Finding("fast-motion", Level.WARNING, seen, advice)], {"displacement": fast}
