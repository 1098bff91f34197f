"""Compiled kernels on depth images. Rows are independent: a range of rows is one thread's share.

How a loop is written decides whether the compiler fills vectors: indices count from 0 and only grow (no test for a
negative one), there is no branch, and arrays can be told apart: what is written lies at fixed offsets in one array.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

BLOCK = 512
"""Pixels of a row that are worked on at a time, in an array (13, BLOCK): five sums, then eight values of a surface."""

INVALID = np.float32(-1e15)
"""Inverse depth where there is none: a pair with it is never straight."""

BEND_SIGMAS = np.float32(8)
"""Largest bend that noise explains, in standard deviations of the centre's depth."""


@kernel
def grey_rows(start, stop, color, out):
    """Rows start..stop of the grey image (H, W) float32, 0..255, of color (H, W * 3) uint8 (ITU-R BT.601)."""
    for v in range(start, stop):
        rgb, grey = color[v], out[v]
        for k in range(len(grey)):
            red, green, blue = np.float32(rgb[3 * k]), np.float32(rgb[3 * k + 1]), np.float32(rgb[3 * k + 2])
            grey[k] = np.float32(0.299) * red + np.float32(0.587) * green + np.float32(0.114) * blue


@kernel
def halve_depth(start, stop, depth, relative_band, out):
    """Rows start..stop of the half-size depth image.

    The mean of those pixels of each 2x2 block that lie within `relative_band` of the nearest one, so that no
    average mixes two surfaces; 0 where all four are invalid.
    """
    far, zero, one = np.float32(1e9), np.float32(0), np.float32(1)
    for v in range(start, stop):
        upper, lower, row = depth[2 * v], depth[2 * v + 1], out[v]
        for u in range(len(row)):
            a, b, c, d = upper[2 * u], upper[2 * u + 1], lower[2 * u], lower[2 * u + 1]
            nearest = min(min(a if a > 0 else far, b if b > 0 else far), min(c if c > 0 else far, d if d > 0 else far))
            limit = nearest * (one + relative_band)
            total, count = zero, zero
            for z in (a, b, c, d):
                use = (z > zero) & (z <= limit)
                total += z if use else zero
                count += one if use else zero
            row[u] = total / max(count, one)


@kernel
def bend_ratio(a, z, b, noise):
    """Bend of inverse depth between three pixels, in standard deviations of depth z by the noise model."""
    sigma = noise[0] + noise[1] * (z - noise[2]) * (z - noise[2])
    return abs(z * z / a + z * z / b - np.float32(2) * z) / sigma


@kernel
def bend_ratios(depth, noise, out):
    """Fill `out` with the bends of pixels three apart, on every eighth row and column; returns how many are valid."""
    height, width = depth.shape
    count = 0
    for v in range(0, height, 8):
        for u in range(0, width - 6, 4):
            a, z, b = depth[v, u], depth[v, u + 3], depth[v, u + 6]
            if (a > 0) & (z > 0) & (b > 0):
                out[count] = bend_ratio(a, z, b, noise)
                count += 1
    for v in range(0, height - 6, 4):
        for u in range(0, width, 8):
            a, z, b = depth[v, u], depth[v + 3, u], depth[v + 6, u]
            if (a > 0) & (z > 0) & (b > 0):
                out[count] = bend_ratio(a, z, b, noise)
                count += 1
    return count


@kernel
def invert_row(depth, noise, inverse, bend):
    """Inverse depth of a row, and the largest bend of it that noise explains, which is 0 where depth is invalid."""
    zero, one = np.float32(0), np.float32(1)
    floor, growth, nearest = noise[0], noise[1], noise[2]
    for u in range(len(depth)):
        z = depth[u]
        m = one / z if z > zero else INVALID
        inverse[u] = m
        bend[u] = BEND_SIGMAS * (floor + growth * (z - nearest) * (z - nearest)) * m * m if z > zero else zero


@kernel
def with_pair(sums, a, b, twice, bend, x, y):
    """Return the sums xx, xy, yy, x s, y s with the slope of a pixel pair (a, b) that is 2 (x, y) apart."""
    straight = abs(a + b - twice) < bend
    use = np.float32(1) if straight else np.float32(0)
    slope = b - a if straight else np.float32(0)
    return (
        sums[0] + use * (x * x),
        sums[1] + use * (x * y),
        sums[2] + use * (y * y),
        sums[3] + slope * x,
        sums[4] + slope * y,
    )


@kernel
def add_slopes(before, centre, behind, bend, x, y, work):
    """Add the slopes of the pixel pairs (before, behind), which are 2 (x, y) apart, to the five sums."""
    for k in range(len(centre)):
        sums = (work[k], work[k + BLOCK], work[k + 2 * BLOCK], work[k + 3 * BLOCK], work[k + 4 * BLOCK])
        sums = with_pair(sums, before[k], behind[k], np.float32(2) * centre[k], bend[k], x, y)
        work[k], work[k + BLOCK], work[k + 2 * BLOCK], work[k + 3 * BLOCK], work[k + 4 * BLOCK] = sums


@kernel
def sum_slopes_5x5(above, over, centre, under, below, bend, work):
    """Set the five sums to those of a 5x5 window: `add_slopes` of all its twelve pairs, without leaving registers.

    Rows begin two pixels before those of `bend`.
    """
    # Floats, all of them: integers would be literal types, and every pair of them a function to compile.
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    for k in range(len(bend)):
        twice, limit = two * centre[k + 2], bend[k]
        sums = (zero, zero, zero, zero, zero)
        sums = with_pair(sums, centre[k + 1], centre[k + 3], twice, limit, one, zero)
        sums = with_pair(sums, centre[k], centre[k + 4], twice, limit, two, zero)
        sums = with_pair(sums, over[k + 4], under[k], twice, limit, -two, one)
        sums = with_pair(sums, over[k + 3], under[k + 1], twice, limit, -one, one)
        sums = with_pair(sums, over[k + 2], under[k + 2], twice, limit, zero, one)
        sums = with_pair(sums, over[k + 1], under[k + 3], twice, limit, one, one)
        sums = with_pair(sums, over[k], under[k + 4], twice, limit, two, one)
        sums = with_pair(sums, above[k + 4], below[k], twice, limit, -two, two)
        sums = with_pair(sums, above[k + 3], below[k + 1], twice, limit, -one, two)
        sums = with_pair(sums, above[k + 2], below[k + 2], twice, limit, zero, two)
        sums = with_pair(sums, above[k + 1], below[k + 3], twice, limit, one, two)
        sums = with_pair(sums, above[k], below[k + 4], twice, limit, two, two)
        work[k], work[k + BLOCK], work[k + 2 * BLOCK], work[k + 3 * BLOCK], work[k + 4 * BLOCK] = sums


@kernel
def surface_block(depth, centre, intrinsics, noise, min_cosine, u, v, work):
    """Turn the sums of a block, whose first pixel is (u, v), into surfaces; see `surface_rows`."""
    zero, one, tiny = np.float32(0), np.float32(1), np.float32(1e-24)
    floor, growth, nearest = noise[0], noise[1], noise[2]
    fx, fy = intrinsics[0], intrinsics[1]
    left, y = np.float32(u) - intrinsics[2], (np.float32(v) - intrinsics[3]) / fy
    per_pixel = one / fx
    for k in range(len(depth)):
        sxx, sxy, syy = work[k], work[k + BLOCK], work[k + 2 * BLOCK]
        sx, sy = work[k + 3 * BLOCK], work[k + 4 * BLOCK]
        z, m = depth[k], centre[k]
        determinant = sxx * syy - sxy * sxy
        good = determinant > np.float32(0.5)
        scale = np.float32(0.5) / (determinant if good else one)
        x = (np.float32(k) + left) * per_pixel
        a = fx * scale * (syy * sx - sxy * sy)
        b = fy * scale * (sxx * sy - sxy * sx)
        c = m - a * x - b * y
        # (A, B, C) points away from the camera: n . ray = 1/z > 0.
        per_length = one / np.sqrt(max(a * a + b * b + c * c, tiny))
        cosine = m * per_length / np.sqrt(x * x + y * y + one)
        good = good & (cosine > min_cosine)
        flip = -per_length if good else zero
        work[k + 5 * BLOCK] = x * z
        work[k + 6 * BLOCK] = y * z
        work[k + 7 * BLOCK] = z
        work[k + 8 * BLOCK] = a * flip
        work[k + 9 * BLOCK] = b * flip
        work[k + 10 * BLOCK] = c * flip
        work[k + 11 * BLOCK] = one / (floor + growth * (z - nearest) * (z - nearest)) if good else zero
        # Radius of the disc that covers the pixel on the slanted surface (Keller et al. 2013, sec. 3.1).
        work[k + 12 * BLOCK] = z * np.float32(0.70711) * per_pixel / max(cosine, np.float32(0.26)) if good else zero


@kernel
def store_block(work, out):
    """Write the surfaces of a block, value by value, to its pixels (N * 8), pixel by pixel."""
    for k in range(len(out) // 8):
        out[8 * k] = work[k + 5 * BLOCK]
        out[8 * k + 1] = work[k + 6 * BLOCK]
        out[8 * k + 2] = work[k + 7 * BLOCK]
        out[8 * k + 3] = work[k + 8 * BLOCK]
        out[8 * k + 4] = work[k + 9 * BLOCK]
        out[8 * k + 5] = work[k + 10 * BLOCK]
        out[8 * k + 6] = work[k + 11 * BLOCK]
        out[8 * k + 7] = work[k + 12 * BLOCK]


@kernel
def surface_rows(start, stop, depth, intrinsics, radius, noise, min_cosine, out):
    """Rows start..stop of the surface image (H, W * 8): vertex, normal, 1 / sigma, surfel radius.

    Inverse depth of a plane is linear in the pixel: 1/z = A x + B y + C with x = (u - cx) / fx, y = (v - cy) / fy and
    (A, B, C) the normal's direction. The slopes come from differences of opposite pixels in a window, which cancels
    the centre's own noise; a pair counts when the centre lies between its two ends, that is, when no edge passes.
    """
    height, width = depth.shape
    # Inverse depth of the rows in the window, each in the place of the one that has left it; a margin on both sides.
    size = 2 * radius + 1
    inverse = np.full((size, width + 2 * radius), INVALID, np.float32)
    bend = np.zeros((size, width), np.float32)
    work = np.empty(13 * BLOCK, np.float32)
    for v in range(start - radius, stop + radius):
        place = (v + size) % size
        if (v >= 0) & (v < height):
            invert_row(depth[v], noise, inverse[place, radius : radius + width], bend[place])
        else:
            inverse[place] = INVALID
        row = v - radius
        if row < start:
            continue
        middle = (row + size) % size
        for first in range(0, width, BLOCK):
            last = min(first + BLOCK, width)
            limits = bend[middle, first:last]
            if radius == 2:
                wide = last + 4
                sum_slopes_5x5(
                    inverse[(row + 3) % size, first:wide], inverse[(row + 4) % size, first:wide],
                    inverse[middle, first:wide],
                    inverse[(row + 6) % size, first:wide], inverse[(row + 7) % size, first:wide],
                    limits, work,
                )  # fmt: skip
            else:
                for k in range(5 * BLOCK):
                    work[k] = np.float32(0)
                for dv in range(radius + 1):
                    before, behind = inverse[(row - dv + size) % size], inverse[(row + dv) % size]
                    for du in range(-radius if dv > 0 else 1, radius + 1):
                        i, j = first + radius, last + radius
                        add_slopes(
                            before[i - du : j - du], inverse[middle, i:j], behind[i + du : j + du], limits,
                            np.float32(du), np.float32(dv), work,
                        )  # fmt: skip
            surface_block(
                depth[row, first:last], inverse[middle, first + radius : last + radius], intrinsics, noise, min_cosine,
                first, row, work,
            )  # fmt: skip
            store_block(work, out[row, 8 * first : 8 * last])
        for u in range(width):
            if (u < radius) | (u >= width - radius):  # the window is cut on a side: no normal
                for k in range(8 * u + 3, 8 * u + 8):
                    out[row, k] = np.float32(0)


@kernel
def bilateral_rows(start, stop, depth, radius, space_sigma, noise, range_factor, out):
    """Rows start..stop of the bilateral filter; range sigma = range_factor * sigma(z); invalid stays 0."""
    height, width = depth.shape
    for v in range(start, stop):
        for u in range(width):
            z = depth[v, u]
            if z <= 0:
                out[v, u] = np.float32(0)
                continue
            sigma = range_factor * (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2]))
            total, weights = np.float32(0), np.float32(0)
            for dv in range(-min(radius, v), min(radius, height - 1 - v) + 1):
                for du in range(-min(radius, u), min(radius, width - 1 - u) + 1):
                    other = depth[v + dv, u + du]
                    near = np.float32(du * du + dv * dv) / (space_sigma * space_sigma)
                    step = (other - z) / sigma
                    weight = np.exp(np.float32(-0.5) * (near + step * step)) if other > 0 else np.float32(0)
                    total += weight * other
                    weights += weight
            out[v, u] = total / weights
