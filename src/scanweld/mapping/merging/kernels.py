"""Compiled kernel that makes one surface of the layers that several passes left."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel


@kernel
def merge_layers(
    ranking, rank, cell_of, ranges, positions, normals, colors, radii, confidences, anchors, gap, limits, taken
):
    """Let each surfel, in order of rank, take in those of other passes that lie on its disc; the arrays are changed.

    All arrays are sorted by cell. ranking, rank (M,) int64: which comes when, and its inverse; cell_of (M,) int64;
    ranges (C, 9, 2) int64: rows of the nine rows of cells around cell c; positions, normals, colors (3, M), radii,
    confidences (M,) float32; anchors (M,) int32. gap: keyframes between two passes; limits: distance along the normal
    [m], cosine of the normals, largest confidence. taken (M,) bool is written.
    """
    distance, min_cosine, most = limits[0], limits[1], limits[2]
    for place in range(len(ranking)):
        k = ranking[place]
        if taken[k]:
            continue
        x, y, z = positions[0, k], positions[1, k], positions[2, k]
        nx, ny, nz = normals[0, k], normals[1, k], normals[2, k]
        weight = confidences[k]
        height = np.float32(0)
        sums = np.empty(6, np.float32)
        for i in range(3):
            sums[i] = weight * normals[i, k]
            sums[3 + i] = weight * colors[i, k]
        num = 0
        for row in range(9):
            for j in range(ranges[cell_of[k], row, 0], ranges[cell_of[k], row, 1]):
                if taken[j] or rank[j] <= place or abs(anchors[j] - anchors[k]) < gap:
                    continue
                dx, dy, dz = positions[0, j] - x, positions[1, j] - y, positions[2, j] - z
                h = nx * dx + ny * dy + nz * dz
                lateral = dx * dx + dy * dy + dz * dz - h * h
                reach = max(radii[k], radii[j])
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
        confidences[k] = min(weight, most)
