"""Compiled kernels of the projective aligner.

Blocks of points are projected, compacted to those that land in the image, turned into rows (six Jacobian columns,
residual, weight), and the rows are added to the normal equations. Every residual only fills rows; the linear algebra
is written once.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

BLOCK = 512
"""Points handled at a time: their rows stay in the first-level cache."""

CHUNK = 8192
"""Points whose sums share one row of float64 partial sums; fixed, so that sums do not depend on the threads."""

SUMS = 32
"""Partial sums: 28 products of the columns (J, r), then loss, inliers, matched, projected."""


@kernel
def project_block(first, count, positions, transform, intrinsics, width, height, moved, pixels):
    """Move `count` points and project them; keep those in the image. Returns how many were kept.

    moved (4, BLOCK): x, y, z in the target frame and the index of the point; pixels (BLOCK,): row-major pixel.
    """
    kept = 0
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half = np.float32(0.5)
    right, bottom = np.float32(width), np.float32(height)
    for k in range(count):
        i = first + k
        x, y, z = positions[0, i], positions[1, i], positions[2, i]
        xc = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
        yc = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
        zc = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
        inverse = np.float32(1) / max(zc, np.float32(1e-6))
        u = fx * xc * inverse + cx + half
        v = fy * yc * inverse + cy + half
        inside = (zc > np.float32(1e-3)) & (u >= 0) & (u < right) & (v >= 0) & (v < bottom)
        # Written always, counted only when inside: no branch to mispredict.
        moved[0, kept], moved[1, kept], moved[2, kept], moved[3, kept] = xc, yc, zc, np.float32(k)
        pixels[kept] = (np.int64(v) * width + np.int64(u)) if inside else 0
        kept += 1 if inside else 0
    return kept


@kernel
def point_to_plane_rows(first, kept, moved, pixels, normals, transform, target, gate, min_cosine, robust, rows, sums):
    """Fill rows (8, BLOCK) with J, r, w of the accepted correspondences; returns how many.

    r = n . (p - q) with q, n the target's vertex and normal (Chen and Medioni 1991), J = [n, p x n]; both in units of
    the depth noise at q. The weight is Huber's.
    """
    matched = 0
    squared_gate = gate * gate
    for k in range(kept):
        q = target[pixels[k]]
        x, y, z = moved[0, k], moved[1, k], moved[2, k]
        dx, dy, dz = x - q[0], y - q[1], z - q[2]
        nx, ny, nz = q[3], q[4], q[5]
        i = first + np.int64(moved[3, k])
        a, b, c = normals[0, i], normals[1, i], normals[2, i]
        cosine = (
            nx * (transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c)
            + ny * (transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c)
            + nz * (transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c)
        )
        s = q[6]
        accept = (s > 0) & (dx * dx + dy * dy + dz * dz < squared_gate) & (cosine > min_cosine)
        r = (nx * dx + ny * dy + nz * dz) * s
        rows[0, matched], rows[1, matched], rows[2, matched] = nx * s, ny * s, nz * s
        rows[3, matched] = (y * nz - z * ny) * s
        rows[4, matched] = (z * nx - x * nz) * s
        rows[5, matched] = (x * ny - y * nx) * s
        rows[6, matched] = r
        matched += 1 if accept else 0
    inliers = np.float32(0)
    loss = np.float32(0)
    for k in range(matched):
        size = abs(rows[6, k])
        inside = size <= robust
        rows[7, k] = np.float32(1) if inside else robust / size
        loss += np.float32(0.5) * size * size if inside else robust * (size - np.float32(0.5) * robust)
        inliers += np.float32(1) if inside else np.float32(0)
    sums[28] += loss
    sums[29] += inliers
    sums[30] += matched
    sums[31] += kept
    return matched


@kernel
def accumulate(rows, count, sums):
    """Add the weighted products of the seven columns (J, r) of `count` rows to sums[0:28], upper triangle."""
    entry = 0
    for a in range(7):
        for b in range(a, 7):
            total = np.float32(0)
            for k in range(count):
                total += rows[7, k] * rows[a, k] * rows[b, k]
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
    moved = np.empty((4, BLOCK), np.float32)
    pixels = np.empty(BLOCK, np.int64)
    rows = np.empty((8, BLOCK), np.float32)
    for part in range(start, stop):
        sums = partials[part]
        sums[:] = 0.0
        for first in range(bounds[part], bounds[part + 1], BLOCK):
            count = min(BLOCK, bounds[part + 1] - first)
            kept = project_block(first, count, positions, transform, intrinsics, width, height, moved, pixels)
            matched = point_to_plane_rows(
                first, kept, moved, pixels, normals, transform, target, gate, min_cosine, robust, rows, sums
            )
            accumulate(rows, matched, sums)
