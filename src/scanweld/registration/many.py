"""Many scans at once: align pairs, find out which alignments agree, and solve for all poses together.

1. Candidates: all pairs, or for many scans those that are near in the given order; where guesses are given, those that
   should overlap.
2. Each pair is aligned by itself. What the aligner does not call CONVERGED is no evidence.
3. Triangles of alignments that close vote for their members; the spanning tree of the best alignments gives a start.
4. A robust pose graph keeps what agrees (:mod:`~.pose_graph`). Where as many alignments speak against a link as for it,
   nobody can tell which are wrong: all are dropped, and the scans stay apart.
5. Pairs that were not tried, and should overlap by what is known now, are aligned as well, and the graph is solved
   again. Without guesses from outside the aligner is not told where the graph has them: starting from an answer, it
   would only confirm it.

Scans that do not connect are reported as components of their own, never placed at a guess.

Source: S. Choi, Q.-Y. Zhou, V. Koltun, "Robust reconstruction of indoor scenes", 2015, for the pairwise part; the pose
graph's sources are named there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scanweld.arrays import Float64, Int64, as_transforms
from scanweld.config import check_ranges, setting
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.parallel import limited_threads
from scanweld.registration.pair_tasks import (
    LEAST_POINTS,
    Aligner,
    Distributed,
    InProcess,
    PairAligner,
    PairTasks,
    Scan,
    ScanFacts,
    align_by_default,
)
from scanweld.registration.pose_graph import PoseGraphConfig, edge_information
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.scan_graph import (
    Alignments,
    bridges,
    component_labels,
    misfits,
    solve,
    tree_poses,
    triangle_votes,
    trustworthy,
)

__all__ = ["ManyConfig", "ManyResult", "ScanPair", "register_many"]

_log = logging.getLogger(__name__)

_DOF = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class ManyConfig:
    """Settings of :func:`register_many`."""

    all_pairs_up_to: int = setting(
        30, "number of scans up to which every pair is tried; raising it costs time with its square", low=2
    )
    window: int = setting(
        4, "of more scans without guesses, those at most so far apart in the given order are tried", low=1
    )
    min_predicted_overlap: float = setting(
        0.25,
        "share of a scan that a pose must put on another one for the pair to be tried because of that pose; raising it "
        "tries fewer pairs",
        low=0.0,
        high=1.0,
    )
    rounds: int = setting(
        1, "times that pairs which were not tried are added where the solved poses say that scans overlap", low=0
    )
    noise_share: float = setting(
        0.5,
        "no alignment is believed to be better than this share of its rmse: the errors of neighbouring points are "
        "alike, and the covariance does not know. Raising it keeps pairs that agree less well",
        low=0.0,
    )
    max_chi2_per_dof: float = setting(
        4.0, "alignments that disagree with the others by more are dropped (see PoseGraphConfig)", low=0.0
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class ScanPair:
    """One pair that was tried.

    Attributes
    ----------
    target, source : numbers of the scans, target < source
    result : of the alignment, T_target_source
    used : whether the poses rest on it
    verified : whether it is used and lies on a cycle of used pairs, so that others confirm it
    chi2 : squared Mahalanobis distance from what the poses say; 0 where they say nothing, the scans being apart
    triangles, triangles_closed : closed triangles of alignments that it is part of, and how many of them agree
    """

    target: int
    source: int
    result: RegistrationResult
    used: bool
    verified: bool
    chi2: float
    triangles: int
    triangles_closed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ManyResult:
    """Poses of many scans and what they are worth.

    Attributes
    ----------
    T_world_scan : (N, 4, 4); the world of each component is its first scan, which has the identity
    status : CONVERGED where all scans are connected and held; NO_OVERLAP where some do not connect; DEGENERATE where
        some are connected but free in some direction
    scan_status : of each scan: CONVERGED where it is connected to others, else NO_OVERLAP, TOO_FEW_CORRESPONDENCES
        (hardly any points) or DEGENERATE
    components : scans that are connected, in the order of their first; poses of different components do not compare
    covariance : (N, 6, 6) of T_world_scan, left perturbation at the world's origin; zero for the first of a component
    rmse_m : root mean square of the used pairs' rmse_m, weighted by their inliers [m]
    pairs : every pair that was tried
    note : one sentence for a person; "" where nothing is amiss
    """

    T_world_scan: Float64
    status: Status
    scan_status: tuple[Status, ...]
    components: tuple[tuple[int, ...], ...]
    covariance: Float64
    rmse_m: float
    pairs: tuple[ScanPair, ...]
    note: str = ""


def register_many(
    clouds: Sequence[Scan],
    *,
    T_init: npt.ArrayLike | None = None,
    config: ManyConfig | None = None,
    align: PairAligner | None = None,
    prepare: Callable[[PointCloud], Any] | None = None,
    num_threads: int | None = None,
    executor: Executor | None = None,
) -> ManyResult:
    """Find the poses of scans that overlap in part, whichever do.

    Parameters
    ----------
    clouds : N scans, each (M, 3) points [m], a cloud, a file, or a function that returns one of these; rows that are
        not finite are left out
    T_init : (N, 4, 4) guesses of T_world_scan; None where nothing is known
    config : see :class:`ManyConfig`
    align : what aligns a pair; :func:`~scanweld.registration.global_registration.register_global`, and GICP where
        there is a guess, when None
    prepare : what is done once with each scan before; `align` gets what it returns
    num_threads : all cores when None; the result does not depend on it
    executor : where pairs are aligned, each in a task of its own that is handed the two scans as they were given: with
        files or functions no process has all scans in memory, this one none at all. `align` and `prepare` must then be
        what `pickle` can send. In this process when None; the result does not depend on it

    Raises
    ------
    InvalidInputError
        When there are fewer than two scans, one is not 3-D, or `T_init` does not fit.
    FileFormatError
        When a file cannot be read.
    """
    if len(clouds) < 2:
        raise InvalidInputError(f"clouds: expected at least two scans, got {len(clouds)}")
    guesses = None if T_init is None else _as_guesses(T_init, len(clouds))
    aligner = Aligner(align, prepare) if align is not None else Aligner(align_by_default)
    with limited_threads(num_threads):
        tasks: PairTasks = (
            InProcess(clouds, aligner) if executor is None else Distributed(clouds, aligner, executor, num_threads)
        )
        work = _Work(tasks, config or ManyConfig())
        work.try_pairs(_candidates(work, guesses), guesses)
        state = work.solve()
        for _ in range(work.config.rounds):
            more = [pair for pair in work.overlapping(state.poses, state.labels) if pair not in work.results]
            if not more:
                break
            work.try_pairs(more, None if guesses is None else state.poses)
            state = work.solve()
    return _result(work, state)


def _as_guesses(T_init: npt.ArrayLike, count: int) -> Float64:
    guesses = np.asarray(T_init, dtype=np.float64)
    if guesses.shape != (count, 4, 4):
        raise InvalidInputError(f"T_init: expected shape ({count}, 4, 4), got {guesses.shape}")
    return as_transforms(guesses, "T_init")


@dataclass(frozen=True, slots=True)
class _State:
    """What the alignments say.

    Attributes
    ----------
    poses : (N, 4, 4)
    covariance : (N, 6, 6)
    free : (N,) whether a scan is free in some direction
    labels : (N,) components
    pairs : targets and sources of the alignments below
    used, verified, chi2, triangles, closed : (E,)
    """

    poses: Float64
    covariance: Float64
    free: npt.NDArray[np.bool_]
    labels: Int64
    pairs: list[tuple[int, int]]
    used: npt.NDArray[np.bool_]
    verified: npt.NDArray[np.bool_]
    chi2: Float64
    triangles: Int64
    closed: Int64


class _Work:
    """What is known of the scans, and the alignments so far."""

    def __init__(self, tasks: PairTasks, config: ManyConfig) -> None:
        self.tasks, self.config = tasks, config
        self.scans = tasks.describe()
        self.enough = [scan.num_points >= LEAST_POINTS for scan in self.scans]
        self.results: dict[tuple[int, int], RegistrationResult] = {}
        self._trees: dict[int, cKDTree] = {}

    def try_pairs(self, pairs: list[tuple[int, int]], poses: Float64 | None) -> None:
        """Align pairs (target, source), from where `poses` put them if given."""
        guesses = [None if poses is None else se3.inverse(poses[i]) @ poses[j] for i, j in pairs]
        for (i, j), result in zip(pairs, self.tasks.align(pairs, guesses), strict=True):
            _log.debug("scans %d and %d: %s, overlap %.2f", i, j, result.status.value, result.overlap)
            self.results[i, j] = result

    def overlapping(self, poses: Float64, labels: Int64) -> list[tuple[int, int]]:
        """Return the pairs of a component of which one scan should lie on the other."""
        pairs = [(i, j) for i, j in self._all_pairs() if labels[i] == labels[j]]
        return [pair for pair in pairs if self._overlap(*pair, poses) >= self.config.min_predicted_overlap]

    def _all_pairs(self) -> list[tuple[int, int]]:
        return list(combinations(np.flatnonzero(self.enough).tolist(), 2))

    def _overlap(self, i: int, j: int, poses: Float64) -> float:
        """Share of the points of i that are near one of j, or the other way round if that is more."""
        a, b = self.scans[i], self.scans[j]
        gate, T = max(a.gate_m, b.gate_m), se3.inverse(poses[i]) @ poses[j]
        if np.linalg.norm(se3.transform_points(T, b.centroid_m) - a.centroid_m) > a.reach_m + b.reach_m + gate:
            return 0.0
        shares = [
            np.isfinite(self._tree(k).query(se3.transform_points(motion, points), distance_upper_bound=gate)[0]).mean()
            for k, motion, points in ((i, T, b.sample_m), (j, se3.inverse(T), a.sample_m))
        ]
        return float(max(shares))

    def _tree(self, k: int) -> cKDTree:
        if k not in self._trees:
            self._trees[k] = cKDTree(self.scans[k].sample_m)
        return self._trees[k]

    def solve(self) -> _State:
        """Find out which alignments agree, and the poses that they give."""
        count = len(self.scans)
        pairs = [pair for pair in sorted(self.results) if self.results[pair].status.success]
        alignments = self._alignments(pairs)
        triangles, closed = triangle_votes(alignments, self.config.max_chi2_per_dof * _DOF)
        start = tree_poses(alignments, closed, count)
        settings = PoseGraphConfig(max_chi2_per_dof=self.config.max_chi2_per_dof, start="given")
        _, used, _, _ = solve(alignments, start, settings, robust=True)
        used = trustworthy(alignments.ends, used, count)
        kept = alignments.select(used)
        poses, _, covariance, free = solve(kept, tree_poses(kept, closed[used], count), settings, robust=False)
        verified = used.copy()
        verified[np.flatnonzero(used)[list(bridges(kept.ends, count))]] = False
        labels = component_labels(kept.ends, count)
        together = labels[alignments.ends[:, 0]] == labels[alignments.ends[:, 1]]
        chi2 = np.where(together, misfits(alignments, poses), 0.0)
        return _State(poses, covariance, free, labels, pairs, used, verified, chi2, triangles, closed)

    def _alignments(self, pairs: list[tuple[int, int]]) -> Alignments:
        results = [self.results[pair] for pair in pairs]
        return Alignments(
            np.array(pairs, dtype=np.int64).reshape(-1, 2),
            np.array([result.T_target_source for result in results]).reshape(-1, 4, 4),
            np.array(
                [self._information(result, self.scans[i]) for result, (i, _) in zip(results, pairs, strict=True)]
            ).reshape(-1, 6, 6),
            np.array([result.overlap * np.sqrt(result.num_inliers) for result in results]),
        )

    def _information(self, result: RegistrationResult, target: ScanFacts) -> Float64:
        """Information of an edge, whose standard deviations are no smaller than the noise allows.

        The floor is a shift of `noise_share` rmse at the target's centroid, and a turn about it that moves the points
        as much.
        """
        radius = target.radius_m
        floor = max(self.config.noise_share * result.rmse_m, 1e-4 * radius)
        place = np.eye(4)
        place[:3, 3] = target.centroid_m
        at_centroid = se3.adjoint(place)
        information = edge_information(result, min_sigma_m=floor)
        turned = at_centroid.T @ information @ at_centroid  # twists about the centroid are Ad times those at the origin
        scale = np.array([1.0] * 3 + [1 / radius] * 3)
        values, vectors = np.linalg.eigh(turned * np.outer(scale, scale))
        variances = 1 / np.maximum(values, 1e-12) + floor**2
        inverse = (vectors / variances) @ vectors.T / np.outer(scale, scale)
        back = se3.adjoint(se3.inverse(place))
        return np.asarray(back.T @ inverse @ back)


def _candidates(work: _Work, guesses: Float64 | None) -> list[tuple[int, int]]:
    """Return the pairs to try first, (target, source) with target < source."""
    if guesses is not None:
        return work.overlapping(guesses, np.zeros(len(guesses), dtype=np.int64))
    pairs = work._all_pairs()
    if len(work.scans) <= work.config.all_pairs_up_to:
        return pairs
    return [(i, j) for i, j in pairs if j - i <= work.config.window]


def _result(work: _Work, state: _State) -> ManyResult:
    components = tuple(tuple(np.flatnonzero(state.labels == label).tolist()) for label in range(state.labels.max() + 1))
    alone = {component[0] for component in components if len(component) == 1}
    statuses = []
    for k, enough in enumerate(work.enough):
        if not enough:
            statuses.append(Status.TOO_FEW_CORRESPONDENCES)
        elif k in alone:
            statuses.append(Status.NO_OVERLAP)
        else:
            statuses.append(Status.DEGENERATE if state.free[k] else Status.CONVERGED)
    pairs = _pairs(work, state)
    used = [pair.result for pair in pairs if pair.used]
    inliers = np.array([max(result.num_inliers, 1) for result in used], dtype=np.float64)
    squares = np.array([result.rmse_m**2 for result in used])
    status, note = _judge(components, statuses, pairs)
    return ManyResult(
        T_world_scan=state.poses,
        status=status,
        scan_status=tuple(statuses),
        components=components,
        covariance=state.covariance,
        rmse_m=float(np.sqrt(inliers @ squares / inliers.sum())) if used else 0.0,
        pairs=tuple(pairs),
        note=note,
    )


def _pairs(work: _Work, state: _State) -> list[ScanPair]:
    """Return every pair that was tried; those without an alignment are in no triangle and in no graph."""
    row = {pair: k for k, pair in enumerate(state.pairs)}
    pairs = []
    for i, j in sorted(work.results):
        k = row.get((i, j), -1)
        aligned = k >= 0
        pairs.append(
            ScanPair(
                target=i,
                source=j,
                result=work.results[i, j],
                used=aligned and bool(state.used[k]),
                verified=aligned and bool(state.verified[k]),
                chi2=float(state.chi2[k]) if aligned else 0.0,
                triangles=int(state.triangles[k]) if aligned else 0,
                triangles_closed=int(state.closed[k]) if aligned else 0,
            )
        )
    return pairs


def _judge(
    components: tuple[tuple[int, ...], ...], statuses: list[Status], pairs: list[ScanPair]
) -> tuple[Status, str]:
    notes = []
    status = Status.CONVERGED
    if Status.DEGENERATE in statuses:
        status = Status.DEGENERATE
    if len(components) > 1:
        status = Status.NO_OVERLAP
        alone = [component[0] for component in components if len(component) == 1]
        groups = [component for component in components if len(component) > 1]
        if alone:
            notes.append(f"scans {', '.join(map(str, alone))} connect to no other")
        if len(groups) > 1:
            notes.append(f"{len(groups)} groups do not connect: {', '.join(map(str, groups))}")
    dropped = [(pair.target, pair.source) for pair in pairs if pair.result.status.success and not pair.used]
    if dropped:
        notes.append(f"pairs dropped because others contradict them: {', '.join(map(str, dropped))}")
    single = [(pair.target, pair.source) for pair in pairs if pair.used and not pair.verified]
    if single and len(statuses) > 2:
        notes.append(f"pairs that no other confirms: {', '.join(map(str, single))}")
    return status, "; ".join(notes)
