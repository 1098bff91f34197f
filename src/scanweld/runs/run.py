"""Read a sequence, run SLAM on it, evaluate, write the run folder."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from scanweld.arrays import Float64
from scanweld.checkup.first_look import FirstLook
from scanweld.datasets.base import LiveSequence, RgbdSequence
from scanweld.datasets.images import explain_unusable_depth
from scanweld.datasets.playback import Clock, WallClock
from scanweld.errors import DatasetError, InvalidInputError
from scanweld.geometry.frame import Frame
from scanweld.notebook import BAD, DOUBTFUL, GOOD, card
from scanweld.refinement.refine import Refinement
from scanweld.runs.calibrated import CalibratedSequence
from scanweld.runs.checkpoint.identity import fingerprint_of
from scanweld.runs.checkpoint.keeper import Checkpoints
from scanweld.runs.folder import check_writable, still_free, write_folder
from scanweld.runs.interrupts import Patience
from scanweld.runs.observer import RunObserver
from scanweld.runs.output import write_run
from scanweld.runs.refining import calibrate as calibrate_camera
from scanweld.runs.refining import described
from scanweld.runs.summary import summarise
from scanweld.runs.walk import AfterFrame, Tally, process_all
from scanweld.slam.config import SlamConfig
from scanweld.slam.motion import POSED, UNSEEN
from scanweld.slam.system import Slam, build_slam
from scanweld.slam.warmup import load_kernels
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult, FrameState, Trajectory

logger = logging.getLogger(__name__)

Progress = Callable[[FrameResult], None]

HELD_S = 0.1
"""A run that is held looks this often whether it is to end."""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What a run came to.

    Attributes
    ----------
    folder : where it was written, None when it was not
    metrics : what metrics.json holds
    results : one per selected frame, in the world of the map; frames of other submaps are LOST there
    map : the surfel map, of the main submap
    interrupted : Ctrl-C ended it early; what was done until then was kept
    refinements : what came of calibration and refinement, in that order, where they were asked for
    resumable : an interrupted run can be continued from what its folder holds
    """

    folder: Path | None
    metrics: Mapping[str, Any]
    results: tuple[FrameResult, ...]
    map: Any
    interrupted: bool = False
    refinements: tuple[Refinement, ...] = ()
    resumable: bool = False

    @property
    def trustworthy(self) -> bool:
        """Whether tracking held at the end and for at least half of the frames, without those that were dropped."""
        tracked = sum(result.state in POSED for result in self.results)
        taken = sum(result.state is not FrameState.DROPPED for result in self.results)
        seen = [result for result in self.results if result.state not in UNSEEN]
        return bool(seen) and seen[-1].state in POSED and 2 * tracked >= taken

    def __repr__(self) -> str:
        m = self.metrics
        return f"<RunSummary {m['frames_tracked']} of {m['frames']} frames tracked, {len(self.map):,} surfels>"

    def _repr_html_(self) -> str:
        """Show what the run came to in a notebook."""
        m, ate_m = self.metrics, self.metrics["ate_rmse_m"]
        mark = BAD if not self.trustworthy else DOUBTFUL if m["frames_lost"] or self.interrupted else GOOD
        rows = [
            ("interrupted", "yes; what was done by then was kept" if self.interrupted else ""),
            ("lost", f"{m['frames_lost']} frames, found again {m['relocalisations']}x" if m["frames_lost"] else ""),
            ("unreadable", f"{m['frames_unreadable']} frames" if m["frames_unreadable"] else ""),
            ("dropped", f"{m['frames_dropped']} frames, to keep pace" if m.get("frames_dropped") else ""),
            ("path", f"{m['path_length_m']:.2f} m"),
            ("ATE", f"{1e3 * ate_m:.2f} mm" if ate_m is not None else "no ground truth"),
            ("loops", f"{m['loop_closures']} closed" if m["loop_closures"] else ""),
            ("map", f"{m['num_surfels']:,} surfels"),
            ("written", f"{self.folder}/" if self.folder is not None else ""),
        ]
        return card(f"Run: {m['frames_tracked']} of {m['frames']} frames tracked", rows, mark=mark)


@dataclass(slots=True)
class _Run(Stateful):
    """A run so far. An interruption at any time leaves it whole: map and sequence are of the same camera."""

    STATE: ClassVar = {"slam": Stateful, "tally": Tally, "resumed_at": list[int]}
    MADE = frozenset({"sequence", "config", "refinements", "interrupted"})

    sequence: RgbdSequence
    config: SlamConfig
    slam: Slam
    tally: Tally = field(default_factory=Tally)
    refinements: list[Refinement] = field(default_factory=list)
    interrupted: bool = False
    resumed_at: list[int] = field(default_factory=list)  # frames that were the first after a resumption

    def restored(self) -> None:
        """Check that there are not more frames than in the sequence."""
        if len(self.slam.results) > len(self.sequence):
            raise ValueError("more frames than the sequence has")

    @property
    def tracked(self) -> bool:
        """Whether any frame has a pose."""
        return any(result.state in POSED for result in self.slam.results)

    def calibrate(self, after_frame: AfterFrame) -> None:
        """Calibrate the camera, and where that helps run once more with it."""
        calibrated, found = calibrate_camera(self.slam, self.sequence, self.config.refinement)
        self.refinements.append(found)
        if found.recalibrated:
            again = build_slam(calibrated.camera, self.config)
            process_all(again, calibrated, Tally(), None, after_frame)
            self.slam, self.sequence = again, calibrated

    def refine(self) -> None:
        """Adjust the keyframes to each other; the camera stays as it is."""
        poses_alone = replace(self.config.refinement, calibrate_intrinsics=False, calibrate_depth=False)
        self.refinements.append(self.slam.refine(self.sequence.camera, poses_alone))

    def interrupt(self) -> None:
        """End here."""
        self.interrupted = True
        self.tally.warn(f"interrupted after {len(self.slam.results)} of {len(self.sequence)} frames")

    def check_map(self) -> None:
        """Raise DatasetError when nothing has been mapped; frames at given poses need no surfaces."""
        if self.tracked and len(self.slam.map) > 0:
            return
        usable_m = (0.0, self.config.surfaces.max_depth_m)
        why = explain_unusable_depth(self.tally.median_depth_m, self.sequence.depth_scale, usable_m)
        raise DatasetError(f"{self.sequence.name}: no frame has usable depth, the map is empty; {why}")

    def describe(
        self, description: Mapping[str, Any], options: Mapping[str, bool], fingerprint: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return a description with what was asked for, what of, and what became of the run."""
        return {
            **description,
            **options,
            "fingerprint": {**fingerprint, "content": f"{self.tally.content:08x}"} if fingerprint else {},
            "warnings": [*description.get("warnings", ()), *self.tally.warnings],
            "interrupted": self.interrupted,
            **({"resumed_at": self.resumed_at} if self.resumed_at else {}),
            **({"calibrated": isinstance(self.sequence, CalibratedSequence)} if options["calibrate"] else {}),
            **({"refinements": described(self.refinements)} if self.refinements else {}),
        }


def run_sequence(
    sequence: RgbdSequence,
    config: SlamConfig | None = None,
    *,
    out: Path | None = None,
    force: bool = False,
    poses: Trajectory | None = None,
    progress: Progress | None = None,
    observers: Sequence[RunObserver] = (),
    tracked_only: bool = False,
    calibrate: bool = False,
    refine: bool = False,
    realtime: bool = False,
    clock: Clock | None = None,
    resume: bool = False,
    checkpoint_every_s: float | None = None,
    resumable: bool = True,
    description: Mapping[str, Any] | None = None,
    started: float | None = None,
) -> RunSummary:
    """Run SLAM over a sequence and write the run folder.

    Parameters
    ----------
    sequence : what to read
    config : what to do with it
    out : run folder; None writes nothing
    force : replace an existing run
    poses : fuse at these T_world_camera instead of tracking; frames without one within 0.02 s are skipped
    progress : called after each frame
    observers : look on, and may hold the run between two frames
    tracked_only : leave lines of frames without a measured pose out of trajectory.txt
    calibrate : estimate intrinsics and depth from the keyframes, and where that helps run once more with them
    refine : adjust the keyframes in the end; map and trajectory move with them (docs/refinement.md)
    realtime : play the recording at the speed of its timestamps, and drop frames instead of falling behind
        (:func:`~.playback.play`); by default every frame is taken, and results do not depend on timing. A live camera
        is in real time anyway
    clock : that of `realtime`; by default the machine's
    resume : continue the run in `out` where its checkpoint is (docs/checkpoints.md), or begin where there is none
    checkpoint_every_s : seconds between two checkpoints, by default 60 or as many as keep their cost below 2 %; 0: none
        but when the run is interrupted. Runs in real time have none: they cannot be continued
    resumable : False: no checkpoint is written, not when the run is interrupted either
    description : goes into run.json; its "warnings" are put before those of the run
    started : `time.perf_counter()` from which seconds_total counts; default now

    Raises
    ------
    OutputError
        When `out` cannot be written; checked before any frame is read.
    DatasetError
        When no frame can be decoded, or the recording has vanished meanwhile; a checkpoint of what was done by then is
        written.
    FileFormatError, ConfigError
        When the checkpoint to resume from is damaged, of another version, or of another configuration.
    InvalidInputError
        When no given pose belongs to a frame, given poses are to be refined, a camera is to be calibrated in real time,
        or the checkpoint to resume from is of another sequence.
    """
    if isinstance(sequence, LiveSequence) and (calibrate or poses is not None):
        raise InvalidInputError(
            f"{sequence.name}: a live camera cannot be run again or at given poses; record it first"
        )
    if poses is not None and (calibrate or refine):
        raise InvalidInputError("poses: given poses are not refined; leave out either poses, or refine and calibrate")
    if realtime and calibrate:
        raise InvalidInputError("calibrate: the recording is run twice for it, which is not real time; leave one out")
    timeless = not realtime and not isinstance(sequence, LiveSequence)
    if resume and not timeless:
        raise InvalidInputError("resume: a run in real time cannot be continued; leave one out")
    started = time.perf_counter() if started is None else started
    config = config or SlamConfig()
    if out is not None:
        check_writable(out, force=force, resume=resume)
    with Patience() as patience:

        def after_frame(slam: Slam, frame: Frame | None, result: FrameResult) -> None:
            if progress is not None:
                progress(result)
            for observer in observers if result.state is not FrameState.DROPPED else ():
                observer.on_frame(slam, frame, result)
            try:
                patience.check()  # only here: a frame is in the map and in the trajectory, or in neither
                while not all(observer.ready(HELD_S) for observer in observers):
                    patience.check()
            except KeyboardInterrupt:
                keep(slam, result.index, frame, surely=run.tracked)
                raise
            keep(slam, result.index, frame)

        def keep(slam: Slam, index: int, frame: Frame | None, *, surely: bool = False) -> None:
            """Write a checkpoint where it is time; a second pass has none, it is made again from the first one."""
            fault = checkpoints.keep(run, index, frame, surely=surely) if slam is run.slam else ""
            if fault:
                run.tally.warn(fault)

        given = None if poses is None else poses_by_frame(sequence, poses)
        placed = _beside(config, out)
        run = _Run(sequence, placed, build_slam(sequence.camera, placed))
        kept_in = out if timeless and resumable else None
        checkpoints = Checkpoints(kept_in, sequence, config, given, every_s=checkpoint_every_s)
        if resume and checkpoints.resume(run):
            run.resumed_at.append(len(run.slam.results))
            started -= checkpoints.seconds_before
        elif resume:
            logger.warning("%s: there is no checkpoint to resume from; the run begins at the first frame", out)
        with checkpoints.told_in_errors():
            try:
                if realtime:
                    load_kernels()
                played_by = (clock or WallClock()) if realtime else None
                # Which takes longer than the time between two frames.
                look = FirstLook(sequence) if timeless else None
                process_all(run.slam, sequence, run.tally, given, after_frame, played_by, look)
                run.slam.finish()
                if calibrate or refine:
                    keep(run.slam, -1, None, surely=True)
                if calibrate:
                    run.calibrate(after_frame)
                if refine:
                    run.refine()
            except DatasetError:
                keep(run.slam, -1, None, surely=run.tracked)
                raise
            except KeyboardInterrupt:
                if not run.tracked:
                    raise  # there is nothing to keep
                if not isinstance(sequence, LiveSequence):  # which has no other end
                    run.interrupt()
        for observer in observers:
            observer.on_end(run.slam)
        run.check_map()
        metrics, error = summarise(run.slam, run.sequence.ground_truth, run.tally.num_points_input)
        metrics["seconds_total"] = time.perf_counter() - started
        has_checkpoint = False
        if out is not None:
            out = still_free(out, force=force or resume)
            asked = {"calibrate": calibrate, "refine": refine, "realtime": realtime, "tracked_only": tracked_only}
            fingerprint = fingerprint_of(sequence, given) if timeless else {}
            with checkpoints.told_in_errors(), write_folder(out, force=force or resume) as aside:
                write_run(
                    aside, run.slam, run.sequence, config, metrics, error, tracked_only=tracked_only, started=started,
                    description=run.describe(description or {}, asked, fingerprint),
                )  # fmt: skip
                has_checkpoint = run.interrupted and checkpoints.keep_in(aside)
        results, refinements = tuple(run.slam.main_results), tuple(run.refinements)
        return RunSummary(out, metrics, results, run.slam.map, run.interrupted, refinements, has_checkpoint)


def _beside(config: SlamConfig, out: Path | None) -> SlamConfig:
    """Keep what of the map does not fit in memory where the run will be written, unless the user says where."""
    if config.map.folder or out is None:
        return config
    folder = next(parent for parent in out.resolve().parents if parent.exists())
    return replace(config, map=replace(config.map, folder=str(folder)))


def poses_by_frame(sequence: RgbdSequence, poses: Trajectory) -> list[Float64 | None]:
    """Return the given pose of each frame, None where there is none within 0.02 s."""
    if len(poses) == 0:
        raise InvalidInputError("poses: the trajectory is empty; give one pose per frame, or none to track")
    times = sequence.timestamps_s
    after = np.clip(np.searchsorted(poses.timestamps_s, times), 1, max(1, len(poses) - 1))
    before = after - 1
    after = np.minimum(after, len(poses) - 1)
    nearer = np.abs(poses.timestamps_s[after] - times) < np.abs(poses.timestamps_s[before] - times)
    nearest = np.where(nearer, after, before)
    close = np.abs(poses.timestamps_s[nearest] - times) <= 0.02
    if not close.any():
        raise InvalidInputError(
            f"poses: none belongs to a frame; poses are at {poses.timestamps_s[0]:.3f} to "
            f"{poses.timestamps_s[-1]:.3f} s, frames at {times[0]:.3f} to {times[-1]:.3f} s"
        )
    return [poses.T_world_camera[k] if ok else None for k, ok in zip(nearest, close, strict=True)]
