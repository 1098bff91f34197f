"""Where a scan was seen from, told by how its points are spread.

A sensor with even steps of angle sees a patch of surface at distance d, turned by theta, with a density of points per
area proportional to cos(theta) / d^2. Depth cameras and turning lasers nearly obey that law, whatever frame the points
are in now; clouds that were thinned, merged or sampled from a model do not, and have no viewpoint.

With c the viewpoint, p a point and n its normal: log density = const + log |n . (p - c)| - 3 log |p - c|.
"""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry.neighbours import NeighbourIndex
from scanweld.geometry.point_cloud import PointCloud, voxel_downsample

_PLACES = 1500  # where the density is measured, at most
_CELLS = 8.0  # of them to the cloud's median radius: near and far parts count alike
_NEIGHBOURS = 40  # a density is known to about 1 / sqrt(40)
_FLAT, _ROUND = 0.15, 0.1  # variance across over along the patch, and of the shorter over the longer axis
_OFF_CENTRE = 0.35  # offset of the neighbours' mean over their spread, beyond which the place is at a rim
_MIN_PLACES = 40
_REACH, _STEPS = 3.0, 9  # starts on a grid of so many median radii to either side
_STARTS = 6
_ITERATIONS = 60
_LOSS = 0.2  # log density: residuals beyond it count less
_MIN_GRAZING = 0.01  # cos(theta) does not reach zero where a normal is a little off
_GOOD_FIT = 0.25  # median |residual| that the law may leave
_GOOD_GAIN = 0.55  # ... and how much of what a constant density leaves
_MIN_SPREAD = 0.2  # median |log density - median|: evenly spread points say nothing
_FARTHEST = 5.0  # median radii from the cloud's centre


def estimate_viewpoint(points: Float64, index: NeighbourIndex) -> Float64 | None:
    """Return where points (N, 3) were seen from (3,) [m], within about a tenth of their distance; None if nowhere.

    Parameters
    ----------
    points : as measured, neither thinned nor merged; any frame
    index : of the same points
    """
    places, normals, log_density = _densities(points, index)
    if len(places) < _MIN_PLACES:
        return None
    center = np.median(places, axis=0)
    radius = float(np.median(np.linalg.norm(places - center, axis=1)))
    if radius <= 0:
        return None
    local = (places - center) / radius
    ticks = np.linspace(-_REACH, _REACH, _STEPS)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    cost = np.array([np.abs(_residuals(at, local, normals, log_density)).mean() for at in grid])
    ends = [_descend(grid[k], local, normals, log_density) for k in np.argsort(cost, kind="stable")[:_STARTS]]
    best, _ = min(ends, key=lambda end: end[1])
    left = float(np.median(np.abs(_residuals(best, local, normals, log_density))))
    without = float(np.median(np.abs(log_density - np.median(log_density))))
    if without < _MIN_SPREAD or left > min(_GOOD_FIT, _GOOD_GAIN * without) or np.linalg.norm(best) > _FARTHEST:
        return None
    return np.asarray(center + radius * best)


def _densities(points: Float64, index: NeighbourIndex) -> tuple[Float64, Float64, Float64]:
    """Return flat places (M, 3), their normals (M, 3) and the logarithm of the points per area there (M,)."""
    nothing = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    radius = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    if len(points) <= _NEIGHBOURS or radius <= 0:
        return nothing
    cells = voxel_downsample(PointCloud(points), radius / _CELLS).points_m
    cells = np.ascontiguousarray(cells[:: -(-len(cells) // _PLACES)])
    places = points[np.unique(index.nearest(cells, np.inf)[1])]
    local = points[index.k_nearest(places, _NEIGHBOURS)[1]] - places[:, None]
    mean = local.mean(axis=1)
    centred = local - mean[:, None]
    values, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred / _NEIGHBOURS)
    normals = vectors[:, :, 0]
    along = mean - np.einsum("nd,nd->n", mean, normals)[:, None] * normals
    flat = (values[:, 0] < _FLAT * values[:, 1]) & (values[:, 1] > _ROUND * values[:, 2]) & (values[:, 1] > 0)
    flat &= np.einsum("nd,nd->n", along, along) < _OFF_CENTRE**2 * values[:, 2]
    # Points spread evenly over an ellipse of variances l1, l2 cover 4 pi sqrt(l1 l2).
    area = 4 * np.pi * np.sqrt(values[flat, 1] * values[flat, 2])
    return places[flat], normals[flat], np.log(_NEIGHBOURS / area)


def _residuals(c: Float64, places: Float64, normals: Float64, log_density: Float64) -> Float64:
    """What the law does not explain with the viewpoint c, about its median (the constant)."""
    offset = places - c
    squared = np.maximum(np.einsum("nd,nd->n", offset, offset), 1e-12)
    across = np.maximum(np.einsum("nd,nd->n", offset, normals) ** 2, _MIN_GRAZING**2 * squared)
    residuals = 0.5 * np.log(across) - 1.5 * np.log(squared) - log_density
    return np.asarray(residuals - np.median(residuals))


def _descend(start: Float64, places: Float64, normals: Float64, log_density: Float64) -> tuple[Float64, float]:
    """Improve a viewpoint by Levenberg-Marquardt with Cauchy's loss; return it and its loss."""

    def loss_at(c: Float64) -> tuple[Float64, float]:  # residuals, loss
        r = _residuals(c, places, normals, log_density)
        return r, float(np.log1p((r / _LOSS) ** 2).sum())

    c = start
    residuals, loss = loss_at(c)
    damping = 1e-2
    for _ in range(_ITERATIONS):
        offset = places - c
        squared = np.maximum(np.einsum("nd,nd->n", offset, offset), 1e-12)
        along = np.einsum("nd,nd->n", offset, normals)
        free = along**2 > _MIN_GRAZING**2 * squared
        jacobian = 3 * offset / squared[:, None] - normals * np.where(free, 1 / np.where(free, along, 1), 0)[:, None]
        weights = 1 / (1 + (residuals / _LOSS) ** 2)
        jacobian -= (weights @ jacobian) / weights.sum()  # the constant follows
        hessian = (jacobian * weights[:, None]).T @ jacobian
        gradient = (jacobian * weights[:, None]).T @ residuals
        step = np.linalg.solve(hessian + damping * (np.diag(np.diag(hessian)) + 1e-9 * np.eye(3)), gradient)
        trial, trial_loss = loss_at(c - step)
        if trial_loss < loss:
            c, residuals, loss = c - step, trial, trial_loss
            damping = max(damping / 4, 1e-7)
            if np.abs(step).max() < 1e-5:
                break
        else:
            damping *= 5
            if damping > 1e6:
                break
    return c, loss
