"""7-Scenes layout: three files a frame, side by side.

    frame-000000.color.png (or .jpg)   frame-000000.depth.png   frame-000000.pose.txt
    intrinsics.K.txt or camera-intrinsics.txt    optional, a 3x3 matrix;   camera.json    optional, wins

Depth: 16 bits, 1000 = 1 m, 65535 and 0 invalid. A pose is a 4x4 T_world_camera [m]; one that is not finite
means that the recorder had lost the camera, and the frame has no ground truth. Numbers may have gaps; frame
n is at n / 30 s. Without an intrinsics file they are 585 585 320 240 at 640x480.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from scanweld.datasets.base import FileSequence
from scanweld.datasets.intrinsics import Overrides, read_intrinsics_matrix
from scanweld.datasets.layout import FRAMES_PER_SECOND, build_sequence, first_existing, pair_by_number
from scanweld.io.trajectory_files import read_pose
from scanweld.trajectory import Trajectory

logger = logging.getLogger(__name__)

INTRINSICS = (585.0, 585.0, 320.0, 240.0)
_NAME = re.compile(r"frame-(\d{1,15})\.(color|depth|pose)\.(png|jpg|jpeg|txt)")


def is_seven_scenes(folder: Path) -> bool:
    """Whether the folder has a file named as this format's images."""
    return bool(frame_files(folder, "depth") or frame_files(folder, "color"))


def open_seven_scenes(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence in the 7-Scenes layout; raises DatasetError when it cannot be used."""
    pairs = pair_by_number(folder, frame_files(folder, "depth"), frame_files(folder, "color"))
    matrix = first_existing(folder, ("intrinsics.K.txt", "camera-intrinsics.txt"))
    return build_sequence(
        folder,
        list(pairs.values()),
        overrides=overrides,
        intrinsics=INTRINSICS,
        default_depth_scale=1000,
        intrinsics_file=None if matrix is None else read_intrinsics_matrix(matrix),
        ground_truth=frame_poses(folder),
    )


def frame_files(folder: Path, kind: str) -> dict[int, Path]:
    """Return the files of a kind, "color", "depth" or "pose", by number, ascending."""
    found = {}
    for path in folder.iterdir():
        match = _NAME.fullmatch(path.name)
        if match and match[2] == kind:
            found[int(match[1])] = path
    return dict(sorted(found.items()))


def frame_poses(folder: Path) -> Trajectory | None:
    """Return the finite poses, frame n at n / 30 s, or None without any; raises FileFormatError for a damaged one."""
    poses = {number: read_pose(path) for number, path in frame_files(folder, "pose").items()}
    known = {number: pose for number, pose in poses.items() if pose is not None}
    if len(known) < len(poses):
        logger.warning(
            "%s: %d of %d true poses are not finite and left out", folder, len(poses) - len(known), len(poses)
        )
    if not known:
        return None
    return Trajectory(np.array(list(known)) / FRAMES_PER_SECOND, np.stack(list(known.values())))
