"""A finished run opened again: its sequence, and where each frame was."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanweld.arrays import Bool, Float64, Int64
from scanweld.config import from_mapping
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.synthetic import RenderConfig, SyntheticSequence
from scanweld.errors import DatasetError, FileFormatError
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.trajectory_files import read_trajectory
from scanweld.refinement.calibration import DepthCorrection
from scanweld.report.run_files import FrameTable, check_run_folder, poses_of_frames, read_frames, read_json
from scanweld.runs.calibrated import CalibratedSequence
from scanweld.runs.folder import MARK
from scanweld.runs.input import RunInput
from scanweld.runs.storage.urls import is_url
from scanweld.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class PosedFrames:
    """The frames of a run whose pose was measured, in the world of its map.

    Attributes
    ----------
    rows : (N,) their numbers in the run
    T_world_camera : (N, 4, 4)
    """

    rows: Int64
    T_world_camera: Float64

    def select(self, chosen: Bool | Int64) -> PosedFrames:
        """Return the chosen ones, a mask or indices."""
        return PosedFrames(self.rows[chosen], self.T_world_camera[chosen])


def read_description(folder: Path) -> Mapping[str, Any]:
    """Return what run.json of a run folder holds.

    Raises
    ------
    FileFormatError
        When the folder is no run folder.
    """
    check_run_folder(folder, [MARK])
    return read_json(folder / MARK)


def posed_frames(folder: Path) -> PosedFrames:
    """Return where the frames of a run were.

    Raises
    ------
    FileFormatError
        When frames.csv or trajectory.txt cannot be read.
    """
    frames: FrameTable = read_frames(folder / "frames.csv")
    poses, known = poses_of_frames(frames, read_trajectory(folder / "trajectory.txt", "tum"))
    kept = frames.posed & known
    return PosedFrames(frames.number[kept], poses[kept])


def reopen_sequence(run: Mapping[str, Any]) -> RgbdSequence:
    """Open the sequence of a run as it was opened for the run, calibrated if it was.

    Parameters
    ----------
    run : what run.json holds

    Raises
    ------
    DatasetError
        When the sequence is not there any more, or is another one by now.
    FileFormatError
        When what run.json says of a calibration is not readable.
    """
    sequence = reopen_input(run)
    found = run.get("refinements")
    if run.get("calibrated") and found:
        try:
            camera, offset = PinholeCamera(**found[0]["intrinsics"]), float(found[0]["inverse_depth_offset_per_m"])
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"{MARK}: the calibration of the run is not readable: {error}") from None
        return CalibratedSequence(sequence, camera, DepthCorrection(offset))
    return sequence


def reopen_input(run: Mapping[str, Any], *, fetch: bool = False) -> RgbdSequence:
    """Open the sequence of a run as the run began with it; parameters and errors as in :func:`reopen_sequence`.

    One behind a URL is fetched only with `fetch`: who looks at a run folder of somebody else asks no server for that.
    """
    if isinstance(run.get("render"), Mapping):  # a demo renders its sequence, and keeps what it rendered
        return SyntheticSequence(from_mapping(RenderConfig, run["render"], MARK))
    place = str(run.get("input") or "")
    if is_url(place) and not fetch:
        raise DatasetError(f"the sequence of the run is not on this machine: {place}")
    if not is_url(place) and not os.path.exists(place):  # in contrast to Path's, at a loss for no name
        raise DatasetError(f"the sequence of the run is not there any more: {place or 'it has no path'}")
    return RunInput.of_run(run).open()


def given_poses(sequence: RgbdSequence, source: str) -> Trajectory:
    """Return the true poses of a sequence, where `source` is "truth", or those of a file.

    Raises
    ------
    DatasetError
        When the sequence has no true poses.
    FileFormatError
        When the file is no trajectory.
    """
    if source != "truth":
        return read_trajectory(source)
    if sequence.ground_truth is None:
        raise DatasetError(f"{sequence.name}: has no ground truth; --poses FILE takes a trajectory file")
    return sequence.ground_truth
