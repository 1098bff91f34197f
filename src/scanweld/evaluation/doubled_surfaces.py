"""How much of a map lies twice: the layers that drift leaves where a place was seen again.

Around each point p with normal n stands a cylinder along n. The points in it that face the same way have heights
n . (q - p). They are parted into groups in two ways: wherever neighbouring heights are further apart than
`thickness_m`, and once into two by the threshold that parts them best (N. Otsu, "A threshold selection method from
gray-level histograms", 1979). A group is a *layer* when it has points in all four quadrants around the axis. The point
is *doubled* when its own group is a layer, another layer is within `distance_m`, and their mean heights differ by
`thickness_m` and by four standard deviations of the heights within them.

What that leaves out, on purpose:

- noise: halves of one noisy surface are 2.7 standard deviations apart (3.5 if its heights are evenly spread), however
  thick it is; a stray point off a surface surrounds nothing;
- the neighbours on the same surface: their heights are those of the point, they are its own group;
- corners: the other wall faces another way; the two sides of a board face opposite ways;
- steps: a book on a table is a few centimetres above it and faces the same way, but it ends where it ends. Beyond its
  edge the table lies on one side of the axis only;
- single things before a surface, a leaf or a pen: the thinner of two layers has a third of the other's points at least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Bool, Float64, Int64, as_points, finite_rows
from scanweld.errors import InvalidInputError

THICKNESS_M = 0.01
SEPARATION = 4.0
"""Standard deviations within two layers that their means must be apart; halves of a Gaussian are 2.7 apart."""
FACING_DEG = 25.0
RADIUS_SPACINGS = 5.0
"""Radius of the cylinder in spacings of the points: enough that a surface has points in all four quadrants."""
FULLNESS = 1 / 3
"""The thinner of two layers must have this share of the other's points: a few things before a surface are no layer."""
_CELLS_PER_RADIUS = 4.0  # of what is denser than this, one point per cell is enough
_CHUNK = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class DoubledSurfaces:
    """Share of a map that lies within a distance of another surface facing the same way.

    Attributes
    ----------
    share : doubled points over all that were looked at, 0..1
    num_points : how many were looked at
    points_m : (K, 3), the doubled ones, for a person to look at [m]
    """

    share: float
    num_points: int
    points_m: Float64


def doubled_surfaces(
    points_m: npt.ArrayLike,
    normals: npt.ArrayLike,
    *,
    distance_m: float = 0.05,
    thickness_m: float = THICKNESS_M,
    radius_m: float | None = None,
    max_points: int = 20_000,
    num_threads: int = 1,
) -> DoubledSurfaces:
    """Measure the share of a map that has another surface in front of or behind it, facing the same way.

    Parameters
    ----------
    points_m, normals : (N, 3), unit normals; rows that are not finite are left out
    distance_m : how far apart two layers of one surface may be, along the normal [m]
    thickness_m : sheets that are nearer to each other are one surface [m]
    radius_m : of the cylinder around a normal [m]; None takes five times the spacing of the points, 2 to 10 cm
    max_points : look at so many points, spread evenly over the rows
    num_threads : threads of the neighbour search; the result does not depend on it

    Raises
    ------
    InvalidInputError
        When there is no point, or the shapes do not match.
    """
    points, directions = as_points(points_m, "points", dimensions=(3,)), as_points(normals, "normals", dimensions=(3,))
    if points.shape != directions.shape:
        raise InvalidInputError(f"doubled_surfaces: {len(points)} points, but {len(directions)} normals")
    usable = finite_rows(points) & finite_rows(directions)
    points, directions = points[usable], directions[usable]
    if len(points) == 0:
        raise InvalidInputError("doubled_surfaces: the map is empty")
    if not (distance_m > 0 and thickness_m > 0 and max_points > 0):
        raise InvalidInputError("doubled_surfaces: distance_m, thickness_m and max_points must be positive")
    queries = np.unique(np.linspace(0, len(points) - 1, min(max_points, len(points))).astype(np.int64))
    if radius_m is None:
        radius_m = float(np.clip(RADIUS_SPACINGS * _spacing(points, queries, num_threads), 0.02, 0.1))
    kept = _thinned(points, directions, radius_m / _CELLS_PER_RADIUS)
    cloud, facing = points[kept], directions[kept]
    tree = cKDTree(cloud)
    doubled = np.zeros(len(queries), dtype=np.bool_)
    for start in range(0, len(queries), _CHUNK):
        rows = queries[start : start + _CHUNK]
        p, n = points[rows], directions[rows]
        owner, other = _neighbours(tree, p, float(np.hypot(radius_m, distance_m)), num_threads)
        offset = cloud[other] - p[owner]
        height = (n[owner] * offset).sum(axis=1)
        lateral = offset - height[:, None] * n[owner]
        inside = (np.abs(height) <= distance_m) & (np.square(lateral).sum(axis=1) <= radius_m**2)
        inside &= (facing[other] * n[owner]).sum(axis=1) >= np.cos(np.deg2rad(FACING_DEG))
        quadrant = _quadrants(lateral[inside], n[owner[inside]])
        heights = _Heights.of(len(rows), owner[inside], height[inside], quadrant)
        doubled[start : start + len(rows)] = heights.have_another_layer(thickness_m)
    return DoubledSurfaces(share=float(doubled.mean()), num_points=len(queries), points_m=points[queries[doubled]])


def _spacing(points: Float64, queries: Int64, num_threads: int) -> float:
    """Median distance from a point to its nearest neighbour [m]."""
    if len(points) < 2:
        return 0.0
    some = queries[:: max(1, len(queries) // 2000)]
    distance, _ = cKDTree(points).query(points[some], k=2, workers=num_threads)
    return float(np.median(distance[:, 1]))


def _thinned(points: Float64, normals: Float64, cell_m: float) -> Int64:
    """Rows of one point per cell and main direction of the normal: dense maps cost no more than needed."""
    cell = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64)
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (normals[np.arange(len(normals)), axis] > 0)
    order = np.lexsort((side, *cell.T))  # stable: the first row of each cell stays the first
    keys = np.column_stack([cell, side])[order]
    first = np.r_[True, (np.diff(keys, axis=0) != 0).any(axis=1)]
    return np.sort(order[first])


def _neighbours(tree: cKDTree, points: Float64, radius_m: float, num_threads: int) -> tuple[Int64, Int64]:
    """Pairs (query, row of the tree) within a radius."""
    lists = tree.query_ball_point(points, radius_m, workers=num_threads, return_sorted=True)
    counts = np.array([len(found) for found in lists])
    other = np.fromiter((row for found in lists for row in found), np.int64, int(counts.sum()))
    return np.repeat(np.arange(len(points)), counts), other


def _quadrants(lateral: Float64, normals: Float64) -> Int64:
    """Quadrant around the normal as a bit: 1, 2, 4, 8; points on the axis itself have none, 0."""
    # Any two axes across the normal do, as long as one normal always gets the same.
    helper = np.zeros_like(normals)
    helper[np.arange(len(normals)), np.abs(normals).argmin(axis=1)] = 1.0
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    x = (lateral * first).sum(axis=1)
    y = (lateral * np.cross(normals, first)).sum(axis=1)
    bit = 1 << (2 * (x > 0) + (y > 0)).astype(np.int64)
    return np.where(x**2 + y**2 > 1e-12, bit, 0)


@dataclass(frozen=True, slots=True)
class _Heights:
    """Heights [m] in the cylinders of `count` queries, sorted by query and height; each query is in its own at 0."""

    count: int
    owner: Int64
    height: Float64
    quadrant: Int64
    itself: Bool

    @classmethod
    def of(cls, count: int, owner: Int64, height: Float64, quadrant: Int64) -> _Heights:
        owner = np.concatenate([owner, np.arange(count)])
        height = np.concatenate([height, np.zeros(count)])
        quadrant = np.concatenate([quadrant, np.zeros(count, dtype=np.int64)])
        itself = np.arange(len(owner)) >= len(owner) - count
        order = np.lexsort((height, owner))
        return cls(count, owner[order], height[order], quadrant[order], itself[order])

    def have_another_layer(self, thickness_m: float) -> Bool:
        """Return which of the queries are in one layer and have another."""
        first = np.r_[True, np.diff(self.owner) > 0]
        gaps = first | np.r_[False, np.diff(self.height) > thickness_m]
        halves = first.copy()
        halves[self._best_thresholds(np.flatnonzero(first))] = True
        return self._parted(gaps, thickness_m) | self._parted(halves, thickness_m)

    def _best_thresholds(self, first: Int64) -> Int64:
        """Where the upper of two groups begins, for each query with two heights at least (Otsu 1979, eq. 14)."""
        sizes = np.diff(np.r_[first, len(self.owner)])
        rank = np.arange(len(self.owner)) - np.repeat(first, sizes)  # how many are below
        total = np.repeat(np.add.reduceat(self.height, first), sizes)
        running = np.cumsum(self.height) - self.height
        below = running - np.repeat(running[first], sizes)
        num = np.repeat(sizes, sizes)
        weight = rank * (num - rank)
        difference = below / np.maximum(rank, 1) - (total - below) / (num - rank)
        between = np.where(rank > 0, weight * difference**2, -1.0)
        order = np.lexsort((between, self.owner))  # the last of each query is its best
        best = order[np.r_[first[1:], len(self.owner)] - 1]
        return np.asarray(best[rank[best] > 0])

    def _parted(self, begins: Bool, thickness_m: float) -> Bool:
        """Which queries are in one layer and have another, given where the groups begin."""
        start = np.flatnonzero(begins)
        size = np.diff(np.r_[start, len(self.owner)])
        mean = np.add.reduceat(self.height, start) / size
        spread = np.add.reduceat(np.square(self.height - np.repeat(mean, size)), start)
        is_layer = np.bitwise_or.reduceat(self.quadrant, start) == 15
        own = np.flatnonzero(np.logical_or.reduceat(self.itself, start))  # one group of each query, in their order
        owner = self.owner[start]
        mine = own[owner]
        deviation = np.sqrt((spread + spread[mine]) / (size + size[mine]))
        apart = np.abs(mean - mean[mine]) > np.maximum(thickness_m, SEPARATION * deviation)
        found = np.zeros(self.count, dtype=np.bool_)
        full = np.minimum(size, size[mine]) >= FULLNESS * np.maximum(size, size[mine])
        found[owner[is_layer & is_layer[mine] & apart & full]] = True
        return found
