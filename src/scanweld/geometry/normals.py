"""Normals of a point cloud from the k nearest neighbours of every point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Float64, as_points
from scanweld.errors import InvalidInputError
from scanweld.geometry.neighbours.kd_tree import KdTree, NeighbourIndex, build_index

if TYPE_CHECKING:
    from scanweld.geometry.neighbours.grid import HashGrid

NEIGHBOURS = 20
_SPARSE = 1 / 256  # of the points, queries in sparse places; more of them are worth a grid of their own
_COARSER = 4.0  # times the cells of the first grid
_LISTED = 8192  # rows at a time: k neighbours of a million points at once would take 480 MB


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
    index: NeighbourIndex | None = None,
    num_threads: int | None = None,
) -> SurfaceFit:
    """Fit a plane through the neighbours of each point, or of each place `at` (M, D).

    The variance of a normal is that of a regression slope, lambda_0 / (k lambda_1) with the eigenvalues of
    the neighbours' covariance in ascending order. `tree` or `index` is one of the same points, where there is one.
    """
    count, dimension = points_m.shape
    if count < dimension or neighbours < dimension:
        raise InvalidInputError(
            f"normals need at least {dimension} points and neighbours, got {count} points, k = {neighbours}"
        )
    if not np.isfinite(points_m).all():
        raise InvalidInputError("normals: some points are not finite; drop them first (PointCloud.finite())")
    k = min(neighbours, count)
    normals, values = _fit(_index_of(points_m, tree, index, num_threads), at, k, num_threads)
    flat = normals.any(axis=1)
    variance = values[:, 0] / (k * np.where(flat, values[:, 1], 1.0))
    return SurfaceFit(normals, np.where(flat, variance, 0.0))


def flatness(
    points_m: Float64,
    *,
    at: Float64,
    neighbours: int,
    tree: cKDTree | None = None,
    index: NeighbourIndex | None = None,
    num_threads: int | None = None,
) -> Float64:
    """Return the smallest over the largest eigenvalue of the neighbourhoods of places: 0 flat, 1 round."""
    k = min(neighbours, len(points_m))
    _, values = _fit(_index_of(points_m, tree, index, num_threads), at, k, num_threads)
    return np.asarray(values[:, 0] / np.where(values[:, -1] > 0, values[:, -1], 1.0))


def _index_of(
    points: Float64, tree: cKDTree | None, index: NeighbourIndex | None, num_threads: int | None
) -> NeighbourIndex:
    if index is not None:
        return index
    return build_index(points, num_threads) if tree is None else KdTree(points, num_threads, tree=tree)


def _fit(index: NeighbourIndex, at: Float64 | None, k: int, num_threads: int | None) -> tuple[Float64, Float64]:
    """Normals and ascending eigenvalues (M, D) of the covariance of the k points nearest to each place."""
    from scanweld.geometry.neighbours.grid import HashGrid, embedded  # loads Numba
    from scanweld.geometry.surfaces import kernels
    from scanweld.parallel import limited_threads

    points = index.points
    dimension = points.shape[1]
    count = len(points if at is None else at)
    normals, values = np.empty((count, dimension)), np.empty((count, dimension))
    rest = np.arange(count)
    with limited_threads(num_threads):
        if isinstance(index, HashGrid):
            grid = index.suited_to(k)
            queries = grid.rows if at is None else grid.arranged(at)

            _fit_on(grid, queries, k, False, normals, values)
            rest = np.flatnonzero(values[:, 0] < 0)
            if len(rest) > len(points) * _SPARSE:
                grid = HashGrid(points, cell_m=_COARSER * grid.cell_m)
            if len(rest):
                queries = grid.arranged((points if at is None else at)[rest])
                queries[:, 3] = rest[queries[:, 3].astype(np.int64)]
                _fit_on(grid, queries, k, True, normals, values)
                rest = rest[values[rest, 0] < 0]
            if len(rest):
                index = index.tree
        space = embedded(points)
        for start in range(0, len(rest), _LISTED):
            rows = rest[start : start + _LISTED]
            places = np.ascontiguousarray((points if at is None else at)[rows])
            _, near = index.k_nearest(places, k)
            kernels.fit_listed(embedded(places), near, space, dimension, rows, normals, values)
    return normals, values


def _fit_on(grid: HashGrid, queries: Float64, k: int, patient: bool, normals: Float64, values: Float64) -> None:
    """Fit the neighbourhoods of queries (N, 4) into the rows that they name."""
    from scanweld.geometry.surfaces import kernels
    from scanweld.parallel import run_ranges

    def fit(first: int, last: int) -> None:
        start, stop = first * kernels.CHUNK, min(last * kernels.CHUNK, len(queries))
        kernels.fit_nearest(
            queries, start, stop, k, normals.shape[1], grid.rows, grid.starts, grid.lattice, patient, normals, values
        )

    run_ranges(-(-len(queries) // kernels.CHUNK), fit)
