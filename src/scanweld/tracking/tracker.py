"""Frame-to-model tracking: the map's surfels are the source, the frame is the target."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Float32, Float64, Int64
from scanweld.config import check_ranges, section, setting
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid, as_kernel_input
from scanweld.geometry.views import ModelView
from scanweld.registration.photometric.refinement import Photometry
from scanweld.registration.projective import ProjectiveConfig, align_projective, schedules
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.verification import Agreement, check_against_depth
from scanweld.tracking import kernels
from scanweld.tracking.rotation import find_turns, thumbnails


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

    photometry: bool | str = setting(
        "auto", "auto (or true): brightness where it helps geometry or replaces it; off (or false): geometry alone"
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.photometry not in (True, False, "auto", "off"):
            raise ConfigError(f"photometry = {self.photometry!r}: expected 'auto', 'off', true or false")

    @property
    def uses_photometry(self) -> bool:
        """Whether brightness may be used."""
        return self.photometry in (True, "auto")


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
        perturbation of it, in world axes. Free directions are named in the camera's axes; along these the pose is the
        predicted one.
        """
        rows = self._select(view)
        positions_m, normals = _taken(view.positions_m, rows), _taken(view.normals, rows)
        scene = _Scene(positions_m, normals, pyramid, self._photometry(pyramid, view, rows))
        T_camera_world = se3.inverse(T_world_camera)
        first, *wider = schedules(self.config.projective)
        strict = replace(wider[0], coarse_gate_m=first.coarse_gate_m, min_cosine=first.min_cosine) if wider else first
        best = scene.align(T_camera_world, first)
        far = best.status.has_pose and _is_far(best, T_camera_world, first)
        if far:  # the prediction speaks against it, so the depth must speak for it
            agreement = scene.agreement(best)
            if not agreement.fits(strict):
                best = replace(best, status=Status.NO_OVERLAP, note=f"far from the prediction, and {agreement.words}")
        if far or not best.status.has_pose:
            best = self._turned(scene, view, T_camera_world, best, strict)
        if not best.status.has_pose:
            for schedule in wider:
                result = scene.align(T_camera_world, schedule)
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

    def _turned(
        self,
        scene: _Scene,
        view: ModelView,
        T_camera_world: Float64,
        best: RegistrationResult,
        strict: ProjectiveConfig,
    ) -> RegistrationResult:
        """Try again from where small images say the camera has turned to; returns the better answer.

        Two answers are told apart by how much of what both cameras see agrees.
        """
        light = scene.photometry
        if light is None:
            return best
        camera = view.camera
        source = thumbnails(light.pictures[0][0], light.pictures[0][1], camera)
        target = thumbnails(light.grey, np.ones(light.grey.shape, np.bool_), camera)
        T_view_world = se3.inverse(view.T_world_camera)
        for turn in find_turns(source, target):
            start = T_view_world.copy()
            start[:3] = turn.rotation @ start[:3]
            result = scene.align(start, strict)
            if result.status is not Status.CONVERGED or _is_far(result, start, strict):
                continue
            if not best.status.has_pose or scene.agreement(result).agree > scene.agreement(best).agree:
                return result
        return best

    def _select(self, view: ModelView) -> Int64:
        """Choose the rows (M,) of the view to track against, in the order of the image.

        Where half of the view is stable, only stable surfels count: the others are mostly noise. A map that is young or
        new to this place has nothing better than all of them.
        """
        config = self.config
        least, count = view.stable_confidence, int(np.count_nonzero(view.confidences >= view.stable_confidence))
        if count < MIN_STABLE_SHARE * len(view):
            least, count = 0.0, len(view)
        wanted = max(round(config.stable_fraction * count), config.projective.min_points)
        if wanted >= count:
            return _listed(view, least, -(-count // config.projective.max_points))
        rows = _listed(view, least)
        # Confidence stops growing, so ties are the rule: those at the limit are taken evenly over the image.
        confidences = view.confidences[rows]
        wanted = min(wanted, len(rows))
        limit = np.partition(confidences, len(rows) - wanted)[len(rows) - wanted]
        above, tied = np.flatnonzero(confidences > limit), np.flatnonzero(confidences == limit)
        more = wanted - len(above)
        rows = rows[np.sort(np.concatenate([above, tied[np.arange(more) * len(tied) // more]]))]
        return np.asarray(rows[:: max(1, -(-wanted // config.projective.max_points))])

    def _photometry(self, pyramid: SurfacePyramid, view: ModelView, rows: Int64) -> Photometry | None:
        """Return the brightness of both sides where there is any and it is wanted."""
        if not self.config.uses_photometry or pyramid.grey is None or view.intensities is None:
            return None
        return Photometry(_taken(view.intensities[None], rows)[0], pyramid.grey, view, rows)


def _listed(view: ModelView, least: float, stride: int = 1) -> Int64:
    """List the rows (M,) of at least this confidence at every `stride`-th pixel, in the order of the image."""
    if len(view) == 0:
        return np.empty(0, np.int64)
    rows = np.empty(view.index_map.size + 1, np.int64)
    return rows[: kernels.list_rows(view.index_map, view.confidences, np.float32(least), max(1, stride), rows)]


def _taken(values: Float32, rows: Int64) -> Float32:
    """Return columns `rows` (M,) of values (C, N)."""
    taken = np.empty((len(values), len(rows)), np.float32)
    kernels.take_columns(as_kernel_input(values, np.float32), rows, taken)
    return taken


@dataclass(frozen=True, slots=True)
class _Scene:
    """What is aligned: surfels (3, M), world frame, and a frame."""

    positions_m: Float32
    normals: Float32
    pyramid: SurfacePyramid
    photometry: Photometry | None

    def align(self, T_camera_world: Float64, config: ProjectiveConfig) -> RegistrationResult:
        """Align from a start."""
        return align_projective(
            self.positions_m, self.normals, self.pyramid.levels, T_camera_world, config, photometry=self.photometry
        )

    def agreement(self, result: RegistrationResult) -> Agreement:
        """Compare an answer with the depth."""
        return check_against_depth(self.positions_m, self.normals, result.T_target_source, self.pyramid.levels[0])


def _is_far(result: RegistrationResult, T_target_source: Float64, config: ProjectiveConfig) -> bool:
    """Whether an answer is far from where it was expected."""
    shift, turn = np.split(se3.log(result.T_target_source @ se3.inverse(T_target_source)), 2)
    return bool(np.linalg.norm(shift) > config.coarse_gate_m or np.linalg.norm(turn) > FAR_TURN_RAD)
