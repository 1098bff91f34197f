"""Correspondences by nearest neighbour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry.neighbours import KdTree, NeighbourIndex

__all__ = ["Correspondences", "KdTree", "NeighbourIndex", "find_correspondences"]


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
