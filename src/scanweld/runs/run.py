"""Read a sequence, run SLAM on it, evaluate, write the run folder."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Float64
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.gyroscope import gyroscope_of
from scanweld.datasets.images import check_depth_unit, explain_unusable_depth
from scanweld.datasets.stream import stream
from scanweld.errors import DatasetError, InvalidInputError
from scanweld.evaluation.surface_metrics import compression_ratio
from scanweld.evaluation.trajectory_metrics import AteResult, ate, rpe
from scanweld.refinement.refine import Refinement
from scanweld.runs.calibrated import CalibratedSequence
from scanweld.runs.folder import check_writable, write_folder
from scanweld.runs.interrupts import Patience
from scanweld.runs.output import write_run
from scanweld.runs.refining import calibrate as calibrate_camera
from scanweld.runs.refining import described
from scanweld.slam.motion import POSED
from scanweld.slam.system import Slam, SlamConfig, build_slam
from scanweld.trajectory import FrameResult, FrameState, Trajectory

logger = logging.getLogger(__name__)

Progress = Callable[[FrameResult], None]

UNIT_CHECK_FRAMES = 5
"""Frames whose depth is looked at for a wrong unit."""


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
    """

    folder: Path | None
    metrics: Mapping[str, Any]
    results: tuple[FrameResult, ...]
    map: Any
    interrupted: bool = False
    refinements: tuple[Refinement, ...] = ()

    @property
    def trustworthy(self) -> bool:
        """Whether tracking held at the end and for at least half of the frames."""
        tracked = sum(result.state in POSED for result in self.results)
        posed_at_end = [r for r in self.results if r.state is not FrameState.UNREADABLE]
        return bool(posed_at_end) and posed_at_end[-1].state in POSED and 2 * tracked >= len(self.results)


@dataclass(slots=True)
class _Tally:
    """What is counted while frames go by."""

    num_points_input: int = 0
    median_depth_m: float = 0.0  # of the first frame with depth
    unit_doubted: bool = False
    warnings: list[str] = field(default_factory=list)

    def warn(self, message: str) -> None:
        logger.warning(message)
        self.warnings.append(message)


def run_sequence(
    sequence: RgbdSequence,
    config: SlamConfig | None = None,
    *,
    out: Path | None = None,
    force: bool = False,
    poses: Trajectory | None = None,
    progress: Progress | None = None,
    tracked_only: bool = False,
    calibrate: bool = False,
    refine: bool = False,
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
    tracked_only : leave lines of frames without a measured pose out of trajectory.txt
    calibrate : estimate intrinsics and depth from the keyframes, and where that helps run once more with them
    refine : adjust the keyframes in the end; map and trajectory move with them (docs/refinement.md)
    description : goes into run.json; its "warnings" are put before those of the run
    started : `time.perf_counter()` from which seconds_total counts; default now

    Raises
    ------
    OutputError
        When `out` cannot be written; checked before any frame is read.
    DatasetError
        When no frame can be decoded.
    InvalidInputError
        When no given pose belongs to a frame, or given poses are to be refined.
    """
    if poses is not None and (calibrate or refine):
        raise InvalidInputError("poses: given poses are not refined; leave out either poses, or refine and calibrate")
    started = time.perf_counter() if started is None else started
    config = config or SlamConfig()
    if out is not None:
        check_writable(out, force=force)
    with Patience() as patience:  # a frame is in the map and in the trajectory, or in neither
        given = None if poses is None else _poses_by_frame(sequence, poses)
        slam = build_slam(sequence.camera, config)
        tally = _Tally()
        interrupted = False
        refinements: list[Refinement] = []
        try:
            _process_all(slam, sequence, given, tally, progress, patience)
            if calibrate:
                calibrated, found = calibrate_camera(slam, sequence, config.refinement)
                refinements.append(found)
                if found.recalibrated:
                    again = build_slam(calibrated.camera, config)
                    _process_all(again, calibrated, None, _Tally(), progress, patience)
                    slam, sequence = again, calibrated  # together: an interrupted second run leaves the first
            if refine:
                poses_alone = replace(config.refinement, calibrate_intrinsics=False, calibrate_depth=False)
                refinements.append(slam.refine(sequence.camera, poses_alone))
        except KeyboardInterrupt:
            if not any(result.state in POSED for result in slam.results):
                raise  # there is nothing to keep
            interrupted = True
            tally.warn(f"interrupted after {len(slam.results)} of {len(sequence)} frames")
        tracked = any(result.state in POSED for result in slam.results)
        if not tracked or len(slam.map) == 0:  # frames at given poses need no surfaces
            why = explain_unusable_depth(tally.median_depth_m, sequence.depth_scale, (0.0, config.surfaces.max_depth_m))
            raise DatasetError(f"{sequence.name}: no frame has usable depth, the map is empty; {why}")
        metrics, error = summarise(slam, sequence.ground_truth, tally.num_points_input)
        metrics["seconds_total"] = time.perf_counter() - started
        summary = RunSummary(out, metrics, tuple(slam.main_results), slam.map, interrupted, tuple(refinements))
        if out is not None:
            with write_folder(out, force=force) as aside:
                write_run(
                    aside, slam, sequence, config, metrics, error,
                    tracked_only=tracked_only,
                    description={
                        **(description or {}),
                        "warnings": [*(description or {}).get("warnings", ()), *tally.warnings],
                        "interrupted": interrupted,
                        **({"calibrated": isinstance(sequence, CalibratedSequence)} if calibrate else {}),
                        **({"refinements": described(refinements)} if refinements else {}),
                    },
                    started=started,
                )  # fmt: skip
        return summary


def _process_all(
    slam: Slam,
    sequence: RgbdSequence,
    given: list[Float64 | None] | None,
    tally: _Tally,
    progress: Progress | None,
    patience: Patience,
) -> None:
    gyroscope = gyroscope_of(sequence)
    turned = [None] * len(sequence) if gyroscope is None else gyroscope.orientations(sequence.timestamps_s)
    # Two frames ahead: a prepared one of 640x480 holds 20 MB.
    with contextlib.closing(stream(sequence, 2, prepare=slam.prepare)) as records:
        for record in records:
            pose = given[record.index] if given is not None else None
            if record.frame is None:
                tally.warn(f"frame {record.index} is skipped: {record.error}")
                result = slam.skip(record.timestamp_s, record.error)
            elif given is not None and pose is None:
                result = slam.skip(record.timestamp_s, "no given pose")
            else:
                depth = record.frame.depth_m
                tally.num_points_input += int(np.count_nonzero(depth))
                if record.index < UNIT_CHECK_FRAMES and not tally.unit_doubted and depth.any():
                    tally.median_depth_m = float(np.median(depth[depth > 0]))
                    advice = check_depth_unit(tally.median_depth_m, sequence.depth_scale)
                    if advice:
                        tally.unit_doubted = True
                        tally.warn(advice)
                result = slam.process(
                    record.frame, pyramid=record.prepared, T_world_camera=pose, orientation=turned[record.index]
                )
            if progress is not None:
                progress(result)
            patience.check()


def _poses_by_frame(sequence: RgbdSequence, poses: Trajectory) -> list[Float64 | None]:
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


def summarise(slam: Slam, truth: Trajectory | None, num_points_input: int) -> tuple[dict[str, Any], AteResult | None]:
    """Return what metrics.json holds, but for seconds_total, and the trajectory error where there is a truth."""
    results = slam.main_results
    apart = slam.unjoined
    states = [result.state for result in results]
    frame_ms = [sum(result.stage_ms.values()) for result in results if result.stage_ms]
    error: AteResult | None = None
    motion: tuple[float | None, float | None] = (None, None)
    if truth is not None:
        try:
            error = ate(slam.trajectory, truth)
            if error.num_pairs > 1:
                relative = rpe(slam.trajectory, truth)
                motion = relative.rmse_trans_m, float(np.degrees(relative.rmse_rot_rad))
        except InvalidInputError as fault:
            logger.warning("not evaluated: %s", fault)
    median_ms = float(np.median(frame_ms)) if frame_ms else None
    return {
        "frames": len(results),
        "frames_tracked": sum(state in POSED for state in states),
        "frames_lost": states.count(FrameState.LOST),
        "frames_unreadable": states.count(FrameState.UNREADABLE),
        "relocalisations": states.count(FrameState.RELOCALISED),
        "loop_closures": slam.loop_closer.num_closures,
        "submaps_joined": slam.atlas.num_joins,
        "submaps_unjoined": len(apart),
        "frames_in_unjoined_submaps": sum(r.state in POSED and r.submap in apart for r in slam.results),
        "ate_rmse_m": error.rmse_m if error else None,
        "ate_max_m": error.max_m if error else None,
        "rpe_trans_m": motion[0],
        "rpe_rot_deg": motion[1],
        "path_length_m": slam.trajectory.path_length_m,
        "num_surfels": len(slam.map),
        "num_points_input": num_points_input,
        "compression_ratio": compression_ratio(num_points_input, len(slam.map)) if len(slam.map) else None,
        "ms_per_frame_median": median_ms,
        "fps": 1e3 / median_ms if median_ms else None,
        "peak_rss_mb": peak_rss_mb(),
    }, error


def peak_rss_mb() -> float | None:
    """Largest resident memory of this process so far [MB]; None where the platform does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3
