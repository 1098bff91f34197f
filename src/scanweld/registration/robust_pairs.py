"""Alignment of paired points most of which are paired wrongly.

1. Pairs that keep their distance can be right together: the largest set that all do (a maximum clique) is kept.
2. Graduated non-convexity with the truncated least-squares loss takes out what distances cannot tell.
3. All pairs within the noise bound of that motion are aligned by least squares.
4. The same matches, shuffled, tell how many pairs agree by chance; an answer must have more.

Sources: H. Yang, J. Shi, L. Carlone, "TEASER: Fast and certifiable point cloud registration", T-RO 2021. H. Yang,
P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Float64, Int64, as_points, finite_rows
from scanweld.errors import InvalidInputError
from scanweld.registration.closed_form import align_closed_form, fit_horn
from scanweld.registration.consistency.clique import MAX_NODES, Clique, largest_clique
from scanweld.registration.consistency.graph import consistency_graph
from scanweld.registration.result import RegistrationResult, Status

_GNC_RATE = 1.4  # growth of mu between steps (Yang et al. 2020, section IV)
_GNC_STEPS = 100
_POLISH_STEPS = 20  # rounds of "inliers of the motion, motion of the inliers"; a handful settle it
_MIRRORED = 0.5  # share of a consistent set that its own motion aligns; a mirror image keeps distances, too
_LUCK = 1e-3  # expected number of random cliques of a size, below which the size is no chance
_CHANCE_SAMPLE = 2000  # shuffled matches: enough for the density of their graph, and fast
_SCALE_STEP = 0.08  # of the ladder of scales, relative
_SCALE_REACH = 4.0  # the ladder covers the ratio of the sets' sizes times and over this


@dataclass(frozen=True, slots=True)
class RobustAlignment:
    """An alignment of pairs, and which of them it takes for right.

    Attributes
    ----------
    result : the alignment
    inliers : (N,), pairs within the noise bound of it; none where there is no answer
    consistent : number of pairs in the largest consistent set
    chance : number that matches of this kind would have by chance
    """

    result: RegistrationResult
    inliers: Bool
    consistent: int
    chance: int


def align_pairs_robustly(
    source: npt.ArrayLike,
    target: npt.ArrayLike,
    noise_bound_m: npt.ArrayLike,
    *,
    scale: bool = False,
    seed: int = 0,
    max_nodes: int = MAX_NODES,
) -> RobustAlignment:
    """Align points whose row i is believed to belong to row i of the other set, where up to 99 % may be wrong.

    Parameters
    ----------
    source, target : (N, D) [m], D = 2 or 3. Rows with a value that is not finite are dropped in pairs, and counted.
        Time and memory grow with N^2: a second and 12 MB for 10 000 pairs
    noise_bound_m : how far a right partner may be from its place, about three standard deviations; for all pairs or
        each (N,) [m]
    scale : estimate the scale, too, x_target = scale R x + t; it takes more right pairs and more time
    seed : of the shuffled matches that tell what chance gives
    max_nodes : budget of the search for the largest consistent set; beyond it the best one found is taken

    Returns
    -------
    CONVERGED when more pairs agree with the motion than chance explains, and they hold all of its directions.
    TOO_FEW_CORRESPONDENCES with fewer than D pairs; NO_OVERLAP when no more pairs agree than by chance; DEGENERATE when
    those that agree leave a rotation free, as on a line.

    Raises
    ------
    InvalidInputError
        When shapes do not match, or a noise bound is not positive.
    """
    a, b, bounds, finite = _validated(source, target, noise_bound_m)
    dimension, dropped = a.shape[1], int((~finite).sum())
    note = f"{dropped} pairs were not finite and were dropped" if dropped else ""
    if len(a) < dimension:
        words = f"{len(a)} pairs, {dimension} are needed in {dimension}-D"
        return _nothing(finite, dimension, Status.TOO_FEW_CORRESPONDENCES, words, note)
    clique, ratio = _consistent_set(a, b, bounds, scale, max_nodes)
    chance = size_by_chance(a, b, bounds, scale=ratio, seed=seed, slack=_SCALE_STEP / 2 if scale else 0.0)
    inliers, fit = align_clique(a, b, bounds, clique.vertices, scale=scale)
    # Well beyond chance, or two pairs that agree by luck would be called mirrored.
    if len(clique) > 2 * max(chance, dimension) and inliers[clique.vertices].mean() < _MIRRORED:
        words = (
            f"{len(clique)} pairs keep their distances, but no motion aligns them: are they mirrored, an axis flipped?"
        )
        return _nothing(finite, dimension, Status.DEGENERATE, words, note, len(clique), chance)
    agreeing = min(int(inliers.sum()), len(clique))
    if agreeing <= max(chance, dimension):
        words = (
            f"{agreeing} of {len(a)} pairs agree on a motion, and by chance {chance} would; are these matches of the "
            "same scene, is the noise bound right?"
        )
        return _nothing(finite, dimension, Status.NO_OVERLAP, words, note, len(clique), chance)
    if not clique.proven:
        note = "; ".join(filter(None, [note, "a larger consistent set may exist (max_nodes)"]))
    result = replace(fit, overlap=float(inliers.sum()) / len(finite), note="; ".join(filter(None, [fit.note, note])))
    mask = np.zeros(len(finite), np.bool_)
    mask[finite] = inliers
    return RobustAlignment(result, mask, len(clique), chance)


def align_clique(
    source: Float64, target: Float64, bounds_m: Float64, members: Int64, *, scale: bool = False
) -> tuple[Bool, RegistrationResult]:
    """Align the members of a consistent set robustly, then all pairs (N, D) that agree with that motion.

    Returns
    -------
    The inliers (N,), at most `bounds_m` off, and the least-squares alignment of them.
    """
    kind = "least_squares" if scale else "none"
    a, b, bounds = source[members], target[members], bounds_m[members]
    weights = _graduated(a, b, bounds, kind)
    kept = weights > 0.5
    if kept.sum() < a.shape[1]:
        kept[:] = True
    T, s = _fit(a[kept], b[kept], kind)
    inliers = np.zeros(len(source), np.bool_)
    for _ in range(_POLISH_STEPS):
        before, inliers = inliers, _residuals(source, target, T, s) <= bounds_m
        if (inliers == before).all() or inliers.sum() < source.shape[1]:
            break
        T, s = _fit(source[inliers], target[inliers], kind)
    return inliers, align_closed_form(source[inliers], target[inliers], scale=kind)


def size_by_chance(
    source: Float64, target: Float64, bounds_m: Float64, *, scale: float = 1.0, slack: float = 0.0, seed: int = 0
) -> int:
    """Return how many of N pairs would be consistent if they were paired at random.

    The larger of what the shuffled pairs show, which knows of clusters, and of the size k of which a random graph of
    the same density p is expected to have fewer than 1e-3 cliques, C(N, k) p^(k (k - 1) / 2).
    """
    rng = np.random.default_rng(seed)
    count = len(source)
    chosen = rng.permutation(count)[:_CHANCE_SAMPLE]
    shuffled = np.roll(chosen, 1)  # one long cycle: nobody keeps its partner, no two exchange theirs
    if len(chosen) < 3:
        return 0
    bounds = np.maximum(bounds_m[chosen], bounds_m[shuffled])
    graph = consistency_graph(source[chosen], target[shuffled], bounds, scale=scale, slack=slack)
    edges = int(np.unpackbits(graph.view(np.uint8)).sum())
    found = len(largest_clique(graph, max_nodes=0))
    return max(found, clique_by_chance(count, edges / (len(chosen) * (len(chosen) - 1))))


def clique_by_chance(count: int, density: float) -> int:
    """Return the largest size of which a random graph of `count` vertices has a clique with some probability."""
    if density >= 1:
        return count
    if density <= 0:
        return 1
    for k in range(2, count + 1):
        log_expected = (
            math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1)
            + k * (k - 1) / 2 * math.log(density)
        )  # fmt: skip
        if log_expected < math.log(_LUCK):
            return k - 1
    return count


def _consistent_set(a: Float64, b: Float64, bounds: Float64, scale: bool, max_nodes: int) -> tuple[Clique, float]:
    """Return the largest consistent set, and the scale at which it is."""
    if not scale:
        return largest_clique(consistency_graph(a, b, bounds), max_nodes=max_nodes), 1.0
    best, ratio = Clique(np.zeros(1, np.int64), True), 1.0
    for s in _scale_ladder(a, b):
        graph = consistency_graph(a, b, bounds, scale=s, slack=_SCALE_STEP / 2, min_length_m=2 * float(bounds.max()))
        clique = largest_clique(graph, at_least=len(best) + 1, max_nodes=max_nodes)
        if len(clique) > len(best):
            best, ratio = clique, s
    return best, ratio


def _scale_ladder(a: Float64, b: Float64) -> Float64:
    """Scales to look at, the likely ones first: around the ratio of the sets' median distances from their centres."""
    size_a, size_b = (float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1))) for p in (a, b))
    if size_a <= 0 or size_b <= 0:
        return np.ones(1)
    steps = math.ceil(math.log(_SCALE_REACH) / math.log1p(_SCALE_STEP))
    exponents = np.array(sorted(range(-steps, steps + 1), key=abs))
    return np.asarray(size_b / size_a * (1 + _SCALE_STEP) ** exponents)


def _graduated(a: Float64, b: Float64, bounds: Float64, kind: str) -> Float64:
    """Weights (N,) of graduated non-convexity with the truncated least-squares loss (Yang et al. 2020, eq. 14).

    Residuals are in units of their bounds, so the threshold is 1. mu grows from nearly convex until all weights are 0
    or 1.
    """
    weights = np.ones(len(a))
    T, s = _fit(a, b, kind)
    squared = (_residuals(a, b, T, s) / bounds) ** 2
    mu = 1 / max(2 * float(squared.max()) - 1, 1e-9)
    if squared.max() <= 1:
        return weights
    for _ in range(_GNC_STEPS):
        low, high = mu / (mu + 1), (mu + 1) / mu
        between = np.sqrt(mu * (mu + 1) / np.maximum(squared, 1e-300)) - mu
        weights = np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, between))
        if (weights > 0).sum() < a.shape[1]:
            break
        T, s = _fit(a, b, kind, weights)
        squared = (_residuals(a, b, T, s) / bounds) ** 2
        if np.all((weights == 0) | (weights == 1)):
            break
        mu *= _GNC_RATE
    return weights


def _fit(a: Float64, b: Float64, kind: str, weights: Float64 | None = None) -> tuple[Float64, float]:
    used = slice(None) if weights is None else weights > 0
    fit = fit_horn(a[used], b[used], None if weights is None else weights[used], scale=kind)
    return fit.transform, fit.scale


def _residuals(a: Float64, b: Float64, T: Float64, scale: float) -> Float64:
    d = a.shape[1]
    return np.asarray(np.linalg.norm(scale * a @ T[:d, :d].T + T[:d, d] - b, axis=1))


def _nothing(
    finite: Bool, dimension: int, status: Status, words: str, note: str, consistent: int = 0, chance: int = 0
) -> RobustAlignment:
    size = dimension * (dimension + 1) // 2
    result = RegistrationResult(
        T_target_source=np.eye(dimension + 1),
        status=status,
        information=np.zeros((size, size)),
        note="; ".join(filter(None, [words, note])),
    )
    return RobustAlignment(result, np.zeros(len(finite), np.bool_), consistent, chance)


def _validated(
    source: npt.ArrayLike, target: npt.ArrayLike, noise_bound_m: npt.ArrayLike
) -> tuple[Float64, Float64, Float64, Bool]:
    a = as_points(source, "source")
    b = as_points(target, "target", dimensions=(a.shape[1],))
    if len(a) != len(b):
        raise InvalidInputError(
            f"pairs: row i of the source belongs to row i of the target, got {len(a)} and {len(b)} rows; "
            "use register_global() where the pairs are unknown"
        )
    bounds = np.asarray(noise_bound_m, dtype=np.float64)
    if bounds.ndim > 1 or (bounds.ndim == 1 and bounds.shape != (len(a),)):
        raise InvalidInputError(f"noise_bound_m: expected a number or shape ({len(a)},), got {bounds.shape}")
    if not (np.isfinite(bounds).all() and (bounds > 0).all()):
        raise InvalidInputError("noise_bound_m: expected positive finite distances [m]")
    finite = finite_rows(a, b)
    bounds = np.broadcast_to(bounds, (len(a),))
    return a[finite], b[finite], np.ascontiguousarray(bounds[finite]), finite
