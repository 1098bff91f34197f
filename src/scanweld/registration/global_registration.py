"""Registration with no initial guess.

1. Both clouds are thinned to voxels that suit their size and spacing. Where the spread of their points tells from where
   they were seen, their normals are turned to face it.
2. Points that look alike (FPFH) are matched, and sets of matches that keep their distances and angles propose motions:
   several, because rooms and furniture repeat themselves.
   Surfaces are placed without features, too: turns that bring the main directions of both together, each with the
   shifts at which most surface meets and none stands where the other scan looked through.
3. Each motion is refined on the thinned surfaces and judged: how many matches agree for the surface that is shared, how
   closely the surfaces meet, and whether one scan stands where the other looked through.
4. The best is refined by generalised ICP. It is CONVERGED only when all of that says so and no other motion is as
   good.

Sources: R. B. Rusu, N. Blodow, M. Beetz, "Fast point feature histograms (FPFH) for 3D registration", ICRA 2009.
H. Yang, J. Shi, L. Carlone, "TEASER: Fast and certifiable point cloud registration", T-RO 2021. The search over several
consistent sets follows the idea of X. Zhang et al., "3D registration with maximal cliques", CVPR 2023.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scanweld.arrays import Float64, finite_rows, refuse_giants
from scanweld.config import check_ranges, setting
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.point_cloud import PointCloud, voxel_downsample
from scanweld.parallel import limited_threads
from scanweld.registration.global_search.agreement import DepthMap, SurfaceAgreement, assess, depth_map
from scanweld.registration.global_search.hypotheses import Hypothesis, distance, propose
from scanweld.registration.global_search.scan import Scan, choose_voxel, find_viewpoint, prepare_scan
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.result import RegistrationResult, Status

logger = logging.getLogger(__name__)

_MIN_POINTS = 100  # a cloud with fewer has no features to speak of
_MIN_THINNED = 30  # points of a thinned cloud
_STAGES = ((2.0, 0.5), (1.0, 0.5))  # gate and fineness of the final refinement, voxels
_KEPT = 0.7  # share of the evidence that must be left after the refinement
_ASTRAY = 3.0  # voxels that the refinement may move the source, on average
_MEETING = 300.0  # points of mean weight that meet are worth one feature
_BLIND = 3.0  # times as much evidence is needed where free space says nothing
_RIVAL = 0.6  # share of the best evidence that makes another motion as good
_DIFFERENT = 5.0  # voxels between two motions, on average, that make them two


@dataclass(frozen=True, slots=True, kw_only=True)
class GlobalConfig:
    """Settings of :func:`register_global`."""

    voxel_m: float = setting(
        0.0,
        "side of the voxels to which both clouds are thinned [m]; 0 takes a thirtieth of the larger cloud's median "
        "distance from its centre, or 1.5 times the points' spacing if that is more. Raising it is faster and coarser",
        low=0.0,
    )
    hypotheses: int = setting(
        16, "different motions that are proposed and judged; raising it solves more ambiguous scenes", low=1
    )
    viewpoints: str = setting(
        "auto",
        "auto finds out from where each cloud was seen, and uses the free space in between; none does without, as for "
        "clouds that were merged from several scans",
    )
    min_evidence: float = setting(
        3.0,
        "number of points where surfaces meet and features match, times their share of all points where surfaces meet, "
        "and a 300th of the points that meet; three times as much where a viewpoint is unknown. Raising it trusts "
        "fewer answers",
        low=0.0,
    )
    min_contact: float = setting(
        0.3, "share of the points near the other scan that must lie on its surface", low=0.0, high=1.0
    )
    max_conflict: float = setting(
        0.03, "share of the points that may stand in the other scan's free space", low=0.0, high=1.0
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.viewpoints not in ("auto", "none"):
            raise ConfigError(f"viewpoints = {self.viewpoints!r}: expected auto or none")


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A motion between the centred clouds, and what speaks for it."""

    motion: Hypothesis
    agreement: SurfaceAgreement

    @property
    def evidence(self) -> float:
        """How many features agree, and how much surface meets; the worse of both directions counts.

        Of features, the number of points that touch where their most similar one is, times their share of all that
        touch: walls alone touch in many ways, but hardly ever at the most similar points. Of surfaces, the weight of
        what touches, times its share of what is near. What stands in free space weighs heavily: true motions have
        next to none of it.
        """
        pairs = zip(self.motion.support, self.agreement.touching, strict=True)
        features = min(count * count / max(touching, count, 1) for count, touching in pairs)
        surfaces = self.agreement.meeting * self.agreement.contact / _MEETING
        return float(features + surfaces) * self.agreement.belief


def register_global(
    source: Any,
    target: Any,
    *,
    scale: bool = False,
    config: GlobalConfig | None = None,
    num_threads: int | None = None,
) -> RegistrationResult:
    """Align `source` to `target`, wherever both may be; they must share about a quarter of their surface.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) [m], a :class:`~scanweld.PointCloud`, or a cloud of another library. As measured:
        neither thinned nor merged scans tell more (see `viewpoints` of the settings). Rows that are not finite are
        dropped, and counted
    scale : estimate the scale, too, x_target = scale R x + t; the clouds must then share most of their surface
    config : see :class:`GlobalConfig`
    num_threads : all cores when None; the result does not depend on it

    Returns
    -------
    CONVERGED when the surfaces agree at the motion and at no other. DEGENERATE when another motion fits about as well,
    as for symmetric things (the note says how far apart they are), or when a direction is free. NO_OVERLAP when no
    motion is better than what unrelated scans give; the transform is then the best guess, not to be used.
    TOO_FEW_CORRESPONDENCES with hardly any points.

    Raises
    ------
    InvalidInputError
        When the clouds are not three-dimensional.
    """
    settings = config or GlobalConfig()
    with limited_threads(num_threads):
        return _register(source, target, scale, settings)


def _register(source: Any, target: Any, scale: bool, config: GlobalConfig) -> RegistrationResult:
    (a, bad_a), (b, bad_b) = _finite(source, "source"), _finite(target, "target")
    dropped = f"{bad_a + bad_b} points were not finite and were dropped" if bad_a + bad_b else ""
    if min(len(a), len(b)) < _MIN_POINTS:
        words = f"{len(a)} source and {len(b)} target points; {_MIN_POINTS} of each are needed"
        return _nothing(Status.TOO_FEW_CORRESPONDENCES, words, dropped)
    # Coordinates of 1e6 lose nothing when the search is done about the clouds' own centres.
    center_a, center_b = a[0] + (a - a[0]).mean(axis=0), b[0] + (b - b[0]).mean(axis=0)
    local_a, local_b = a - center_a, b - center_b
    voxel_a, voxel_b = _voxels(local_a, local_b, scale, config)
    if not (voxel_a > 0 and voxel_b > 0):
        return _nothing(Status.DEGENERATE, "the points of a cloud are in one place", dropped)
    thinned = [len(voxel_downsample(PointCloud(p), v)) for p, v in ((local_a, voxel_a), (local_b, voxel_b))]
    if min(thinned) < _MIN_THINNED:
        words = f"{min(thinned)} points are left of a cloud in voxels of {voxel_b:.3g} m, {_MIN_THINNED} are needed; "
        return _nothing(Status.DEGENERATE, words + "is one cloud far smaller than the other, or in one place?", dropped)
    scans, views = _scans(local_a, local_b, voxel_a, voxel_b, config)
    candidates, num_matches = _candidates(*scans, views, scale, config)
    if not candidates:
        words = f"none of the motions that {num_matches} feature matches propose can be; are these scans of one scene?"
        return _nothing(Status.NO_OVERLAP, words, dropped)
    status, reason = _verdict(candidates, scans, config)
    best = candidates[0]
    result = _refined(a, b, _between(best.motion, center_a, center_b), voxel_b, scale)
    if status is Status.CONVERGED:
        end = replace(best.motion, T=result.T_target_source, scale=result.scale)
        end = _between(end, -center_a, -center_b)
        kept = _Candidate(end, assess(*scans, end.T, end.scale, *views)).evidence
        if result.status is Status.DEGENERATE and best.motion.spread_m < voxel_b:
            result = _held_by_matches(result, best.motion)
        elif result.status is Status.NO_OVERLAP:  # the evidence of both scans' free space is the better one
            result = replace(result, status=Status.CONVERGED, note="")
        status = result.status
        if distance(best.motion, end, scans[0].points) > _ASTRAY * voxel_b or kept < _KEPT * best.evidence:
            status, reason = Status.NO_OVERLAP, "the refinement went astray: the surfaces do not hold the motion"
    note = "; ".join(filter(None, [reason, result.note, dropped]))
    return replace(result, status=status, covariance=result.covariance if status.has_pose else None, note=note)


def _between(motion: Hypothesis, center_a: Float64, center_b: Float64) -> Hypothesis:
    """Return the same motion between clouds whose origins are at -center_a and -center_b in its own."""
    T = motion.T.copy()
    T[:3, 3] += center_b - motion.scale * T[:3, :3] @ center_a
    return replace(motion, T=T)


def _finite(cloud: Any, name: str) -> tuple[Float64, int]:
    """Return the finite points of a cloud, and the number of others."""
    points = as_cloud(cloud, name).points_m
    refuse_giants(points, name)
    if points.shape[1] != 3:
        raise InvalidInputError(
            f"{name}: register_global needs points in 3-D, got {points.shape}; use icp() in 2-D, from several T_init"
        )
    finite = finite_rows(points)
    return points[finite], int((~finite).sum())


def _voxels(a: Float64, b: Float64, scale: bool, config: GlobalConfig) -> tuple[float, float]:
    """Return the voxels of both clouds: one for both, or in proportion to their sizes when the scale is unknown."""
    if not scale:
        voxel = config.voxel_m or max(choose_voxel(a), choose_voxel(b))
        return voxel, voxel
    size_a, size_b = (float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1))) for p in (a, b))
    if size_a <= 0 or size_b <= 0:
        return 0.0, 0.0
    voxel_b = config.voxel_m or max(choose_voxel(b), choose_voxel(a) * size_b / size_a)
    return voxel_b * size_a / size_b, voxel_b


def _scans(
    a: Float64, b: Float64, voxel_a: float, voxel_b: float, config: GlobalConfig
) -> tuple[tuple[Scan, Scan], tuple[DepthMap | None, DepthMap | None]]:
    """Thin both clouds and describe their points; draw what each sees from its viewpoint, where that is known."""
    at_a, at_b = (find_viewpoint(p) if config.viewpoints == "auto" else None for p in (a, b))
    views = tuple(None if at is None else depth_map(p, at) for p, at in ((a, at_a), (b, at_b)))
    both = at_a is not None and at_b is not None  # normals of one scan alone have nothing to be compared with
    scans = prepare_scan(a, voxel_a, at_a if both else None), prepare_scan(b, voxel_b, at_b if both else None)
    return scans, (views[0], views[1])


def _candidates(
    source: Scan,
    target: Scan,
    views: tuple[DepthMap | None, DepthMap | None],
    scale: bool,
    config: GlobalConfig,
) -> tuple[list[_Candidate], int]:
    """Return the motions that surfaces and free space allow, the best first, and the number of matches."""
    motions, num_matches = propose(
        source, target, config.hypotheses, scale=scale, source_view=views[0], target_view=views[1]
    )
    candidates = []
    for motion in motions:
        agreement = assess(source, target, motion.T, motion.scale, *views)
        candidate = _Candidate(motion, agreement)
        logger.debug("evidence %.2f, support %s, %s", candidate.evidence, motion.support, agreement)
        if agreement.contact >= config.min_contact and agreement.conflict <= config.max_conflict:
            candidates.append(candidate)
    return sorted(candidates, key=lambda candidate: -candidate.evidence), num_matches


def _verdict(candidates: list[_Candidate], scans: tuple[Scan, Scan], config: GlobalConfig) -> tuple[Status, str]:
    """Say what the best candidate is worth, and why."""
    source, target = scans
    best = candidates[0]
    needed = config.min_evidence * (1 if source.oriented else _BLIND)
    if best.evidence < needed:
        return Status.NO_OVERLAP, (
            f"the best motion brings surfaces together, but few of their features agree: {min(best.motion.support)} of "
            f"{min(best.agreement.touching)}, evidence {best.evidence:.2g}; unrelated scans may reach {needed:.2g}"
        )
    for other in candidates[1:]:
        apart = distance(best.motion, other.motion, source.points)
        if other.evidence > _RIVAL * best.evidence and apart > _DIFFERENT * target.voxel_m:
            turn = np.degrees(se3.rotation_angle_rad(best.motion.T[:3, :3].T @ other.motion.T[:3, :3]))
            return Status.DEGENERATE, (
                f"another motion fits about as well: {apart:.3g} m and {turn:.0f} degrees away, evidence "
                f"{other.evidence:.2g} against {best.evidence:.2g}; is the scene symmetric, or does it repeat itself?"
            )
    return Status.CONVERGED, ""


def _refined(a: Float64, b: Float64, motion: Hypothesis, voxel_m: float, scale: bool) -> RegistrationResult:
    """Refine on the clouds themselves by generalised ICP, coarse to fine."""
    T, s = motion.T, motion.scale
    for gate, fineness in _STAGES:
        settings = IcpConfig(
            method="gicp",
            max_correspondence_distance_m=gate * voxel_m,
            voxel_m=fineness * voxel_m,
            scale="least_squares" if scale else "none",
            min_overlap=0.0,
            attempts=0,
        )
        # The scale so far goes into the source: ICP starts at 1.
        result = icp(s * a, b, T_init=T, config=settings)
        T, s = result.T_target_source, s * result.scale
    return replace(result, T_target_source=T, scale=s)


def _held_by_matches(result: RegistrationResult, motion: Hypothesis) -> RegistrationResult:
    """Keep an answer whose surfaces leave a direction free, when the feature matches hold it.

    ICP left that direction where the matches had put it. How well it is known there is no matter of the surfaces'
    residuals, so no covariance is claimed.
    """
    free = ", ".join(direction.words for direction in result.unobservable)
    note = f"the surfaces alone leave free: {free}; the feature matches hold it to {motion.spread_m:.2g} m"
    return replace(result, status=Status.CONVERGED, unobservable=(), covariance=None, note=note)


def _nothing(status: Status, words: str, dropped: str) -> RegistrationResult:
    return RegistrationResult(
        T_target_source=np.eye(4),
        status=status,
        information=np.zeros((6, 6)),
        note="; ".join(filter(None, [words, dropped])),
    )
