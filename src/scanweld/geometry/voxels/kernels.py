"""Compiled kernels that group points by the voxel they lie in, with an open-addressed hash table."""

from __future__ import annotations

import math

import numba
import numpy as np

from scanweld.parallel import inlined, kernel

# No fast-math here: it would multiply by the inverse of the side, which puts other points on a voxel's face.
exact = numba.njit(fastmath=False, error_model="numpy", boundscheck=False, cache=True, nogil=True)


@exact
def voxel_number(value, origin, side):
    """Number of the voxel of a coordinate along one axis."""
    return np.int64(math.floor((value - origin) / side))


@inlined
def first_slot(key, mask):
    """Where a key is looked for first."""
    return np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask


@inlined
def slot_of(key, keys, table):
    """Where the label of a key is in the table, or the free slot where it belongs."""
    mask = len(table) - 1
    slot = first_slot(key, mask)
    label = table[slot]
    while label >= 0 and keys[label] != key:
        slot = (slot + 1) & mask
        label = table[slot]
    return slot


@kernel
def label_points(points, first, origin, side, sizes, table, labels, keys, firsts, count):
    """Give points (N, D), from row `first` on, the label of their voxel, numbered as they come.

    sizes (D,): voxels along each axis. table (T,) int32, T a power of two: label of a key, -1 empty. keys, firsts:
    row-major number and first point of each label. Returns the next row, which is short of N when the table has become
    too full, and the number of labels.
    """
    largest = min(len(table) // 2, len(keys))
    key, label = np.int64(-1), np.int32(-1)
    for n in range(first, len(points)):
        last = key
        key = np.int64(0)
        for axis in range(points.shape[1]):
            key = key * sizes[axis] + voxel_number(points[n, axis], origin[axis], side)
        if key != last:  # consecutive points often share a voxel
            slot = slot_of(key, keys, table)
            label = table[slot]
            if label < 0:
                if count == largest:
                    return n, count
                label = np.int32(count)
                table[slot], keys[count], firsts[count] = label, key, n
                count += 1
        labels[n] = label
    return len(points), count


@kernel
def fill_table(keys, count, table):
    """Enter labels 0..count into an empty table."""
    mask = len(table) - 1
    for label in range(count):
        slot = first_slot(keys[label], mask)
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = label


@kernel
def add_rows(values, origin, labels, sums, counts):
    """Add values (N, C) less `origin` (C,) to the row of their label in sums (V, C), and count them."""
    for n in range(len(labels)):
        label = labels[n]
        counts[label] += 1
        for c in range(values.shape[1]):
            sums[label, c] += values[n, c] - origin[c]
