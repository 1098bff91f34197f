"""Compiled kernels of the photometric residual; they fill rows and sums as those of the projective aligner do."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel
from scanweld.registration.kernels import BLOCK, ROW, accumulate, gather_surface, project_block

COLUMNS = 9
"""Six of the motion, gain, offset, residual."""

SUMS = 46
"""Partial sums: 45 products of the columns, then how many points count."""


@kernel
def gather_grey(first, count, moved, intensities, grey, intrinsics, lit):
    """Gather the brightness of `count` points and of the image there.

    lit (7 * BLOCK,): brightness of the point; that of the four pixels around it; its place between these, across and
    down, -1 outside.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    right, bottom = np.float32(grey.shape[1] - 1), np.float32(grey.shape[0] - 1)
    outside = np.float32(-1)
    for k in range(np.uint64(count)):
        inverse = np.float32(1) / max(moved[k + np.uint64(2) * ROW], np.float32(1e-3))
        u, v = fx * moved[k] * inverse + cx, fy * moved[k + ROW] * inverse + cy
        inside = (u >= 0) & (u < right) & (v >= 0) & (v < bottom)
        u, v = u if inside else np.float32(0), v if inside else np.float32(0)
        column, row = np.uint64(u), np.uint64(v)
        lit[k] = intensities[np.uint64(first) + k]
        lit[k + ROW], lit[k + np.uint64(2) * ROW] = grey[row, column], grey[row, column + np.uint64(1)]
        lit[k + np.uint64(3) * ROW] = grey[row + np.uint64(1), column]
        lit[k + np.uint64(4) * ROW] = grey[row + np.uint64(1), column + np.uint64(1)]
        lit[k + np.uint64(5) * ROW] = u - np.float32(column) if inside else outside
        lit[k + np.uint64(6) * ROW] = v - np.float32(row) if inside else outside


@kernel
def on_the_surface(k, moved, behind, limits):
    """Whether point k is within limits[0] [m] of the surface behind its pixel, and the cosine is above limits[1]."""
    dx, dy, dz = (
        moved[k] - behind[k],
        moved[k + BLOCK] - behind[k + BLOCK],
        moved[k + 2 * BLOCK] - behind[k + 2 * BLOCK],
    )
    nx, ny, nz = behind[k + 3 * BLOCK], behind[k + 4 * BLOCK], behind[k + 5 * BLOCK]
    cosine = nx * moved[k + 3 * BLOCK] + ny * moved[k + 4 * BLOCK] + nz * moved[k + 5 * BLOCK]
    near = dx * dx + dy * dy + dz * dz < limits[0] * limits[0]
    return (behind[k + 6 * BLOCK] > 0) & near & (cosine > limits[1])


@kernel
def list_seen(positions, normals, intensities, transform, surface, grey, intrinsics, limits, values, frame):
    """List the points that the frame sees; returns how many.

    values (7, N): position, normal and brightness of those that it sees; frame (N,): its own brightness there; surface
    (H * W, 8) and grey (H, W) float32, the frame; the rest as for `photometric_sums` and `on_the_surface`.
    """
    moved, pixels = np.empty(6 * BLOCK, np.float32), np.empty(BLOCK, np.int32)
    behind, lit = np.empty(7 * BLOCK, np.float32), np.empty(7 * BLOCK, np.float32)
    height, width = grey.shape
    seen = 0
    for first in range(0, positions.shape[1], BLOCK):
        count = min(BLOCK, positions.shape[1] - first)
        project_block(first, count, positions, normals, transform, intrinsics, width, height, moved, pixels)
        gather_surface(count, pixels, surface, behind)
        gather_grey(first, count, moved, intensities, grey, intrinsics, lit)
        for k in range(count):
            for axis in range(3):
                values[axis, seen] = positions[axis, first + k]
                values[axis + 3, seen] = normals[axis, first + k]
            e, f = lit[k + 5 * BLOCK], lit[k + 6 * BLOCK]
            top = lit[k + BLOCK] + e * (lit[k + 2 * BLOCK] - lit[k + BLOCK])
            low = lit[k + 3 * BLOCK] + e * (lit[k + 4 * BLOCK] - lit[k + 3 * BLOCK])
            values[6, seen], frame[seen] = lit[k], top + f * (low - top)
            seen += (e >= 0) & on_the_surface(k, moved, behind, limits)  # written always, counted only when seen
    return seen


@kernel
def photometric_rows(count, moved, lit, intrinsics, model, rows, sums):
    """Fill rows (10 * BLOCK,) with J (8), r, w of the points; those outside the image weigh nothing.

    r = gain I_model + offset - I(pi(p)), with I interpolated bilinearly and differentiated as interpolated;
    J = [d, p x d, I_model, 1] with d = dr/dp = -dI/du du/dp. Residuals are in units of their scale; weights are those
    of Student's t (Lange et al. 1989).

    moved, lit: see `project_block`, `gather_grey`; model: gain, offset, 1 / scale, degrees of freedom.
    """
    one, zero = np.float32(1), np.float32(0)
    fx, fy = intrinsics[0], intrinsics[1]
    gain, offset, s, freedom = model[0], model[1], model[2], model[3]
    matched = zero
    for k in range(np.uint64(count)):
        x, y, z = moved[k], moved[k + ROW], moved[k + np.uint64(2) * ROW]
        m, i00, i01 = lit[k], lit[k + ROW], lit[k + np.uint64(2) * ROW]
        i10, i11 = lit[k + np.uint64(3) * ROW], lit[k + np.uint64(4) * ROW]
        e, f = lit[k + np.uint64(5) * ROW], lit[k + np.uint64(6) * ROW]
        top, low = i00 + e * (i01 - i00), i10 + e * (i11 - i10)
        slope_u = (i01 - i00) * (one - f) + (i11 - i10) * f
        slope_v = low - top
        inverse = one / max(z, np.float32(1e-3))
        r = (gain * m + offset - top - f * slope_v) * s
        jx = -slope_u * fx * inverse * s
        jy = -slope_v * fy * inverse * s
        jz = -(jx * x + jy * y) * inverse
        counted = one if e >= zero else zero
        rows[k], rows[k + ROW], rows[k + np.uint64(2) * ROW] = jx, jy, jz
        rows[k + np.uint64(3) * ROW], rows[k + np.uint64(4) * ROW] = y * jz - z * jy, z * jx - x * jz
        rows[k + np.uint64(5) * ROW] = x * jy - y * jx
        rows[k + np.uint64(6) * ROW], rows[k + np.uint64(7) * ROW] = m * s, s
        rows[k + np.uint64(8) * ROW] = r
        rows[k + np.uint64(9) * ROW] = counted * (freedom + one) / (freedom + r * r)
        matched += counted
    sums[45] += matched


@kernel
def photometric_sums(
    start, stop, bounds, positions, normals, intensities, transform, grey, intrinsics, model, partials
):
    """Sums of parts start..stop into partials (parts, SUMS) float64; part k is points bounds[k]..bounds[k + 1].

    positions, normals (3, N), intensities (N,) float32 in the source frame; transform (3, 4) float32 source -> target;
    grey (H, W) float32, the target; model: see `photometric_rows`.
    """
    moved, pixels = np.empty(6 * BLOCK, np.float32), np.empty(BLOCK, np.int32)
    lit, weighted = np.empty(7 * BLOCK, np.float32), np.empty(BLOCK, np.float32)
    rows = np.empty((COLUMNS + 1) * BLOCK, np.float32)
    height, width = grey.shape
    for part in range(start, stop):
        sums = partials[part]
        sums[:] = 0.0
        for first in range(bounds[part], bounds[part + 1], BLOCK):
            count = min(BLOCK, bounds[part + 1] - first)
            project_block(first, count, positions, normals, transform, intrinsics, width, height, moved, pixels)
            gather_grey(first, count, moved, intensities, grey, intrinsics, lit)
            photometric_rows(count, moved, lit, intrinsics, model, rows, sums)
            accumulate(rows, COLUMNS, count, weighted, sums)
