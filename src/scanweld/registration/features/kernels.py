"""Compiled kernels of the point feature histograms."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import inlined, kernel

BINS = 11
"""Bins of each of the three angles."""


SURE = 0.4
"""Cosine between two normals of unknown sign from which on they are taken to point to the same side."""


@inlined
def add_soft(histogram, row, first, place, weight):
    """Share a count between the two bins whose centres are next to `place`, 0..1 over the range."""
    x = min(max(place * BINS - 0.5, 0.0), BINS - 1.0)
    low = min(int(x), BINS - 2)
    part = x - low
    histogram[row, first + low] += weight * (1.0 - part)
    histogram[row, first + low + 1] += weight * part


@inlined
def same_side(cosine, oriented):
    """How sure it is, 0..1, that two normals point to the same side: near a right angle both signs are as good."""
    return 1.0 if oriented else 0.5 + 0.5 * min(max(cosine / SURE, -1.0), 1.0)


@kernel
def simplified_histograms(start, stop, points, normals, oriented, starts, neighbours, histograms):
    """Fill rows start..stop of histograms (N, 33) with the SPFH of points (N, 3) with normals (N, 3).

    The neighbours of point i are neighbours[starts[i] : starts[i + 1]], itself allowed. The frame of a pair is u = n_p,
    v = d x u, w = u x v with d the direction to the neighbour; alpha = v . n_q, phi = u . d, theta = atan2(w . n_q,
    u . n_q) (Rusu et al. 2009, eq. 1). Unless the normals are oriented, n_q is turned to the side of n_p, theta stays
    within a quarter turn, and near a right angle both sides share the count.
    """
    turns = 0.5 / np.pi if oriented else 1.0 / np.pi
    for i in range(start, stop):
        for k in range(3 * BINS):
            histograms[i, k] = 0.0
        ux, uy, uz = normals[i, 0], normals[i, 1], normals[i, 2]
        count = 0
        for at in range(starts[i], starts[i + 1]):
            j = neighbours[at]
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            if (length == 0.0) | (nx * nx + ny * ny + nz * nz == 0.0) | (ux * ux + uy * uy + uz * uz == 0.0):
                continue
            dx, dy, dz = dx / length, dy / length, dz / length
            along = ux * nx + uy * ny + uz * nz
            same = same_side(along, oriented)
            vx, vy, vz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
            size = np.sqrt(vx * vx + vy * vy + vz * vz)
            if size < 1e-9:  # the neighbour is right above: no frame
                continue
            vx, vy, vz = vx / size, vy / size, vz / size
            wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            alpha = vx * nx + vy * ny + vz * nz
            phi = ux * dx + uy * dy + uz * dz
            across = wx * nx + wy * ny + wz * nz
            add_soft(histograms, i, BINS, 0.5 * (phi + 1.0), 1.0)
            if same > 0.0:
                add_soft(histograms, i, 0, 0.5 * (alpha + 1.0), same)
                add_soft(histograms, i, 2 * BINS, np.arctan2(across, along) * turns + 0.5, same)
            if same < 1.0:  # and turned to the other side
                add_soft(histograms, i, 0, 0.5 * (1.0 - alpha), 1.0 - same)
                add_soft(histograms, i, 2 * BINS, np.arctan2(-across, -along) * turns + 0.5, 1.0 - same)
            count += 1
        if count > 0:
            for k in range(3 * BINS):
                histograms[i, k] /= count


@kernel
def weighted_histograms(start, stop, points, normals, oriented, starts, neighbours, simplified, histograms):
    """Fill rows start..stop of histograms (N, 33) with FPFH = SPFH(p) + mean of SPFH(q) weighted by 1 / |p - q|.

    Turning all normals around a point mirrors the bins of phi and theta. Unless the normals are oriented, neighbours
    with the other sign are therefore added mirrored, and the result is mirrored where phi leans to its lower half: it
    does not depend on any sign.
    """
    total = np.empty(3 * BINS)
    for i in range(start, stop):
        weights = 0.0
        total[:] = 0.0
        for at in range(starts[i], starts[i + 1]):
            j = neighbours[at]
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            along = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
            known = normals[j, 0] * normals[j, 0] + normals[j, 1] * normals[j, 1] + normals[j, 2] * normals[j, 2] > 0.0
            if length == 0.0 or not known:
                continue
            same = same_side(along, oriented)
            weight = 1.0 / length
            weights += weight
            for k in range(BINS):
                mirrored = BINS - 1 - k
                phi, theta = BINS + k, 2 * BINS + k
                total[k] += weight * simplified[j, k]
                total[phi] += weight * (same * simplified[j, phi] + (1.0 - same) * simplified[j, BINS + mirrored])
                total[theta] += weight * (
                    same * simplified[j, theta] + (1.0 - same) * simplified[j, 2 * BINS + mirrored]
                )
        lean = 0.0
        has_normal = normals[i, 0] * normals[i, 0] + normals[i, 1] * normals[i, 1] + normals[i, 2] * normals[i, 2] > 0.0
        for k in range(3 * BINS):
            value = simplified[i, k]
            if weights > 0.0 and has_normal:
                value += total[k] / weights
            total[k] = value
        for k in range(BINS):
            lean += total[BINS + k] * (k - BINS // 2)
        for k in range(BINS):
            mirrored = BINS - 1 - k if lean < 0.0 and not oriented else k
            histograms[i, k] = total[k]
            histograms[i, BINS + k] = total[BINS + mirrored]
            histograms[i, 2 * BINS + k] = total[2 * BINS + mirrored]
