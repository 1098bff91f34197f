"""Compiled kernels of the local aligners.

A pair of points becomes one to three rows of eight numbers: seven Jacobian columns (translation, rotation, log scale)
and the residual. Every metric only fills rows; weighting and adding them up is written once. The NumPy reference of
each row is in :mod:`scanweld.registration.residuals`.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel
from scanweld.registration.robust.kernels import robust_weight

BLOCK = 256
"""Pairs handled at a time: their rows stay in the first-level cache."""

COLUMN = BLOCK + 8
"""Length of a column of rows: at a power of two, all columns would compete for the same few places of the cache."""

CHUNK = 1024
"""Points whose sums share one row of partial sums; fixed, so that sums do not depend on the threads."""

PRODUCTS = 36
"""Products of the eight columns (J, r), upper triangle."""

SUMS = PRODUCTS + 6
"""Then sum w, sum w p (3), sum w |p|^2 of the moved points, and the number of pairs."""

POINT, PLANE, SYMMETRIC, GENERALISED, COLOURED = 0, 1, 2, 3, 4
"""Metrics."""


@kernel
def move_points(start, stop, points, transform, moved):
    """Rows start..stop of moved (N, 3) = points (N, 3) @ transform[:, :3].T + transform[:, 3]; transform (3, 4)."""
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for a in range(3):
            moved[i, a] = transform[a, 0] * x + transform[a, 1] * y + transform[a, 2] * z + transform[a, 3]


@kernel
def _write_row(rows, k, nx, ny, nz, x, y, z, px, py, pz, r):
    """One row: residual r with slope n; the rotation's arm is (x, y, z), the scale's (px, py, pz)."""
    rows[0, k], rows[1, k], rows[2, k] = nx, ny, nz
    rows[3, k] = y * nz - z * ny
    rows[4, k] = z * nx - x * nz
    rows[5, k] = x * ny - y * nx
    rows[6, k] = nx * px + ny * py + nz * pz
    rows[7, k] = r


@kernel
def _point_rows(rows, k, x, y, z, dx, dy, dz):
    """p' - q, coordinate by coordinate."""
    _write_row(rows[0], k, 1.0, 0.0, 0.0, x, y, z, x, y, z, dx)
    _write_row(rows[1], k, 0.0, 1.0, 0.0, x, y, z, x, y, z, dy)
    _write_row(rows[2], k, 0.0, 0.0, 1.0, x, y, z, x, y, z, dz)
    return dx * dx + dy * dy + dz * dz


@kernel
def _plane_row(rows, k, n, x, y, z, dx, dy, dz):
    """n . (p' - q) (Chen and Medioni 1991)."""
    r = n[0] * dx + n[1] * dy + n[2] * dz
    _write_row(rows[0], k, n[0], n[1], n[2], x, y, z, x, y, z, r)
    return r * r


@kernel
def _symmetric_row(rows, k, n, m, x, y, z, dx, dy, dz):
    """(n + m) / 2 . (p' - q), both sides turned by half (Rusinkiewicz 2019, eq. 9); m: the source's normal, moved."""
    sign = 1.0 if n[0] * m[0] + n[1] * m[1] + n[2] * m[2] >= 0 else -1.0
    nx, ny, nz = 0.5 * (n[0] + sign * m[0]), 0.5 * (n[1] + sign * m[1]), 0.5 * (n[2] + sign * m[2])
    r = nx * dx + ny * dy + nz * dz
    hx, hy, hz = x - 0.5 * dx, y - 0.5 * dy, z - 0.5 * dz
    _write_row(rows[0], k, nx, ny, nz, hx, hy, hz, x, y, z, r)
    return r * r


@kernel
def _generalised_rows(rows, k, n, m, thickness, x, y, z, dx, dy, dz):
    """Plane to plane (Segal et al. 2009): d^T (C_q + R C_p R^T)^-1 d with discs C = I - (1 - thickness) n n^T.

    The sum of two discs has the eigenvectors n + m, n - m and their cross product, with the eigenvalues 2 - (1 -
    thickness) (1 + c, 1 - c, 0), c = n . m: three rows, no decomposition. They are scaled so that a residual along two
    equal normals counts as in point-to-plane.
    """
    c = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
    sign = 1.0 if c >= 0 else -1.0
    c = min(abs(c), 1.0)
    ax, ay, az = n[0] + sign * m[0], n[1] + sign * m[1], n[2] + sign * m[2]
    scale = 1.0 / np.sqrt(max(ax * ax + ay * ay + az * az, 1e-300))
    ax, ay, az = ax * scale, ay * scale, az * scale
    bx, by, bz = n[0] - sign * m[0], n[1] - sign * m[1], n[2] - sign * m[2]
    if bx * bx + by * by + bz * bz < 1e-12:  # equal normals: any direction of the plane will do
        if abs(ax) < 0.6:
            bx, by, bz = 0.0, az, -ay
        else:
            bx, by, bz = -az, 0.0, ax
    scale = 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx * scale, by * scale, bz * scale
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    flat = 1.0 - thickness
    along = np.sqrt(2.0 * thickness / (2.0 - flat * (1.0 + c)))
    across = np.sqrt(2.0 * thickness / (2.0 - flat * (1.0 - c)))
    third = np.sqrt(thickness)
    ax, ay, az = ax * along, ay * along, az * along
    bx, by, bz = bx * across, by * across, bz * across
    cx, cy, cz = cx * third, cy * third, cz * third
    r0 = ax * dx + ay * dy + az * dz
    r1 = bx * dx + by * dy + bz * dz
    r2 = cx * dx + cy * dy + cz * dz
    _write_row(rows[0], k, ax, ay, az, x, y, z, x, y, z, r0)
    _write_row(rows[1], k, bx, by, bz, x, y, z, x, y, z, r1)
    _write_row(rows[2], k, cx, cy, cz, x, y, z, x, y, z, r2)
    return r0 * r0 + r1 * r1 + r2 * r2


@kernel
def _colour_row(rows, k, n, gradient, difference, x, y, z, dx, dy, dz):
    """Intensity at the projection onto the tangent plane, minus the source's (Park et al. 2017, eq. 12 to 15).

    `gradient` (3,) lies in the tangent plane of the target at q; `difference`: target minus source intensity at the
    points.
    """
    r = difference + gradient[0] * dx + gradient[1] * dy + gradient[2] * dz
    along = gradient[0] * n[0] + gradient[1] * n[1] + gradient[2] * n[2]
    gx, gy, gz = gradient[0] - along * n[0], gradient[1] - along * n[1], gradient[2] - along * n[2]
    _write_row(rows[1], k, gx, gy, gz, x, y, z, x, y, z, r)
    return r * r


@kernel
def fill_rows(metric, first, stop, stride, moved, partner, target, normals, source_normals, rotation, colour,
              thickness, picks, rows, squares):  # fmt: skip
    """Fill the rows of the pairs among points first, first + stride, .. below stop; returns how many.

    picks (BLOCK,): the points' indices; squares (2, BLOCK): the squared residuals, geometric and of colour.
    """
    pairs = 0
    turned = metric == SYMMETRIC or metric == GENERALISED
    for i in range(first, stop, stride):
        j = partner[i]
        if j < 0:
            continue
        x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
        dx, dy, dz = x - target[j, 0], y - target[j, 1], z - target[j, 2]
        ax, ay, az = 0.0, 0.0, 0.0
        if turned:
            u, v, w = source_normals[i, 0], source_normals[i, 1], source_normals[i, 2]
            ax = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2] * w
            ay = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2] * w
            az = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2] * w
        if metric == POINT:
            squares[0, pairs] = _point_rows(rows, pairs, x, y, z, dx, dy, dz)
        elif metric == SYMMETRIC:
            squares[0, pairs] = _symmetric_row(rows, pairs, normals[j], (ax, ay, az), x, y, z, dx, dy, dz)
        elif metric == GENERALISED:
            squares[0, pairs] = _generalised_rows(rows, pairs, normals[j], (ax, ay, az), thickness, x, y, z, dx, dy, dz)
        else:
            squares[0, pairs] = _plane_row(rows, pairs, normals[j], x, y, z, dx, dy, dz)
            if metric == COLOURED:
                source_colour, target_colour, gradient = colour
                difference = target_colour[j] - source_colour[i]
                squares[1, pairs] = _colour_row(rows, pairs, normals[j], gradient[j], difference, x, y, z, dx, dy, dz)
        picks[pairs] = i
        pairs += 1
    return pairs


@kernel
def add_products(rows, weights, count, sums):
    """Add the weighted products of the eight columns of `count` rows to sums[0:36]."""
    entry = 0
    for a in range(8):
        for b in range(a, 8):
            total = 0.0
            for k in range(count):
                total += weights[k] * rows[a, k] * rows[b, k]
            sums[entry] += total
            entry += 1


@kernel
def pair_sums(metric, start, stop, moved, partner, point_weights, target, normals, source_normals, rotation, colour,
              thickness, noise, robust, partials):  # fmt: skip
    """Sums of chunks start..stop into partials (chunks, SUMS).

    moved (N, 3), target frame; partner (N,) int32, row of the target or -1; point_weights (N,) or (0,) for ones;
    target, normals (M, 3); source_normals (N, 3), source frame; rotation (3, 3) source -> target; colour: source (N,),
    target (M,) intensities and its gradients (M, 3) [1/m]; noise (2,): standard deviations of the geometric [m] and the
    colour residual; robust (3,): code and two parameters of :func:`robust_weight`.

    Colour rows are weighted to be in units of the geometric residual's noise, so that H has the unit of the geometric
    rows.
    """
    rows = np.empty((3, 8, COLUMN))
    squares = np.empty((2, BLOCK))
    picks = np.empty(BLOCK, np.int64)
    weights = np.empty(BLOCK)
    total = moved.shape[0]
    components = 3 if metric == POINT or metric == GENERALISED else 1
    balance = (noise[0] / noise[1]) ** 2
    code = np.int64(robust[0])
    for chunk in range(start, stop):
        sums = partials[chunk]
        sums[:] = 0.0
        end = min((chunk + 1) * CHUNK, total)
        for first in range(chunk * CHUNK, end, BLOCK):
            pairs = fill_rows(
                metric, first, min(first + BLOCK, end), 1, moved, partner, target, normals, source_normals, rotation,
                colour, thickness, picks, rows, squares,
            )  # fmt: skip
            for k in range(pairs):
                w = robust_weight(code, robust[1], robust[2], np.sqrt(squares[0, k]) / noise[0])
                i = picks[k]
                if len(point_weights) > 0:
                    w *= point_weights[i]
                weights[k] = w
                x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
                sums[PRODUCTS] += w
                sums[PRODUCTS + 1] += w * x
                sums[PRODUCTS + 2] += w * y
                sums[PRODUCTS + 3] += w * z
                sums[PRODUCTS + 4] += w * (x * x + y * y + z * z)
                sums[PRODUCTS + 5] += 1.0
            for c in range(components):
                add_products(rows[c], weights, pairs, sums)
            if metric == COLOURED:
                for k in range(pairs):
                    w = balance * robust_weight(code, robust[1], robust[2], np.sqrt(squares[1, k]) / noise[1])
                    if len(point_weights) > 0:
                        w *= point_weights[picks[k]]
                    weights[k] = w
                add_products(rows[1], weights, pairs, sums)


@kernel
def add_scores(metric, stride, moved, partner, point_weights, target, normals, source_normals, rotation, colour,
               thickness, noise, robust, bread, scores):  # fmt: skip
    """Add w J^T r (7,) of every pair to a row of scores (K, 8), and its leverage w tr(J bread J^T) to the last column.

    `stride` > 0: the row is that of the target, row j / stride for every `stride`-th target j, as sources that share a
    target share its error; 0: each pair has the row of its source. bread (7, 7).
    """
    rows = np.empty((3, 8, 1))
    squares = np.empty((2, 1))
    picks = np.empty(1, np.int64)
    components = 3 if metric == POINT or metric == GENERALISED else 1
    balance = (noise[0] / noise[1]) ** 2
    code = np.int64(robust[0])
    levered = bread.any()
    for i in range(moved.shape[0]):
        j = partner[i]
        if j < 0 or (stride > 0 and j % stride != 0):
            continue
        fill_rows(
            metric, i, i + 1, 1, moved, partner, target, normals, source_normals, rotation, colour, thickness, picks,
            rows, squares,
        )  # fmt: skip
        k = j // stride if stride > 0 else i
        own = point_weights[i] if len(point_weights) > 0 else 1.0
        for c in range(components + (metric == COLOURED)):
            if metric == COLOURED and c == 1:
                w = own * balance * robust_weight(code, robust[1], robust[2], np.sqrt(squares[1, 0]) / noise[1])
            else:
                w = own * robust_weight(code, robust[1], robust[2], np.sqrt(squares[0, 0]) / noise[0])
            for a in range(7):
                scores[k, a] += w * rows[c, a, 0] * rows[c, 7, 0]
            if levered:
                for a in range(7):
                    product = 0.0
                    for b in range(7):
                        product += bread[a, b] * rows[c, b, 0]
                    scores[k, 7] += w * rows[c, a, 0] * product


@kernel
def pair_squares(metric, stride, moved, partner, target, normals, source_normals, rotation, colour, thickness, out):
    """Squared residuals (2, K), geometric and of colour, of every `stride`-th point's pair; returns how many."""
    rows = np.empty((3, 8, COLUMN))
    squares = np.zeros((2, BLOCK))
    picks = np.empty(BLOCK, np.int64)
    count = 0
    for first in range(0, moved.shape[0], BLOCK * stride):
        found = fill_rows(
            metric, first, min(first + BLOCK * stride, moved.shape[0]), stride, moved, partner, target, normals,
            source_normals, rotation, colour, thickness, picks, rows, squares,
        )  # fmt: skip
        out[:, count : count + found] = squares[:, :found]
        count += found
    return count
