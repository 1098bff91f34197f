"""Compiled kernels that choose what is tracked and search for moving objects.

Images are those of one pyramid level, see `SurfaceLevel`.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

CLOSED, OPEN, SEED = np.uint8(0), np.uint8(1), np.uint8(2)
"""What a pixel may be: without a surface; part of any surface; one that the model lacks, in space that was empty."""


@kernel
def list_rows(index_map, confidences, least, stride, rows):
    """List the rows of a view in the order of its pixels, those of at least this confidence; returns how many.

    index_map (H, W) int32, confidences (N,) float32: see `ModelView`; stride: of the pixels that are looked at, along
    rows, each a pixel aside of the one above; rows (H * W + 1,) int64.
    """
    count = 0
    for v in range(index_map.shape[0]):
        for u in range((stride - v % stride) % stride, index_map.shape[1], stride):
            row = index_map[v, u]
            rows[count] = row  # written always, counted only when listed: no branch to mispredict
            count += 1 if (row >= 0) & (confidences[np.uint64(max(row, np.int32(0)))] >= least) else 0
    return count


@kernel
def take_columns(values, columns, taken):
    """Copy `columns` (M,) of values (C, N) to taken (C, M); `np.take` needs five times as long."""
    for c in range(values.shape[0]):
        for k in range(columns.shape[0]):
            taken[c, k] = values[c, np.uint64(columns[k])]


@kernel
def mark_supported(
    start, stop, stride, positions, confidences, stable, transform, intrinsics, surface, parameters, supported
):  # fmt: skip
    """Mark the pixels whose surface a stable surfel confirms; looks at every `stride`-th surfel, start..stop of these.

    transform (3, 4) world -> camera; parameters (2,): gate in standard deviations, gate floor [m]; supported (H, W)
    uint8 becomes 1. Threads write nothing but ones.
    """
    height, width = supported.shape
    half = np.float32(0.5)
    for i in range(start * stride, min(stop * stride, len(confidences)), stride):
        if confidences[i] < stable:
            continue
        x, y, z = positions[0, i], positions[1, i], positions[2, i]
        xc = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
        yc = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
        zc = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
        u = intrinsics[0] * xc / zc + intrinsics[2] + half
        v = intrinsics[1] * yc / zc + intrinsics[3] + half
        if (zc <= np.float32(0.01)) | (u < 0) | (v < 0) | (u >= np.float32(width)) | (v >= np.float32(height)):
            continue
        row, column = np.int64(v), np.int64(u)
        s = surface[row, column]
        dx, dy, dz = xc - s[0], yc - s[1], zc - s[2]
        gate = max(parameters[0] / s[6], parameters[1])
        reach = np.float32(4) * s[7] + gate
        along = abs(s[3] * dx + s[4] * dy + s[5] * dz)
        if (s[6] > 0) & (along < gate) & (dx * dx + dy * dy + dz * dz < reach * reach):
            supported[row, column] = np.uint8(1)


@kernel
def classify_rows(
    start, stop, surface, supported, intrinsics, empty_until, transforms, margin, sigmas, state
):  # fmt: skip
    """Tell for the pixels of rows start..stop whether they are CLOSED, OPEN or a SEED.

    empty_until (K, H, W) [m]: how far earlier views saw through each pixel, 0 where that is not known; transforms
    (K, 3, 4) from this camera to theirs; margin [m] and sigmas: how far before that limit a point must lie.
    """
    height, width = state.shape
    half = np.float32(0.5)
    for v in range(start, stop):
        for u in range(width):
            s = surface[v, u]
            state[v, u] = OPEN if s[6] > 0 else CLOSED
            if (s[6] <= 0) | (supported[v, u] > 0):
                continue
            room = margin + sigmas / s[6]
            for k in range(len(transforms)):
                T = transforms[k]
                zc = T[2, 0] * s[0] + T[2, 1] * s[1] + T[2, 2] * s[2] + T[2, 3]
                right = intrinsics[0] * (T[0, 0] * s[0] + T[0, 1] * s[1] + T[0, 2] * s[2] + T[0, 3]) / zc
                down = intrinsics[1] * (T[1, 0] * s[0] + T[1, 1] * s[1] + T[1, 2] * s[2] + T[1, 3]) / zc
                x, y = right + intrinsics[2] + half, down + intrinsics[3] + half
                inside = (x >= 0) & (y >= 0) & (x < np.float32(width)) & (y < np.float32(height))
                if (zc > np.float32(0.01)) & inside and zc + room < empty_until[k, np.int64(y), np.int64(x)]:
                    state[v, u] = SEED
                    break


@kernel
def connected(s, n, max_step, sigmas, min_cosine):
    """Whether two neighbouring pixels s, n (8,) show one surface: depths within the step, normals that agree."""
    cosine = s[3] * n[3] + s[4] * n[4] + s[5] * n[5]
    return (abs(n[2] - s[2]) < max_step * s[2] + sigmas / s[6]) & (cosine > min_cosine)


@kernel
def grow_regions(surface, state, pixel, max_step, sigmas, min_cosine, min_pixels, reach, queue, distance, moving):
    """Gather SEED pixels to regions, and grow those of `min_pixels` and more over OPEN ones into `moving` (H, W) bool.

    Growth ends `reach` [m] from the nearest seed along the surface; pixel: width of a pixel at a depth of 1 m. Seeds
    of regions that are too small become CLOSED. queue (H * W,) int32 and distance (H, W) float32 are working space.
    Returns how many pixels move.
    """
    height, width = state.shape
    kept = 0
    for start in range(height * width):
        v, u = start // width, start % width
        if (state[v, u] != SEED) | moving[v, u]:
            continue
        queue[kept], end, head = start, kept + 1, kept
        moving[v, u] = True
        while head < end:
            v, u = queue[head] // width, queue[head] % width
            head += 1
            for dv, du in ((-1, 0), (0, -1), (0, 1), (1, 0)):
                y, x = v + dv, u + du
                if (y < 0) | (x < 0) | (y >= height) | (x >= width):
                    continue
                if (state[y, x] != SEED) | moving[y, x]:
                    continue
                if connected(surface[v, u], surface[y, x], max_step, sigmas, min_cosine):
                    moving[y, x] = True
                    queue[end] = y * width + x
                    end += 1
        if end - kept >= min_pixels:
            kept = end
        else:
            for k in range(kept, end):
                moving[queue[k] // width, queue[k] % width] = False
                state[queue[k] // width, queue[k] % width] = CLOSED
    for k in range(kept):
        distance[queue[k] // width, queue[k] % width] = np.float32(0)
    head, end = 0, kept
    while head < end:
        v, u = queue[head] // width, queue[head] % width
        head += 1
        far = distance[v, u] + pixel * surface[v, u, 2]
        for dv, du in ((-1, 0), (0, -1), (0, 1), (1, 0)):
            y, x = v + dv, u + du
            if (y < 0) | (x < 0) | (y >= height) | (x >= width) | (far > reach):
                continue
            if (state[y, x] != OPEN) | moving[y, x]:
                continue
            if connected(surface[v, u], surface[y, x], max_step, sigmas, min_cosine):
                moving[y, x], distance[y, x] = True, far
                queue[end] = y * width + x
                end += 1
    return end


@kernel
def refine_rows(start, stop, depth, moving, coarse_depth, factor, max_step, mask):
    """Rows start..stop of the mask (H, W) bool of the full image, from that of a level `factor` times smaller.

    A pixel moves when its coarse pixel or one of its neighbours does, at about the same depth.
    """
    height, width = moving.shape
    for v in range(start, stop):
        for u in range(mask.shape[1]):
            z, found = depth[v, u], False
            row, column = min(v // factor, height - 1), min(u // factor, width - 1)
            for y in range(max(row - 1, 0), min(row + 2, height)):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    found |= moving[y, x] & (abs(coarse_depth[y, x] - z) < max_step * z)
            mask[v, u] = found
