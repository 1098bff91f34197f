"""Compiled kernel that draws triangles with a depth buffer."""

from __future__ import annotations

import math

import numpy as np

from scanweld.parallel import kernel


@kernel
def draw_triangles(first_row, last_row, points, triangles, intrinsics, near, depth, hit, shares):
    """Draw triangles into rows first_row..last_row of an image.

    points (N, 3) float32, in the camera. depth (H, W) float32: of what is nearest, infinite where nothing is. hit
    (H, W) int32: its triangle, -1 for none. shares (H, W, 2) float32: weights of its second and third corner, in
    space. Triangles that reach nearer than `near` are left out.
    """
    width = depth.shape[1]
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for n in range(len(triangles)):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        za, zb, zc = points[a, 2], points[b, 2], points[c, 2]
        if min(za, min(zb, zc)) <= near:
            continue
        ua, va = fx * points[a, 0] / za + cx, fy * points[a, 1] / za + cy
        ub, vb = fx * points[b, 0] / zb + cx, fy * points[b, 1] / zb + cy
        uc, vc = fx * points[c, 0] / zc + cx, fy * points[c, 1] / zc + cy
        top = np.int64(max(math.ceil(min(va, min(vb, vc))), first_row))
        bottom = np.int64(min(math.floor(max(va, max(vb, vc))), last_row - 1))
        left = np.int64(max(math.ceil(min(ua, min(ub, uc))), 0))
        right = np.int64(min(math.floor(max(ua, max(ub, uc))), width - 1))
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if (top > bottom) | (left > right) | (area == 0):
            continue
        inverse = np.float32(1) / area
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                second = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) * inverse
                third = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) * inverse
                first = np.float32(1) - second - third
                if min(first, min(second, third)) < -1e-6:
                    continue
                # 1 / z is linear in the image
                z = np.float32(1) / (first / za + second / zb + third / zc)
                if z < depth[v, u]:
                    depth[v, u], hit[v, u] = z, n
                    shares[v, u, 0], shares[v, u, 1] = second * z / zb, third * z / zc
