"""One pose graph over the keyframes of all fragments: where they are, and which fragments connect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float64, Int64
from scanweld.geometry import se3
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.linking import common_motion
from scanweld.loop_closure.search import Edge
from scanweld.registration.pose_graph import REJECTED, PoseGraph
from scanweld.registration.scan_graph import Alignments, component_labels, tree_poses
from scanweld.runs.fragments.making import Fragment

Links = Mapping[tuple[int, int], Sequence[Edge]]
"""Edges from keyframes of one fragment to those of a later one."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A submap of a fragment: the smallest thing that has a map and a world of its own.

    Attributes
    ----------
    fragment, submap : which
    component : pieces that connect are of one component, and lie in one world
    correction : how its keyframes move there
    """

    fragment: int
    submap: int
    component: int
    correction: MapCorrection


@dataclass(frozen=True, slots=True)
class Assembly:
    """Fragments put together.

    Attributes
    ----------
    pieces : in the order of the fragments
    loops : pairs of keyframes, numbered through all fragments, that loops tie together
    kept : for each pair of fragments with edges how many of these were kept, and how many there were
    """

    pieces: tuple[Piece, ...]
    loops: tuple[tuple[int, int], ...]
    kept: Mapping[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True, slots=True)
class _Nodes:
    """The keyframes of all fragments as the nodes of a graph.

    Attributes
    ----------
    first : (F + 1,) number of the first keyframe of each fragment
    poses : (N, 4, 4), each in the world of its piece
    pieces : (N,) piece of each node
    names : fragment and submap of each piece
    """

    first: Int64
    poses: Float64
    pieces: Int64
    names: tuple[tuple[int, int], ...]


def assemble(fragments: Sequence[Fragment], links: Links) -> Assembly:
    """Find the poses of all keyframes that the edges within fragments and between them agree on.

    What edges no longer tie together once wrong ones were dropped stays apart: each component is in the world of the
    first keyframe of its first piece.
    """
    nodes = _nodes(fragments)
    inner = [(f, f, edge) for f, fragment in enumerate(fragments) for edge in fragment.edges]
    between = [(a, b, edge) for (a, b) in sorted(links) for edge in links[a, b]]
    edges = [
        Edge(int(nodes.first[a]) + e.i, int(nodes.first[b]) + e.j, e.T_i_j, e.information, e.loop)
        for a, b, e in (*inner, *between)
    ]
    poses, kept = _solved(nodes, edges)
    of_piece = component_labels(nodes.pieces[_ends(edges)[kept]], len(nodes.names))
    pieces = []
    for piece, (fragment, submap) in enumerate(nodes.names):
        mine, component = np.flatnonzero(nodes.pieces == piece), int(of_piece[piece])
        first = int(np.flatnonzero(of_piece[nodes.pieces] == component)[0])
        T_new_solved = nodes.poses[first] @ se3.inverse(poses[first])
        moved = T_new_solved @ poses[mine] @ se3.inverse(nodes.poses[mine])
        ids = (mine - nodes.first[fragment]).astype(np.int32)
        pieces.append(Piece(fragment, submap, component, MapCorrection(ids, moved)))
    counts: dict[tuple[int, int], tuple[int, int]] = {}
    for (a, b, _), good in zip(between, kept[len(inner) :], strict=True):
        some, of = counts.get((a, b), (0, 0))
        counts[a, b] = some + int(good), of + 1
    loops = tuple((e.i, e.j) for e, good in zip(edges, kept, strict=True) if e.loop and good)
    return Assembly(tuple(pieces), loops, counts)


def _nodes(fragments: Sequence[Fragment]) -> _Nodes:
    first = np.concatenate([[0], np.cumsum([len(fragment.submaps) for fragment in fragments])])
    names = [(f, int(s)) for f, fragment in enumerate(fragments) for s in np.unique(fragment.submaps)]
    number = {name: piece for piece, name in enumerate(names)}
    pieces = [number[f, s] for f, fragment in enumerate(fragments) for s in fragment.submaps.tolist()]
    poses = np.concatenate([np.empty((0, 4, 4)), *(fragment.T_world_keyframe for fragment in fragments)])
    return _Nodes(first, poses, np.array(pieces, np.int64), tuple(names))


def _solved(nodes: _Nodes, edges: Sequence[Edge]) -> tuple[Float64, Bool]:
    """Return the poses (N, 4, 4) of all nodes, and which edges (E,) were kept; what is apart is apart."""
    graph = PoseGraph()
    start = _start(nodes, edges)[nodes.pieces] @ nodes.poses
    labels = component_labels(_ends(edges), len(nodes.poses))
    held = np.isin(np.arange(len(labels)), np.unique(labels, return_index=True)[1])
    for T, fixed in zip(start, held.tolist(), strict=True):
        graph.add_node(T, fixed=fixed)
    for edge in edges:
        graph.add_edge(edge.i, edge.j, edge.T_i_j, edge.information, robust=edge.loop)
    if not edges:
        return start, np.empty(0, np.bool_)
    solved = graph.optimise()
    return solved.T_world_node, solved.weights >= REJECTED


def _ends(edges: Sequence[Edge]) -> Int64:
    return np.array([(edge.i, edge.j) for edge in edges], np.int64).reshape(-1, 2)


def _start(nodes: _Nodes, edges: Sequence[Edge]) -> Float64:
    """Return where the world of each piece (P, 4, 4) lies, along the best edges between pieces."""
    between: dict[tuple[int, int], list[Edge]] = {}
    for edge in edges:
        a, b = int(nodes.pieces[edge.i]), int(nodes.pieces[edge.j])
        if a != b:
            between.setdefault((a, b), []).append(edge)
    motions, strengths = [], []
    for several in between.values():
        T_a_b = np.stack([nodes.poses[e.i] @ e.T_i_j @ se3.inverse(nodes.poses[e.j]) for e in several])
        sure = [k for k, edge in enumerate(several) if not edge.loop]
        agreed = common_motion(T_a_b)
        motions.append(T_a_b[sure[0]] if sure else T_a_b[0] if agreed is None else agreed)
        strengths.append(len(several) + (1e6 if sure else 0.0))  # what both have seen comes first
    alignments = Alignments(
        np.array(list(between), np.int64).reshape(-1, 2),
        np.array(motions).reshape(-1, 4, 4),
        np.tile(np.eye(6), (len(motions), 1, 1)),
        np.array(strengths),
    )
    return tree_poses(alignments, np.zeros(len(motions), np.int64), len(nodes.names))
