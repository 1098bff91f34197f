"""Compiled kernels that find the zero of the distance in a grid of blocks: marching cubes across block borders."""

from __future__ import annotations

import numpy as np

from scanweld.meshing.kernels import COLOR_ONE, HALF, KEY_BITS, SAMPLES, SIDE, key_of, label_of
from scanweld.parallel import inlined, kernel

PADDED = SIDE + 1


@inlined
def offset_label(key, a, b, c, keys, table):
    """Label of the block that is (a, b, c) further, -1 where there is none."""
    i = (key >> (2 * KEY_BITS)) - HALF + a
    j = ((key >> KEY_BITS) & (2 * HALF - 1)) - HALF + b
    k = (key & (2 * HALF - 1)) - HALF + c
    if (i >= HALF) | (j >= HALF) | (k >= HALF):
        return np.int32(-1)
    return label_of(key_of(i, j, k), keys, table)


@kernel
def march_blocks(
    start, stop, labels, keys, table, distances, weights, least_weight, deepest, cases, firsts, write, corners
):
    """Triangles of blocks labels[start..stop].

    A cell has some where its eight corners were observed (weight above `least_weight`) and no edge across the surface
    ends deeper behind it than a share `deepest` of the largest distance in the block, which is about the truncation.
    There what is behind a surface meets what was seen through beside it: a skirt along the outline of whatever stands
    in front, which nobody saw.

    Without `write`, firsts[n + 1] becomes the number of triangle corners of block n. With it, they are written to
    `corners` from firsts[n] on, as label * 3 SAMPLES + 3 sample + axis: the edge of the grid that the vertex is on.
    """
    d, w = np.empty((PADDED, PADDED, PADDED), np.float32), np.empty((PADDED, PADDED, PADDED), np.float32)
    around = np.empty(8, np.int32)
    for n in range(start, stop):
        label = labels[n]
        for c in range(8):
            around[c] = offset_label(keys[label], c & 1, (c >> 1) & 1, (c >> 2) & 1, keys, table)
        low, high = np.float32(1e9), np.float32(-1e9)
        for i in range(PADDED):
            for j in range(PADDED):
                for k in range(PADDED):
                    owner = around[(i >> 3) | ((j >> 3) << 1) | ((k >> 3) << 2)]
                    at = ((i & 7) * SIDE + (j & 7)) * SIDE + (k & 7)
                    if owner >= 0:
                        w[i, j, k] = weights[owner, at]
                        d[i, j, k] = distances[owner, at]
                        if w[i, j, k] > least_weight:
                            low, high = min(low, d[i, j, k]), max(high, d[i, j, k])
                    else:
                        w[i, j, k] = d[i, j, k] = np.float32(0)
        count = 0
        limit = deepest * max(-low, high)
        if (low < 0) & (high >= 0):
            for i in range(SIDE):
                for j in range(SIDE):
                    for k in range(SIDE):
                        case = 0
                        known = True
                        for c in range(8):
                            x, y, z = i + (c & 1), j + ((c >> 1) & 1), k + ((c >> 2) & 1)
                            known &= w[x, y, z] > least_weight
                            case |= (1 << c) if d[x, y, z] < 0 else 0
                        if (not known) | (case == 0) | (case == 255):
                            continue
                        size = int(cases[case, 0])
                        near = True
                        for t in range(1, 1 + size):
                            c, axis = divmod(int(cases[case, t]), 3)
                            x, y, z = i + (c & 1), j + ((c >> 1) & 1), k + ((c >> 2) & 1)
                            beyond = d[x + (axis == 0), y + (axis == 1), z + (axis == 2)]
                            near &= min(d[x, y, z], beyond) >= -limit
                        if not near:
                            continue
                        if write:
                            for t in range(size):
                                c, axis = divmod(int(cases[case, 1 + t]), 3)
                                x, y, z = i + (c & 1), j + ((c >> 1) & 1), k + ((c >> 2) & 1)
                                owner = around[(x >> 3) | ((y >> 3) << 1) | ((z >> 3) << 2)]
                                at = ((x & 7) * SIDE + (y & 7)) * SIDE + (z & 7)
                                corners[firsts[n] + count + t] = (np.int64(owner) * SAMPLES + at) * 3 + axis
                        count += size
        if not write:
            firsts[n + 1] = count


@kernel
def place_vertices(start, stop, edges, keys, table, distances, colors, voxel, vertices, vertex_colors):
    """Vertices start..stop, where the distance along their edge of the grid is zero, and their colours."""
    for n in range(start, stop):
        edge = edges[n]
        axis, sample, label = edge % 3, (edge // 3) % SAMPLES, edge // (3 * SAMPLES)
        key = keys[label]
        i, j, k = sample // (SIDE * SIDE), (sample // SIDE) % SIDE, sample % SIDE
        x, y, z = i + (axis == 0), j + (axis == 1), k + (axis == 2)
        other = label
        if max(x, max(y, z)) == SIDE:
            other = offset_label(key, x >> 3, y >> 3, z >> 3, keys, table)
        beyond = ((x & 7) * SIDE + (y & 7)) * SIDE + (z & 7)
        a, b = distances[label, sample], distances[other, beyond]
        # Not quite to the ends: vertices of different edges must not coincide, or triangles lose their area.
        t = min(max(a / (a - b), np.float32(1e-4)), np.float32(0.9999))
        vertices[n, 0] = ((key >> (2 * KEY_BITS)) - HALF) * SIDE + i
        vertices[n, 1] = ((key >> KEY_BITS) & (2 * HALF - 1)) - HALF
        vertices[n, 1] = vertices[n, 1] * SIDE + j
        vertices[n, 2] = (key & (2 * HALF - 1)) - HALF
        vertices[n, 2] = vertices[n, 2] * SIDE + k
        vertices[n, axis] += t
        for c in range(3):
            vertices[n, c] *= voxel
            one, two = np.float32(colors[label, sample, c]), np.float32(colors[other, beyond, c])
            one, two = two if one == 0 else one, one if two == 0 else two
            mixed = (one + t * (two - one) - np.float32(1)) / COLOR_ONE
            vertex_colors[n, c] = np.uint8(min(max(mixed + np.float32(0.5), np.float32(0)), np.float32(255)))
