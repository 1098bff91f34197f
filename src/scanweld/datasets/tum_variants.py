"""Benchmarks in the layout of TUM RGB-D that bring other cameras: Bonn RGB-D Dynamic and ETH3D SLAM.

Both hold lists of timestamped files as :mod:`scanweld.datasets.tum` describes, and depth of 16 bits, 5000 = 1 m.

**Bonn** (`rgbd_bonn_*`): rgb.txt, depth.txt, groundtruth.txt. The camera is 542.822841 542.576870 315.593520 237.756098
at 640x480. Its groundtruth.txt is that of the markers on the camera, in axes of the motion capture system: positions
are within 2 cm of the camera's, rotations differ by a constant one. Evaluate with it; do not fuse at its poses.

**ETH3D**: the same files and calibration.txt, one line `fx fy cx cy`; associated.txt pairs `time rgb time depth`.
Images are rectified, depth is registered to the colour camera, and groundtruth.txt is that of this camera. Sequences
of the benchmark's test part have none.
"""

from __future__ import annotations

import logging
from pathlib import Path

from scanweld.datasets.base import FileSequence
from scanweld.datasets.intrinsics import Intrinsics, Overrides, read_text
from scanweld.datasets.tum import DEFAULT_INTRINSICS, is_tum, open_listed
from scanweld.errors import DatasetError

logger = logging.getLogger(__name__)

BONN_INTRINSICS = (542.822841, 542.576870, 315.593520, 237.756098)
CALIBRATION_FILE = "calibration.txt"


def is_bonn(folder: Path) -> bool:
    """Whether the folder has TUM's lists and the name of a Bonn sequence."""
    return is_tum(folder) and "rgbd_bonn" in folder.resolve().name.lower()


def open_bonn(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence of Bonn RGB-D Dynamic; raises DatasetError when it cannot be used."""
    sequence = open_listed(folder, overrides, BONN_INTRINSICS)
    if sequence.ground_truth is not None:
        logger.warning(
            "%s: the true poses are those of the markers on the camera: evaluate with them, do not fuse at them", folder
        )
    return sequence


def is_eth3d(folder: Path) -> bool:
    """Whether the folder has TUM's lists and calibration.txt."""
    return is_tum(folder) and (folder / CALIBRATION_FILE).is_file()


def open_eth3d(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence of ETH3D SLAM; raises DatasetError when it cannot be used."""
    calibration = read_calibration(folder / CALIBRATION_FILE)
    return open_listed(folder, overrides, DEFAULT_INTRINSICS, intrinsics_file=calibration)


def read_calibration(path: Path) -> Intrinsics:
    """Read ETH3D's calibration.txt, `fx fy cx cy`.

    Raises
    ------
    DatasetError
        When it does not hold four numbers.
    """
    words = read_text(path).split()
    try:
        fx, fy, cx, cy = (float(word) for word in words)
    except ValueError:
        raise DatasetError(f"{path}: expected four numbers, fx fy cx cy, got '{' '.join(words)[:60]}'") from None
    return fx, fy, cx, cy
