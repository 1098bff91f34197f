"""Motions that feature matches agree on, and that the free space of both scans allows.

Every match is the seed of a set of consistent matches, and every such set of a motion. Rooms repeat themselves: the
right motion is often not the one that most matches agree on, so many are kept, and looked at with the surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3
from scanweld.parallel import run_ranges
from scanweld.registration.closed_form import PairFit, align_closed_form, fit_pairs
from scanweld.registration.consistency.graph import consistency_graph
from scanweld.registration.features.matching import mutual_matches, nearest_features
from scanweld.registration.global_search.agreement import ROUGH, DepthMap, assess, conflict
from scanweld.registration.global_search.directions import turns
from scanweld.registration.global_search.kernels import count_agreeing, grow_cliques
from scanweld.registration.global_search.placement import place
from scanweld.registration.global_search.scan import Scan
from scanweld.registration.result import RegistrationResult
from scanweld.registration.robust_pairs import align_clique

CANDIDATES = 2
"""A match counts when each feature is among so many of the other's nearest."""

_BOUND = 1.0  # voxels that a right match may be off: its points are means of voxels that lie differently
_AGREE = 1.5  # voxels within which a match agrees with a refined motion ...
_ROUGHLY = 2.0  # ... and with a rough one
_MAX_TURN = 0.3  # difference of the cosines between normals and lines of two consistent matches
_MIN_LENGTH = 2.0  # voxels; nearer matches are evidence of the same thing
_MIN_CLIQUE, _MAX_CLIQUE = 4, 64  # members of a set; more do not make its motion better
_KEPT = 150  # rough motions to compare with the free space
_MAX_CONFLICT = 0.08  # share of the points in free space at a rough motion
_CONFLICT_POINTS = 600
_SCALE_SLACK = 0.15  # how far the ratio of the clouds' sizes may be from the scale, relative
_PLACES = 64  # points that tell how far apart two motions are
_DIFFERENT, _SAME = 5.0, 3.0  # voxels between two rough motions, on average, that make them two; and two refined ones
_WIDEST, _TIGHT = 4.0, 1.5  # gates of the refinement, voxels: it begins with the first and narrows to the last ...
_NARROWING = 0.75  # ... by so much whenever a step is short
_SHORT = 0.1  # voxels
_STEPS = 30
_REFINED = 3000  # points that refine a motion
_CAUCHY = 2.3849
_MIN_COSINE = 0.7
_PLACED, _SCREENED = 80, 1000  # placements that are looked at, with so many points


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


def propose(
    source: Scan,
    target: Scan,
    count: int,
    *,
    scale: bool = False,
    source_view: DepthMap | None = None,
    target_view: DepthMap | None = None,
) -> tuple[list[Hypothesis], int]:
    """Return different motions, refined on the thinned surfaces, and the number of matches.

    At most `count` come from consistent matches, and as many from placing the surfaces turn by turn.
    """
    views = source_view, target_view
    forward, backward = nearest_features(source.features, target.features, CANDIDATES)
    i, j = mutual_matches(forward, backward)
    voxel = target.voxel_m
    a, b = source.points[i], target.points[j]
    found: list[Hypothesis] = []

    def keep(T: Float64, s: float, clique: int) -> bool:
        """Refine a motion and keep it, unless it is known."""
        T, s = refine(source, target, T, s, free_scale=scale, every=-(-len(source.points) // _REFINED))
        moved = se3.transform_points(T, s * source.points)
        support = _support(moved, target.points, forward, voxel), _support(target.points, moved, backward, voxel)
        agree = np.linalg.norm(se3.transform_points(T, s * a) - b, axis=1) <= _AGREE * voxel
        spread = _spread(align_closed_form(s * a[agree], b[agree]), moved)
        hypothesis = Hypothesis(T, s, support, clique, spread)
        new = all(distance(hypothesis, other, source.points) > _SAME * voxel for other in found)
        if new:
            found.append(hypothesis)
        return new

    matched = 0
    for clique in _consistent_sets(source, target, i, j, scale, views):
        _, fit = align_clique(a, b, np.full(len(a), _AGREE * voxel), clique, scale=scale)
        matched += keep(fit.T_target_source, fit.scale if scale else 1.0, len(clique))
        if matched == count:
            break
    placed = 0
    for T in [] if scale else _placed(source, target, views):
        placed += keep(T, 1.0, 0)
        if placed == count:
            break
    return found, len(i)


def _placed(source: Scan, target: Scan, views: tuple[DepthMap | None, DepthMap | None]) -> list[Float64]:
    """Return motions whose surfaces meet after a turn and a shift, those that meet best after a few steps first."""
    rotations = turns(source.normals, target.normals, oriented=source.oriented)
    every = tuple(-(-len(scan.points) // _SCREENED) for scan in (source, target))
    ranked: list[tuple[float, int, Float64]] = []
    for k, start in enumerate(place(source, target, rotations, views, _PLACED)):
        T, _ = refine(source, target, start, 1.0, every=every[0])
        agreement = assess(source, target, T, 1.0, *views, every=(every[0], every[1]), margin=ROUGH)
        ranked.append((-agreement.meeting * agreement.belief, k, T))
    return [T for _, _, T in sorted(ranked, key=lambda item: item[:2])]


def _consistent_sets(
    source: Scan, target: Scan, i: Int64, j: Int64, scale: bool, views: tuple[DepthMap | None, DepthMap | None]
) -> list[Int64]:
    """Return sets of matches that are consistent, of different motions that free space allows, most agreed on first."""
    if len(i) < _MIN_CLIQUE:
        return []
    voxel = target.voxel_m
    a, b = source.points[i], target.points[j]
    graph = consistency_graph(
        a,
        b,
        np.full(len(i), _BOUND * voxel),
        normals=(source.normals[i], target.normals[j]),
        oriented=source.oriented,
        max_turn=_MAX_TURN,
        scale=voxel / source.voxel_m,  # features of the same size are compared: 1 where the scale is known
        slack=_SCALE_SLACK if scale else 0.0,
        min_length_m=_MIN_LENGTH * voxel,
    )
    sizes, members = np.zeros(len(i), np.int64), np.empty((len(i), _MAX_CLIQUE), np.int64)
    run_ranges(len(i), lambda start, stop: grow_cliques(start, stop, graph, sizes, members))
    cliques = [members[seed, : sizes[seed]] for seed in np.flatnonzero(sizes >= _MIN_CLIQUE)]
    kind = "least_squares" if scale else "none"
    fits = [fit_pairs(a, b, source_rows=clique, target_rows=clique, scale=kind) for clique in cliques]
    motions = np.array([np.concatenate([f.scale * f.rotation, f.translation_m[:, None]], axis=1) for f in fits])
    motions = np.ascontiguousarray(motions.reshape(-1, 3, 4))
    counts = np.empty(len(motions), np.int64)
    run_ranges(len(motions), lambda lo, hi: count_agreeing(lo, hi, motions, a, b, _ROUGHLY * voxel, counts))
    places = source.points[:: -(-len(source.points) // _PLACES)]
    landings = np.einsum("pij,nj->pni", motions[:, :, :3], places) + motions[:, None, :, 3]
    kept: list[int] = []
    for k in np.argsort(-counts, kind="stable"):
        if len(kept) == _KEPT:
            break
        if not kept or np.linalg.norm(landings[kept] - landings[k], axis=2).mean(axis=1).min() > _DIFFERENT * voxel:
            kept.append(int(k))
    return [cliques[k] for k in kept if _rough_conflict(source, target, fits[k], views) <= _MAX_CONFLICT]


def _rough_conflict(source: Scan, target: Scan, fit: PairFit, views: tuple[DepthMap | None, DepthMap | None]) -> float:
    """Share of some points of either scan that stand in the free space of the other."""
    worst = 0.0
    if views[1] is not None:
        some = source.points[:: -(-len(source.points) // _CONFLICT_POINTS)]
        moved = fit.scale * some @ fit.rotation.T + fit.translation_m
        worst = max(worst, conflict(moved, views[1], target.voxel_m))
    if views[0] is not None:
        some = target.points[:: -(-len(target.points) // _CONFLICT_POINTS)]
        moved = (some - fit.translation_m) @ fit.rotation / fit.scale
        worst = max(worst, conflict(moved, views[0], source.voxel_m))
    return worst


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


def refine(
    source: Scan, target: Scan, T: Float64, scale: float, *, free_scale: bool = False, every: int = 1
) -> tuple[Float64, float]:
    """Improve a motion by a few robust point-to-plane steps on the thinned scans, wide gate first.

    With `every` = k only each k-th point of the source is looked at.
    """
    voxel = target.voxel_m
    points, facing, worth = source.points[::every], source.normals[::every], source.weights[::every]
    gate = _WIDEST * voxel
    for _ in range(_STEPS):
        moved = se3.transform_points(T, scale * points)
        distances, partners = target.index.nearest(moved, gate)
        near = np.flatnonzero(np.isfinite(distances))
        normals = target.normals[partners[near]]
        cosine = np.einsum("nd,nd->n", facing[near] @ T[:3, :3].T, normals)
        kept = (cosine if source.oriented else np.abs(cosine)) > _MIN_COSINE
        near, normals = near[kept], normals[kept]
        if len(near) < 12:
            break
        p, q = moved[near], target.points[partners[near]]
        r = np.einsum("nd,nd->n", normals, p - q)
        noise = max(1.4826 * float(np.median(np.abs(r))), 1e-3 * voxel)
        weights = worth[near] / (1 + (r / (_CAUCHY * noise)) ** 2)
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
        reach = np.linalg.norm(xi[:3]) + np.linalg.norm(xi[3:]) * np.linalg.norm(arm, axis=1).mean()
        T, scale = moved_T, scale * ratio
        if reach < _SHORT * voxel:
            if gate <= _TIGHT * voxel:
                break
            gate = max(_NARROWING * gate, _TIGHT * voxel)
    return T, scale
