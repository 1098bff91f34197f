"""Times: their unit, and whether frames are missing."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64
from scanweld.checkup.findings import Figures, Finding, Judgement, Level

PLAUSIBLE_INTERVAL_S = (0.002, 2.0)
"""Time from frame to frame [s], from 500 frames a second to one in two seconds."""

GAP_INTERVALS, GAP_S = 4.0, 0.25
"""A gap is so many times the usual interval, and no shorter than this [s]."""

_UNITS = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


def check_times(times_s: Float64) -> Judgement:
    """Look at the times of all frames (N,)."""
    if len(times_s) < 2:
        return [], {"interval_s": None, "longest_gap": None}
    intervals = np.diff(times_s)
    usual = float(np.median(intervals))
    longest = int(np.argmax(intervals))
    figures: Figures = {"interval_s": usual, "longest_gap": float(intervals[longest]) / usual}
    low, high = PLAUSIBLE_INTERVAL_S
    if not low <= usual <= high:
        return [_wrong_unit(usual)], figures
    gaps = np.flatnonzero(intervals >= max(GAP_INTERVALS * usual, GAP_S))
    if len(gaps) == 0:
        return [], figures
    one = len(gaps) == 1
    seen = (
        f"{'a gap' if one else f'{len(gaps)} gaps, the longest'} of {intervals[longest]:.2f} s after frame {longest}, "
        f"where a frame comes every {usual:.3g} s"
    )
    advice = (
        f"record again without load on the disk, or map the parts on their own: --frames 0:{longest + 1}, "
        f"--frames {longest + 1}:"
    )
    return [Finding("gaps", Level.WARNING, seen, advice)], figures


def _wrong_unit(usual: float) -> Finding:
    low, high = PLAUSIBLE_INTERVAL_S
    seen = f"a frame comes every {usual:.4g} s"
    for factor, name in _UNITS:
        if low <= usual / factor <= high:
            fix = f"are these {name}? divide all times, those of the truth too, by {factor:.0e}"
            return Finding("time-unit", Level.ERROR, f"{seen}, as {name} would be {factor / usual:.3g} a second", fix)
    return Finding("time-unit", Level.ERROR, seen, "write all times in seconds")
