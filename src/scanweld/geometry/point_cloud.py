"""Point clouds: points with optional normals and colours, voxel downsampling, typical spacing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Array, Float64, Int32, Int64, UInt8, as_points, finite_rows
from scanweld.errors import InvalidInputError
from scanweld.geometry.neighbours.kd_tree import NeighbourIndex

_FIRST_TABLE = 1 << 15  # slots for 16384 voxels; stays in the second-level cache
_SPACING_SAMPLE = 1500  # the median of so many distances is known to about 3 %


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points in 2-D or 3-D with what is known about each.

    Attributes
    ----------
    points_m : (N, D) float64, D = 2 or 3 [m]; float64 keeps millimetres at coordinates of 1e6 (UTM)
    normals : (N, D) float64, or None; unit length, (0, .., 0) where unknown
    colors : (N, 3) uint8 RGB, or None

    Raises
    ------
    InvalidInputError
        When a shape does not match or colours are not uint8.
    """

    points_m: Float64
    normals: Float64 | None = None
    colors: UInt8 | None = None

    def __post_init__(self) -> None:
        points = as_points(self.points_m, "points_m")
        object.__setattr__(self, "points_m", points)
        if self.normals is not None:
            normals = as_points(self.normals, "normals", dimensions=(points.shape[1],))
            if len(normals) != len(points):
                raise InvalidInputError(f"normals: expected one per point ({len(points)}), got {len(normals)}")
            object.__setattr__(self, "normals", normals)
        if self.colors is not None:
            colors = np.asarray(self.colors)
            if colors.shape != (len(points), 3) or colors.dtype != np.uint8:
                raise InvalidInputError(
                    f"colors: expected shape ({len(points)}, 3) uint8, got {colors.shape} {colors.dtype}"
                )

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.points_m.shape[1])

    def select(self, rows: npt.ArrayLike) -> PointCloud:
        """Return the cloud of the selected rows, a mask or indices."""
        chosen = np.asarray(rows)
        return PointCloud(
            self.points_m[chosen],
            None if self.normals is None else self.normals[chosen],
            None if self.colors is None else self.colors[chosen],
        )

    def finite(self) -> PointCloud:
        """Return the cloud without the rows that hold a NaN or an infinity."""
        if np.isfinite(self.points_m).all() and (self.normals is None or np.isfinite(self.normals).all()):
            return self
        return self.select(finite_rows(self.points_m, self.normals))

    def transformed(self, T_new_old: npt.ArrayLike, scale: float = 1.0) -> PointCloud:
        """Return the cloud moved by x_new = scale R x_old + t; normals are rotated."""
        T = np.asarray(T_new_old, dtype=np.float64)
        d = self.dimension
        rotation = T[:d, :d]
        normals = None if self.normals is None else self.normals @ rotation.T
        return replace(self, points_m=scale * self.points_m @ rotation.T + T[:d, d], normals=normals)

    def columns(self) -> dict[str, Array]:
        """Return the columns of a PLY file in their usual order; a 2-D cloud is written with z = 0."""
        columns: dict[str, Array] = dict(zip("xyz", self.points_m.T, strict=False))
        columns.setdefault("z", np.zeros(len(self)))
        if self.normals is not None:
            columns |= zip(("nx", "ny", "nz"), self.normals.astype(np.float32).T, strict=False)
            columns.setdefault("nz", np.zeros(len(self), np.float32))
        if self.colors is not None:
            columns |= zip(("red", "green", "blue"), self.colors.T, strict=True)
        return columns


def voxel_downsample(cloud: PointCloud, voxel_m: float) -> PointCloud:
    """Replace the points of each cube (square in 2-D) of side `voxel_m` by their mean.

    The grid starts at the cloud's smallest coordinates, so a moved cloud gives the same points moved, and
    large offsets cost no precision. Normals are averaged and renormalised, colours averaged. Voxels come out
    in row-major order: the result depends on nothing but the input.

    Parameters
    ----------
    cloud : rows that are not finite are left out
    voxel_m : side [m], > 0

    Raises
    ------
    InvalidInputError
        When the side is not positive, or so small that voxels cannot be numbered.
    """
    if not (np.isfinite(voxel_m) and voxel_m > 0):
        raise InvalidInputError(f"voxel: expected a positive side in metres, got {voxel_m}")
    cloud = cloud.finite()
    if len(cloud) == 0:
        return cloud
    from scanweld.geometry.voxels import kernels  # loads Numba

    points = cloud.points_m
    origin = np.array([points[:, axis].min() for axis in range(cloud.dimension)])
    width = np.array([points[:, axis].max() for axis in range(cloud.dimension)]) - origin
    if width.max() / voxel_m >= 2.0**53:
        raise InvalidInputError(f"voxel: {voxel_m} m is too small for a cloud {width.max():.3g} m wide")
    labels, firsts, order = _label(points, origin, width, voxel_m)

    def mean(values: Array, about: Float64) -> Float64:
        sums = np.zeros((len(order), values.shape[1]))
        counts = np.zeros(len(order), dtype=np.int32)
        kernels.add_rows(np.ascontiguousarray(values, dtype=np.float64), about, labels, sums, counts)
        return np.asarray((sums / counts[:, None])[order])

    normals = colors = None
    if cloud.normals is not None:
        total = mean(cloud.normals, np.zeros(cloud.dimension))
        length = np.linalg.norm(total, axis=1, keepdims=True)
        cancelled = length < 1e-6  # opposite normals: their mean says nothing, the first one at least exists
        normals = np.where(cancelled, cloud.normals[firsts[order]], total / np.where(cancelled, 1.0, length))
    if cloud.colors is not None:
        colors = np.rint(mean(cloud.colors, np.zeros(3))).astype(np.uint8)
    return PointCloud(mean(points, origin) + origin, normals, colors)


def voxel_downsample_each(
    clouds: Sequence[PointCloud], voxel_m: float, *, num_threads: int | None = None
) -> list[PointCloud]:
    """Thin several clouds by :func:`voxel_downsample`, each in a thread of its own."""
    from scanweld.parallel import limited_threads, run_ranges

    thinned = list(clouds)

    def thin(start: int, stop: int) -> None:
        thinned[start:stop] = [voxel_downsample(cloud, voxel_m) for cloud in clouds[start:stop]]

    with limited_threads(num_threads):
        run_ranges(len(thinned), thin)
    return thinned


def _label(points: Float64, origin: Float64, width: Float64, voxel_m: float) -> tuple[Int32, Int64, Int64]:
    """Label of each point's voxel, first point of each label, and the order of labels that is row-major in space."""
    from scanweld.geometry.voxels import kernels

    sizes = np.floor(width / voxel_m) + 1
    if float(np.prod(sizes)) >= 2.0**62:
        return _label_by_sorting(np.floor((points - origin) / voxel_m).astype(np.int64))
    labels = np.empty(len(points), dtype=np.int32)
    keys, firsts = np.empty(len(points), dtype=np.int64), np.empty(len(points), dtype=np.int64)
    row = count = 0
    size = _FIRST_TABLE
    while row < len(points):
        table = np.full(size, -1, dtype=np.int32)
        kernels.fill_table(keys, count, table)
        row, count = kernels.label_points(
            points, row, origin, float(voxel_m), sizes.astype(np.int64), table, labels, keys, firsts, count
        )
        size *= 4
    return labels, firsts[:count], np.argsort(keys[:count])


def _label_by_sorting(cells: Int64) -> tuple[Int32, Int64, Int64]:
    """As :func:`_label`, for cells (N, D) of which there are more than an integer can number."""
    order = np.lexsort(cells.T[::-1])
    changed = np.concatenate([[False], (np.diff(cells[order], axis=0) != 0).any(axis=1)])
    labels = np.empty(len(cells), dtype=np.int32)
    labels[order] = np.cumsum(changed)
    firsts = order[np.concatenate([[0], np.flatnonzero(changed)])]
    return labels, firsts, np.arange(len(firsts))


def grid_order(points_m: npt.ArrayLike) -> Int64:
    """Return an order (N,) of points (N, D), finite, in which neighbours follow each other: searches for points so
    ordered take about half the time."""
    points = as_points(points_m, "points_m")
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    from scanweld.geometry.neighbours.grid import HashGrid  # loads Numba

    return HashGrid(points).order


def median_spacing(
    points_m: npt.ArrayLike, tree: cKDTree | None = None, *, index: NeighbourIndex | None = None
) -> float:
    """Return the median distance [m] from a point to its nearest distinct neighbour, 0 where there is none.

    Parameters
    ----------
    points_m : (N, D), finite
    tree, index : a k-d tree or another index of the same points, where the caller has one
    """
    points = np.asarray(points_m, dtype=np.float64)
    if len(points) < 2:
        return 0.0
    stride = max(1, len(points) // _SPACING_SAMPLE)
    if index is not None:
        distances, _ = index.k_nearest(points[::stride], 2)
    else:
        distances, _ = (tree or cKDTree(points)).query(points[::stride], k=2)
    spacing = float(np.median(distances[:, 1]))
    if spacing > 0:
        return spacing
    distinct = np.unique(points, axis=0)  # at least half of the points are duplicates
    return median_spacing(distinct) if 1 < len(distinct) < len(points) else 0.0
