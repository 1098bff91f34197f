"""Frame-to-model tracking: the map's surfels are the source, the frame is the target."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.config import check_ranges, section, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import ModelView
from scanweld.registration.projective import ProjectiveConfig, align_projective, schedules
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.verification import check_against_depth


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingConfig:
    """How a frame is aligned with the map."""

    stable_fraction: float = setting(
        1.0,
        "track against this share of the stable surfels in view, the most stable; lower for speed, against drift",
        low=0.001,
        high=1.0,
    )
    # Looser than for unknown motions: the prediction is close. Unrelated views that look alike have 14 % of conflict
    # and more (docs/decisions/0003-verification.md).
    projective: ProjectiveConfig = section(
        lambda: ProjectiveConfig(min_agreement=0.5, max_conflict=0.12), "schedule and gates of the alignment"
    )

    def __post_init__(self) -> None:
        check_ranges(self)


FAR_TURN_RAD = 0.15
"""An answer turned further than this from the prediction must pass the strict free-space check."""

MIN_STABLE_SHARE = 0.5
"""Share of the visible surfels that must be stable for the others to be left out."""


class FrameToModelTracker:
    """Coarse-to-fine projective point-to-plane alignment of a frame with the map."""

    def __init__(self, config: TrackingConfig | None = None) -> None:
        self.config = config or TrackingConfig()

    def track(self, pyramid: SurfacePyramid, view: ModelView, T_world_camera: Float64) -> RegistrationResult:
        """Align a frame with the map seen from close by.

        Parameters
        ----------
        pyramid : the frame
        view : the map as seen from about `T_world_camera`
        T_world_camera : (4, 4), predicted pose

        Returns
        -------
        The result of moving the camera: T_target_source is T_world_camera, and `information` belongs to a left
        perturbation of it, in world axes. Free directions are named in the camera's axes.
        """
        positions, normals = self._select(view)
        T_camera_world = se3.inverse(T_world_camera)
        first, *wider = schedules(self.config.projective)
        best = align_projective(positions, normals, pyramid.levels, T_camera_world, first)
        shift, turn = np.split(se3.log(best.T_target_source @ se3.inverse(T_camera_world)), 2)
        far = np.linalg.norm(shift) > first.coarse_gate_m or np.linalg.norm(turn) > FAR_TURN_RAD
        if best.status.has_pose and far:  # the prediction speaks against it, so the depth must speak for it
            agreement = check_against_depth(positions, normals, best.T_target_source, pyramid.levels[0])
            if not agreement.fits(wider[0] if wider else first):
                best = replace(best, status=Status.NO_OVERLAP, note=f"far from the prediction, and {agreement.words}")
        if not best.status.has_pose:
            for schedule in wider:
                result = align_projective(positions, normals, pyramid.levels, T_camera_world, schedule)
                if result.status is Status.CONVERGED:  # after a wide search nothing less is worth a pose
                    best = result
                    break
        # The aligner moves the map to the camera: T_cw <- exp(xi) T_cw. With T_wc <- exp(eta) T_wc, xi = -Ad(T_cw) eta.
        adjoint = se3.adjoint(best.T_target_source)
        return replace(
            best,
            T_target_source=se3.inverse(best.T_target_source),
            information=adjoint.T @ best.information @ adjoint,
        )

    def _select(self, view: ModelView) -> tuple[Float32, Float32]:
        """Return the positions and normals (3, M) of the surfels to track against, in the order of the image.

        Where half of the view is stable, only stable surfels count: the others are mostly noise. A map that is young or
        new to this place has nothing better than all of them.
        """
        stable = np.flatnonzero(view.confidences >= view.stable_confidence)
        if len(stable) < MIN_STABLE_SHARE * len(view):
            stable = np.arange(len(view))
        wanted = max(round(self.config.stable_fraction * len(stable)), self.config.projective.min_points)
        if wanted < len(stable):
            # Confidence stops growing, so ties are the rule: those at the limit are taken evenly over the image.
            confidences = view.confidences[stable]
            limit = np.partition(confidences, len(stable) - wanted)[len(stable) - wanted]
            above, tied = np.flatnonzero(confidences > limit), np.flatnonzero(confidences == limit)
            more = wanted - len(above)
            stable = stable[np.sort(np.concatenate([above, tied[np.arange(more) * len(tied) // more]]))]
        # The aligner reads no more than this: an even share of the image, before anything is copied.
        stable = stable[:: max(1, -(-len(stable) // self.config.projective.max_points))]
        if len(stable) == len(view):
            return view.positions_m, view.normals
        return np.take(view.positions_m, stable, axis=1), np.take(view.normals, stable, axis=1)
