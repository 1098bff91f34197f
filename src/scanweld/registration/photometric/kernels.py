"""Compiled kernels of the photometric residual; they fill rows and sums as those of the projective aligner do."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel
from scanweld.registration.kernels import BLOCK, project_block

COLUMNS = 9
"""Six of the motion, gain, offset, residual."""

SUMS = 48
"""Partial sums: 45 products of the columns, then loss, matched, projected."""


@kernel
def photometric_rows(
    first, kept, moved, pixels, normals, intensities, transform, surface, grey, intrinsics, limits, model, rows, sums
):
    """Fill rows (10, BLOCK) with J (8), r, w of the points that the frame sees; returns how many.

    r = gain I_model + offset - I(pi(p)), with I interpolated bilinearly and differentiated as interpolated;
    J = [d, p x d, I_model, 1] with d = dr/dp = -dI/du du/dp. A point counts when the surface behind its pixel is within
    the gate of it. Residuals are in units of their scale; weights are those of Student's t (Lange et al. 1989).

    limits: gate [m], smallest cosine; model: gain, offset, 1 / scale, degrees of freedom.
    """
    matched = 0
    one = np.float32(1)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    squared_gate, min_cosine = limits[0] * limits[0], limits[1]
    gain, offset, s, freedom = model[0], model[1], model[2], model[3]
    right, bottom = np.float32(grey.shape[1] - 1), np.float32(grey.shape[0] - 1)
    for k in range(kept):
        q = surface[pixels[k]]
        x, y, z = moved[0, k], moved[1, k], moved[2, k]
        dx, dy, dz = x - q[0], y - q[1], z - q[2]
        i = first + np.int64(moved[3, k])
        a, b, c = normals[0, i], normals[1, i], normals[2, i]
        cosine = (
            q[3] * (transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c)
            + q[4] * (transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c)
            + q[5] * (transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c)
        )
        inverse = one / z
        u, v = fx * x * inverse + cx, fy * y * inverse + cy
        inside = (u >= 0) & (u < right) & (v >= 0) & (v < bottom)
        accept = inside & (q[6] > 0) & (dx * dx + dy * dy + dz * dz < squared_gate) & (cosine > min_cosine)
        column, row = np.int64(u) if inside else 0, np.int64(v) if inside else 0
        e, f = u - np.float32(column), v - np.float32(row)
        i00, i01 = grey[row, column], grey[row, column + 1]
        i10, i11 = grey[row + 1, column], grey[row + 1, column + 1]
        top, low = i00 + e * (i01 - i00), i10 + e * (i11 - i10)
        slope_u = (i01 - i00) * (one - f) + (i11 - i10) * f
        slope_v = low - top
        m = intensities[i]
        r = (gain * m + offset - top - f * (low - top)) * s
        jx = -slope_u * fx * inverse * s
        jy = -slope_v * fy * inverse * s
        jz = -(jx * x + jy * y) * inverse
        rows[0, matched], rows[1, matched], rows[2, matched] = jx, jy, jz
        rows[3, matched] = y * jz - z * jy
        rows[4, matched] = z * jx - x * jz
        rows[5, matched] = x * jy - y * jx
        rows[6, matched], rows[7, matched] = m * s, s
        rows[8, matched] = r
        rows[9, matched] = (freedom + one) / (freedom + r * r)
        matched += 1 if accept else 0
    loss = np.float32(0)
    for k in range(matched):
        loss += np.log(one + rows[8, k] * rows[8, k] / freedom)
    sums[45] += np.float32(0.5) * (freedom + one) * loss
    sums[46] += matched
    sums[47] += kept
    return matched


@kernel
def accumulate_nine(rows, count, sums):
    """Add the weighted products of nine columns of `count` rows to sums[0:45], upper triangle."""
    entry = 0
    for a in range(9):
        for b in range(a, 9):
            total = np.float32(0)
            for k in range(count):
                total += rows[9, k] * rows[a, k] * rows[b, k]
            sums[entry] += total
            entry += 1


@kernel
def photometric_sums(
    start, stop, bounds, positions, normals, intensities, transform, surface, grey, intrinsics, limits, model, partials
):
    """Sums of parts start..stop into partials (parts, SUMS) float64; part k is points bounds[k]..bounds[k + 1].

    positions, normals (3, N), intensities (N,) float32 in the source frame; transform (3, 4) float32 source -> target;
    surface (H * W, 8) and grey (H, W) float32, the target; the rest as for `photometric_rows`.
    """
    moved = np.empty((4, BLOCK), np.float32)
    pixels = np.empty(BLOCK, np.int64)
    rows = np.empty((10, BLOCK), np.float32)
    height, width = grey.shape
    for part in range(start, stop):
        sums = partials[part]
        sums[:] = 0.0
        for first in range(bounds[part], bounds[part + 1], BLOCK):
            count = min(BLOCK, bounds[part + 1] - first)
            kept = project_block(first, count, positions, transform, intrinsics, width, height, moved, pixels)
            matched = photometric_rows(
                first, kept, moved, pixels, normals, intensities, transform, surface, grey, intrinsics, limits, model,
                rows, sums,
            )  # fmt: skip
            accumulate_nine(rows, matched, sums)
