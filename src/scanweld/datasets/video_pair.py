"""RGB-D video: a colour video, depth as a video or as images, and a description of the camera.

    camera.json               below
    color.mp4 (or rgb.*; .mkv, .avi, .mov, .webm)    any codec that OpenCV's FFmpeg decodes
    depth.mkv (or .avi)       one channel of 16 bits, losslessly coded (FFV1, gray16le); or
    depth/00000.png, ...      one channel of 16 bits, numbered
    timestamps.txt            optional, the time of a frame a line [s]

    {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480, "depth_scale": 1000,
     "fps": 30, "color": "color.mp4", "depth": "depth.mkv"}

Intrinsics and size are those of the depth images; depth_scale is in units per metre, 1000 where it is absent. fps
(default: what the colour video says, else 30), color and depth (names of the files) may be left out.

Depth and colour are registered, of the same field of view, and paired by order: image i belongs to frame i. Colour of
another size is resized to that of the depth. `ffmpeg -i depth/%05d.png -c:v ffv1 -pix_fmt gray16le depth.mkv` makes a
depth video.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Array, Float32, Float64, UInt8
from scanweld.datasets.base import no_readable_frame
from scanweld.datasets.images import (
    decode_uint16_png,
    depth_from_units,
    depth_header_fault,
    read_file,
    read_header,
    resize_color,
)
from scanweld.datasets.intrinsics import CAMERA_FILE, Overrides, read_camera_file, read_json, read_text
from scanweld.datasets.layout import (
    FRAMES_PER_SECOND,
    first_existing,
    numbered_files,
    path_inside,
    settle_camera,
    settle_depth_scale,
)
from scanweld.datasets.recorded import RecordedSequence, require_a_readable_frame, require_rate
from scanweld.datasets.video_frames import VideoFrames
from scanweld.errors import DatasetError, UnreadableFrameError

logger = logging.getLogger(__name__)

DEPTH_SCALE = 1000.0
COLOR_NAMES = tuple(f"{stem}.{suffix}" for stem in ("color", "rgb") for suffix in ("mp4", "mkv", "avi", "mov", "webm"))
DEPTH_NAMES = ("depth.mkv", "depth.avi", "depth")
TIMES_FILE = "timestamps.txt"


def is_video_pair(folder: Path) -> bool:
    """Whether the folder has camera.json, a colour video, and depth as a video or as images."""
    return (
        (folder / CAMERA_FILE).is_file()
        and first_existing(folder, COLOR_NAMES) is not None
        and first_existing(folder, DEPTH_NAMES) is not None
    )


def has_camera_file(folder: Path) -> bool:
    """Whether the folder can be read when the caller says what it is: camera.json may name the videos."""
    return (folder / CAMERA_FILE).is_file()


def open_video_pair(folder: Path, overrides: Overrides) -> RecordedSequence:
    """Open an RGB-D video; raises DatasetError when it cannot be used."""
    description = read_json(folder / CAMERA_FILE)
    color_file = _named(folder, description, "color", COLOR_NAMES)
    depth_file = _named(folder, description, "depth", DEPTH_NAMES)
    depth = _Images(depth_file) if depth_file.is_dir() else _Video(depth_file)
    given = read_camera_file(folder)
    camera = settle_camera(folder, depth.size, given, overrides, intrinsics=None)
    scale = settle_depth_scale(folder, DEPTH_SCALE, given, overrides)
    color = color_frames(color_file, camera.shape)
    num_color, num_depth = color.count(), depth.count()
    if num_color != num_depth:
        logger.warning(
            "%s: %d colour and %d depth images; those without a partner are left out", folder, num_color, num_depth
        )
    times_s = _times(folder, description, color.rate_hz, min(num_color, num_depth))

    def source(index: int) -> tuple[Float32, UInt8 | None]:
        return depth_from_units(depth.units(index), scale), color(index)

    return require_a_readable_frame(
        RecordedSequence(
            name=folder.resolve().name or "sequence",
            camera=camera,
            timestamps_s=times_s,
            frame_source=source,
            depth_scale=scale,
        )
    )


def color_frames(path: Path, shape: tuple[int, int]) -> VideoFrames:
    """Return the frames of a colour video as RGB, resized to `shape` (height, width)."""

    def convert(image: Array) -> Array:
        import cv2

        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise UnreadableFrameError(f"{path}: a frame has shape {image.shape} {image.dtype}, expected colour")
        rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        return rgb if rgb.shape[:2] == shape else resize_color(rgb, shape)

    return VideoFrames(path, convert)


class _Video:
    """A depth video."""

    def __init__(self, path: Path) -> None:
        def convert(image: Array) -> Array:
            height, width = image.shape[:2]
            if image.dtype != np.uint16 or image.size != height * width:
                raise UnreadableFrameError(
                    f"{path}: a frame has shape {image.shape} {image.dtype}, expected one channel of 16 bits "
                    "(FFV1, gray16le)"
                )
            return image.reshape(height, width).copy()

        self._frames = VideoFrames(path, convert, as_stored=True)
        self.size, self.count, self.units = self._frames.size, self._frames.count, self._frames.__call__


class _Images:
    """A folder of depth images."""

    def __init__(self, folder: Path) -> None:
        self._files = list(numbered_files(folder, (".png",)).values())
        self.size = image_size(folder, self._files)

    def count(self) -> int:
        return len(self._files)

    def units(self, index: int) -> Array:
        return read_units(self._files[index], self.size[::-1])


def image_size(folder: Path, files: list[Path]) -> tuple[int, int]:
    """Return width and height of the first intact depth image; raises DatasetError when there is none."""
    fault = "there is none"
    for file in files:
        try:
            header = read_header(file)
        except UnreadableFrameError as error:
            fault = str(error) if fault == "there is none" else fault
            continue
        if depth_header_fault(header):
            raise DatasetError(f"{file}: {depth_header_fault(header)}")
        return header.width, header.height
    raise no_readable_frame(str(folder), len(files), fault)


def read_units(path: Path, shape: tuple[int, int]) -> Array:
    """Return a depth image as it is stored, (H, W) uint16; raises UnreadableFrameError."""
    return decode_uint16_png(read_file(path), path, shape)


def _named(folder: Path, description: dict[str, Any], key: str, names: tuple[str, ...]) -> Path:
    name = description.get(key)
    if name is None:
        found = first_existing(folder, names)
        if found is None:
            raise DatasetError(f"{folder}: has no {key} video, expected one of {', '.join(names)}")
        return found
    if not isinstance(name, str):
        raise DatasetError(f"{folder / CAMERA_FILE}: '{key}' must be the name of a file, got {name!r}")
    path = path_inside(folder, name, f"{folder / CAMERA_FILE}: '{key}'")
    if not path.exists():
        raise DatasetError(f"{path}: no such file; {CAMERA_FILE} names it as '{key}'")
    return path


def _times(folder: Path, description: dict[str, Any], rate_hz: float, count: int) -> Float64:
    file = folder / TIMES_FILE
    if file.is_file():
        try:
            times = np.array([float(word) for word in read_text(file).split()])
        except ValueError:
            raise DatasetError(f"{file}: expected the time of a frame a line [s]") from None
        if len(times) < count:
            raise DatasetError(f"{file}: has {len(times)} times for {count} frames")
        return times[:count]
    usable = np.isfinite(rate_hz) and 1e-3 < rate_hz < 1e5
    stated = description.get("fps", rate_hz if usable else FRAMES_PER_SECOND)
    return np.arange(count) / require_rate(stated, f"{folder / CAMERA_FILE}: 'fps'")
