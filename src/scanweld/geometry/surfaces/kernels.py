"""Compiled kernels that fit a plane (a line in 2-D) to neighbourhoods.

A neighbourhood is summed up by its moments about the query, in float64, so large coordinates cost no precision, and its
3 x 3 covariance is decomposed in closed form.
"""

from __future__ import annotations

import math

import numpy as np

from scanweld.geometry.neighbours.kernels import UNRESOLVED
from scanweld.geometry.neighbours.many.kernels import BLOCK, BLOCK_RINGS, k_in_ball, k_in_block, working_space
from scanweld.parallel import inlined, kernel

CHUNK = 512
"""Queries after which the search starts afresh: sums are formed in the same order at any number of threads."""

COLLINEAR = 1e-8
"""Second eigenvalue over the first: a line 1e-4 thin has no normal."""


@inlined
def covariance_of(x, y, z, rows, chosen, count):
    """Upper triangle of the covariance of chosen rows (., 3 or more), from moments about (x, y, z)."""
    sx, sy, sz = 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(count):
        point = rows[chosen[n]]
        a, b, c = point[0] - x, point[1] - y, point[2] - z
        sx, sy, sz = sx + a, sy + b, sz + c
        xx, xy, xz, yy, yz, zz = xx + a * a, xy + a * b, xz + a * c, yy + b * b, yz + b * c, zz + c * c
    w = 1.0 / count
    sx, sy, sz = sx * w, sy * w, sz * w
    return xx * w - sx * sx, xy * w - sx * sy, xz * w - sx * sz, yy * w - sy * sy, yz * w - sy * sz, zz * w - sz * sz


@inlined
def kernel_vector(xx, xy, xz, yy, yz, zz, value):
    """Unit vector that a symmetric matrix scales by `value`, a single eigenvalue: the longest cross product of two rows
    of A - value I."""
    a, b, c = xx - value, yy - value, zz - value
    ux, uy, uz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy  # rows 0, 1
    vx, vy, vz = xy * c - xz * yz, xz * xz - a * c, a * yz - xz * xy  # rows 0, 2
    wx, wy, wz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz  # rows 1, 2
    u, v, w = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    if (v > u) & (v >= w):
        ux, uy, uz, u = vx, vy, vz, v
    elif w > u:
        ux, uy, uz, u = wx, wy, wz, w
    scale = 1.0 / math.sqrt(u)
    return ux * scale, uy * scale, uz * scale


@inlined
def smaller_of_two(a, b, c):
    """Eigenvalues, ascending, of [[a, b], [b, c]] and the unit vector (p, q) of the smaller one."""
    mean, half = 0.5 * (a + c), 0.5 * (a - c)
    root = math.sqrt(half * half + b * b)
    p, q = (-b, half + root) if half > 0 else (root - half, -b)
    length = math.sqrt(p * p + q * q)
    if length > 0:
        return mean - root, mean + root, p / length, q / length
    return mean, mean, 1.0, 0.0


@kernel
def smallest_of_three(xx, xy, xz, yy, yz, zz):
    """Eigenvalues, ascending, of a symmetric matrix with a positive scale, and the unit vector of the smallest.

    The eigenvalue furthest from the others comes from the trigonometric formula, which is accurate for it (Eberly,
    "A robust eigensolver for 3x3 symmetric matrices"); the other two from the 2 x 2 matrix on the plane across its
    vector, so a double eigenvalue costs no precision.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    p = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if not p > 1e-16 * mean:
        return mean, mean, mean, 1.0, 0.0, 0.0
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    half = min(max(0.5 * determinant / (p * p * p), -1.0), 1.0)
    turn = math.acos(abs(half)) / 3.0
    apart = mean + 2.0 * p * math.cos(turn) * (1.0 if half >= 0 else -1.0)
    vx, vy, vz = kernel_vector(xx, xy, xz, yy, yz, zz, apart)
    # Two vectors across v
    if abs(vx) > abs(vy):
        s = 1.0 / math.sqrt(vx * vx + vz * vz)
        ax, ay, az = -vz * s, 0.0, vx * s
    else:
        s = 1.0 / math.sqrt(vy * vy + vz * vz)
        ax, ay, az = 0.0, vz * s, -vy * s
    bx, by, bz = vy * az - vz * ay, vz * ax - vx * az, vx * ay - vy * ax
    cx, cy, cz = xx * ax + xy * ay + xz * az, xy * ax + yy * ay + yz * az, xz * ax + yz * ay + zz * az
    dx, dy, dz = xx * bx + xy * by + xz * bz, xy * bx + yy * by + yz * bz, xz * bx + yz * by + zz * bz
    low, high, s, t = smaller_of_two(
        ax * cx + ay * cy + az * cz, ax * dx + ay * dy + az * dz, bx * dx + by * dy + bz * dz
    )
    if half >= 0:
        return low, high, apart, s * ax + t * bx, s * ay + t * by, s * az + t * bz
    return apart, low, high, vx, vy, vz


@inlined
def write_fit(row, covariance, dimension, normals, values):
    """Write eigenvalues, ascending, and the normal, 0 where the neighbours lie on a line (3-D) or in one place."""
    xx, xy, xz, yy, yz, zz = covariance
    if dimension == 2:
        low, middle, p, q = smaller_of_two(xx, xy, yy)
        nx, ny, nz, high = p, q, 0.0, middle
        flat = middle > 0
    else:
        scale = xx + yy + zz
        up = 1.0 / scale if scale > 0 else 0.0
        low, middle, high, nx, ny, nz = smallest_of_three(xx * up, xy * up, xz * up, yy * up, yz * up, zz * up)
        low, middle, high = low * scale, middle * scale, high * scale
        flat = middle > COLLINEAR * high
    zero_or_one = 1.0 if flat else 0.0
    normals[row, 0], normals[row, 1] = nx * zero_or_one, ny * zero_or_one
    values[row, 0], values[row, 1] = max(low, 0.0), middle
    if dimension == 3:
        normals[row, 2], values[row, 2] = nz * zero_or_one, high


@kernel
def fit_nearest(queries, start, stop, k, dimension, rows, starts, lattice, patient, normals, values):
    """Fit the k nearest points of each query (N, 4) in start..stop, whose result belongs to row query[3].

    normals, values (N, dimension); values[row, 0] is UNRESOLVED where the grid gave up, which it does sooner unless
    `patient`: a coarser one is faster there. Returns how many.
    """
    work = working_space()
    chosen, squares = np.empty(BLOCK, np.int64), np.empty(BLOCK)
    unresolved = 0
    for n in range(start, stop):
        if n % CHUNK == 0:
            work[3][0] = -1
            work[4][0] = 0.0
        x, y, z = queries[n, 0], queries[n, 1], queries[n, 2]
        row = np.int64(queries[n, 3])
        found = k_in_block(x, y, z, k, 1e300, rows, starts, lattice, work, chosen)
        if found == 0 or (found < 0 and patient):
            cells = 1.0 if found == 0 else BLOCK_RINGS + 0.5
            found, chosen, squares = k_in_ball(x, y, z, k, 1e300, cells, rows, starts, lattice, chosen, squares)
        if found < 0:
            unresolved += 1
            values[row, 0] = UNRESOLVED
            continue
        write_fit(row, covariance_of(x, y, z, rows, chosen, found), dimension, normals, values)
    return unresolved


@kernel
def fit_listed(places, near, points, dimension, at, normals, values):
    """Fit the listed neighbours near (N, k), rows of points (M, 3), of places (N, 3); results go to rows at (N,)."""
    for n in range(len(places)):
        covariance = covariance_of(places[n, 0], places[n, 1], places[n, 2], points, near[n], near.shape[1])
        write_fit(at[n], covariance, dimension, normals, values)
