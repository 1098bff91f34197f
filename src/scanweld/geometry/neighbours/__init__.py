"""Who is near whom: one Protocol, a sorted hash grid and a k-d tree that give the same answers."""

from scanweld.geometry.neighbours.kd_tree import KdTree, NeighbourIndex, build_index

__all__ = ["KdTree", "NeighbourIndex", "build_index"]
