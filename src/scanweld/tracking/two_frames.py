"""Alignment of two frames without a map and without a guess of the motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float32, Float64, as_transform
from scanweld.config import check_ranges, section, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.registration.gauss_newton import spectrum, standard_deviation
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.projective import ProjectiveConfig, align_projective, schedules
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.verification import check_against_depth
from scanweld.tracking.appearance import compare_appearance
from scanweld.tracking.image_features import FeatureAlignment, ImageFeatureConfig, align_features, detect

_MIN_POINTS = 200  # with fewer there is nothing to propose from
_ROUGHLY = 0.05  # of the spacing: what is found is only a start
_ATTEMPTS = 8  # starts around the given one from which nearest neighbours are tried
_MIN_KEPT = 0.5  # share of the features' pairs that a dense answer must still explain


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoFrameConfig:
    """How two frames are aligned."""

    surfaces: SurfaceConfig = section(SurfaceConfig, "how depth becomes surfaces")
    projective: ProjectiveConfig = section(
        lambda: ProjectiveConfig(iterations=40, min_cosine=0.8, min_overlap=0.3),
        "schedule and gates of the alignment",
    )
    features: ImageFeatureConfig = section(ImageFeatureConfig, "what is matched between far-apart views")
    max_neighbour_points: int = setting(
        3000, "points of each frame in the last resort, nearest neighbours; raise for detail, costs time", low=200
    )
    neighbour_gate_m: float = setting(
        0.3, "largest distance of nearest neighbours [m]; raise for far-apart views, lower for clutter", low=1e-3
    )
    max_feature_std_m: float = setting(
        0.005, "directions that depth leaves free are taken from features that know the motion this well [m]", low=0.0
    )
    min_correlation: float = setting(
        0.5, "correlation of the texture on common surfaces in a trusted answer; lower for gloss", low=0.0, high=1.0
    )
    min_overlap_alike: float = setting(
        0.1, "share of matched points that is enough where the texture agrees, too", low=0.0, high=1.0
    )

    def __post_init__(self) -> None:
        check_ranges(self)


def align_frames(
    a: Frame, b: Frame, *, T_init: npt.ArrayLike | None = None, config: TwoFrameConfig | None = None
) -> RegistrationResult:
    """Find the motion between two frames: T_target_source = T_b_a maps points of camera a to camera b.

    Starts for a dense alignment (projective point-to-plane) are tried, cheapest first: `T_init` (4, 4), the identity
    by default; the motion that image features with depth agree on; `T_init` with wider gates; what ICP on nearest
    neighbours makes of `T_init`. The first answer that the depth of both views and the texture on their common surfaces
    agree with is returned. When there is none, the result is the best of those from `T_init`, with a status that says
    so. Directions that depth leaves free are taken from image features where these hold them; else they stay at
    `T_init`, and the status is DEGENERATE.

    Raises
    ------
    InvalidInputError
        When `T_init` is not a rigid transform.
    """
    config = config or TwoFrameConfig()
    start = np.eye(4) if T_init is None else as_transform(T_init, "T_init")
    source, target = build_pyramid(a, config.surfaces), build_pyramid(b, config.surfaces)
    best: RegistrationResult | None = None
    for proposal in _proposals(source, target, start, config):
        result = align_proposal(source, target, proposal, config)
        if result.status is Status.CONVERGED:
            return result
        # Only from the caller's start: directions that the data leaves free must stay where that put them.
        if proposal.is_given and (
            best is None or (result.status.rank, result.overlap) > (best.status.rank, best.overlap)
        ):
            best = result
    assert best is not None  # the first proposal is the caller's
    return best


@dataclass(frozen=True, slots=True)
class Proposal:
    """Where a dense alignment starts.

    Attributes
    ----------
    T_target_source : (4, 4), the start
    projective : schedule, and limits of a trusted answer
    features : those that proposed it; None where something else did
    is_given : whether it is the caller's own start
    """

    T_target_source: Float64
    projective: ProjectiveConfig
    features: FeatureAlignment | None = None
    is_given: bool = False


def _proposals(
    source: SurfacePyramid, target: SurfacePyramid, start: Float64, config: TwoFrameConfig
) -> Iterator[Proposal]:
    """Yield what is worth trying, cheapest first; nothing is computed before it is asked for."""
    first, *wider = schedules(config.projective)
    yield Proposal(start, first, is_given=True)
    a, b = (_thinned(pyramid, config.max_neighbour_points) for pyramid in (source, target))
    if min(len(a), len(b)) < _MIN_POINTS:
        return
    # Far from the start nothing speaks for an answer but the check, which is as strict there as after a wide search.
    strict = (
        replace(first, min_agreement=wider[0].min_agreement, max_conflict=wider[0].max_conflict) if wider else first
    )
    features = align_features(detect(source, config.features), detect(target, config.features), config.features)
    if features.result.status.success:
        yield Proposal(features.result.T_target_source, strict, features)
    for schedule in wider:
        yield Proposal(start, schedule, is_given=True)
    nearest = icp(
        a[:, :3],
        b[:, :3],
        target_normals=b[:, 3:],
        T_init=start,
        config=IcpConfig(max_correspondence_distance_m=config.neighbour_gate_m, tolerance=_ROUGHLY, attempts=_ATTEMPTS),
    )
    if nearest.status.success:
        yield Proposal(nearest.T_target_source, strict)


def _thinned(pyramid: SurfacePyramid, count: int) -> Float64:
    """Return about `count` points and normals (N, 6) float64 of a frame, evenly over the image."""
    surface = pyramid.levels[0].surface
    stride = max(1, round(float(np.sqrt(np.count_nonzero(surface[..., 6]) / count))))
    rows = surface[::stride, ::stride].reshape(-1, 8)
    return rows[rows[:, 6] > 0, :6].astype(np.float64)


def align_proposal(
    source: SurfacePyramid, target: SurfacePyramid, proposal: Proposal, config: TwoFrameConfig
) -> RegistrationResult:
    """Align densely from a proposal, and look at the answer from all sides: the depth of both views, the texture on the
    common surfaces, and the features that proposed it.
    """
    positions, normals = surface_points(source)
    tolerant = replace(proposal.projective, min_overlap=min(config.min_overlap_alike, proposal.projective.min_overlap))
    result = align_projective(positions, normals, target.levels, proposal.T_target_source, tolerant)
    if not result.status.has_pose:
        return result
    T = result.T_target_source
    appearance = compare_appearance(source, target, T)
    alike = appearance.telling and appearance.correlation >= config.min_correlation
    backwards = check_against_depth(*surface_points(target), se3.inverse(T), source.levels[0])
    if not backwards.fits(proposal.projective):
        return _refused(result, f"seen from the second frame {backwards.words}")
    if appearance.telling and not alike:
        return _refused(result, f"the surfaces fit, but {appearance.words}")
    if result.overlap < proposal.projective.min_overlap and not alike:
        return _refused(result, f"only {result.overlap:.0%} of the points match, and no texture speaks for it")
    if proposal.features is None:
        return result
    if proposal.features.share_within(T) < _MIN_KEPT:
        return _refused(result, "the depth and the image features propose different motions")
    if result.status is Status.DEGENERATE and alike:
        return _completed(result, proposal.features, config)
    return result


def _refused(result: RegistrationResult, why: str) -> RegistrationResult:
    return replace(result, status=Status.NO_OVERLAP, note=why)


def _completed(result: RegistrationResult, features: FeatureAlignment, config: TwoFrameConfig) -> RegistrationResult:
    """Take the directions that depth leaves free from the features, where these hold all directions well enough.

    The dense alignment has left those directions where the features had put them.
    """
    equations = features.equations(result.T_target_source)
    parts = spectrum(equations)
    if not parts.observable.all() or standard_deviation(equations, parts) > config.max_feature_std_m:
        return result
    information = result.information + equations.information
    return replace(result, status=Status.CONVERGED, information=information, unobservable=(), note="")


def surface_points(pyramid: SurfacePyramid) -> tuple[Float32, Float32]:
    """Return the points and normals (3, N) float32 of a frame's finest level, camera frame, in row-major order."""
    rows = pyramid.levels[0].surface.reshape(-1, 8)
    rows = rows[rows[:, 6] > 0]
    return np.ascontiguousarray(rows[:, 0:3].T), np.ascontiguousarray(rows[:, 3:6].T)
