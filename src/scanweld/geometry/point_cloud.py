"""Point clouds: points with optional normals and colours, voxel downsampling, typical spacing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Array, Float64, Int64, UInt8, as_points, finite_rows
from scanweld.errors import InvalidInputError

_SPACING_SAMPLE = 4000  # the median of so many distances is known to about 2 %


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
        mask = finite_rows(self.points_m, self.normals)
        return self if mask.all() else self.select(mask)

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
    origin = cloud.points_m.min(axis=0)
    local = cloud.points_m - origin
    if local.max() / voxel_m >= 2.0**53:
        raise InvalidInputError(f"voxel: {voxel_m} m is too small for a cloud {local.max():.3g} m wide")
    order, starts = _group(np.floor(local / voxel_m).astype(np.int64))
    counts = np.diff(np.append(starts, len(order)))[:, None]

    def mean(values: Array) -> Float64:
        return np.asarray(np.add.reduceat(values[order].astype(np.float64), starts, axis=0) / counts)

    normals = colors = None
    if cloud.normals is not None:
        total = mean(cloud.normals)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        cancelled = length < 1e-6  # opposite normals: their mean says nothing, the first one at least exists
        normals = np.where(cancelled, cloud.normals[order[starts]], total / np.where(cancelled, 1.0, length))
    if cloud.colors is not None:
        colors = np.rint(mean(cloud.colors)).astype(np.uint8)
    return PointCloud(mean(local) + origin, normals, colors)


def _group(cells: Int64) -> tuple[Int64, Int64]:
    """Return the order that sorts rows of integers, stably, and where each run of equal rows starts."""
    sizes = cells.max(axis=0) + 1
    if float(np.prod(sizes.astype(np.float64))) < 2.0**62:
        key = np.ravel_multi_index(tuple(cells.T), tuple(sizes))
        order = np.argsort(key, kind="stable")
        changed = np.diff(key[order]) != 0
    else:
        order = np.lexsort(cells.T[::-1])
        changed = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return order, np.concatenate([[0], np.flatnonzero(changed) + 1])


def median_spacing(points_m: npt.ArrayLike, tree: cKDTree | None = None) -> float:
    """Return the median distance [m] from a point to its nearest distinct neighbour, 0 where there is none.

    Parameters
    ----------
    points_m : (N, D), finite
    tree : a k-d tree of the same points, where the caller has one
    """
    points = np.asarray(points_m, dtype=np.float64)
    if len(points) < 2:
        return 0.0
    stride = max(1, len(points) // _SPACING_SAMPLE)
    distances, _ = (tree or cKDTree(points)).query(points[::stride], k=2)
    spacing = float(np.median(distances[:, 1]))
    if spacing > 0:
        return spacing
    distinct = np.unique(points, axis=0)  # at least half of the points are duplicates
    return median_spacing(distinct) if 1 < len(distinct) < len(points) else 0.0
