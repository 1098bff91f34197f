"""LZF, the compression of PCD files (M. Lehmann, liblzf): literal runs, and copies of earlier output.

A control byte below 32 says that so many bytes and one more follow as they are. Any other begins a copy: its upper
three bits are the length less 2 (7: add the next byte), its lower five and the last byte the distance less 1.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

TRUNCATED, BEFORE_START, TOO_LONG, TOO_SHORT = 1, 2, 3, 4
"""What can be wrong with compressed data; 0 is nothing."""


@kernel
def decode_lzf(source, target):
    """Fill `target` (uint8) from `source` (uint8); return 0 or what is wrong."""
    i = 0
    o = 0
    while i < source.size:
        control = int(source[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > source.size:
                return TRUNCATED
            if o + length > target.size:
                return TOO_LONG
            for k in range(length):
                target[o + k] = source[i + k]
            i += length
        else:
            length = control >> 5
            if i + (2 if length == 7 else 1) > source.size:
                return TRUNCATED
            if length == 7:
                length += int(source[i])
                i += 1
            length += 2
            start = o - ((control & 31) << 8) - int(source[i]) - 1
            i += 1
            if start < 0:
                return BEFORE_START
            if o + length > target.size:
                return TOO_LONG
            for k in range(length):  # byte by byte: what is copied may begin with what this copy writes
                target[o + k] = target[start + k]
        o += length
    return 0 if o == target.size else TOO_SHORT


@kernel
def encode_lzf(source, target):
    """Compress `source` (uint8) into `target` (uint8, 33/32 of its size and 4); return how many bytes were written."""
    latest = np.full(1 << 16, -1, np.int64)  # where three bytes of this hash were seen last
    i = 0
    o = 0
    literals = 0  # bytes of the literal run that ends at o; its control byte is written when it ends
    while i < source.size:
        length = 0
        start = -1
        if i + 2 < source.size:
            triple = int(source[i]) << 16 | int(source[i + 1]) << 8 | int(source[i + 2])
            slot = (triple * 2654435761 >> 12) & 65535
            start = latest[slot]
            latest[slot] = i
            if start >= 0 and i - start <= 8192:
                most = min(source.size - i, 264)
                while length < most and source[start + length] == source[i + length]:
                    length += 1
        if length >= 3:
            if literals:
                target[o - literals - 1] = literals - 1
                literals = 0
            distance = i - start - 1
            if length - 2 < 7:
                target[o] = (length - 2) << 5 | distance >> 8
                o += 1
            else:
                target[o] = 7 << 5 | distance >> 8
                target[o + 1] = length - 9
                o += 2
            target[o] = distance & 255
            o += 1
            i += length
        else:
            if literals == 0:
                o += 1  # room for the control byte
            target[o] = source[i]
            o += 1
            i += 1
            literals += 1
            if literals == 32:
                target[o - 33] = 31
                literals = 0
    if literals:
        target[o - literals - 1] = literals - 1
    return o
