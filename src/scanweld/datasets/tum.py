"""TUM RGB-D layout: lists of timestamped files.

    rgb.txt, depth.txt    `timestamp path` a line; or associations.txt, `timestamp path timestamp path` a line
    groundtruth.txt       `timestamp tx ty tz qx qy qz qw`, T_world_camera, at its own rate
    camera.json           optional, wins

Colour and depth are recorded at different moments. They are paired as the benchmark's associate.py does: the
nearest pairs first, at most 0.02 s apart, each image used once. **The time of a frame is that of its depth
image**, since depth is what is measured with. Depth: 16 bits, 5000 = 1 m. The intrinsics follow from
`freiburg1`, `fr2`, ... in the folder's name; otherwise they are 525 525 319.5 239.5, with a warning.
"""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from scanweld.datasets.base import FileSequence, FrameFiles
from scanweld.datasets.gyroscope import read_gyroscope
from scanweld.datasets.intrinsics import CAMERA_FILE, Intrinsics, Overrides
from scanweld.datasets.layout import build_sequence, first_existing, path_inside
from scanweld.errors import DatasetError
from scanweld.io.timestamps import MAX_TIME_DIFFERENCE_S, associate_times
from scanweld.io.trajectory_files import read_trajectory

logger = logging.getLogger(__name__)

DEPTH_SCALE = 5000.0
DEFAULT_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
INTRINSICS_BY_CAMERA = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}
ASSOCIATION_FILES = ("associations.txt", "associated.txt", "association.txt", "associate.txt")

_CAMERA = re.compile(r"(?:freiburg|(?<![a-z])fr)_?([123])(?!\d)")


def is_tum(folder: Path) -> bool:
    """Whether the folder has the lists of files of this format."""
    return first_existing(folder, ("rgb.txt", "depth.txt", *ASSOCIATION_FILES)) is not None


def open_tum(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence in the TUM RGB-D layout; raises DatasetError when it cannot be used."""
    return open_listed(folder, overrides, _intrinsics(folder, overrides))


def open_listed(
    folder: Path, overrides: Overrides, intrinsics: Intrinsics, *, intrinsics_file: Intrinsics | None = None
) -> FileSequence:
    """Open a sequence in this layout; intrinsics are those of the camera, as for `build_sequence`."""
    truth = first_existing(folder, ("groundtruth.txt",))
    sequence = build_sequence(
        folder,
        listed_frames(folder),
        overrides=overrides,
        intrinsics=intrinsics,
        intrinsics_file=intrinsics_file,
        default_depth_scale=DEPTH_SCALE,
        ground_truth=None if truth is None else read_trajectory(truth, format="tum"),
    )
    return replace(sequence, gyroscope=read_gyroscope(folder))


def _intrinsics(folder: Path, overrides: Overrides) -> Intrinsics:
    match = _CAMERA.search(folder.resolve().name.lower())
    if match:
        return INTRINSICS_BY_CAMERA[match[1]]
    if overrides.camera is None and not (folder / CAMERA_FILE).is_file():
        logger.warning(
            "%s: intrinsics not known, taken as 525,525,319.5,239.5; pass --camera FX,FY,CX,CY or write %s",
            folder,
            CAMERA_FILE,
        )
    return DEFAULT_INTRINSICS


def listed_frames(folder: Path) -> list[FrameFiles]:
    """Return the frames of rgb.txt and depth.txt, or of associations.txt, by time of the depth image.

    Raises
    ------
    DatasetError
        When a list is missing or malformed, its timestamps do not increase, a path leaves the folder, or no
        pair is found.
    """
    associations = first_existing(folder, ASSOCIATION_FILES)
    depth_list, color_list = folder / "depth.txt", folder / "rgb.txt"
    if depth_list.is_file():
        depth = _read_list(depth_list)
        if not color_list.is_file():
            logger.warning("%s: no rgb.txt, the map will have no colour", folder)
            return [FrameFiles(time, path, None) for time, path in depth]
        return _paired(folder, depth, _read_list(color_list))
    if associations is not None:
        return _read_associations(associations)
    raise DatasetError(f"{folder}: rgb.txt without depth.txt; both are needed (or associations.txt)")


def _paired(folder: Path, depth: list[tuple[float, Path]], color: list[tuple[float, Path]]) -> list[FrameFiles]:
    depth_times_s = np.array([time for time, _ in depth])
    color_times_s = np.array([time for time, _ in color])
    pairs = associate_times(depth_times_s, color_times_s)
    if depth and color and not pairs:
        raise DatasetError(
            f"{folder}: no depth image within {MAX_TIME_DIFFERENCE_S} s of a colour image; depth.txt spans "
            f"{depth_times_s[0]:.3f} to {depth_times_s[-1]:.3f} s, rgb.txt {color_times_s[0]:.3f} to "
            f"{color_times_s[-1]:.3f} s; are both in seconds of one clock?",
            fault="time-unit",
        )
    dropped = len(depth) + len(color) - 2 * len(pairs)
    if dropped:
        level = logging.WARNING if dropped > len(pairs) else logging.INFO
        logger.log(
            level,
            "%s: %d frames; %d depth and %d colour images have no partner within %g s and are left out",
            folder,
            len(pairs),
            len(depth) - len(pairs),
            len(color) - len(pairs),
            MAX_TIME_DIFFERENCE_S,
        )
    return [FrameFiles(depth[a][0], depth[a][1], color[b][1]) for a, b in pairs]


def _read_list(path: Path) -> list[tuple[float, Path]]:
    entries: list[tuple[float, Path]] = []
    for number, line in _content(path):
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise DatasetError(f"{path}, line {number}: expected `timestamp path`, got {line[:60]!r}")
        time = _time(path, number, words[0], entries[-1][0] if entries else None)
        entries.append((time, path_inside(path.parent, words[1].strip(), f"{path}, line {number}")))
    return entries


def _read_associations(path: Path) -> list[FrameFiles]:
    frames: list[FrameFiles] = []
    for number, line in _content(path):
        words = line.split()
        if len(words) != 4:
            raise DatasetError(f"{path}, line {number}: expected `timestamp path timestamp path`, got {line[:60]!r}")
        # The benchmark's tool writes colour first, ICL-NUIM depth first: the folder's name tells.
        first, second = (0, 2) if "depth" in words[1].lower() else (2, 0)
        time = _time(path, number, words[first], frames[-1].timestamp_s if frames else None)
        _time(path, number, words[second], None)
        where = f"{path}, line {number}"
        depth, color = (path_inside(path.parent, words[k + 1], where) for k in (first, second))
        frames.append(FrameFiles(time, depth, color))
    return frames


def _content(path: Path) -> list[tuple[int, str]]:
    """Numbered lines that are neither empty nor comments."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from None
    return [(n, line.strip()) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]


def _time(path: Path, number: int, word: str, before_s: float | None) -> float:
    try:
        time = float(word)
    except ValueError:
        time = float("nan")
    if not np.isfinite(time):
        raise DatasetError(f"{path}, line {number}: expected a timestamp [s], got {word[:40]!r}")
    if before_s is not None and time <= before_s:
        what, fix = ("repeats", "remove one of the two") if time == before_s else ("is before", "sort the file")
        message = f"{path}, line {number}: timestamp {time:.6f} {what} {before_s:.6f} above it; {fix}"
        raise DatasetError(message, fault="time-order")
    return time
