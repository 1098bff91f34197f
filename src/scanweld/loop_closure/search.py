"""What is found out about a new keyframe while the next frames are tracked: a loop, or the place in another submap.

Everything here looks at keyframes and edges as they were when the search began, and changes nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig
from scanweld.loop_closure.held_out import fits_better, fits_in_place
from scanweld.loop_closure.joining import PlacePair
from scanweld.loop_closure.keyframes import Keyframe
from scanweld.loop_closure.place_verification import VerificationConfig, verify_place
from scanweld.registration.pose_graph import PoseGraph, edge_information

logger = logging.getLogger(__name__)

_KEPT_WEIGHT = 0.5
"""Robust weight of an edge that was not dropped."""

_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-3, 1e-3  # of the motion between two keyframes, however short
_SIGMA_RAD_PER_M = 0.005


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured motion between two keyframes; `loop` edges may be wrong."""

    i: int
    j: int
    T_i_j: Float64
    information: Float64
    loop: bool


def tracked_edge(i: int, j: int, T_i_j: Float64, drift: float, *, loop: bool = False) -> Edge:
    """Return the edge between two keyframes that were tracked in one map; its uncertainty grows with its length."""
    length, turn = float(np.linalg.norm(T_i_j[:3, 3])), float(se3.rotation_angle_rad(T_i_j))
    sigma_m = _LEAST_SIGMA_M + drift * length
    sigma_rad = _LEAST_SIGMA_RAD + _SIGMA_RAD_PER_M * length + drift * turn
    return Edge(i, j, T_i_j, np.diag(np.repeat([sigma_m, sigma_rad], 3) ** -2.0), loop)


@dataclass(frozen=True, slots=True)
class Query:
    """A keyframe whose place is looked for among older ones.

    Attributes
    ----------
    keyframe, submap : its numbers
    revisited : keyframes of its submap that look alike, best first
    elsewhere : the same of other submaps
    """

    keyframe: int
    submap: int
    revisited: list[int]
    elsewhere: list[int]


@dataclass(frozen=True, slots=True)
class Found:
    """The answer to a query; empty where the keyframe is where it seems to be, or at no place that is known.

    Attributes
    ----------
    loop : the edge that closes a loop, or None
    T_world_keyframe : (K, 4, 4) with it, of the keyframes of the submap
    pairs : the keyframe with those of other submaps that show its place
    """

    loop: Edge | None
    T_world_keyframe: Float64
    pairs: tuple[PlacePair, ...]


def find_place(
    query: Query,
    keyframes: Sequence[Keyframe],
    members: Int64,
    edges: Sequence[Edge],
    surfaces: SurfaceConfig,
    verification: VerificationConfig,
) -> Found:
    """Look for a loop that a keyframe closes, and if there is none for its place in other submaps.

    Parameters
    ----------
    keyframes : all that there are
    members : (K,) the numbers of those of its submap
    edges : between any of them
    """
    for candidate in query.revisited:
        if _is_in_place(keyframes[query.keyframe], keyframes[candidate], surfaces):
            continue
        loop = _verified(query.keyframe, candidate, keyframes, surfaces, verification)
        poses = None if loop is None else close_loop(loop, keyframes, members, edges, surfaces)
        if poses is not None:
            return Found(loop, poses, ())
    places = (_verified(query.keyframe, other, keyframes, surfaces, verification) for other in query.elsewhere)
    pairs = [PlacePair(edge.i, edge.j, edge.T_i_j, edge.information) for edge in places if edge is not None]
    return Found(None, np.empty((0, 4, 4)), tuple(pairs))


def _is_in_place(keyframe: Keyframe, candidate: Keyframe, surfaces: SurfaceConfig) -> bool:
    """Whether the map already agrees with a candidate: there is no loop to close."""
    T_candidate_keyframe = se3.inverse(candidate.T_world_camera) @ keyframe.T_world_camera
    return fits_in_place(keyframe.pyramid(surfaces), candidate, T_candidate_keyframe, surfaces)


def _verified(
    keyframe: int,
    candidate: int,
    keyframes: Sequence[Keyframe],
    surfaces: SurfaceConfig,
    verification: VerificationConfig,
) -> Edge | None:
    """Return the edge from a candidate when it shows the place of the keyframe."""
    result = verify_place(keyframes[keyframe].sighting(surfaces), keyframes[candidate], verification)
    if not result.status.success:
        return None
    return Edge(candidate, keyframe, result.T_target_source, edge_information(result), True)


def close_loop(
    loop: Edge, keyframes: Sequence[Keyframe], members: Int64, edges: Sequence[Edge], surfaces: SurfaceConfig
) -> Float64 | None:
    """Solve the graph with one more edge; return the poses when keyframes that took no part fit better with them."""
    node = {int(index): k for k, index in enumerate(members)}
    mine = [keyframes[index] for index in members]
    old = np.stack([keyframe.T_world_camera for keyframe in mine])
    graph = PoseGraph()
    for pose in old:
        graph.add_node(pose)
    for edge in (*edges, loop):
        if edge.i in node:
            graph.add_edge(node[edge.i], node[edge.j], edge.T_i_j, edge.information, robust=edge.loop)
    solved = graph.optimise()
    if not solved.status.has_pose or solved.weights[-1] < _KEPT_WEIGHT:
        logger.info("loop %d -> %d: the rest of the path does not allow it", loop.i, loop.j)
        return None
    if not fits_better(mine, old, solved.T_world_node, node[loop.i], node[loop.j], surfaces):
        logger.info("loop %d -> %d: other keyframes do not fit better", loop.i, loop.j)
        return None
    return solved.T_world_node
