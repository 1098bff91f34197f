"""Correspondences by nearest neighbour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from scanweld.arrays import Float64, Int64


class NeighbourIndex(Protocol):
    """Finds the nearest target point of each query; a k-d tree here, anything else that answers the same."""

    def nearest(self, points: Float64, max_distance: float) -> tuple[Float64, Int64]:
        """Return distances (N,) and indices (N,); inf and the number of targets where none is near enough."""


class KdTree:
    """k-d tree of the target points (M, D), M >= 1; the answer does not depend on the number of threads."""

    def __init__(self, points: Float64, num_threads: int | None = None) -> None:
        self.tree = cKDTree(points)
        self._workers = num_threads or -1

    def nearest(self, points: Float64, max_distance: float) -> tuple[Float64, Int64]:
        """Return the nearest target of each point within `max_distance`, the bound included."""
        bound = np.nextafter(max_distance, np.inf)
        distances, indices = self.tree.query(points, distance_upper_bound=bound, workers=self._workers)
        return distances, indices.astype(np.int64)


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Pairs of rows, ascending in the source.

    Attributes
    ----------
    source, target : (M,) int64, rows of the two clouds
    distances_m : (M,)
    """

    source: Int64
    target: Int64
    distances_m: Float64

    def __len__(self) -> int:
        return len(self.source)

    @property
    def num_targets(self) -> int:
        """Number of different target points in use."""
        return len(np.unique(self.target))


def find_correspondences(index: NeighbourIndex, points: Float64, max_distance: float) -> Correspondences:
    """Pair every point (N, D), already moved to the target frame, with its nearest target within the gate."""
    distances, target = index.nearest(points, max_distance)
    source = np.flatnonzero(np.isfinite(distances))
    return Correspondences(source, target[source], distances[source])
