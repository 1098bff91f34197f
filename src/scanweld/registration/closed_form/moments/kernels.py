"""Kernels that sum pairs up: their moments, for any dimension D.

Coordinates of a pair are one column of 2 D numbers, the source's first. A row of moments holds COUNT, DROPPED, INVALID
and WEIGHT, then an origin (2 D), the weighted mean minus that origin (2 D), and the weighted second moments about the
mean (2 D, 2 D). Every block has its own origin, one of its points, so coordinates of 1e6 lose nothing. Blocks merge as
T. F. Chan, G. H. Golub, R. J. LeVeque do, "Updating formulae and a pairwise algorithm for computing sample variances",
1979.

Where an argument `source_rows` is empty, row i belongs to row i; where `weights` is, all pairs count alike.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

BLOCK = 512
CHUNK = 16384
"""Pairs per partial sum; fixed, so that results do not depend on the number of threads."""

COUNT, DROPPED, INVALID, WEIGHT = range(4)
HEAD = 4

EXPONENT = np.int64(0x7FF0000000000000)  # all of its bits are set in infinities and NaN, which fast-math may not test
NEGATIVE_ZERO = np.int64(-0x8000000000000000)


@kernel
def load_weights(first, count, source, target, source_rows, weights, w, head):
    """Weights of a block of pairs into w; 0 where one is not used. Counts them in head[:HEAD]."""
    d = source.shape[1]
    w[:count] = 1.0
    if len(weights) > 0:
        given, bits = weights[first : first + count], weights.view(np.int64)[first : first + count]
        for k in range(count):
            invalid = ((bits[k] & EXPONENT) == EXPONENT) | ((bits[k] < 0) & (bits[k] != NEGATIVE_ZERO))
            head[INVALID] += 1.0 if invalid else 0.0
            w[k] = 0.0 if invalid else given[k]
    if len(source_rows) == 0:
        a = source.reshape(-1).view(np.int64)[first * d : (first + count) * d]
        b = target.reshape(-1).view(np.int64)[first * d : (first + count) * d]
        largest = np.int64(0)
        for k in range(count * d):
            largest = max(largest, a[k] & EXPONENT, b[k] & EXPONENT)
        if largest == EXPONENT:
            for k in range(count):
                largest = np.int64(0)
                for j in range(d):
                    largest = max(largest, a[k * d + j] & EXPONENT, b[k * d + j] & EXPONENT)
                if largest == EXPONENT:
                    w[k] = 0.0
                    head[DROPPED] += 1.0
    used = 0.0
    total = 0.0
    for k in range(count):
        used += 1.0 if w[k] > 0 else 0.0
        total += w[k]
    head[COUNT] += used
    head[WEIGHT] += total


@kernel
def load_points(first, count, points, rows, w, origin, x):
    """Coordinates (D, count) of a block of points, minus the origin, into x; 0 where the weight is 0."""
    if len(rows) == 0:
        block = points[first : first + count]
        for j in range(points.shape[1]):
            o = origin[j]
            for k in range(count):
                x[j, k] = block[k, j] - o if w[k] > 0 else 0.0
    else:
        picked = rows[first : first + count]
        for j in range(points.shape[1]):
            o = origin[j]
            for k in range(count):
                x[j, k] = points[np.uint64(picked[k]), j] - o if w[k] > 0 else 0.0


@kernel
def block_moments(count, x, w, y, moments):
    """Mean and second moments of x (2 D, count), weights w, into a row whose head is known; x loses its mean."""
    size = len(x)
    mean = moments[HEAD + size : HEAD + 2 * size]
    second = moments[HEAD + 2 * size :].reshape(size, size)
    for j in range(size):
        total = 0.0
        for k in range(count):
            total += w[k] * x[j, k]
        mean[j] = total / moments[WEIGHT]
        for k in range(count):
            x[j, k] -= mean[j]
    for i in range(size):
        for k in range(count):
            y[k] = w[k] * x[i, k]
        for j in range(i, size):
            total = 0.0
            for k in range(count):
                total += y[k] * x[j, k]
            second[i, j] = total
            second[j, i] = total


@kernel
def merge_moments(total, part, size):
    """Add the pairs of one row of moments to another; `size` is 2 D."""
    for k in range(3):
        total[k] += part[k]
    one, other = total[WEIGHT], part[WEIGHT]
    if other <= 0:
        return
    if one <= 0:
        for k in range(WEIGHT, len(total)):
            total[k] = part[k]
        return
    share = other / (one + other)
    total[WEIGHT] = one + other
    delta = np.empty(size)
    for j in range(size):
        delta[j] = part[HEAD + j] - total[HEAD + j]
    for j in range(size):
        delta[j] += part[HEAD + size + j] - total[HEAD + size + j]
    for i in range(size):
        total[HEAD + size + i] += share * delta[i]
        for j in range(size):
            k = HEAD + (2 + i) * size + j
            total[k] += part[k] + one * share * delta[i] * delta[j]


@kernel
def pair_moments(start, stop, source, target, source_rows, target_rows, weights, partials):
    """Moments of the chunks start..stop of the pairs into partials (chunks, 4 + 4 D + 4 D^2)."""
    d = source.shape[1]
    num_pairs = len(source_rows) if len(source_rows) > 0 else len(source)
    x, w, y = np.empty((2 * d, BLOCK)), np.empty(BLOCK), np.empty(BLOCK)
    block = np.empty(partials.shape[1])
    for chunk in range(start, stop):
        partials[chunk] = 0.0
        last = min((chunk + 1) * CHUNK, num_pairs)
        for first in range(chunk * CHUNK, last, BLOCK):
            count = min(BLOCK, last - first)
            block[:] = 0.0
            load_weights(first, count, source, target, source_rows, weights, w, block)
            k = 0  # the heaviest pair is the origin: one from far away that hardly counts would cost digits
            for other in range(1, count):
                k = other if w[other] > w[k] else k
            if w[k] > 0:
                i = source_rows[first + k] if len(source_rows) > 0 else first + k
                j = target_rows[first + k] if len(source_rows) > 0 else first + k
                origin = block[HEAD : HEAD + 2 * d]
                for c in range(d):
                    origin[c], origin[d + c] = source[i, c], target[j, c]
                load_points(first, count, source, source_rows, w, origin[:d], x[:d])
                load_points(first, count, target, target_rows, w, origin[d:], x[d:])
                block_moments(count, x, w, y, block)
            merge_moments(partials[chunk], block, 2 * d)
