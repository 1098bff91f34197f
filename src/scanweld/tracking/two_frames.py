"""Alignment of two frames without a map and without a guess of the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float32, as_transform
from scanweld.config import check_ranges, section
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.registration.projective import ProjectiveConfig, align_projective, schedules
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.verification import check_against_depth


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoFrameConfig:
    """How two frames are aligned."""

    surfaces: SurfaceConfig = section(SurfaceConfig, "how depth becomes surfaces")
    projective: ProjectiveConfig = section(
        lambda: ProjectiveConfig(iterations=40, min_cosine=0.8, min_overlap=0.3),
        "schedule and gates of the alignment",
    )

    def __post_init__(self) -> None:
        check_ranges(self)


def align_frames(
    a: Frame, b: Frame, *, T_init: npt.ArrayLike | None = None, config: TwoFrameConfig | None = None
) -> RegistrationResult:
    """Find the motion between two frames: T_target_source = T_b_a maps points of camera a to camera b.

    Projective point-to-plane from `T_init` (4, 4), the identity by default. When the result contradicts what the
    two cameras saw, the alignment is tried again with wider gates; the first pose that both views agree with is the
    answer. Motions beyond about 25 degrees or half the overlap end in an honest status.

    Raises
    ------
    InvalidInputError
        When `T_init` is not a rigid transform.
    """
    config = config or TwoFrameConfig()
    start = np.eye(4) if T_init is None else as_transform(T_init, "T_init")
    source, target = build_pyramid(a, config.surfaces), build_pyramid(b, config.surfaces)
    positions, normals = surface_points(source)
    best: RegistrationResult | None = None
    for projective in schedules(config.projective):
        result = align_projective(positions, normals, target.levels, start, projective)
        result = _check_backwards(result, source, target, projective)
        if result.status is Status.CONVERGED:
            return result
        if best is None or (result.status.rank, result.overlap) > (best.status.rank, best.overlap):
            best = result
    assert best is not None  # there is at least one schedule
    return best


def _check_backwards(
    result: RegistrationResult, source: SurfacePyramid, target: SurfacePyramid, config: ProjectiveConfig
) -> RegistrationResult:
    """The points of b must not stand in free space of a either."""
    if not result.status.has_pose:
        return result
    positions, normals = surface_points(target)
    agreement = check_against_depth(positions, normals, se3.inverse(result.T_target_source), source.levels[0])
    if agreement.fits(config):
        return result
    return replace(result, status=Status.NO_OVERLAP, note=f"seen from the second frame {agreement.words}")


def surface_points(pyramid: SurfacePyramid) -> tuple[Float32, Float32]:
    """Return the points and normals (3, N) float32 of a frame's finest level, camera frame, in row-major order."""
    rows = pyramid.levels[0].surface.reshape(-1, 8)
    rows = rows[rows[:, 6] > 0]
    return np.ascontiguousarray(rows[:, 0:3].T), np.ascontiguousarray(rows[:, 3:6].T)
