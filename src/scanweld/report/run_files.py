"""Read back what a run folder holds, as plain columns: the report shows the files, not what a program remembers."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Array, Bool, Float64, Int64
from scanweld.config import load_toml
from scanweld.errors import FileFormatError, InvalidInputError
from scanweld.io.ply import read_ply_columns
from scanweld.io.timestamps import associate_times
from scanweld.io.trajectory_files import read_trajectory
from scanweld.trajectory import Trajectory

NEEDED = ("run.json", "metrics.json", "frames.csv", "trajectory.txt", "map.ply")
"""Files without which a folder is no run."""

TRUTH_FILE = "groundtruth.txt"
KEYFRAMES_FILE = "keyframes.csv"

POSED_STATES = ("tracking", "relocalised")
"""States of frames whose pose was measured."""

_STAGE_PREFIX = "ms_"
_LARGEST_NUMBER = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTable:
    """frames.csv as columns, one row a frame.

    Attributes
    ----------
    number : (N,) number of the frame in the run
    timestamp_s : (N,) [s]
    state : "tracking", "lost", "relocalised", "unreadable" or "dropped"
    alignment : the aligner's status in lower case, "" where none ran
    note : why a frame was not plainly tracked, else ""
    rmse_m, inliers, overlap, surfels : (N,)
    stage_ms : (N,) for each stage, in the order of the file [ms]
    submap : (N,) piece of the map that the frame belongs to; zeros where the file does not say
    """

    number: Int64
    timestamp_s: Float64
    state: tuple[str, ...]
    alignment: tuple[str, ...]
    note: tuple[str, ...]
    rmse_m: Float64
    inliers: Float64
    overlap: Float64
    surfels: Float64
    stage_ms: Mapping[str, Float64]
    submap: Int64

    def __len__(self) -> int:
        return len(self.number)

    @property
    def main_submap(self) -> int:
        """The piece of map with the most measured frames: the one that map.ply and trajectory.txt hold."""
        measured = self.submap[np.array([state in POSED_STATES for state in self.state], np.bool_)]
        submaps, counts = np.unique(measured, return_counts=True)
        return int(submaps[np.argmax(counts)]) if len(submaps) else 0

    @property
    def posed(self) -> Bool:
        """Whether each frame's pose was measured in the main submap (N,)."""
        measured = np.array([state in POSED_STATES for state in self.state], np.bool_)
        return np.asarray(measured & (self.submap == self.main_submap))

    @property
    def aligned(self) -> Bool:
        """Whether an alignment ran, so that residual, overlap and inliers mean something (N,)."""
        return np.array([bool(status) for status in self.alignment], np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFiles:
    """A run folder, read.

    Attributes
    ----------
    name : of the sequence, or else of the folder
    frames : see :class:`FrameTable`
    trajectory : what trajectory.txt holds, T_world_camera
    truth : true poses, or None
    surfels : columns of map.ply, by name
    metrics, run : what metrics.json and run.json hold
    config_text, config : config.toml as it is, and its values
    renders : pictures of the map
    keyframes : numbers of the frames that became keyframes; empty where the run does not say
    loops : (K, 2) numbers of the frames that loops tie together
    """

    name: str
    frames: FrameTable
    trajectory: Trajectory
    truth: Trajectory | None
    surfels: Mapping[str, Array]
    metrics: Mapping[str, Any]
    run: Mapping[str, Any]
    config_text: str
    config: Mapping[str, Any]
    renders: tuple[Path, ...]
    keyframes: Int64
    loops: Int64


def check_run_folder(folder: Path, needed: Sequence[str]) -> None:
    """Raise FileFormatError when a folder has not all of the files that a run has."""
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise FileFormatError(f"{folder}: not a run folder (no {missing[0]}); `scanweld slam SEQUENCE` makes one")


def read_run_files(folder: Path, *, truth: Path | None = None) -> RunFiles:
    """Read a run folder.

    Parameters
    ----------
    folder : what `scanweld slam` wrote, with this or an earlier version
    truth : true trajectory to compare with, in place of the one that the run kept

    Raises
    ------
    FileFormatError
        When the folder is no run folder, or one of its files cannot be read.
    """
    check_run_folder(folder, NEEDED)
    run = read_json(folder / "run.json")
    frames = read_frames(folder / "frames.csv")
    if len(frames) == 0:
        raise FileFormatError(f"{folder / 'frames.csv'}: has no frame")
    true_path = truth or folder / TRUTH_FILE
    config_path = folder / "config.toml"
    config_text = config_path.read_text(encoding="utf-8", errors="replace") if config_path.is_file() else ""
    keyframes, loops = read_keyframes(folder / KEYFRAMES_FILE)
    surfels = read_ply_columns(folder / "map.ply")
    if not {"x", "y", "z"} <= surfels.keys():
        raise FileFormatError(f"{folder / 'map.ply'}: the points have no x, y and z, only {', '.join(surfels)}")
    return RunFiles(
        name=str(run.get("name") or Path(str(run.get("input") or "")).name or folder.resolve().name),
        frames=frames,
        trajectory=read_trajectory(folder / "trajectory.txt", "tum"),
        truth=read_trajectory(true_path) if truth or true_path.is_file() else None,
        surfels=surfels,
        metrics=_numbers(read_json(folder / "metrics.json")),
        run=run,
        config_text=config_text,
        config=load_toml(config_path) if config_text else {},
        renders=tuple(sorted((folder / "renders").glob("*.png"))),
        keyframes=keyframes,
        loops=loops,
    )


def read_frames(path: Path) -> FrameTable:
    """Read frames.csv; columns that an earlier version did not write are empty.

    Raises
    ------
    FileFormatError
        When a row has a value that is no number where one must be.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path}: not a readable table: {error}") from None

    def words(name: str) -> tuple[str, ...]:
        return tuple(row.get(name) or "" for row in rows)

    def numbers(name: str) -> Float64:
        try:
            values = np.array([float(row.get(name) or 0) for row in rows], np.float64)
        except ValueError as error:
            raise FileFormatError(f"{path}: column '{name}': {error}") from None
        if not np.isfinite(values).all():
            raise FileFormatError(f"{path}: column '{name}' has a value that is not finite")
        return values

    def integers(name: str) -> Int64:
        values = numbers(name)
        if (np.abs(values) > _LARGEST_NUMBER).any():
            raise FileFormatError(f"{path}: column '{name}' has a value that is no number of frames")
        return values.astype(np.int64)

    stages = [key for key in (rows[0] if rows else ()) if key and key.startswith(_STAGE_PREFIX)]
    return FrameTable(
        number=integers("frame"),
        timestamp_s=numbers("timestamp"),
        state=words("status"),
        alignment=words("alignment"),
        note=words("note"),
        rmse_m=numbers("rmse"),
        inliers=numbers("inliers"),
        overlap=numbers("overlap"),
        surfels=numbers("surfels"),
        stage_ms={stage.removeprefix(_STAGE_PREFIX): numbers(stage) for stage in stages},
        submap=integers("submap"),
    )


def read_keyframes(path: Path) -> tuple[Int64, Int64]:
    """Return the frames that are keyframes, and pairs of frames (K, 2) that loops tie; both empty without a file."""
    if not path.is_file():
        return np.empty(0, np.int64), np.empty((0, 2), np.int64)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [(int(row["frame"]), row.get("loop") or "") for row in csv.DictReader(file)]
        loops = [(frame, int(other)) for frame, others in rows for other in others.split()]
        return np.array([frame for frame, _ in rows], np.int64), np.array(loops, np.int64).reshape(-1, 2)
    except (OSError, UnicodeDecodeError, csv.Error, KeyError, ValueError, TypeError, OverflowError) as error:
        raise FileFormatError(f"{path}: not a list of keyframes: {error}") from None


def read_json(path: Path) -> Mapping[str, Any]:
    """Return the object that a file of JSON holds.

    Raises
    ------
    FileFormatError
        When it is none.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise FileFormatError(f"{path}: not readable JSON: {error}") from None
    if not isinstance(content, dict):
        raise FileFormatError(f"{path}: expected a JSON object, got {type(content).__name__}")
    return content


def poses_of_frames(frames: FrameTable, trajectory: Trajectory) -> tuple[Float64, Bool]:
    """Return T_world_camera (N, 4, 4) of every frame, and whether trajectory.txt has it (N,).

    A frame that was left out of the trajectory gets the pose before it.
    """
    if len(trajectory) == 0:
        raise InvalidInputError("trajectory.txt: has no pose")
    pairs = np.array(associate_times(frames.timestamp_s, trajectory.timestamps_s, 1e-4)).reshape(-1, 2)
    row = np.full(len(frames), -1)
    row[pairs[:, 0].astype(np.intp)] = pairs[:, 1]
    known = row >= 0
    held = np.maximum.accumulate(row)
    first = row[known][0] if known.any() else 0
    return trajectory.T_world_camera[np.where(held < 0, first, held)], known


def _numbers(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Leave out what is no finite number, so that nobody who shows a figure has to ask."""
    return {key: v for key, v in values.items() if isinstance(v, (int, float)) and math.isfinite(v)}
