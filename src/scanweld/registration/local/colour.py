"""Intensities of a cloud and their gradients along its surface (Park, Zhou, Koltun 2017, section 4)."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry.neighbours import NeighbourIndex
from scanweld.geometry.point_cloud import PointCloud
from scanweld.parallel import run_ranges

_LUMA = np.array([0.299, 0.587, 0.114]) / 255  # ITU-R BT.601
_CHUNK = 4096  # points at a time, so that the neighbours of a million points never lie in memory together
_RIDGE = 1e-6  # relative; neighbours on a line give a gradient along the line only


def intensity(cloud: PointCloud) -> Float64:
    """Return the grey values (N,), 0..1, of a cloud with colours."""
    assert cloud.colors is not None
    return np.asarray(cloud.colors @ _LUMA)


def intensity_gradients(
    points: Float64, normals: Float64, values: Float64, index: NeighbourIndex, neighbours: int
) -> Float64:
    """Return the gradients (N, 3) [1/m] of values (N,) along the tangent planes of points (N, 3).

    Least squares over the k nearest neighbours, projected onto the tangent plane (eq. 10 and 11), with the gradient
    held within it.
    """
    gradients = np.zeros_like(points)
    k = min(neighbours, len(points))

    def solve(start: int, stop: int) -> None:
        for first in range(start * _CHUNK, min(stop * _CHUNK, len(points)), _CHUNK):
            rows = slice(first, min(first + _CHUNK, stop * _CHUNK, len(points)))
            _, near = index.k_nearest(points[rows], k)
            n = normals[rows, None, :]
            arms = points[near] - points[rows, None, :]
            arms = arms - (arms * n).sum(axis=2, keepdims=True) * n
            change = values[near] - values[rows, None]
            moments = np.swapaxes(arms, 1, 2) @ arms
            size = np.trace(moments, axis1=1, axis2=2)[:, None, None]
            # n n^T makes the matrix regular without adding to the solution, which lies in the plane.
            system = moments + size * (np.swapaxes(n, 1, 2) @ n + _RIDGE * np.eye(3)) + 1e-300 * np.eye(3)
            gradients[rows] = np.linalg.solve(system, np.swapaxes(arms, 1, 2) @ change[:, :, None])[:, :, 0]

    run_ranges(-(-len(points) // _CHUNK), solve)
    return gradients
