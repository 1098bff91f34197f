"""Motions that many feature matches agree on, the best supported first.

The largest set of consistent matches gives the first motion; without the matches that agree with it, the largest set
of the rest gives the next. Rooms repeat themselves: the right motion is often not the one with the most matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3
from scanweld.registration.closed_form import align_closed_form
from scanweld.registration.consistency.clique import largest_clique
from scanweld.registration.consistency.graph import consistency_graph
from scanweld.registration.features.matching import mutual_matches, nearest_features
from scanweld.registration.global_search.scan import Scan
from scanweld.registration.result import RegistrationResult
from scanweld.registration.robust_pairs import align_clique

CANDIDATES = 2
"""A match counts when each feature is among so many of the other's nearest."""

_BOUND = 1.0  # voxels that a right match may be off: its points are means of voxels that lie differently
_AGREE = 1.5  # voxels within which a match agrees with a motion
_MAX_TURN = 0.3  # difference of the cosines between normals and lines of two consistent matches
_MIN_LENGTH = 2.0  # voxels; nearer matches are evidence of the same thing
_MIN_CLIQUE = 4
_MAX_NODES = 300  # the next set is as good: the search need not be exact here
_SAME = 3.0  # voxels between two motions of the source, on average, that make them one
_WIDE, _TIGHT = 3.0, 1.5  # gates of the refinement, voxels
_WIDE_STEPS, _STEPS = 4, 10
_CAUCHY = 2.3849
_MIN_COSINE = 0.7


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """x_target = scale R x + t between two scans, and its support.

    Attributes
    ----------
    T : (4, 4)
    scale : 1 unless estimated
    support : (2,), for how many points of the source the target's most similar feature is where the motion puts them,
        and the other way round
    clique : size of the consistent set it came from
    spread_m : standard deviation of where the agreeing matches alone put the source's points, root mean square; inf
        where they leave a direction free
    """

    T: Float64
    scale: float
    support: tuple[int, int]
    clique: int
    spread_m: float

    def apply(self, points: Float64) -> Float64:
        """Move points (N, 3)."""
        return se3.transform_points(self.T, self.scale * points)


def propose(source: Scan, target: Scan, count: int, *, scale: bool = False) -> tuple[list[Hypothesis], int]:
    """Return at most `count` different motions, refined on the thinned surfaces, and the number of matches."""
    forward, backward = nearest_features(source.features, target.features, CANDIDATES)
    i, j = mutual_matches(forward, backward)
    voxel = target.voxel_m
    ratio = voxel / source.voxel_m if scale else 1.0  # features of the same size are compared
    a, b = source.points[i], target.points[j]
    bounds = np.full(len(i), _BOUND * voxel)
    graph = consistency_graph(
        a,
        b,
        bounds,
        normals=(source.normals[i], target.normals[j]),
        oriented=source.oriented,
        max_turn=_MAX_TURN,
        scale=ratio,
        slack=0.1 if scale else 0.0,
        min_length_m=_MIN_LENGTH * voxel,
    )
    alive = np.ones(len(i), np.bool_)
    found: list[Hypothesis] = []
    for _ in range(2 * count):
        clique = largest_clique(graph, alive=alive, at_least=_MIN_CLIQUE, max_nodes=_MAX_NODES)
        if len(clique) < _MIN_CLIQUE or len(found) == count:
            break
        inliers, fit = align_clique(a, b, _AGREE * bounds, clique.vertices, scale=scale)
        alive[clique.vertices] = False
        alive &= ~inliers
        T, s = refine(source, target, fit.T_target_source, fit.scale if scale else 1.0, free_scale=scale)
        agree = np.linalg.norm(se3.transform_points(T, s * a) - b, axis=1) <= _AGREE * voxel
        moved = se3.transform_points(T, s * source.points)
        spread = _spread(align_closed_form(s * a[agree], b[agree]), moved)
        support = _support(moved, target.points, forward, voxel), _support(target.points, moved, backward, voxel)
        hypothesis = Hypothesis(T, s, support, len(clique), spread)
        if all(distance(hypothesis, other, source.points) > _SAME * voxel for other in found):
            found.append(hypothesis)
    return found, len(i)


def _support(points: Float64, others: Float64, nearest: Int64, voxel_m: float) -> int:
    """Return how many points (N, 3) are where the other scan's most similar feature is; `nearest` (N, K) are rows."""
    if nearest.shape[1] == 0:
        return 0
    known = np.flatnonzero(nearest[:, 0] >= 0)
    off = np.linalg.norm(points[known] - others[nearest[known, 0]], axis=1)
    return int((off <= _AGREE * voxel_m).sum())


def _spread(fit: RegistrationResult, moved: Float64) -> float:
    """Return by how much the uncertainty of a fit moves points (N, 3), root mean square [m]."""
    if not fit.status.success or fit.covariance is None:
        return np.inf
    # A twist (rho, phi) moves a point x by rho + phi x x = [I | -hat(x)] twist.
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(moved), 3, 3)), -se3.hat(moved)], axis=2)
    return float(np.sqrt(np.einsum("nij,jk,nik->n", jacobian, fit.covariance, jacobian, optimize=True).mean()))


def distance(one: Hypothesis, other: Hypothesis, points: Float64) -> float:
    """Mean distance [m] between where two motions put points (N, 3)."""
    return float(np.linalg.norm(one.apply(points) - other.apply(points), axis=1).mean())


def refine(source: Scan, target: Scan, T: Float64, scale: float, *, free_scale: bool = False) -> tuple[Float64, float]:
    """Improve a motion by a few robust point-to-plane steps on the thinned scans, wide gate first."""
    voxel = target.voxel_m
    for step in range(_STEPS):
        gate = (_WIDE if step < _WIDE_STEPS else _TIGHT) * voxel
        moved = se3.transform_points(T, scale * source.points)
        distances, partners = target.index.nearest(moved, gate)
        near = np.flatnonzero(np.isfinite(distances))
        normals = target.normals[partners[near]]
        cosine = np.einsum("nd,nd->n", source.normals[near] @ T[:3, :3].T, normals)
        kept = (cosine if source.oriented else np.abs(cosine)) > _MIN_COSINE
        near, normals = near[kept], normals[kept]
        if len(near) < 12:
            break
        p, q = moved[near], target.points[partners[near]]
        r = np.einsum("nd,nd->n", normals, p - q)
        noise = max(1.4826 * float(np.median(np.abs(r))), 1e-3 * voxel)
        weights = 1 / (1 + (r / (_CAUCHY * noise)) ** 2)
        center = p.mean(axis=0)
        arm = p - center
        jacobian = np.concatenate([normals, np.cross(arm, normals)], axis=1)
        if free_scale:
            jacobian = np.concatenate([jacobian, np.einsum("nd,nd->n", normals, arm)[:, None]], axis=1)
        hessian = (jacobian * weights[:, None]).T @ jacobian
        damping = 1e-6 * np.trace(hessian[:3, :3]) * np.diag([1.0] * 3 + [voxel**2] * (jacobian.shape[1] - 3))
        xi = -np.linalg.solve(hessian + damping, (jacobian * weights[:, None]).T @ r)
        ratio = float(np.exp(np.clip(xi[6], -0.1, 0.1))) if free_scale else 1.0
        turn = se3.exp(xi[:6])
        moved_T = np.eye(4)
        moved_T[:3, :3] = turn[:3, :3] @ T[:3, :3]
        moved_T[:3, 3] = turn[:3, :3] @ (ratio * (T[:3, 3] - center)) + turn[:3, 3] + center
        T, scale = moved_T, scale * ratio
    return T, scale
