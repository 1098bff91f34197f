"""Compiled kernels of direct bundle adjustment: what one keyframe sees of the surfels, and how keyframes are tied."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

COLUMNS = 14
"""Of a row: pose (6), camera (5: fx, fy, cx, cy, inverse depth offset), surfel offset, residual, weight."""

CHANNELS = 3
"""Residuals of an observation: distance to the plane, and two differences of brightness."""


@kernel
def observe(
    positions, normals, tangents, transform, surface, grey, intrinsics, noise, limits, lit, which, pixels, seen, rows
):
    """Find the surfels that a keyframe sees; returns how many.

    positions, normals (S, 3), tangents (S, 2, 3) float32, world frame; transform (3, 4) float32, T_camera_world;
    surface (H, W, 8), grey (H, W) float32, `lit`: whether there is brightness; intrinsics (4,);
    noise (3,), of :class:`SurfaceConfig`; limits: gate [m],
    smallest cosine. Written: which (S,) int32, the surfels; pixels (S,) int32, where they are seen; seen (S, 3), the
    measured normals, camera frame; rows (S, CHANNELS, COLUMNS).

    With q the measured point on the ray of the surfel p, n its normal, all in the camera's frame, the distance is
    r = n . (q - p) / sigma(q), and p, n move with T_camera_world <- exp(xi) T_camera_world, q with the intrinsics.
    The differences of brightness are I(pi(p + t_c)) - I(pi(p)) in grey levels, t_c the two tangents.
    """
    height, width = grey.shape
    one, half = np.float32(1), np.float32(0.5)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    gate, min_cosine = limits[0], limits[1]
    p = np.empty(3, np.float32)
    n = np.empty(3, np.float32)
    m = np.empty(3, np.float32)
    values = np.empty((3, COLUMNS), np.float32)
    count = 0
    for s in range(positions.shape[0]):
        for a in range(3):
            p[a] = transform[a, 3]
            n[a] = np.float32(0)
            for b in range(3):
                p[a] += transform[a, b] * positions[s, b]
                n[a] += transform[a, b] * normals[s, b]
        if p[2] < np.float32(1e-2):
            continue
        u = fx * p[0] / p[2] + cx
        v = fy * p[1] / p[2] + cy
        if not ((u >= -half) & (v >= -half) & (u < np.float32(width) - half) & (v < np.float32(height) - half)):
            continue
        column, row = int(u + half), int(v + half)
        q = surface[row, column]
        # Depth is interpolated (inverse depth, which is linear on a plane), so that residuals do not jump where a
        # surfel comes into another pixel; not across an edge.
        left, top = max(min(int(u), width - 2), 0), max(min(int(v), height - 2), 0)
        e, f = min(max(u - np.float32(left), np.float32(0)), one), min(max(v - np.float32(top), np.float32(0)), one)
        inverse = np.float32(0)
        close = True
        for k in range(4):
            z = surface[top + k // 2, left + k % 2, 2]
            close = close & (abs(z - p[2]) < gate) & (z > 0)
            share = (e if k % 2 == 1 else one - e) * (f if k // 2 == 1 else one - f)
            inverse += share / max(z, np.float32(1e-3))
        facing = n[0] * q[3] + n[1] * q[4] + n[2] * q[5] > min_cosine
        if not ((q[6] > 0) & close & facing):
            continue
        z = one / inverse
        which[count] = s
        pixels[count] = row * width + column
        for a in range(3):
            seen[count, a] = q[3 + a]
        # Slopes and weight are those at the surfel, not at the measured vertex: that one shares its noise with the
        # residual, and their product would not average to zero.
        sigma = noise[0] + noise[1] * (p[2] - noise[2]) * (p[2] - noise[2])
        w = q[6] * (noise[0] + noise[1] * (q[2] - noise[2]) * (q[2] - noise[2])) / sigma
        out = rows[count, 0]
        out[0], out[1], out[2] = -n[0] * w, -n[1] * w, -n[2] * w
        out[3] = -(p[1] * n[2] - p[2] * n[1]) * w
        out[4] = -(p[2] * n[0] - p[0] * n[2]) * w
        out[5] = -(p[0] * n[1] - p[1] * n[0]) * w
        out[6], out[7] = -n[0] * p[0] / fx * w, -n[1] * p[1] / fy * w
        out[8], out[9] = -n[0] * p[2] / fx * w, -n[1] * p[2] / fy * w
        out[10] = -p[2] * (n[0] * p[0] + n[1] * p[1] + n[2] * p[2]) * w
        out[11] = -w
        out[12] = (z / p[2] - one) * (n[0] * p[0] + n[1] * p[1] + n[2] * p[2]) * w
        out[13] = one
        inside = lit
        for c in range(3):
            for a in range(3):
                m[a] = p[a]
                if c > 0:
                    for b in range(3):
                        m[a] += transform[a, b] * tangents[s, c - 1, b]
            inverse = one / max(m[2], np.float32(1e-2))
            u, v = fx * m[0] * inverse + cx, fy * m[1] * inverse + cy
            good = (u >= 0) & (v >= 0) & (u < np.float32(width - 1)) & (v < np.float32(height - 1))
            inside = inside & good
            column, row = (int(u), int(v)) if good else (0, 0)
            e, f = u - np.float32(column), v - np.float32(row)
            i00, i01 = grey[row, column], grey[row, column + 1]
            i10, i11 = grey[row + 1, column], grey[row + 1, column + 1]
            slope_u = (one - f) * (i01 - i00) + f * (i11 - i10)
            slope_v = (one - e) * (i10 - i00) + e * (i11 - i01)
            jx, jy = slope_u * fx * inverse, slope_v * fy * inverse
            jz = -(jx * m[0] + jy * m[1]) * inverse
            out = values[c]
            out[0], out[1], out[2] = jx, jy, jz
            out[3] = m[1] * jz - m[2] * jy
            out[4] = m[2] * jx - m[0] * jz
            out[5] = m[0] * jy - m[1] * jx
            out[6], out[7] = slope_u * m[0] * inverse, slope_v * m[1] * inverse
            out[8], out[9] = slope_u, slope_v
            out[10] = np.float32(0)
            out[11] = jx * n[0] + jy * n[1] + jz * n[2]
            out[12] = (one - f) * ((one - e) * i00 + e * i01) + f * ((one - e) * i10 + e * i11)
        for c in range(1, 3):
            for k in range(13):
                rows[count, c, k] = values[c, k] - values[0, k] if inside else np.float32(0)
            rows[count, c, 13] = one if inside else np.float32(0)
        count += 1
    return count


@kernel
def pair_blocks(start, stop, bounds, surfel, keyframe, mixed, run_bounds, runs, pair_of, blocks):
    """Add what the surfels tie between keyframes i in start..stop and later ones j: blocks[pair] -= C_a C_b^T.

    bounds (K + 1,): observations bounds[i]..bounds[i + 1] are those of keyframe i; surfel, keyframe (M,) of each;
    mixed (M, 6, 3) float32, C; runs[run_bounds[s]..run_bounds[s + 1]] are the observations of surfel s; pair_of (K, K)
    int32, the number of a pair; blocks (P, 6, 6) float64.
    """
    for i in range(start, stop):
        for a in range(bounds[i], bounds[i + 1]):
            s = surfel[a]
            left = mixed[a]
            for e in range(run_bounds[s], run_bounds[s + 1]):
                b = runs[e]
                j = keyframe[b]
                if j <= i:
                    continue
                right = mixed[b]
                block = blocks[pair_of[i, j]]
                for k in range(6):
                    for m in range(6):
                        block[k, m] -= left[k, 0] * right[m, 0] + left[k, 1] * right[m, 1] + left[k, 2] * right[m, 2]
