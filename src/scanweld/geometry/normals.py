"""Normals of a point cloud from the k nearest neighbours of every point."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Float64, as_points
from scanweld.errors import InvalidInputError

NEIGHBOURS = 20
_CHUNK = 8192  # rows at a time: k neighbours of a million points at once would take 480 MB
_COLLINEAR = 1e-8  # second eigenvalue over the first: a line 1e-4 thin has no normal


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """A plane (a line in 2-D) through the neighbours of each point.

    Attributes
    ----------
    normals : (N, D), unit; (0, .., 0) where the neighbours lie on a line (3-D) or in one place
    angular_variance : (N,) [rad^2], how far noise may have turned each normal, per axis
    """

    normals: Float64
    angular_variance: Float64


def estimate_normals(
    points_m: npt.ArrayLike,
    *,
    neighbours: int = NEIGHBOURS,
    viewpoint_m: npt.ArrayLike | None = None,
    num_threads: int | None = None,
) -> Float64:
    """Estimate the surface normals of points (N, D), D = 2 or 3: the direction in which the neighbours vary
    least.

    Parameters
    ----------
    points_m : (N, D), finite
    neighbours : k, the point itself included; more smooth over noise and round off edges
    viewpoint_m : (D,), e.g. the sensor; normals are turned to face it. Without it the largest component of
        each normal is positive, which is repeatable but no orientation
    num_threads : all cores when None; the result does not depend on it

    Returns
    -------
    (N, D) float64, unit length; (0, .., 0) where the neighbours lie on a line (3-D) or in one place

    Raises
    ------
    InvalidInputError
        When there are fewer than D points, fewer than D neighbours, or a point is not finite.
    """
    points = as_points(points_m, "points_m")
    normals = fit_surfaces(points, neighbours=neighbours, num_threads=num_threads).normals
    if viewpoint_m is None:
        largest = np.take_along_axis(normals, np.abs(normals).argmax(axis=1)[:, None], axis=1)
        sign = np.where(largest < 0, -1.0, 1.0)
    else:
        viewpoint = np.asarray(viewpoint_m, dtype=np.float64)
        if viewpoint.shape != (points.shape[1],):
            raise InvalidInputError(f"viewpoint_m: expected shape ({points.shape[1]},), got {viewpoint.shape}")
        towards = np.einsum("nd,nd->n", normals, viewpoint - points)[:, None]
        sign = np.where(towards < 0, -1.0, 1.0)
    return np.asarray(normals * sign)


def fit_surfaces(
    points_m: Float64,
    *,
    neighbours: int = NEIGHBOURS,
    at: Float64 | None = None,
    tree: cKDTree | None = None,
    num_threads: int | None = None,
) -> SurfaceFit:
    """Fit a plane through the neighbours of each point, or of each place `at` (M, D).

    The variance of a normal is that of a regression slope, lambda_0 / (k lambda_1) with the eigenvalues of
    the neighbours' covariance in ascending order.
    """
    count, dimension = points_m.shape
    if count < dimension or neighbours < dimension:
        raise InvalidInputError(
            f"normals need at least {dimension} points and neighbours, got {count} points, k = {neighbours}"
        )
    if not np.isfinite(points_m).all():
        raise InvalidInputError("normals: some points are not finite; drop them first (PointCloud.finite())")
    places = points_m if at is None else at
    k = min(neighbours, count)
    values, vectors = _eigen(points_m, places, tree, k, num_threads)
    flat = values[:, 1] > (_COLLINEAR * values[:, -1] if dimension == 3 else 0.0)
    normals = np.where(flat[:, None], vectors[:, :, 0], 0.0)
    variance = np.where(flat, values[:, 0] / (k * np.where(flat, values[:, 1], 1.0)), 0.0)
    return SurfaceFit(normals, np.maximum(variance, 0.0))


def flatness(
    points_m: Float64,
    *,
    at: Float64,
    neighbours: int,
    tree: cKDTree | None = None,
    num_threads: int | None = None,
) -> Float64:
    """Return the smallest over the largest eigenvalue of the neighbourhoods of places: 0 flat, 1 round."""
    values, _ = _eigen(points_m, at, tree, min(neighbours, len(points_m)), num_threads)
    return np.asarray(np.maximum(values[:, 0], 0.0) / np.where(values[:, -1] > 0, values[:, -1], 1.0))


def _eigen(
    points: Float64, places: Float64, tree: cKDTree | None, k: int, num_threads: int | None
) -> tuple[Float64, Float64]:
    """Ascending eigenvalues (M, D) and vectors (M, D, D) of the covariance of k points near each place."""
    index = tree if tree is not None else cKDTree(points)
    dimension = points.shape[1]
    values = np.empty((len(places), dimension))
    vectors = np.empty((len(places), dimension, dimension))

    def decompose(start: int) -> None:
        rows = slice(start, start + _CHUNK)
        _, near = index.query(places[rows], k=k)
        local = points[near.reshape(-1, k)]
        local -= local.mean(axis=1, keepdims=True)  # centred first: offsets of 1e6 cost nothing
        values[rows], vectors[rows] = np.linalg.eigh(np.swapaxes(local, 1, 2) @ local / k)

    with ThreadPoolExecutor(max_workers=num_threads or os.cpu_count()) as pool:
        list(pool.map(decompose, range(0, len(places), _CHUNK)))
    return values, vectors
