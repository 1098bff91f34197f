"""Direct bundle adjustment of keyframes: :func:`refine_keyframes`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from scanweld.arrays import Bool, Float64, Int32
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.keyframes import Keyframe
from scanweld.refinement.calibration import (
    PARAMETERS,
    VALUES,
    Calibration,
    DepthCorrection,
    relative_units,
    values_of_parameters,
)
from scanweld.refinement.config import RefinementConfig
from scanweld.refinement.held_out import HeldOut, gain, measure
from scanweld.refinement.normal_equations import (
    MotionEdges,
    NormalEquations,
    assemble,
    covariance_of,
    dispersion,
    solve,
)
from scanweld.refinement.observations import (
    Fit,
    Observations,
    Views,
    fit_surfels,
    fitted_surfels,
    observe,
    sample_surfels,
)
from scanweld.refinement.surfels import Cameras, Surfels

logger = logging.getLogger(__name__)

CONVERGED_M = 2e-4
"""A step that moves no camera and no surface further than this is the last."""

LOOSENED = 10.0
"""Times that tracked motions are known less well where the camera is calibrated: they were measured with it."""

LARGEST_STEP = 0.05
"""Of the camera, as a share of the depth: further away the linearisation means nothing."""

PLAUSIBLE = np.array([0.02, 0.002, 0.01, 0.01, 0.01])
"""Error that each parameter may have when it is not estimated, as a share of the depth."""

MIN_SIGHTINGS = 500
"""With fewer of them shared by keyframes there is nothing to adjust."""


class RefinementStatus(Enum):
    """What came of a refinement."""

    BETTER = "better"  # what took no part fits better: the answer was kept
    NOT_BETTER = "not better"  # it does not: nothing was changed
    DEGENERATE = "degenerate"  # parameters that were asked for are not determined; see `held`
    TOO_FEW = "too few"  # keyframes, or surfaces that they share: nothing was changed


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step: the stage, the mean robust loss before it, and how far it moved.

    Attributes
    ----------
    stage : "depth", "depth, brightness", "depth, camera" or "depth, brightness, camera"
    loss : mean robust loss of the distances, in units of the noise (dimensionless)
    sightings : number of observations that took part
    moved_m : largest displacement of a keyframe or of what it sees [m]
    """

    stage: str
    loss: float
    sightings: int
    moved_m: float


@dataclass(frozen=True, slots=True)
class Refinement:
    """Keyframes and camera after an adjustment, or as they were where it did not help.

    Attributes
    ----------
    status : what came of it
    better : whether anything was changed; else the poses, the camera and the depth are those that were given
    T_world_camera : (K, 4, 4), poses of the keyframes
    T_new_old : (K, 4, 4), maps old world coordinates of what belongs to a keyframe to new ones
    keyframe_ids : (K,) int32, and their `timestamps_s` (K,)
    camera : of the sequence
    depth : what to do to every depth image
    sigmas : standard deviation of each value that was estimated, by its name, at the size of the sequence
    held : parameters that were asked for and are not determined, so stayed as they were
    held_out : mean loss of what took no part, before and after
    iterations : every step
    note : one line for a person
    """

    status: RefinementStatus
    better: bool
    T_world_camera: Float64
    T_new_old: Float64
    keyframe_ids: Int32
    timestamps_s: Float64
    camera: PinholeCamera
    depth: DepthCorrection
    sigmas: dict[str, float]
    held: tuple[str, ...]
    held_out: tuple[float, float]
    iterations: tuple[Iteration, ...]
    note: str

    @property
    def recalibrated(self) -> bool:
        """Whether camera or depth changed: a map that was made before is then to be made again."""
        return self.better and bool(self.sigmas)

    @property
    def correction(self) -> MapCorrection:
        """How what belongs to each keyframe moves."""
        return MapCorrection(self.keyframe_ids, self.T_new_old)

    def corrections_at(self, timestamps_s: Float64) -> Float64:
        """Return T_new_old (N, 4, 4) at times (N,): between two keyframes it goes over from one to the other."""
        times = self.timestamps_s
        after = np.clip(np.searchsorted(times, timestamps_s), 1, max(len(times) - 1, 1))
        result = np.tile(np.eye(4), (len(timestamps_s), 1, 1))
        for n, (time, k) in enumerate(zip(timestamps_s, np.minimum(after, len(times) - 1), strict=True)):
            before = max(k - 1, 0)
            span = times[k] - times[before]
            fraction = float(np.clip((time - times[before]) / span, 0, 1)) if span > 0 else 1.0
            result[n] = se3.interpolate(self.T_new_old[before], self.T_new_old[k], [fraction])[0]
        return result


def refine_keyframes(
    keyframes: Sequence[Keyframe], camera: PinholeCamera, config: RefinementConfig | None = None
) -> Refinement:
    """Adjust the poses of keyframes, and the camera where that is asked for, so that all views agree.

    Alternates between a sparse set of surfels (closed form) and Gauss-Newton steps on all poses and the camera, from
    which the surfels are eliminated: first depth alone with a gate that shrinks, then the camera, then brightness.
    After each stage surfels that took no part say whether it helped; what did not is dropped.

    Parameters
    ----------
    keyframes : in the order of time, images of one size
    camera : of the sequence that they come from
    config : what is estimated, and how

    Raises
    ------
    InvalidInputError
        When the keyframes differ in their cameras.

    Notes
    -----
    After T. Schops, T. Sattler, M. Pollefeys, "BAD SLAM: Bundle adjusted direct RGB-D SLAM", CVPR 2019, whose residuals
    these are; the poses are solved for together, which their alternation approaches (docs/refinement.md).
    """
    config = config or RefinementConfig()
    if any(keyframe.camera != keyframes[0].camera for keyframe in keyframes):
        raise InvalidInputError("refine: the keyframes have several cameras, expected one; refine each part on its own")
    if len(keyframes) < 2:
        return _unchanged(keyframes, camera, RefinementStatus.TOO_FEW, "fewer than two keyframes")
    return _Adjustment(keyframes, camera, config).run()


class _Adjustment:
    """The stages, one after the other, and the best state so far."""

    def __init__(self, keyframes: Sequence[Keyframe], camera: PinholeCamera, config: RefinementConfig) -> None:
        self.keyframes, self.camera, self.config = keyframes, camera, config
        self.views = Views(keyframes, config.surfaces)
        self.before = np.stack([se3.inverse(keyframe.T_world_camera) for keyframe in keyframes])
        self.asked = np.array([config.calibrate_intrinsics] * 4 + [config.calibrate_depth])
        self.edges = MotionEdges.between(self.before, config.drift)
        self.units = relative_units(keyframes[0].camera, self.views.median_depth_m())
        self.history: list[Iteration] = []
        self.covariance: Float64 = np.zeros((5, 5))  # of the parameters, at the last step
        self.determined: Bool = np.zeros(5, np.bool_)

    def run(self) -> Refinement:
        """Go through the stages."""
        config = self.config
        self.sampled = Cameras(self.before, Calibration(self.keyframes[0].camera))
        self.views.begin(self.sampled.calibration)
        surfels = sample_surfels(self.views, self.before, config.cell_px, config.fine_gate_m, config.min_cosine)
        surfels = self._thinned(surfels)
        if len(surfels) == 0:
            note = "the keyframes share hardly any surfaces"
            return _unchanged(self.keyframes, self.camera, RefinementStatus.TOO_FEW, note)
        self.judges, self.surfels = surfels.only(surfels.held), surfels.only(~surfels.held)
        nothing = np.zeros(5, np.bool_)
        first = best = self._candidate(self.sampled)
        best = self._better(best, self._minimise(best.cameras, nothing, lit=False, coarse=True))
        if self.asked.any():
            best = self._calibrated(best)
        if config.photometry == "auto" and any(self.views.lit):
            best = self._better(best, self._minimise(best.cameras, nothing, lit=True, coarse=False))
        return self._result(first, best)

    def _calibrated(self, best: _Candidate) -> _Candidate:
        """Estimate the camera, too, as far as depth determines it."""
        active = self._determined(best.cameras)
        while active.any():
            found = self._minimise(best.cameras, active, lit=False, coarse=False)
            worst, unsure = self._worst(self.covariance)
            if unsure <= self.config.max_relative_sigma:
                self.determined = active
                return self._better(best, found)
            active[worst] = False
        return best

    def _determined(self, cameras: Cameras) -> Bool:
        """Return which parameters of those that were asked for (5,) depth determines, all of them at once."""
        surfels = self.surfels.carried(self.sampled, cameras)
        found = observe(self.views, cameras, surfels, self.config.fine_gate_m, self.config.min_cosine, lit=False)
        equations = self._equations(fit_surfels(found, len(surfels), self.config.robust_sigma), cameras, lit=False)
        information = solve(equations, np.zeros(5, np.bool_)).information
        active = self.asked.copy()
        while active.any():
            worst, unsure = self._worst(self._covariance(information, active))
            if unsure <= self.config.max_relative_sigma:
                break
            logger.info("refine: %s is known to %.2g of the depth only, held", PARAMETERS[worst], unsure)
            active[worst] = False
        return active

    def _covariance(self, information: Float64, active: Bool) -> Float64:
        """Return the covariance (5, 5) of the active parameters; what was asked for and is held may be wrong, too.

        Held parameters pull on the others with the error that they plausibly have (consider parameters, Schmidt 1966).
        """
        covariance = np.zeros((5, 5))
        held = self.asked & ~active
        own = covariance_of(information[np.ix_(active, active)])
        pull = own @ information[np.ix_(active, held)]
        plausible = (PLAUSIBLE / self.units)[held] ** 2
        covariance[np.ix_(active, active)] = own + (pull * plausible) @ pull.T
        return covariance

    def _worst(self, covariance: Float64) -> tuple[int, float]:
        """Return the parameter that is known least, and how well, as a share of the depth."""
        relative = np.sqrt(np.diag(covariance)) * self.units
        worst = int(np.argmax(relative))
        return worst, float(relative[worst])

    def _thinned(self, surfels: Surfels) -> Surfels:
        """Keep the surfels that several keyframes see, and of these as many as there is room for."""
        config = self.config
        seen = observe(self.views, self.sampled, surfels, config.coarse_gate_m, config.min_cosine, lit=False)
        times = np.bincount(seen.surfel, minlength=len(surfels))
        shared = np.flatnonzero(times >= 2)
        total = int(times[shared].sum())
        if total < MIN_SIGHTINGS:
            return surfels.only(shared[:0])
        place = np.floor(np.arange(len(shared) + 1) * min(1.0, config.max_observations / total))
        return surfels.only(shared[np.diff(place) > 0])

    def _candidate(self, cameras: Cameras) -> _Candidate:
        held_out = measure(self.views, self.judges, self.sampled, cameras, self.config)
        slopes = values_of_parameters(cameras.calibration.camera)
        return _Candidate(cameras, held_out, np.sqrt(np.diag(slopes @ self.covariance @ slopes.T)))

    def _better(self, best: _Candidate, cameras: Cameras) -> _Candidate:
        """Return the new answer where depth that took no part fits it better, else the best so far."""
        new = self._candidate(cameras)
        depth = gain(best.held_out, new.held_out)
        logger.info("refine: %s: held out %s", self.history[-1].stage, depth)
        return replace(new, sigmas=np.where(new.sigmas > 0, new.sigmas, best.sigmas)) if depth.significant else best

    def _minimise(self, cameras: Cameras, active: Bool, *, lit: bool, coarse: bool) -> Cameras:
        """Alternate between surfels and poses until nothing moves; notes the covariance of the camera."""
        config = self.config
        stage = "depth" + (", brightness" if lit else "") + (", camera" if active.any() else "")
        gate = config.coarse_gate_m if coarse else config.fine_gate_m
        surfels = self.surfels.carried(self.sampled, cameras)
        for _ in range(config.iterations):
            found = observe(self.views, cameras, surfels, gate, config.min_cosine, lit=lit)
            fit = fit_surfels(found, len(surfels), config.robust_sigma)
            surfels = fitted_surfels(surfels, fit)
            stepped, moved = self._step(fit, cameras, active, lit=lit)
            surfels = surfels.carried(cameras, stepped)
            loss = float(fit.losses[:, 0].mean()) if len(fit.losses) else 0.0
            self.history.append(Iteration(stage, loss, len(fit.losses), moved))
            logger.debug("refine: %s, %s", self.history[-1], stepped.calibration)
            cameras = stepped
            if moved < CONVERGED_M and gate == config.fine_gate_m:
                break
            gate = max(config.fine_gate_m, gate / 1.5)
        return cameras

    def _step(self, fit: Fit, cameras: Cameras, active: Bool, *, lit: bool) -> tuple[Cameras, float]:
        """Take a Gauss-Newton step; returns the cameras after it, and how far it moved them or what they see [m]."""
        equations = self._equations(fit, cameras, lit=lit)
        slopes = values_of_parameters(cameras.calibration.camera)
        step = solve(equations, active, LARGEST_STEP / self.units)
        self.covariance = self._covariance(step.information, active)
        T = np.stack([se3.exp(xi) @ T for xi, T in zip(step.poses, cameras.T_camera_world, strict=True)])
        size = np.abs(step.poses)
        depth_m = self.units[4]
        moved = float((size[:, :3].max(axis=1) + depth_m * size[:, 3:].max(axis=1)).max())
        moved = max(moved, float(depth_m) * float(np.abs(step.camera * self.units).max()))
        return Cameras(T, cameras.calibration.stepped(slopes @ step.camera)), moved

    def _equations(self, fit: Fit, cameras: Cameras, *, lit: bool) -> NormalEquations:
        """Weigh the residuals by what they know, and sum them."""
        height, width = self.keyframes[0].camera.shape
        used = fit.observations
        depth = dispersion(used, height, width, slice(0, 1))
        light = dispersion(used, height, width, slice(1, 3)) if lit else 1.0
        edges = self.edges
        if self.asked.any():  # what was tracked with a wrong camera only damps the step
            edges = MotionEdges.between(cameras.T_camera_world, self.config.drift, LOOSENED)
        sums = assemble(_weighed(used, depth, light), cameras.T_camera_world, len(fit.offsets_m), edges)
        return sums.in_terms_of(values_of_parameters(cameras.calibration.camera))

    def _result(self, first: _Candidate, best: _Candidate) -> Refinement:
        """Turn the best state into the answer."""
        held = tuple(name for name, a, b in zip(PARAMETERS, self.asked, self.determined, strict=True) if a and not b)
        better = best is not first
        size = self.keyframes[0].camera
        scale = np.array([self.camera.width / size.width, self.camera.height / size.height] * 2 + [1.0])
        sigmas = {name: float(best.sigmas[k] * scale[k]) for k, name in enumerate(VALUES) if best.sigmas[k] > 0}
        calibration = best.cameras.calibration
        poses = np.stack([se3.inverse(T) for T in best.cameras.T_camera_world])
        old = np.stack([keyframe.T_world_camera for keyframe in self.keyframes])
        if not better:
            poses = old
        T_new_old = poses @ np.stack([se3.inverse(T) for T in old])
        status = RefinementStatus.BETTER if better else RefinementStatus.NOT_BETTER
        losses = first.held_out.mean, best.held_out.mean
        return Refinement(
            status=RefinementStatus.DEGENERATE if held else status,
            better=better,
            T_world_camera=poses,
            T_new_old=T_new_old,
            keyframe_ids=np.array([keyframe.index for keyframe in self.keyframes], np.int32),
            timestamps_s=np.array([keyframe.timestamp_s for keyframe in self.keyframes]),
            camera=calibration.resized(self.camera, size),
            depth=calibration.depth,
            sigmas=sigmas,
            held=held,
            held_out=losses,
            iterations=tuple(self.history),
            note=_words(better, losses, T_new_old, held, sigmas),
        )


@dataclass(frozen=True, slots=True)
class _Candidate:
    """An answer, how well what took no part fits it, and the standard deviations (5,) of calibrated values, else 0."""

    cameras: Cameras
    held_out: HeldOut
    sigmas: Float64


def _weighed(observations: Observations, depth: float, brightness: float) -> Observations:
    """Divide the weights by how much the residuals overstate what they know."""
    rows = observations.rows.copy()
    rows[:, 0, 13] /= np.float32(depth)
    rows[:, 1:, 13] /= np.float32(brightness)
    return replace(observations, rows=rows)


def _unchanged(keyframes: Sequence[Keyframe], camera: PinholeCamera, status: RefinementStatus, note: str) -> Refinement:
    poses = np.array([keyframe.T_world_camera for keyframe in keyframes], np.float64).reshape(-1, 4, 4)
    return Refinement(
        status=status,
        better=False,
        T_world_camera=poses,
        T_new_old=np.tile(np.eye(4), (len(keyframes), 1, 1)),
        keyframe_ids=np.array([keyframe.index for keyframe in keyframes], np.int32),
        timestamps_s=np.array([keyframe.timestamp_s for keyframe in keyframes]),
        camera=camera,
        depth=DepthCorrection(),
        sigmas={},
        held=(),
        held_out=(0.0, 0.0),
        iterations=(),
        note=note,
    )


def _words(
    better: bool, losses: tuple[float, float], T_new_old: Float64, held: tuple[str, ...], sigmas: dict[str, float]
) -> str:
    """Say what came of it."""
    moved = float(np.linalg.norm(T_new_old[:, :3, 3], axis=1).max(initial=0.0))
    text = f"what took no part fits better: its loss fell from {losses[0]:.3f} to {losses[1]:.3f}"
    text = text if better else "what took no part does not fit better, so nothing was changed"
    if better:
        text += f"; the world moved by up to {moved * 1e3:.1f} mm"
    if sigmas:
        text += f"; estimated: {', '.join(sigmas)}"
    if held:
        text += f"; the views do not determine {', '.join(held)}, which stayed as given"
    return text
