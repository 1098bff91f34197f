"""Stray Scanner: the folder that the app exports.

    rgb.mp4                 colour, 1920x1440
    depth/000000.png        16 bits, mm, 256x192; one for each frame of the video
    confidence/000000.png   8 bits, 0 low to 2 high; optional
    camera_matrix.csv       3x3, for the colour images
    odometry.csv            timestamp, frame, x, y, z, qx, qy, qz, qw, with a header line
    imu.csv                 not read
    camera.json             optional, wins; it describes the depth images

**Colour is made as small as the depth**, which has the same field of view; the intrinsics follow. Depth of low
confidence (0) is invalid. Image n, frame n of the video and the line of odometry.csv whose `frame` is n belong
together; frames without a line are left out. A pose is T_world_camera [m] of a camera with x right, y down, z forward,
in ARKit's world with y up. The video is decoded in order; going back seeks.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.datasets.images import decode_uint8_png, depth_from_units, read_file
from scanweld.datasets.intrinsics import (
    Overrides,
    read_camera_file,
    read_intrinsics_matrix,
    read_text,
    resized_intrinsics,
)
from scanweld.datasets.layout import numbered_files, settle_camera, settle_depth_scale
from scanweld.datasets.recorded import RecordedSequence, known_poses, require_a_readable_frame
from scanweld.datasets.video_frames import VideoFrames
from scanweld.datasets.video_pair import color_frames, image_size, read_units
from scanweld.errors import DatasetError
from scanweld.geometry import se3

logger = logging.getLogger(__name__)

DEPTH_SCALE = 1000.0
MIN_CONFIDENCE = 1
"""Least confidence of depth that is used: 0 is low, 1 medium, 2 high."""

_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")


def is_stray_scanner(folder: Path) -> bool:
    """Whether the folder has rgb.mp4, odometry.csv and depth/."""
    return (folder / "rgb.mp4").is_file() and (folder / "odometry.csv").is_file() and (folder / "depth").is_dir()


def open_stray_scanner(folder: Path, overrides: Overrides) -> RecordedSequence:
    """Open a recording of Stray Scanner; raises DatasetError when it cannot be used."""
    depth = numbered_files(folder / "depth", (".png",))
    if not depth:
        raise DatasetError(f"{folder}: the sequence is empty, depth/ has no numbered image")
    table = _read_odometry(folder / "odometry.csv")
    rows = {int(number): row for row, number in enumerate(table[:, 1])}
    numbers = [number for number in depth if number in rows]
    if not numbers:
        raise DatasetError(f"{folder}: no depth image has the number of a line of odometry.csv")
    if len(numbers) < max(len(depth), len(table)):
        logger.warning(
            "%s: %d depth images, %d lines of odometry.csv; those without a partner are left out",
            folder, len(depth), len(table),
        )  # fmt: skip
    chosen = table[[rows[number] for number in numbers]]
    width, height = image_size(folder / "depth", [depth[number] for number in numbers])
    color = color_frames(folder / "rgb.mp4", (height, width))
    given = read_camera_file(folder)
    intrinsics = read_intrinsics_matrix(folder / "camera_matrix.csv")
    camera = settle_camera(
        folder,
        (width, height),
        given,
        overrides,
        intrinsics=None,
        intrinsics_file=resized_intrinsics(intrinsics, color.size, (width, height)),
    )
    scale = settle_depth_scale(folder, DEPTH_SCALE, given, overrides)
    poses = se3.from_quaternion_xyzw(chosen[:, 5:], chosen[:, 2:5])
    return require_a_readable_frame(
        RecordedSequence(
            name=folder.resolve().name or "sequence",
            camera=camera,
            timestamps_s=chosen[:, 0],
            frame_source=_StrayFrames(folder, {n: depth[n] for n in numbers}, color, camera.shape, scale),
            depth_scale=scale,
            ground_truth=known_poses(chosen[:, 0], poses, folder / "odometry.csv"),
        )
    )


class _StrayFrames:
    """Read frame i of a recording."""

    def __init__(
        self, folder: Path, depth: dict[int, Path], color: VideoFrames, shape: tuple[int, int], depth_scale: float
    ) -> None:
        self._folder, self._depth, self._numbers = folder, depth, list(depth)
        self._color, self._shape, self._depth_scale = color, shape, depth_scale

    def __call__(self, index: int) -> tuple[Float32, UInt8 | None]:
        number = self._numbers[index]
        file = self._depth[number]
        depth_m = depth_from_units(read_units(file, self._shape), self._depth_scale)
        confidence = self._folder / "confidence" / file.name
        if confidence.is_file():
            depth_m[decode_uint8_png(read_file(confidence), confidence, self._shape) < MIN_CONFIDENCE] = 0
        return depth_m, np.asarray(self._color(number), dtype=np.uint8)


def _read_odometry(path: Path) -> Float64:
    """Return (N, 9): time, frame number, position, quaternion_xyzw, in the order of the frames."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if not set(_COLUMNS) <= set(names):
        raise DatasetError(f"{path}: expected a header line with {', '.join(_COLUMNS)}, got '{','.join(names)[:60]}'")
    places = [names.index(name) for name in _COLUMNS]
    table = np.empty((len(lines) - 1, len(_COLUMNS)))
    for row, line in enumerate(lines[1:]):
        words = line.split(",")
        try:
            table[row] = [float(words[place]) for place in places]
        except (ValueError, IndexError):
            raise DatasetError(f"{path}, line {row + 2}: expected {len(names)} numbers, got '{line[:60]}'") from None
    numbers = table[:, 1]
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.linalg.norm(table[:, 5:], axis=1)
    if not np.isfinite(table).all() or (np.abs(norms - 1) > 1e-2).any():
        raise DatasetError(f"{path}: a value is not finite, or a quaternion has not the norm 1")
    if (numbers != np.round(numbers)).any() or (numbers < 0).any() or len(np.unique(numbers)) < len(numbers):
        raise DatasetError(f"{path}: the numbers of the frames must be whole and different")
    table = table[np.argsort(numbers)]
    later = np.diff(table[:, 0]) > 0
    if not later.all():
        at = int(np.argmin(later)) + 1
        raise DatasetError(f"{path}: time must increase; frame {table[at, 1]:.0f} is at {table[at, 0]:.6f} s")
    return table
