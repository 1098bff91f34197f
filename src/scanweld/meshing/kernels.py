"""Compiled kernels that fuse depth into blocks of signed distances (Curless and Levoy 1996; Nießner et al. 2013).

The grid is a set of blocks of SIDE^3 samples. Sample (i, j, k) of block (a, b, c) is at
voxel_m * (SIDE a + i, SIDE b + j, SIDE c + k) in the world. A block is found by its key in an open-addressed hash
table of labels; its arrays are row `label` of distances, weights (C, SIDE^3) and colors (C, SIDE^3, 3).
"""

from __future__ import annotations

import math

import numpy as np

from scanweld.geometry.voxels.kernels import slot_of
from scanweld.parallel import inlined, kernel

SIDE = 8
SAMPLES = SIDE * SIDE * SIDE
KEY_BITS = 21
HALF = 1 << (KEY_BITS - 1)
"""Block coordinates are within -HALF..HALF-1."""

COLOR_ONE = np.float32(256)
"""Stored colours are 1 + 256 times the channel, 0 where there is none yet: a mean of bytes would stop moving."""

MOST_EXTENSION = np.float32(3)
"""The band along a ray is that many times the truncation at most, where the surface is seen flatly."""


@inlined
def key_of(a, b, c):
    """Key of a block."""
    return ((np.int64(a) + HALF) << (2 * KEY_BITS)) | ((np.int64(b) + HALF) << KEY_BITS) | (np.int64(c) + HALF)


@inlined
def label_of(key, keys, table):
    """Label of a block, -1 where there is none."""
    return table[slot_of(key, keys, table)]


@inlined
def enter_block(key, keys, table, count):
    """Enter a block that may be there already; returns the number of blocks then, -1 - count when there is no room."""
    slot = slot_of(key, keys, table)
    if table[slot] >= 0:
        return count
    if count >= min(len(table) // 2, len(keys)):
        return -1 - count
    table[slot], keys[count] = np.int32(count), key
    return count + 1


@inlined
def truncation(z, band):
    """Half the width of the band of distances [m] about a surface at depth z."""
    return min(max(band[0] + band[1] * (z - band[2]) * (z - band[2]), band[3]), band[4])


@kernel
def mark_blocks(surface, pose, intrinsics, band, block_m, stride, table, keys, count):
    """Enter the blocks that the band about the measured surface crosses; a walk through the grid along each ray.

    surface (H, W, 8) float32 as in SurfaceLevel. pose (3, 4): T_world_camera. band (5,): see `truncation`. Pixels are
    taken every `stride` rows and columns. Returns the number of blocks; -1 - number when there is no room for more,
    and -1 - len(keys) - 1 when a block is too far away to be numbered.
    """
    height, width = surface.shape[0], surface.shape[1]
    last_key = np.int64(-1)
    at = np.empty(3)
    cell, step = np.empty(3, np.int64), np.empty(3, np.int64)
    until, every = np.empty(3), np.empty(3)
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            cosine = seen_cosine(surface[v, u])
            if cosine <= 0:
                continue
            z = surface[v, u, 2]
            reach = truncation(z, band) * min(np.float32(1) / cosine, MOST_EXTENSION)
            x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
            # Amanatides and Woo 1987: from cell to cell along the segment, parameter 0..1.
            near, far = max(z - reach, np.float32(0)), z + reach
            for axis in range(3):
                ray = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2]
                start = (pose[axis, 3] + near * ray) / block_m
                along = (far - near) * ray / block_m
                at[axis] = start
                cell[axis] = np.int64(math.floor(start))
                step[axis] = 1 if along > 0 else -1
                if abs(along) > 1e-12:
                    every[axis] = 1.0 / abs(along)
                    border = cell[axis] + 1 - start if along > 0 else start - cell[axis]
                    until[axis] = border * every[axis]
                else:
                    every[axis] = until[axis] = 1e30
            while True:
                if min(cell[0], min(cell[1], cell[2])) < -HALF or max(cell[0], max(cell[1], cell[2])) >= HALF:
                    return -2 - len(keys)
                key = key_of(cell[0], cell[1], cell[2])
                if key != last_key:
                    last_key = key
                    count = enter_block(key, keys, table, count)
                    if count < 0:
                        return count
                axis = 0
                if until[1] < until[axis]:
                    axis = 1
                if until[2] < until[axis]:
                    axis = 2
                if until[axis] > 1.0:
                    break
                cell[axis] += step[axis]
                until[axis] += every[axis]
    return count


@inlined
def seen_cosine(pixel):
    """Cosine between a pixel's normal and the way to the camera; 0 where there is no normal."""
    x, y, z = pixel[0], pixel[1], pixel[2]
    across = -(x * pixel[3] + y * pixel[4] + z * pixel[5])
    return across / math.sqrt(x * x + y * y + z * z + np.float32(1e-12))


@kernel
def blocks_in_view(start, stop, keys, block_m, pose, intrinsics, shape, farthest, visible):
    """Mark blocks start..stop that may be seen: their ball reaches into the frustum up to depth `farthest`."""
    radius = 0.8661 * block_m
    width, height = shape[1], shape[0]
    left, right = (-0.5 - intrinsics[2]) / intrinsics[0], (width - 0.5 - intrinsics[2]) / intrinsics[0]
    top, bottom = (-0.5 - intrinsics[3]) / intrinsics[1], (height - 0.5 - intrinsics[3]) / intrinsics[1]
    reach_l, reach_r = radius * math.sqrt(1 + left * left), radius * math.sqrt(1 + right * right)
    reach_t, reach_b = radius * math.sqrt(1 + top * top), radius * math.sqrt(1 + bottom * bottom)
    for n in range(start, stop):
        key = keys[n]
        dx = ((key >> (2 * KEY_BITS)) - HALF + 0.5) * block_m - pose[0, 3]
        dy = (((key >> KEY_BITS) & (2 * HALF - 1)) - HALF + 0.5) * block_m - pose[1, 3]
        dz = ((key & (2 * HALF - 1)) - HALF + 0.5) * block_m - pose[2, 3]
        x = pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz
        y = pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz
        z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
        visible[n] = (
            (z > -radius)
            & (z < farthest + radius)
            & (x - left * z > -reach_l)
            & (right * z - x > -reach_r)
            & (y - top * z > -reach_t)
            & (bottom * z - y > -reach_b)
        )


@kernel
def weigh_pixels(start, stop, surface, band, noise, pixels):
    """Rows start..stop of pixels (H, W, 8): vertex, normal, weight and truncation of each pixel.

    The weight is the cosine at which the surface is seen over the variance of the depth, in units of the smallest. It
    is negative where there is no normal, as at edges: where the surface is cannot be told there, only what is in front
    of it. The truncation is 0 where nothing was measured. noise (4,): floor, growth and nearest of the depth noise,
    and the floor of the best frame.
    """
    for v in range(start, stop):
        for u in range(surface.shape[1]):
            for c in range(6):
                pixels[v, u, c] = surface[v, u, c]
            z = surface[v, u, 2]
            cosine = seen_cosine(surface[v, u])
            if cosine > 0:
                share = noise[3] * surface[v, u, 6]
                weight = cosine * share * share
            else:
                share = noise[3] / (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2]))
                weight = np.float32(-0.5) * share * share
            pixels[v, u, 6] = weight
            pixels[v, u, 7] = truncation(z, band) if z > 0 else np.float32(0)


@kernel
def integrate_blocks(start, stop, labels, keys, voxel, pose, intrinsics, pixels, color, distances, weights, colors):
    """Fuse one frame into blocks labels[start..stop]: a weighted mean of the distances to what samples project to.

    The distance is that to the plane through the pixel's vertex, across its normal: unlike the difference in depth it
    is right where a surface is seen at an angle. Behind the surface the weight falls to 0 at the truncation, so that
    the two sides of something thin disturb each other less. What is seen through is carved: its distance is the
    truncation. pixels (H, W, 8) as `weigh_pixels` makes them; color (H, W, 3) uint8.
    """
    height, width = pixels.shape[0], pixels.shape[1]
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half, zero, one = np.float32(0.5), np.float32(0), np.float32(1)
    # What one step along a world axis is in the camera
    xi, yi, zi = np.float32(pose[0, 0] * voxel), np.float32(pose[0, 1] * voxel), np.float32(pose[0, 2] * voxel)
    xj, yj, zj = np.float32(pose[1, 0] * voxel), np.float32(pose[1, 1] * voxel), np.float32(pose[1, 2] * voxel)
    xk, yk, zk = np.float32(pose[2, 0] * voxel), np.float32(pose[2, 1] * voxel), np.float32(pose[2, 2] * voxel)
    side = np.float32(voxel)
    for n in range(start, stop):
        label = labels[n]
        key = keys[label]
        dx = ((key >> (2 * KEY_BITS)) - HALF) * SIDE * voxel - pose[0, 3]
        dy = (((key >> KEY_BITS) & (2 * HALF - 1)) - HALF) * SIDE * voxel - pose[1, 3]
        dz = ((key & (2 * HALF - 1)) - HALF) * SIDE * voxel - pose[2, 3]
        bx = np.float32(pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz)
        by = np.float32(pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz)
        bz = np.float32(pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz)
        for row in range(SIDE * SIDE):
            i, j = np.float32(row // SIDE), np.float32(row % SIDE)
            rx, ry, rz = bx + i * xi + j * xj, by + i * yi + j * yj, bz + i * zi + j * zj
            for k in range(SIDE):
                s = np.float32(k)
                x, y, z = rx + s * xk, ry + s * yk, rz + s * zk
                if z <= side:
                    continue
                inverse = one / z
                pu, pv = fx * x * inverse + cx + half, fy * y * inverse + cy + half
                if (pu < zero) | (pv < zero) | (pu >= width) | (pv >= height):
                    continue
                u, v = np.int64(pu), np.int64(pv)
                limit = pixels[v, u, 7]
                ahead = pixels[v, u, 2] - z  # along the optical axis, positive in front of the surface
                if (limit <= zero) | (ahead < -MOST_EXTENSION * limit):
                    continue
                far_ahead = ahead > MOST_EXTENSION * limit
                w = pixels[v, u, 6]
                d = limit
                if w < zero:
                    if not far_ahead:
                        continue
                    w = -w
                elif not far_ahead:
                    across = pixels[v, u, 3] * (x - pixels[v, u, 0]) + pixels[v, u, 4] * (y - pixels[v, u, 1])
                    d = min(across - pixels[v, u, 5] * ahead, limit)
                    if d <= -limit:
                        continue
                    if d < -side:
                        w *= (limit + d) / (limit - side)
                at = row * SIDE + k
                total = weights[label, at] + w
                if total <= zero:
                    continue
                share = w / total
                distances[label, at] += share * (d - distances[label, at])
                weights[label, at] = total
                if abs(d) < 2 * side:
                    old = colors[label, at, 0] > 0
                    for channel in range(3):
                        value = one + COLOR_ONE * np.float32(color[v, u, channel])
                        mean = np.float32(colors[label, at, channel])
                        mixed = mean + share * (value - mean) if old else value
                        colors[label, at, channel] = np.uint16(mixed + half)


@kernel
def mark_balls(positions, reach, block_m, table, keys, count):
    """Enter the blocks that boxes of half width reach (N,) about positions (N, 3) touch; returns as `mark_blocks`."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(positions)):
        for axis in range(3):
            low[axis] = np.int64(math.floor((positions[n, axis] - reach[n]) / block_m))
            high[axis] = np.int64(math.floor((positions[n, axis] + reach[n]) / block_m))
        if min(low[0], min(low[1], low[2])) < -HALF or max(high[0], max(high[1], high[2])) >= HALF:
            return -2 - len(keys)
        for a in range(low[0], high[0] + 1):
            for b in range(low[1], high[1] + 1):
                for c in range(low[2], high[2] + 1):
                    count = enter_block(key_of(a, b, c), keys, table, count)
                    if count < 0:
                        return count
    return count


@kernel
def integrate_discs(positions, normals, paint, radii, strengths, voxel, limit, keys, table, distances, weights, colors):
    """Fuse oriented discs: samples up to `limit` before and behind a disc take the distance to its plane.

    positions, normals (N, 3) float64; paint (N, 3) uint8; radii (N,) [m] of the discs, at whose rim the weight, which
    is `strengths` (N,) in the middle, is 0.
    """
    one, half = np.float32(1), np.float32(0.5)
    for n in range(len(positions)):
        radius = radii[n]
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        # Half the size of the box about the disc, which is as thick as the band
        hx = radius * math.sqrt(max(1 - nx * nx, 0.0)) + limit * abs(nx)
        hy = radius * math.sqrt(max(1 - ny * ny, 0.0)) + limit * abs(ny)
        hz = radius * math.sqrt(max(1 - nz * nz, 0.0)) + limit * abs(nz)
        last_key, label = np.int64(-1), np.int32(-1)
        for i in range(math.ceil((x - hx) / voxel), math.floor((x + hx) / voxel) + 1):
            for j in range(math.ceil((y - hy) / voxel), math.floor((y + hy) / voxel) + 1):
                for k in range(math.ceil((z - hz) / voxel), math.floor((z + hz) / voxel) + 1):
                    dx, dy, dz = i * voxel - x, j * voxel - y, k * voxel - z
                    d = nx * dx + ny * dy + nz * dz
                    inside = 1.0 - (dx * dx + dy * dy + dz * dz - d * d) / (radius * radius)
                    if (abs(d) > limit) | (inside <= 0):
                        continue
                    key = key_of(i >> 3, j >> 3, k >> 3)
                    if key != last_key:
                        last_key, label = key, label_of(key, keys, table)
                    if label < 0:
                        continue
                    at = ((i & 7) * SIDE + (j & 7)) * SIDE + (k & 7)
                    w = np.float32(strengths[n] * inside)
                    total = weights[label, at] + w
                    share = w / total
                    distances[label, at] += share * (np.float32(d) - distances[label, at])
                    weights[label, at] = total
                    kept = colors[label, at]
                    old = kept[0] > 0
                    for channel in range(3):
                        value = one + COLOR_ONE * np.float32(paint[n, channel])
                        mean = np.float32(kept[channel])
                        kept[channel] = np.uint16((mean + share * (value - mean) if old else value) + half)
