"""Compiled kernels of the projective aligner.

Blocks of points are moved and projected, what their pixels hold is gathered, and both are turned into rows (Jacobian
columns, residual, weight) that are added to the normal equations. Every residual only fills rows; the linear algebra is
written once. All but the gathering is vectorised: what does not count has the weight zero, and a block's arrays are
flat, with their rows a fixed distance apart, or the compiler could not tell that they do not overlap.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

BLOCK = 512
"""Points handled at a time: their rows stay in the first-level cache."""

ROW = np.uint64(BLOCK)
"""Distance of the rows of a block's arrays."""

CHUNK = 8192
"""Points whose sums share one row of float64 partial sums; fixed, so that sums do not depend on the threads."""

COLUMNS = 7
"""Six of the motion, residual."""

SUMS = 32
"""Partial sums: 28 products of the columns (J, r), then loss, inliers, matched, projected."""


@kernel
def project_block(first, count, positions, normals, transform, intrinsics, width, height, moved, pixels):
    """Move `count` points and their normals and project them; returns how many are in the image.

    moved (6 * BLOCK,): positions and normals in the target frame; pixels (BLOCK,) int32: row-major, -1 outside.
    """
    half, zero, near = np.float32(0.5), np.float32(0), np.float32(1e-3)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    r00, r01, r02, t0 = transform[0, 0], transform[0, 1], transform[0, 2], transform[0, 3]
    r10, r11, r12, t1 = transform[1, 0], transform[1, 1], transform[1, 2], transform[1, 3]
    r20, r21, r22, t2 = transform[2, 0], transform[2, 1], transform[2, 2], transform[2, 3]
    right, bottom, columns = np.float32(width), np.float32(height), np.int32(width)
    kept = np.int32(0)
    for k in range(np.uint64(count)):
        i = np.uint64(first) + k
        x, y, z = positions[0, i], positions[1, i], positions[2, i]
        a, b, c = normals[0, i], normals[1, i], normals[2, i]
        xc = r00 * x + r01 * y + r02 * z + t0
        yc = r10 * x + r11 * y + r12 * z + t1
        zc = r20 * x + r21 * y + r22 * z + t2
        inverse = np.float32(1) / max(zc, near)
        u = fx * xc * inverse + cx + half
        v = fy * yc * inverse + cy + half
        inside = (zc > near) & (u >= zero) & (u < right) & (v >= zero) & (v < bottom)
        moved[k], moved[k + ROW], moved[k + np.uint64(2) * ROW] = xc, yc, zc
        moved[k + np.uint64(3) * ROW] = r00 * a + r01 * b + r02 * c
        moved[k + np.uint64(4) * ROW] = r10 * a + r11 * b + r12 * c
        moved[k + np.uint64(5) * ROW] = r20 * a + r21 * b + r22 * c
        column, row = np.int32(min(max(u, zero), right)), np.int32(min(max(v, zero), bottom))
        pixels[k] = row * columns + column if inside else np.int32(-1)
        kept += np.int32(1) if inside else np.int32(0)
    return kept


@kernel
def gather_surface(count, pixels, target, surface):
    """Gather what the pixels hold: surface (7 * BLOCK,) vertex, normal, one over the noise; zero where there is none.

    target (H * W, 8) float32, see `SurfaceLevel.surface`.
    """
    for k in range(np.uint64(count)):
        j = np.uint64(max(pixels[k], np.int32(0)))
        a, b, c, d = target[j, 0], target[j, 1], target[j, 2], target[j, 3]
        e, f, s = target[j, 4], target[j, 5], target[j, 6]
        surface[k], surface[k + ROW], surface[k + np.uint64(2) * ROW] = a, b, c
        surface[k + np.uint64(3) * ROW], surface[k + np.uint64(4) * ROW] = d, e
        surface[k + np.uint64(5) * ROW] = f
        surface[k + np.uint64(6) * ROW] = s if pixels[k] >= 0 else np.float32(0)


@kernel
def point_to_plane_rows(count, moved, surface, gate, min_cosine, robust, rows, sums):
    """Fill rows (8 * BLOCK,) with J, r, w of the correspondences; those that are not accepted weigh nothing.

    r = n . (p - q) with q, n the target's vertex and normal (Chen and Medioni 1991), J = [n, p x n]; both in units of
    the depth noise at q. The weight is Huber's.
    """
    one, zero, half = np.float32(1), np.float32(0), np.float32(0.5)
    squared_gate = gate * gate
    loss, inliers, matched = zero, zero, zero
    for k in range(np.uint64(count)):
        x, y, z = moved[k], moved[k + ROW], moved[k + np.uint64(2) * ROW]
        a, b, c = moved[k + np.uint64(3) * ROW], moved[k + np.uint64(4) * ROW], moved[k + np.uint64(5) * ROW]
        dx, dy, dz = x - surface[k], y - surface[k + ROW], z - surface[k + np.uint64(2) * ROW]
        nx, ny = surface[k + np.uint64(3) * ROW], surface[k + np.uint64(4) * ROW]
        nz, s = surface[k + np.uint64(5) * ROW], surface[k + np.uint64(6) * ROW]
        cosine = nx * a + ny * b + nz * c
        accept = (s > zero) & (dx * dx + dy * dy + dz * dz < squared_gate) & (cosine > min_cosine)
        r = (nx * dx + ny * dy + nz * dz) * s
        size = abs(r)
        weight = min(robust / max(size, np.float32(1e-12)), one)
        counted = one if accept else zero
        loss += counted * weight * size * (size - half * weight * size)
        inliers += counted if size <= robust else zero
        matched += counted
        nx, ny, nz = nx * s, ny * s, nz * s
        rows[k], rows[k + ROW], rows[k + np.uint64(2) * ROW] = nx, ny, nz
        rows[k + np.uint64(3) * ROW], rows[k + np.uint64(4) * ROW] = y * nz - z * ny, z * nx - x * nz
        rows[k + np.uint64(5) * ROW], rows[k + np.uint64(6) * ROW] = x * ny - y * nx, r
        rows[k + np.uint64(7) * ROW] = counted * weight
    sums[28] += loss
    sums[29] += inliers
    sums[30] += matched


@kernel
def accumulate(rows, columns, count, weighted, sums):
    """Add the weighted products of the columns of `count` rows to the first of `sums`, upper triangle.

    rows ((columns + 1) * BLOCK,), the weights last; weighted (BLOCK,) is overwritten.
    """
    entry = 0
    for a in range(np.uint64(columns)):
        for k in range(np.uint64(count)):
            weighted[k] = rows[k + np.uint64(columns) * ROW] * rows[k + a * ROW]
        for b in range(a, np.uint64(columns)):
            total = np.float32(0)
            for k in range(np.uint64(count)):
                total += weighted[k] * rows[k + b * ROW]
            sums[entry] += total
            entry += 1


@kernel
def point_to_plane_sums(
    start,
    stop,
    bounds,
    positions,
    normals,
    transform,
    target,
    intrinsics,
    width,
    height,
    gate,
    min_cosine,
    robust,
    partials,
):
    """Sums of parts start..stop into partials (parts, SUMS) float64; part k is points bounds[k]..bounds[k + 1].

    positions, normals (3, N) float32 in the source frame; transform (3, 4) float32 source -> target; target
    (H * W, 8) float32, see `SurfaceLevel.surface`; gate [m]; robust: Huber's threshold in standard deviations.
    """
    moved, pixels = np.empty(6 * BLOCK, np.float32), np.empty(BLOCK, np.int32)
    surface, rows = np.empty(7 * BLOCK, np.float32), np.empty((COLUMNS + 1) * BLOCK, np.float32)
    weighted = np.empty(BLOCK, np.float32)
    for part in range(start, stop):
        sums = partials[part]
        sums[:] = 0.0
        for first in range(bounds[part], bounds[part + 1], BLOCK):
            count = min(BLOCK, bounds[part + 1] - first)
            sums[31] += project_block(
                first, count, positions, normals, transform, intrinsics, width, height, moved, pixels
            )
            gather_surface(count, pixels, target, surface)
            point_to_plane_rows(count, moved, surface, gate, min_cosine, robust, rows, sums)
            accumulate(rows, COLUMNS, count, weighted, sums)


@kernel
def slope_pairs(positions, normals, transform, target, intrinsics, width, height, centre, inverse_radius, reach, pairs):
    """List the slopes of both sides for every point within `reach` [m] of a surface in depth; returns how many.

    pairs (13, N): [n, a x n] of the point's normal; the same of the surface's; 1 / variance of the depth. The arm a is
    that from the `centre`, over the radius. The rest as for `point_to_plane_sums`.
    """
    moved, pixels, surface = np.empty(6 * BLOCK, np.float32), np.empty(BLOCK, np.int32), np.empty(7 * BLOCK, np.float32)
    total, found = positions.shape[1], 0
    for first in range(0, total, BLOCK):
        count = min(BLOCK, total - first)
        project_block(first, count, positions, normals, transform, intrinsics, width, height, moved, pixels)
        gather_surface(count, pixels, target, surface)
        for k in range(count):
            x, y = (moved[k] - centre[0]) * inverse_radius, (moved[k + BLOCK] - centre[1]) * inverse_radius
            z = (moved[k + 2 * BLOCK] - centre[2]) * inverse_radius
            for side in range(2):
                normal = surface if side else moved
                a, b, c = normal[k + 3 * BLOCK], normal[k + 4 * BLOCK], normal[k + 5 * BLOCK]
                row = 6 * side
                pairs[row, found], pairs[row + 1, found], pairs[row + 2, found] = a, b, c
                pairs[row + 3, found], pairs[row + 4, found] = y * c - z * b, z * a - x * c
                pairs[row + 5, found] = x * b - y * a
            s = surface[k + 6 * BLOCK]
            pairs[12, found] = s * s
            found += (s > 0) & (abs(surface[k + 2 * BLOCK] - moved[k + 2 * BLOCK]) < reach)
    return found


@kernel
def compare_with_depth(positions, normals, transform, target, intrinsics, width, height, counts):
    """Count (4,) how many points land on a surface, and how many of them are on it, in front of it and behind it.

    positions, normals (3, N) float32 in the source frame; the rest as for `point_to_plane_sums`. What counts as on it
    says `verification.check_against_depth`.
    """
    moved, pixels, surface = np.empty(6 * BLOCK, np.float32), np.empty(BLOCK, np.int32), np.empty(7 * BLOCK, np.float32)
    counts[:] = 0
    total = positions.shape[1]
    for first in range(0, total, BLOCK):
        count = min(BLOCK, total - first)
        project_block(first, count, positions, normals, transform, intrinsics, width, height, moved, pixels)
        gather_surface(count, pixels, target, surface)
        for k in range(count):
            s = surface[k + 6 * BLOCK]
            if s <= 0:
                continue
            dx, dy = moved[k] - surface[k], moved[k + BLOCK] - surface[k + BLOCK]
            dz = moved[k + 2 * BLOCK] - surface[k + 2 * BLOCK]
            nx, ny, nz = surface[k + 3 * BLOCK], surface[k + 4 * BLOCK], surface[k + 5 * BLOCK]
            cosine = nx * moved[k + 3 * BLOCK] + ny * moved[k + 4 * BLOCK] + nz * moved[k + 5 * BLOCK]
            off, far = abs(nx * dx + ny * dy + nz * dz) * s, max(np.float32(0.05), np.float32(6) / s)
            agrees = (off < np.float32(4)) & (abs(dz) < np.float32(0.1)) & (cosine > np.float32(0.5))
            counts[0] += 1
            counts[1] += agrees
            counts[2] += (not agrees) & (dz < -far)
            counts[3] += (not agrees) & (dz > far)
