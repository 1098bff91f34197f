"""Compiled kernels on depth images. Rows are independent: a range of rows is one thread's share."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel


@kernel
def halve_depth(start, stop, depth, relative_band, out):
    """Rows start..stop of the half-size depth image.

    The mean of those pixels of each 2x2 block that lie within `relative_band` of the nearest one, so that no
    average mixes two surfaces; 0 where all four are invalid.
    """
    for v in range(start, stop):
        for u in range(out.shape[1]):
            a, b = depth[2 * v, 2 * u], depth[2 * v, 2 * u + 1]
            c, d = depth[2 * v + 1, 2 * u], depth[2 * v + 1, 2 * u + 1]
            far = np.float32(1e9)
            nearest = min(min(a if a > 0 else far, b if b > 0 else far), min(c if c > 0 else far, d if d > 0 else far))
            limit = nearest * (np.float32(1) + relative_band)
            total, count = np.float32(0), np.float32(0)
            for z in (a, b, c, d):
                use = np.float32((z > 0) & (z <= limit))
                total += use * z
                count += use
            out[v, u] = total / max(count, np.float32(1))


@kernel
def add_slopes(a, m, b, bend, x, y, sxx, sxy, syy, sx, sy):
    """Add the slopes of the pixel pairs (a, b) around m, 2 (x, y) apart, to sums (5, N): xx, xy, yy, x s, y s.

    All slices start at index 0, so that the compiler sees plain unit strides and vectorises.
    """
    zero = np.float32(0)
    for k in range(len(m)):
        straight = abs(a[k] + b[k] - m[k] - m[k]) < bend[k]
        use = np.float32(1) if (a[k] > zero) & (b[k] > zero) & straight else zero
        slope = use * (b[k] - a[k])
        sxx[k] += use * x * x
        sxy[k] += use * x * y
        syy[k] += use * y * y
        sx[k] += slope * x
        sy[k] += slope * y


@kernel
def surface_rows(start, stop, depth, intrinsics, radius, noise, min_cosine, out):
    """Rows start..stop of the surface image (H, W, 8): vertex, normal, 1 / sigma, surfel radius.

    Inverse depth of a plane is linear in the pixel: 1/z = A x + B y + C with x = (u - cx) / fx, y = (v - cy) / fy and
    (A, B, C) the normal's direction. The slopes come from differences of opposite pixels in a window, which cancels
    the centre's own noise; a pair counts when the centre lies between its two ends, that is, when no edge passes.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    zero, one = np.float32(0), np.float32(1)
    top = max(0, start - radius)
    bottom = min(height, stop + radius)
    inverse = np.zeros((bottom - top, width), np.float32)
    for v in range(top, bottom):
        for u in range(width):
            z = depth[v, u]
            inverse[v - top, u] = one / z if z > 0 else zero
    sums = np.empty((5, width), np.float32)
    bend = np.empty(width, np.float32)
    for v in range(start, stop):
        sums[:] = zero
        centre = inverse[v - top]
        for u in range(width):
            # Largest bend that noise explains: eight standard deviations, as inverse depth.
            z, m = depth[v, u], centre[u]
            bend[u] = np.float32(8) * (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2])) * m * m
        for dv in range(0, radius + 1):
            if v - dv < top or v + dv >= bottom:
                continue
            before, behind = inverse[v - dv - top], inverse[v + dv - top]
            for du in range(-radius, radius + 1):
                if dv == 0 and du <= 0:
                    continue
                i, j = radius, width - radius
                add_slopes(
                    before[i - du : j - du], centre[i:j], behind[i + du : j + du], bend[i:j],
                    np.float32(du), np.float32(dv),
                    sums[0, i:j], sums[1, i:j], sums[2, i:j], sums[3, i:j], sums[4, i:j],
                )  # fmt: skip
        for u in range(width):
            sxx, sxy, syy, sx, sy = sums[0, u], sums[1, u], sums[2, u], sums[3, u], sums[4, u]
            determinant = sxx * syy - sxy * sxy
            good = determinant > np.float32(0.5)
            scale = np.float32(0.5) / (determinant if good else one)
            x = (np.float32(u) - cx) / fx
            y = (np.float32(v) - cy) / fy
            a = fx * scale * (syy * sx - sxy * sy)
            b = fy * scale * (sxx * sy - sxy * sx)
            c = centre[u] - a * x - b * y
            # (A, B, C) points away from the camera: n . ray = 1/z > 0.
            length = np.sqrt(a * a + b * b + c * c)
            cosine = centre[u] / max(length * np.sqrt(x * x + y * y + one), np.float32(1e-12))
            good = good & (cosine > min_cosine)
            flip = -one / max(length, np.float32(1e-12)) if good else zero
            z = depth[v, u]
            out[v, u, 0] = x * z
            out[v, u, 1] = y * z
            out[v, u, 2] = z
            out[v, u, 3] = a * flip
            out[v, u, 4] = b * flip
            out[v, u, 5] = c * flip
            out[v, u, 6] = one / (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2])) if good else zero
            # Radius of the disc that covers the pixel on the slanted surface (Keller et al. 2013, sec. 3.1).
            out[v, u, 7] = z * np.float32(0.70711) / fx / max(cosine, np.float32(0.26)) if good else zero


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
