"""Whether a frame shows the place of a keyframe, and from where: what looks alike must also fit.

Starts come from the image features that both share, or, where there are too few to speak, from the assumption that the
camera is about where it was. A dense alignment from there is believed when depth agrees in both directions and leaves
free space free, textures correlate on the common surfaces, the features that proposed it are still explained, and
every direction of the motion is held, by depth or by features. Where no texture speaks, more must fit, because corners
of rooms fit corners of other rooms. Two rooms that are exact copies cannot be told apart by one view; that is for
whoever closes a loop to check on other frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Array, Float64
from scanweld.config import check_ranges, section, setting
from scanweld.loop_closure.keyframes import Keyframe, Sighting
from scanweld.loop_closure.place_recognition import KeyframeDatabase
from scanweld.registration.projective import ProjectiveConfig, schedules
from scanweld.registration.result import RegistrationResult, Status
from scanweld.tracking.image_features import FeatureAlignment, align_features
from scanweld.tracking.two_frames import Proposal, TwoFrameConfig, align_proposal


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationConfig:
    """When a place is believed."""

    alignment: TwoFrameConfig = section(
        lambda: TwoFrameConfig(
            projective=ProjectiveConfig(
                iterations=20, min_cosine=0.8, min_overlap=0.6, max_points=20_000, widest_gate_m=0.5
            )
        ),
        "how a frame is aligned with a keyframe, and what is asked of it; min_overlap where no texture speaks",
    )
    candidates: int = setting(5, "keyframes that a lost frame is compared with; raise for recall, costs time", low=1)
    speaking_features: int = setting(
        60, "where both have so many features and these agree on no motion, the place is another", low=4
    )
    min_agreement_alone: float = setting(
        0.65, "share of the compared points that agree with the depth in an answer that no features proposed",
        low=0.0, high=1.0,
    )  # fmt: skip
    max_conflict_alone: float = setting(
        0.02, "share of the compared points in front of the depth in such an answer", low=0.0, high=1.0
    )
    variance_scale: float = setting(
        10.0, "variance of an alignment, in variances if the noise of every pixel were its own; raise to trust less",
        low=1.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_ranges(self)


def verify_place(
    sighting: Sighting, keyframe: Keyframe, config: VerificationConfig | None = None
) -> RegistrationResult:
    """Find the motion from a frame to a keyframe of the same place: T_target_source = T_keyframe_frame.

    Only CONVERGED says that the place is the same; any other status and its note say why it was not believed. The
    `covariance` counts neighbouring pixels as what they are, hardly independent; it is None where there is no answer.

    Parameters
    ----------
    sighting : of the frame
    keyframe : what it is compared with
    """
    config = config or VerificationConfig()
    features = align_features(sighting.features, keyframe.features, config.alignment.features)
    enough = min(len(sighting.features), len(keyframe.features)) >= config.speaking_features
    if enough and not features.result.status.success:
        return replace(features.result, status=Status.NO_OVERLAP)
    target = keyframe.pyramid(config.alignment.surfaces)
    best: RegistrationResult | None = None
    for proposal in _proposals(features, config):
        result = align_proposal(sighting.pyramid, target, proposal, config.alignment)
        if result.status is Status.CONVERGED:
            covariance = np.asarray(config.variance_scale * np.linalg.inv(result.information), np.float64)
            return replace(result, covariance=covariance)
        if best is None or result.status.rank > best.status.rank:
            best = result
    assert best is not None  # there is always a first proposal
    return best


def _proposals(features: FeatureAlignment, config: VerificationConfig) -> Iterator[Proposal]:
    """Yield where a dense alignment may start: where the features say, or else from the keyframe's own pose."""
    projective = config.alignment.projective
    if features.result.status.success:
        yield Proposal(features.result.T_target_source, projective, features)
        return
    strict = replace(
        projective,
        min_agreement=max(projective.min_agreement, config.min_agreement_alone),
        max_conflict=min(projective.max_conflict, config.max_conflict_alone),
    )
    for schedule in schedules(strict):
        yield Proposal(np.eye(4), schedule)


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """Where a lost frame is.

    Attributes
    ----------
    keyframe : index of the keyframe that it was found from; -1 when it was not
    T_world_camera : (4, 4), or None when it was not found
    result : of the alignment, T_keyframe_frame; of the last candidate when none was believed
    tried : the candidates, in order
    """

    keyframe: int
    T_world_camera: Float64 | None
    result: RegistrationResult
    tried: tuple[int, ...]

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.T_world_camera is not None


def relocalise(
    sighting: Sighting,
    database: KeyframeDatabase,
    config: VerificationConfig | None = None,
    *,
    allowed: Array | None = None,
) -> Relocalisation:
    """Find a frame among the keyframes: the first candidate that is verified gives its pose.

    Parameters
    ----------
    sighting : of the frame
    database : the keyframes
    allowed : (K,) bool, the keyframes that may be tried; all by default
    """
    config = config or VerificationConfig()
    result = RegistrationResult(
        T_target_source=np.eye(4),
        status=Status.TOO_FEW_CORRESPONDENCES,
        information=np.zeros((6, 6)),
        note="no keyframe to compare with",
    )
    if sighting.usable < database.config.keyframes.min_usable:
        note = f"only {sighting.usable:.1%} of the image has surfaces"
        return Relocalisation(-1, None, replace(result, note=note), ())
    tried = []
    for candidate in database.query(sighting, config.candidates, allowed=allowed):
        tried.append(candidate.index)
        keyframe = database[candidate.index]
        result = verify_place(sighting, keyframe, config)
        if result.status.success:
            return Relocalisation(
                keyframe.index, keyframe.T_world_camera @ result.T_target_source, result, tuple(tried)
            )
    return Relocalisation(-1, None, result, tuple(tried))
