"""Redwood layout: numbered images in two folders.

    image/ or color/ (also rgb/)   00000.jpg, 00001.jpg, ... or PNG; from 0 or 1, any number of digits
    depth/                         00000.png, ...: 16 bits, 1000 = 1 m
    groundtruth.txt                TUM format; or trajectory.log or one other *.log, Redwood format, also .gz
    camera.json                    optional

Frames are taken at 30 a second. Without camera.json the intrinsics are 525 525 319.5 239.5 at 640x480.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scanweld.datasets.base import FileSequence, FrameFiles
from scanweld.datasets.intrinsics import Overrides
from scanweld.datasets.layout import (
    COLOR_SUFFIXES,
    FRAMES_PER_SECOND,
    build_sequence,
    first_existing,
    numbered_files,
    pair_by_number,
)
from scanweld.errors import FileFormatError
from scanweld.io.trajectory_files import read_trajectory
from scanweld.trajectory import Trajectory

logger = logging.getLogger(__name__)

COLOR_FOLDERS = ("image", "color", "rgb", "colour", "images")
INTRINSICS = (525.0, 525.0, 319.5, 239.5)


def is_redwood(folder: Path) -> bool:
    """Whether the folder has depth/ or one of the colour folders with numbered images."""
    names = ("depth", *COLOR_FOLDERS)
    return any(numbered_files(folder / name, COLOR_SUFFIXES) for name in names)


def empty_image_folders(folder: Path) -> list[str]:
    """Return the depth and colour folders of a sequence, as "depth/", if none of them has any image."""
    names = [name for name in ("depth", *COLOR_FOLDERS) if (folder / name).is_dir()]
    images = any(path.suffix.lower() in COLOR_SUFFIXES for name in names for path in (folder / name).iterdir())
    return [] if images else [f"{name}/" for name in names]


def open_redwood(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence in the Redwood layout; raises DatasetError when it cannot be used."""
    color_folder = first_existing(folder, COLOR_FOLDERS)
    color = {} if color_folder is None else numbered_files(color_folder, COLOR_SUFFIXES)
    depth = numbered_files(folder / "depth", (".png",))
    pairs = pair_by_number(folder, depth, color)
    # Numbering from 1 is a matter of taste; a sequence that begins later is a part of a longer one.
    first = 1 if min(pairs) == 1 else 0
    frames = [replace(files, timestamp_s=(number - first) / FRAMES_PER_SECOND) for number, files in pairs.items()]
    return build_sequence(
        folder,
        frames,
        overrides=overrides,
        intrinsics=INTRINSICS,
        default_depth_scale=1000,
        ground_truth=_ground_truth(folder, frames),
    )


def _ground_truth(folder: Path, frames: Sequence[FrameFiles]) -> Trajectory | None:
    known = first_existing(folder, ("groundtruth.txt", "trajectory.log", "trajectory.log.gz"))
    if known is not None:
        truth = read_trajectory(known)
    else:
        logs = [*folder.glob("*.log"), *folder.glob("*.log.gz")]
        if len(logs) != 1:
            return None
        known = logs[0]
        try:
            truth = read_trajectory(known, format="redwood")
        except FileFormatError as error:
            logger.warning("no ground truth: %s", error)
            return None
    if known.name != "groundtruth.txt" and len(truth) == len(frames):
        # A log has a pose for each frame but no times; the numbering of the frames may have gaps.
        return Trajectory(np.array([files.timestamp_s for files in frames]), truth.T_world_camera)
    return truth
