"""Compiled kernel that makes one surface of the layers that several passes left."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel


@kernel
def merge_layers(
    order, place, starts, members, lattice, origin, positions, normals, colors, radii, confidences, anchors, gap,
    limits, side, changed, taken,
):  # fmt: skip
    """Let some surfels, in turn, take in those of other passes that lie on their discs; the arrays are changed.

    order (C,) int64: the surfels whose turn it is; place (M,) int64: of each surfel in the order of all; starts
    (cells + 1,) int64, members (M,) int64: surfels by cells of a lattice of that shape (3,) int64 and that side, from
    that origin (3,) float32; positions, normals, colors (3, M), radii, confidences (M,) float32; anchors (M,) int32.
    gap: keyframes between two passes; limits: distance along the normal [m], cosine of the normals, largest confidence,
    largest radius [m], share of the larger disc that is taken from. changed, taken (M,) bool are written.
    """
    distance, min_cosine, most, widest, share = limits[0], limits[1], limits[2], limits[3], limits[4]
    half = np.float32(0.87) * side  # no point of a cell is further from its middle: sqrt(3) / 2
    sums, low, high = np.empty(6, np.float32), np.empty(3, np.int64), np.empty(3, np.int64)
    # What a cell holds at most: most of them are passed over as a whole.
    cells = len(starts) - 1
    oldest, newest, largest = np.empty(cells, np.int32), np.empty(cells, np.int32), np.empty(cells, np.float32)
    for cell in range(cells):
        oldest[cell], newest[cell], largest[cell] = np.int32(0x7FFFFFFF), np.int32(-1), np.float32(0)
        for m in range(starts[cell], starts[cell + 1]):
            anchor = anchors[members[m]]
            oldest[cell], newest[cell] = min(oldest[cell], anchor), max(newest[cell], anchor)
            largest[cell] = max(largest[cell], radii[members[m]])
    for turn in range(len(order)):
        k = order[turn]
        if taken[k]:
            continue
        x, y, z = positions[0, k], positions[1, k], positions[2, k]
        nx, ny, nz = normals[0, k], normals[1, k], normals[2, k]
        for axis in range(3):
            extent = distance * abs(normals[axis, k]) + share * widest
            low[axis] = max(np.int64(0), np.int64(np.floor((positions[axis, k] - origin[axis] - extent) / side)))
            high[axis] = min(lattice[axis] - 1, np.int64(np.floor((positions[axis, k] - origin[axis] + extent) / side)))
        weight, height, num = confidences[k], np.float32(0), 0
        for i in range(3):
            sums[i] = weight * normals[i, k]
            sums[3 + i] = weight * colors[i, k]
        for cx in range(low[0], high[0] + 1):
            for cy in range(low[1], high[1] + 1):
                for cz in range(low[2], high[2] + 1):
                    cell = (cx * lattice[1] + cy) * lattice[2] + cz
                    if (anchors[k] - oldest[cell] < gap) & (newest[cell] - anchors[k] < gap):
                        continue
                    dx = origin[0] + (np.float32(cx) + np.float32(0.5)) * side - x
                    dy = origin[1] + (np.float32(cy) + np.float32(0.5)) * side - y
                    dz = origin[2] + (np.float32(cz) + np.float32(0.5)) * side - z
                    h = nx * dx + ny * dy + nz * dz
                    reach = share * max(radii[k], largest[cell]) + half
                    if (abs(h) > distance + half) | (dx * dx + dy * dy + dz * dz - h * h > reach * reach):
                        continue
                    for m in range(starts[cell], starts[cell + 1]):
                        j = members[m]
                        if taken[j] or place[j] <= place[k] or abs(anchors[j] - anchors[k]) < gap:
                            continue
                        dx, dy, dz = positions[0, j] - x, positions[1, j] - y, positions[2, j] - z
                        h = nx * dx + ny * dy + nz * dz
                        lateral = dx * dx + dy * dy + dz * dz - h * h
                        reach = share * max(radii[k], radii[j])
                        cosine = nx * normals[0, j] + ny * normals[1, j] + nz * normals[2, j]
                        if abs(h) > distance or lateral > reach * reach or cosine < min_cosine:
                            continue
                        taken[j] = True
                        num += 1
                        w = confidences[j]
                        weight += w
                        height += w * h
                        for i in range(3):
                            sums[i] += w * normals[i, j]
                            sums[3 + i] += w * colors[i, j]
        if num == 0:
            continue
        height /= weight
        # Along the normal only: the spacing of the surfels on the surface stays what it was.
        positions[0, k], positions[1, k], positions[2, k] = x + height * nx, y + height * ny, z + height * nz
        length = np.sqrt(sums[0] * sums[0] + sums[1] * sums[1] + sums[2] * sums[2])
        for i in range(3):
            normals[i, k] = sums[i] / length
            colors[i, k] = sums[3 + i] / weight
        confidences[k], changed[k] = min(weight, most), True
