"""Replica as rendered for NICE-SLAM.

    results/frame000000.jpg, results/depth000000.png    one of each a frame
    traj.txt                                            a T_world_camera a line, 16 numbers, row by row [m]
    cam_params.json, here or one folder up              {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}

Depth: 16 bits, `scale` units per metre (6553.5). Poses are of a camera with x right, y down, z forward; line n belongs
to frame n, at n / 30 s. Without cam_params.json the camera is 600 600 599.5 339.5 at 1200x680, as all the published
scenes have. camera.json wins.
"""

from __future__ import annotations

import re
from pathlib import Path

from scanweld.datasets.base import FileSequence
from scanweld.datasets.images import require_depth_scale
from scanweld.datasets.intrinsics import Intrinsics, Overrides, read_json, require_number
from scanweld.datasets.layout import build_sequence, first_existing, pair_by_number
from scanweld.errors import DatasetError
from scanweld.io.trajectory_files import read_trajectory

DEPTH_SCALE = 6553.5
# 600 600 599.5 339.5 at 1200x680, as defaults are given: at 640x480.
INTRINSICS = (320.0, 600 * 480 / 680, 319.5, 239.5)
PARAMETERS = "cam_params.json"

_NAME = re.compile(r"(frame|depth)(\d{1,15})\.(png|jpg|jpeg)")


def is_replica(folder: Path) -> bool:
    """Whether the folder has results/depthNNNNNN.png."""
    return bool(_files(folder, "depth"))


def open_replica(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence in the NICE-SLAM layout of Replica; raises DatasetError when it cannot be used."""
    parameters = first_existing(folder, (PARAMETERS, f"../{PARAMETERS}"))
    intrinsics, scale = (None, DEPTH_SCALE) if parameters is None else _read_parameters(parameters)
    truth = first_existing(folder, ("traj.txt",))
    return build_sequence(
        folder,
        list(pair_by_number(folder, _files(folder, "depth"), _files(folder, "frame")).values()),
        overrides=overrides,
        intrinsics=INTRINSICS,
        default_depth_scale=scale,
        intrinsics_file=intrinsics,
        ground_truth=None if truth is None else read_trajectory(truth, format="kitti"),
    )


def _files(folder: Path, kind: str) -> dict[int, Path]:
    results, found = folder / "results", {}
    for path in results.iterdir() if results.is_dir() else ():
        match = _NAME.fullmatch(path.name)
        if match and match[1] == kind:
            found[int(match[2])] = path
    return dict(sorted(found.items()))


def _read_parameters(path: Path) -> tuple[Intrinsics, float]:
    values = read_json(path).get("camera")
    if not isinstance(values, dict):
        raise DatasetError(f"{path}: expected an object 'camera' with w, h, fx, fy, cx, cy and scale")
    fx, fy, cx, cy, scale = (require_number(path, values, key) for key in ("fx", "fy", "cx", "cy", "scale"))
    return (fx, fy, cx, cy), require_depth_scale(scale, str(path))
