"""Scans as nodes, alignments as edges: which alignments agree with one another, and what they connect."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components

from scanweld.arrays import Bool, Float64, Int64
from scanweld.geometry import se3
from scanweld.registration.pose_graph import PoseGraph, PoseGraphConfig


@dataclass(frozen=True, slots=True)
class Alignments:
    """Alignments that may be wrong.

    Attributes
    ----------
    ends : (E, 2) target and source of each, in ascending order
    T_target_source : (E, 4, 4)
    information : (E, 6, 6), left perturbation at the target's origin
    strength : (E,) what decides between alignments that nothing else tells apart; more is better
    """

    ends: Int64
    T_target_source: Float64
    information: Float64
    strength: Float64

    def select(self, mask: Bool) -> Alignments:
        """Return some of the alignments."""
        return Alignments(self.ends[mask], self.T_target_source[mask], self.information[mask], self.strength[mask])


def triangle_votes(alignments: Alignments, max_chi2: float) -> tuple[Int64, Int64]:
    """Return how many triangles of alignments each one is part of, and how many of them close, (E,) each.

    A triangle i, j, k closes when T_ij T_jk T_ik^-1 is the identity within its covariance, which is
    C_ij + Ad(T_ij) C_jk Ad(T_ij)^T + C_ik.
    """
    number = {(int(i), int(j)): k for k, (i, j) in enumerate(alignments.ends)}
    later: dict[int, list[int]] = {}
    for i, j in sorted(number):
        later.setdefault(i, []).append(j)
    triangles = np.array(
        [
            (number[i, j], number[j, k], number[i, k])
            for i, neighbours in later.items()
            for j, k in combinations(neighbours, 2)
            if (j, k) in number
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    count = len(alignments.ends)
    if len(triangles) == 0:
        return np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    ij, jk, ik = triangles.T
    T, covariance = alignments.T_target_source, np.linalg.inv(alignments.information)
    error = se3.log(T[ij] @ T[jk] @ se3.inverse(T[ik]))
    turn = se3.adjoint(T[ij])
    total = covariance[ij] + turn @ covariance[jk] @ np.swapaxes(turn, 1, 2) + covariance[ik]
    chi2 = np.einsum("ta,ta->t", error, np.linalg.solve(total, error[:, :, None])[:, :, 0])
    closed = triangles[chi2 <= max_chi2]
    return np.bincount(triangles.ravel(), minlength=count), np.bincount(closed.ravel(), minlength=count)


def tree_poses(alignments: Alignments, votes: Int64, num_scans: int) -> Float64:
    """Return poses (N, 4, 4) along the spanning forest of the alignments with most votes, then most strength.

    The first scan of each component has the identity.
    """
    order = np.lexsort((-alignments.strength, -votes))
    label = np.arange(num_scans)
    chosen = []
    for k in order:
        i, j = label[alignments.ends[k]]
        if i != j:
            label[label == j] = i
            chosen.append(k)
    poses = np.tile(np.eye(4), (num_scans, 1, 1))
    edge = {(int(i), int(j)): k for k in chosen for i, j in [alignments.ends[k]]}
    graph = adjacency(alignments.ends[chosen], num_scans)
    labels = component_labels(alignments.ends[chosen], num_scans)
    for root in np.unique(labels, return_index=True)[1]:
        order, parent = breadth_first_order(graph, root, directed=False)
        for node in order[1:]:
            above = int(parent[node])
            if (above, int(node)) in edge:
                T = alignments.T_target_source[edge[above, int(node)]]
            else:
                T = se3.inverse(alignments.T_target_source[edge[int(node), above]])
            poses[node] = poses[above] @ T
    return poses


def solve(
    alignments: Alignments, start: Float64, config: PoseGraphConfig, *, robust: bool
) -> tuple[Float64, Bool, Float64, Bool]:
    """Optimise the poses of all components at once; the first scan of each stays where it is.

    Returns
    -------
    poses (N, 4, 4), mask (E,) of the alignments that were kept, and unless robust the covariances (N, 6, 6) of the
    poses, and a mask (N,) of the scans that the alignments leave free in some direction
    """
    graph = PoseGraph()
    labels = component_labels(alignments.ends, len(start))
    first = np.unique(labels, return_index=True)[1]
    for node, T in enumerate(start):
        graph.add_node(T, fixed=node in first)
    for (i, j), T, information in zip(alignments.ends, alignments.T_target_source, alignments.information, strict=True):
        graph.add_edge(int(i), int(j), T, information, robust=robust)
    result = graph.optimise(config, covariance_of=() if robust else range(len(start)))
    loose = np.isin(np.arange(len(start)), result.loose_nodes)
    covariance = np.zeros((len(start), 6, 6)) if result.covariance is None else result.covariance
    return result.T_world_node, ~result.rejected, covariance, loose


def misfits(alignments: Alignments, T_world_scan: Float64) -> Float64:
    """Return the squared Mahalanobis distances (E,) of alignments from what poses (N, 4, 4) say."""
    i, j = alignments.ends.T
    between = se3.inverse(T_world_scan[i]) @ T_world_scan[j]
    error = se3.log(between @ se3.inverse(alignments.T_target_source))
    return np.asarray(np.einsum("ea,eab,eb->e", error, alignments.information, error))


def bridges(ends: Int64, num_scans: int) -> dict[int, Int64]:
    """Return the edges that lie on no cycle, each with the component labels (N,) that are left without it."""
    found = {}
    count = len(np.unique(component_labels(ends, num_scans)))
    for k in range(len(ends)):
        labels = component_labels(np.delete(ends, k, axis=0), num_scans)
        if len(np.unique(labels)) > count:
            found[k] = labels
    return found


def trustworthy(ends: Int64, kept: Bool, num_scans: int) -> Bool:
    """Mask (E,) of the kept edges that remain when those are dropped that others speak against as loudly.

    - Where a rejected edge joins the two sides of a bridge, either of the two may be the wrong one: the bridge goes.
    - Where a scan has no more kept than rejected edges to the scans that it is connected to, chance may have chosen
      which: all of its edges go. The worst scan first, because its rejected edges also count against others.
    """
    kept = kept.copy()
    while True:
        bad = _contradicted_bridges(ends, kept, num_scans)
        if not bad.any():
            bad = kept & (ends == _outvoted(ends, kept, num_scans)).any(axis=1)
        if not bad.any():
            return kept
        kept &= ~bad


def _contradicted_bridges(ends: Int64, kept: Bool, num_scans: int) -> Bool:
    mask = np.zeros(len(ends), dtype=np.bool_)
    whole = component_labels(ends[kept], num_scans)
    rejected = ends[~kept & (whole[ends[:, 0]] == whole[ends[:, 1]])]
    rows = np.flatnonzero(kept)
    for k, labels in bridges(ends[kept], num_scans).items():
        mask[rows[k]] = bool((labels[rejected[:, 0]] != labels[rejected[:, 1]]).any())
    return mask


def _outvoted(ends: Int64, kept: Bool, num_scans: int) -> int:
    """Return the scan with the most rejected edges above its kept ones, at least as many; -1 where there is none."""
    labels = component_labels(ends[kept], num_scans)
    rejected = ends[~kept & (labels[ends[:, 0]] == labels[ends[:, 1]])]
    against = np.bincount(rejected.ravel(), minlength=num_scans) - np.bincount(ends[kept].ravel(), minlength=num_scans)
    against[np.bincount(rejected.ravel(), minlength=num_scans) == 0] = -1
    worst = int(np.argmax(against))
    return worst if against[worst] >= 0 else -1


def component_labels(ends: Int64, num_scans: int) -> Int64:
    """Number (N,) the connected components, in the order of their first scans."""
    labels = connected_components(adjacency(ends, num_scans), directed=False)[1]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse], dtype=np.int64)


def adjacency(ends: Int64, num_scans: int) -> sp.csr_matrix:
    """Return the graph of the edges as a sparse matrix."""
    return sp.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(num_scans, num_scans))
