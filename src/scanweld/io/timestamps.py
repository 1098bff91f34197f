"""Pair two recordings by time, as the TUM RGB-D benchmark does."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64

MAX_TIME_DIFFERENCE_S = 0.02
"""The benchmark's default: half a frame at 25 frames a second."""


def associate_times(
    times_a_s: Float64, times_b_s: Float64, max_difference_s: float = MAX_TIME_DIFFERENCE_S
) -> list[tuple[int, int]]:
    """Pair two increasing lists of times (N,) and (M,), nearest pairs first, each time used at most once.

    Returns the index pairs (a, b) in the order of a. This is the matching of the benchmark's associate.py;
    equal differences are taken in the order of (a, b).
    """
    low = np.searchsorted(times_b_s, times_a_s - max_difference_s, side="left")
    high = np.searchsorted(times_b_s, times_a_s + max_difference_s, side="right")
    candidates = [
        (abs(float(times_a_s[a] - times_b_s[b])), a, b)
        for a in range(len(times_a_s))
        for b in range(int(low[a]), int(high[a]))
    ]
    used_a: set[int] = set()
    used_b: set[int] = set()
    pairs = []
    for _, a, b in sorted(candidates):
        if a not in used_a and b not in used_b:
            used_a.add(a)
            used_b.add(b)
            pairs.append((a, b))
    return sorted(pairs)
