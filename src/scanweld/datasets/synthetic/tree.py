"""The bounding volume tree over the primitives of a scene."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64, Int32, Int64
from scanweld.datasets.synthetic.scene import Shape

LEAF_SIZE = 2


def primitive_bounds(affine: Float64, shapes: Int64, tapers: Float64) -> Float64:
    """Boxes (P, 6) [m, world], lowest and highest corner, of primitives given as for a Scene."""
    matrices = affine.reshape(-1, 3, 4)
    linear = np.linalg.inv(matrices[:, :, :3])  # columns: the half axes in the world
    centre = -(linear @ matrices[:, :, 3:])[..., 0]
    stretch = np.ones((len(affine), 1, 3))
    wide = np.maximum(tapers, 1.0)
    frustum = shapes == Shape.FRUSTUM
    stretch[frustum, 0, 0] = stretch[frustum, 0, 2] = wide[frustum]
    stretch[shapes == Shape.QUAD, 0, 2] = 0.0
    cube = np.abs(linear * stretch).sum(axis=2)
    ball = np.linalg.norm(linear, axis=2)
    half = np.where((shapes == Shape.BALL)[:, None], ball, cube) + 1e-6
    return np.concatenate([centre - half, centre + half], axis=1)


def build_tree(boxes: Float64) -> tuple[Int64, Float64, Int32]:
    """Build a binary tree over boxes (P, 6) by the surface area heuristic.

    Returns the order (P,) into which the primitives are to be sorted, and `bounds` (M, 6) and `links` (M, 2)
    of the nodes as :func:`scanweld.datasets.synthetic.kernels.cast` reads them.

    Source: I. Wald, "On fast construction of SAH-based bounding volume hierarchies", 2007 (sweep over the
    centroids).
    """
    centroids = (boxes[:, :3] + boxes[:, 3:]) / 2
    order = np.arange(len(boxes))
    bounds = [_union(boxes)]
    links = [[0, 0]]
    pending = [(0, 0, len(boxes))]
    while pending:
        node, start, stop = pending.pop()
        if stop - start <= LEAF_SIZE:
            links[node] = [start, stop - start]
            continue
        members = order[start:stop]
        ranking, size = _best_split(boxes[members], centroids[members])
        order[start:stop] = members[ranking]
        links[node] = [len(links), 0]
        for low, high in ((start, start + size), (start + size, stop)):
            pending.append((len(links), low, high))
            bounds.append(_union(boxes[order[low:high]]))
            links.append([0, 0])
    return order, np.array(bounds), np.array(links, dtype=np.int32)


def _union(boxes: Float64) -> Float64:
    return np.concatenate([boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)])


def _half_areas(low: Float64, high: Float64) -> Float64:
    x, y, z = (high - low).T
    return np.asarray(x * y + y * z + z * x)


def _best_split(boxes: Float64, centroids: Float64) -> tuple[Int64, int]:
    """Ranking of the members and size of the first part that cost the least."""
    count = len(boxes)
    best: tuple[float, Int64, int] | None = None
    sizes = np.arange(1, count)
    for axis in range(3):
        ranking = np.argsort(centroids[:, axis], kind="stable")
        ranked = boxes[ranking]
        left = _half_areas(np.minimum.accumulate(ranked[:, :3]), np.maximum.accumulate(ranked[:, 3:]))
        back = ranked[::-1]
        right = _half_areas(np.minimum.accumulate(back[:, :3]), np.maximum.accumulate(back[:, 3:]))[::-1]
        cost = left[:-1] * sizes + right[1:] * (count - sizes)
        at = int(np.argmin(cost))
        if best is None or cost[at] < best[0]:
            best = (float(cost[at]), ranking, at + 1)
    assert best is not None
    return best[1], best[2]
