"""Record3D: `.r3d`, a ZIP archive, or a folder that holds the same files.

    metadata         JSON: w, h (colour), K (for colour, 9 numbers, column by column), poses, fps, perhaps dw, dh
                     (depth), frameTimestamps [s], perFrameIntrinsicCoeffs (fx, fy, cx, cy of each frame)
    rgbd/0.jpg       colour
    rgbd/0.depth     float32 [m], NaN where there is none, row by row, compressed by LZFSE (extra `record3d`)
    rgbd/0.conf      uint8, 0 low to 2 high, likewise; optional

Colour is larger than depth (960x720 and 256x192) and of the same field of view: **colour is made as small as the
depth**, and the intrinsics follow. Depth of low confidence (0) is invalid. One camera serves all frames, K; where the
focal length of single frames departs from it by more than 1 %, a warning says so.

A pose is qx qy qz qw tx ty tz, T_world_camera of ARKit's camera: x right, y up, z **backward**, in a world with y up.
Here it becomes T = T_file diag(1, -1, -1, 1), of a camera with x right, y down, z forward; the world stays.
"""

from __future__ import annotations

import logging
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.datasets.color_registration import ColorToDepth
from scanweld.datasets.images import MAX_PIXELS, decode_color, valid_depth
from scanweld.datasets.intrinsics import (
    MAX_TEXT_BYTES,
    Intrinsics,
    Overrides,
    make_camera,
    parse_json,
    require_number,
    resized_intrinsics,
)
from scanweld.datasets.layout import settle_camera, settle_depth_scale
from scanweld.datasets.lzfse import decompress_lzfse
from scanweld.datasets.recorded import (
    RecordedSequence,
    known_poses,
    require_a_readable_frame,
    require_rate,
    times_or_rate,
)
from scanweld.errors import DatasetError, UnreadableFrameError
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera

logger = logging.getLogger(__name__)

MIN_CONFIDENCE = 1
"""Least confidence of depth that is used: 0 is low, 1 medium, 2 high."""

MAX_FOCAL_CHANGE = 0.01
"""Largest share by which the focal length of a frame may depart from K without a warning."""

_METADATA = "metadata"
_FRAME = re.compile(r"rgbd/(\d{1,9})\.(jpg|depth|conf)")
_FROM_ARKIT = np.diag([1.0, -1.0, -1.0, 1.0])
_ZIP_FAULTS = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, NotImplementedError, ValueError)


def recording(path: Path) -> Path | None:
    """Return the `.r3d` file that `path` is, or the only one in the folder, or the folder it was unpacked to."""
    if path.is_file():
        return path if path.suffix.lower() == ".r3d" else None
    if (path / _METADATA).is_file() and (path / "rgbd").is_dir():
        return path
    found = [file for file in path.glob("*.r3d") if file.is_file()]
    return found[0] if len(found) == 1 else None


def is_record3d(path: Path) -> bool:
    """Whether this is an `.r3d` file, a folder with one, or one unpacked."""
    return recording(path) is not None


def open_record3d(path: Path, overrides: Overrides) -> RecordedSequence:
    """Open a recording of Record3D.

    Raises
    ------
    DatasetError
        When it cannot be used.
    MissingDependencyError
        When pyliblzfse is not installed: pip install 'scanweld[record3d]'.
    """
    place = recording(path)
    if place is None:
        raise DatasetError(f"{path}: expected an .r3d file, or the folder that one was unpacked to")
    files = _Folder(place) if place.is_dir() else _Archive(place)
    where = f"{place}: {_METADATA}"
    values = parse_json(files.read(_METADATA, MAX_TEXT_BYTES), where)
    width, height = _size(values, ("w", "h"), where)
    numbers = sorted(files.numbers["depth"])
    if not numbers:
        raise DatasetError(f"{place}: the sequence is empty, no rgbd/0.depth was found")
    depth_size = _depth_size(values, where)
    color_camera = make_camera(_intrinsics(values, where), width, height, where)
    scaled = resized_intrinsics(_intrinsics(values, where), (width, height), depth_size)
    camera = settle_camera(place, depth_size, None, overrides, intrinsics=None, intrinsics_file=scaled)
    rate_hz = require_rate(values.get("fps", 30), f"{where}: 'fps'")
    times_s, poses = _times_and_poses(values, numbers, rate_hz, where)
    registration = ColorToDepth(color_camera, PinholeCamera(*scaled, *depth_size)) if files.numbers["jpg"] else None
    scale = settle_depth_scale(place, 1.0, None, overrides)
    return require_a_readable_frame(
        RecordedSequence(
            name=place.stem if place.is_file() else place.resolve().name,
            camera=camera,
            timestamps_s=times_s,
            frame_source=_Record3DFrames(files, numbers, camera.shape, scale, registration),
            depth_scale=scale,
            ground_truth=None if poses is None else known_poses(times_s, poses, where),
        )
    )


class _Archive:
    """The files of a ZIP archive, by name; nothing is unpacked to disk, so names cannot lead anywhere."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path)
            self._entries = {entry.filename: entry for entry in self._zip.infolist()}
        except _ZIP_FAULTS as error:
            raise DatasetError(f"{path}: no readable .r3d file (a ZIP archive): {error}; truncated?") from None
        self.numbers = _numbers(self._entries)

    def read(self, name: str, max_bytes: int) -> bytes:
        """Return the content of a file; its size in the archive is checked first, and holds the decompressor."""
        entry = self._entries.get(name)
        if entry is None:
            raise UnreadableFrameError(f"{self.path}: has no {name}")
        if entry.file_size > max_bytes:
            raise UnreadableFrameError(f"{self.path}: {name} claims {entry.file_size} bytes, at most {max_bytes} fit")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # LZMA takes what memory it claims
            raise UnreadableFrameError(f"{self.path}: {name} is neither stored nor deflated")
        try:
            return self._zip.read(entry)
        except _ZIP_FAULTS as error:
            raise UnreadableFrameError(f"{self.path}: {name} cannot be read: {error}") from None


class _Folder:
    """The files of an unpacked archive."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.numbers = _numbers([f"rgbd/{file.name}" for file in (path / "rgbd").iterdir()])

    def read(self, name: str, max_bytes: int) -> bytes:
        """Return the content of a file."""
        try:
            with (self.path / name).open("rb") as stream:
                data = stream.read(max_bytes + 1)
        except OSError as error:
            raise UnreadableFrameError(f"{self.path / name}: {error.strerror or error}") from None
        if len(data) > max_bytes:
            raise UnreadableFrameError(f"{self.path / name}: larger than the {max_bytes} bytes that fit")
        return data


class _Record3DFrames:
    """Read frame i of a recording."""

    def __init__(
        self,
        files: _Archive | _Folder,
        numbers: list[int],
        shape: tuple[int, int],
        depth_scale: float,
        registration: ColorToDepth | None,
    ) -> None:
        self._files, self._numbers, self._shape = files, numbers, shape
        self._depth_scale, self._registration = depth_scale, registration

    def __call__(self, index: int) -> tuple[Float32, UInt8 | None]:
        number, files = self._numbers[index], self._files
        height, width = self._shape
        data = _plane(files, f"rgbd/{number}.depth", 4 * height * width)
        depth_m = valid_depth(np.frombuffer(data, "<f4").reshape(self._shape) / np.float32(self._depth_scale))
        if number in files.numbers["conf"]:
            confidence = np.frombuffer(_plane(files, f"rgbd/{number}.conf", height * width), np.uint8)
            depth_m[confidence.reshape(self._shape) < MIN_CONFIDENCE] = 0
        if self._registration is None or number not in files.numbers["jpg"]:
            return depth_m, None
        shape = self._registration.color_shape
        name = f"rgbd/{number}.jpg"
        color = decode_color(files.read(name, 65536 + 4 * shape[0] * shape[1]), f"{files.path}: {name}", shape)
        return depth_m, self._registration(color, depth_m)


def _plane(files: _Archive | _Folder, name: str, num_bytes: int) -> bytes:
    return decompress_lzfse(files.read(name, 4096 + 2 * num_bytes), num_bytes, f"{files.path}: {name}")


def _numbers(names: Any) -> dict[str, set[int]]:
    found: dict[str, set[int]] = {"jpg": set(), "depth": set(), "conf": set()}
    for name in names:
        match = _FRAME.fullmatch(name)
        if match and str(int(match[1])) == match[1]:
            found[match[2]].add(int(match[1]))
    return found


def _size(values: dict[str, Any], keys: tuple[str, str], where: str) -> tuple[int, int]:
    width, height = (require_number(where, values, key) for key in keys)
    if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS):
        raise DatasetError(f"{where}: says that images have {width:g}x{height:g} pixels")
    return int(width), int(height)


def _depth_size(values: dict[str, Any], where: str) -> tuple[int, int]:
    """Width and height of the depth images: dw and dh; recordings from before these were written have 256x192."""
    if "dw" in values or "dh" in values:
        return _size(values, ("dw", "dh"), where)
    width, height = _size(values, ("w", "h"), where)
    return (192, 256) if width < height else (256, 192)


def _intrinsics(values: dict[str, Any], where: str) -> Intrinsics:
    K = _table(values, "K", (9,), where)
    if K is None:
        raise DatasetError(f"{where}: 'K' is missing, expected 9 numbers, the camera matrix column by column")
    fx, fy, cx, cy = (float(K[k]) for k in (0, 4, 6, 7))
    single = _table(values, "perFrameIntrinsicCoeffs", (-1, 4), where)
    if single is not None and len(single) and fx > 0:
        with np.errstate(over="ignore"):
            change = float(np.abs(single[:, 0] / fx - 1).max())
        if change > MAX_FOCAL_CHANGE:
            logger.warning(
                "%s: focal lengths differ from K by up to %.1f %%; K is used for all frames", where, 100 * change
            )
    return fx, fy, cx, cy


def _times_and_poses(
    values: dict[str, Any], numbers: list[int], rate_hz: float, where: str
) -> tuple[Float64, Float64 | None]:
    """Times (N,) [s] and T_world_camera (N, 4, 4) of the frames with these numbers."""
    times = np.array(numbers) / rate_hz
    recorded = _table(values, "frameTimestamps", (-1,), where)
    if recorded is not None and len(recorded):
        times = times_or_rate(_of_frames(recorded, numbers, "frameTimestamps", where), rate_hz, where)
    table = _table(values, "poses", (-1, 7), where)
    if table is None:
        return times, None
    table = _of_frames(table, numbers, "poses", where)
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(table[:, :4], axis=1)
    if not (np.abs(norms - 1) < 1e-2).all():
        raise DatasetError(f"{where}: 'poses' must begin with unit quaternions, got a norm of {norms.min():.3g}")
    return times, se3.from_quaternion_xyzw(table[:, :4], table[:, 4:]) @ _FROM_ARKIT


def _of_frames(rows: Float64, numbers: list[int], key: str, where: str) -> Float64:
    if len(rows) <= numbers[-1]:
        raise DatasetError(f"{where}: '{key}' has {len(rows)} entries, but there is a frame {numbers[-1]}")
    return rows[numbers]


def _table(values: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> Float64 | None:
    """Numbers of the given shape, -1 standing for any length; None where the key is absent."""
    if values.get(key) is None:
        return None
    try:
        table = np.array(values[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        table = np.full((), np.nan)
    if table.size == 0 and shape[0] == -1:
        table = table.reshape(0, *shape[1:])
    fits = table.ndim == len(shape) and all(want in (-1, got) for want, got in zip(shape, table.shape, strict=True))
    if not fits or not np.isfinite(table).all():
        expected = " x ".join("N" if want < 0 else str(want) for want in shape)
        raise DatasetError(f"{where}: '{key}' must be {expected} numbers")
    return table
