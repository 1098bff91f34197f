"""Compiled kernel that undoes the filters of PNG rows."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel


@kernel
def unfilter(lines, size, out):
    """Undo the filters of `lines` (H, 1 + W * size) uint8, whose first byte names the filter; size: bytes of a pixel.

    Each byte is coded as the difference to a guess from the bytes one pixel left, above, and in the corner between
    them (PNG specification, section 9.2). `out` (1 + H, size + W * size) begins with a row and a pixel of zeros, which
    are those beyond the edge. Returns False when there is an unknown filter.
    """
    height, length = lines.shape[0], lines.shape[1] - 1
    for v in range(height):
        kind, line = lines[v, 0], lines[v, 1:]
        corners, uppers, lefts, row = out[v], out[v, size:], out[v + 1], out[v + 1, size:]
        if kind == 0:
            for k in range(length):
                row[k] = line[k]
        elif kind == 1:
            for k in range(length):
                row[k] = np.uint8(line[k] + lefts[k])
        elif kind == 2:
            for k in range(length):
                row[k] = np.uint8(line[k] + uppers[k])
        elif kind == 3:
            for k in range(length):
                row[k] = np.uint8(np.int32(line[k]) + ((np.int32(lefts[k]) + np.int32(uppers[k])) >> 1))
        elif kind == 4:
            for k in range(length):
                left, above, corner = np.int32(lefts[k]), np.int32(uppers[k]), np.int32(corners[k])
                # Whichever is nearest to left + above - corner; of equals the first (section 9.4).
                to_left, to_above = abs(above - corner), abs(left - corner)
                to_corner = abs(left + above - corner - corner)
                second = above if to_above <= to_corner else corner
                guess = left if (to_left <= to_above) & (to_left <= to_corner) else second
                row[k] = np.uint8(np.int32(line[k]) + guess)
        else:
            return False
    return True
