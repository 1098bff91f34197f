"""ScanNet and BundleFusion: the binary `.sens` file, version 4.

Little-endian, nothing aligned:

    uint32    version, 4
    uint64 n, n bytes    name of the sensor
    float32[16] x 4      colour intrinsics, colour extrinsics, depth intrinsics, depth extrinsics; 4x4, row by row
    int32     colour compression: 0 raw RGB, 1 PNG, 2 JPEG
    int32     depth compression: 0 raw uint16, 1 zlib of uint16 (2, "occi", is not read)
    uint32 x 4    colour width, colour height, depth width, depth height
    float32   depth shift: units per metre, 1000
    uint64    number of frames, then each:
        float32[16]    T_world_camera of the depth camera [m]; -inf where the recorder had lost it
        uint64 x 2     time of colour and of depth [us]
        uint64 x 2     number of bytes of colour and of depth, then the two
    ...       readings of an inertial sensor, not read

The time of a frame is that of its depth, from the first on; files whose times do not increase, or are no microseconds
(many hold zeros), are taken at 30 frames a second.

Depth is that of the depth camera. Its extrinsics map points of the depth camera to those that the colour intrinsics
project; ScanNet's own files are calibrated, and they are the identity. Colour is mostly larger than depth (1296x968 and
640x480) and is resampled to the pixels of the depth by the two intrinsics
(:class:`~scanweld.datasets.color_registration.ColorToDepth`). The recorded poses become the ground truth: they are
BundleFusion's, not those of a motion capture system.

Only the index is kept in memory; a frame is read from its place in the file.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from scanweld.arrays import Array, Float32, Float64, UInt8
from scanweld.datasets.color_registration import ColorToDepth
from scanweld.datasets.images import MAX_PIXELS, decode_color, depth_from_units, require_depth_scale
from scanweld.datasets.intrinsics import Intrinsics, Overrides, make_camera
from scanweld.datasets.layout import FRAMES_PER_SECOND, settle_camera, settle_depth_scale
from scanweld.datasets.recorded import RecordedSequence, known_poses, require_a_readable_frame, times_or_rate
from scanweld.errors import DatasetError, UnreadableFrameError

VERSION = 4
RAW, PNG, JPEG = 0, 1, 2
RAW_USHORT, ZLIB_USHORT = 0, 1

_MAX_NAME_BYTES = 1 << 16
_MIN_INTERVAL_S, _MAX_INTERVAL_S = 1e-3, 5.0  # between frames of a camera that somebody carries
_CALIBRATION = struct.Struct("<64f2i4IfQ")
_FRAME = struct.Struct("<16f4Q")


@dataclass(frozen=True, slots=True)
class _Header:
    """What stands before the frames."""

    color_intrinsics: Float64  # (4, 4), as the rest
    color_extrinsics: Float64
    depth_intrinsics: Float64
    depth_extrinsics: Float64
    color_compression: int
    depth_compression: int
    color_shape: tuple[int, int]
    depth_shape: tuple[int, int]
    depth_scale: float
    num_frames: int


def sens_file(path: Path) -> Path | None:
    """Return the `.sens` file that `path` is, or the only one in the folder that it is."""
    if path.is_file():
        return path if path.suffix.lower() == ".sens" else None
    found = [file for file in path.glob("*.sens") if file.is_file()]
    return found[0] if len(found) == 1 else None


def is_scannet(path: Path) -> bool:
    """Whether this is a `.sens` file, or a folder with one."""
    return sens_file(path) is not None


def open_scannet(path: Path, overrides: Overrides) -> RecordedSequence:
    """Open a `.sens` file, or the one in a folder; raises DatasetError when it cannot be used."""
    file = sens_file(path)
    if file is None:
        raise DatasetError(f"{path}: expected a .sens file, or a folder with one")
    with file.open("rb") as stream:
        header = _read_header(file, stream)
        offsets, sizes, times_us, poses = _read_index(file, stream, header)
    height, width = header.depth_shape
    camera = settle_camera(
        file, (width, height), None, overrides, intrinsics=None, intrinsics_file=_pinhole(header.depth_intrinsics)
    )
    registration = None
    if header.color_shape[0] and header.color_shape[1] and sizes[:, 0].any():
        color_camera = make_camera(_pinhole(header.color_intrinsics), *header.color_shape[::-1], f"{file}: colour")
        registration = ColorToDepth(color_camera, camera, _color_from_depth(file, header))
    times_s = times_or_rate(_seconds(times_us), FRAMES_PER_SECOND, file)
    scale = settle_depth_scale(file, require_depth_scale(header.depth_scale, str(file)), None, overrides)
    return require_a_readable_frame(
        RecordedSequence(
            name=file.stem,
            camera=camera,
            timestamps_s=times_s,
            frame_source=_SensFrames(file, header, offsets, sizes, scale, registration),
            depth_scale=scale,
            ground_truth=known_poses(times_s, poses, file),
        )
    )


class _SensFrames:
    """Read frame i of a `.sens` file; the file is opened for each, so that any thread may."""

    def __init__(
        self,
        file: Path,
        header: _Header,
        offsets: Array,
        sizes: Array,
        depth_scale: float,
        registration: ColorToDepth | None,
    ) -> None:
        self._file, self._header, self._depth_scale = file, header, depth_scale
        self._offsets, self._sizes, self._registration = offsets, sizes, registration

    def __call__(self, index: int) -> tuple[Float32, UInt8 | None]:
        where = f"{self._file}, frame {index}"
        color_bytes, depth_bytes = (int(size) for size in self._sizes[index])
        try:
            with self._file.open("rb") as stream:
                stream.seek(int(self._offsets[index]))
                color_data, depth_data = stream.read(color_bytes), stream.read(depth_bytes)
        except OSError as error:
            raise UnreadableFrameError(f"{where}: {error.strerror or error}") from None
        if len(depth_data) != depth_bytes:
            raise UnreadableFrameError(f"{where}: the file has become shorter")
        depth_m = depth_from_units(_depth_units(where, depth_data, self._header), self._depth_scale)
        if self._registration is None or not color_data:
            return depth_m, None
        return depth_m, self._registration(_color(where, color_data, self._header), depth_m)


def _read_header(file: Path, stream: BinaryIO) -> _Header:
    size = file.stat().st_size
    start = stream.read(12)
    if len(start) < 12:
        raise DatasetError(f"{file}: no .sens file, it has {len(start)} bytes")
    version, name_bytes = struct.unpack("<IQ", start)
    if version != VERSION:
        raise DatasetError(f"{file}: no .sens file of version {VERSION} (it begins with {version})")
    if name_bytes > min(size, _MAX_NAME_BYTES):
        raise DatasetError(f"{file}: the header claims a sensor name of {name_bytes} bytes; the file is damaged")
    stream.seek(name_bytes, 1)
    rest = stream.read(_CALIBRATION.size)
    if len(rest) < _CALIBRATION.size:
        raise DatasetError(f"{file}: truncated within its header ({size} bytes)")
    values = _CALIBRATION.unpack(rest)
    matrices = np.array(values[:64], dtype=np.float64).reshape(4, 4, 4)
    color_compression, depth_compression, *sizes = values[64:70]
    color_width, color_height, depth_width, depth_height = sizes
    if not 0 < depth_width * depth_height <= MAX_PIXELS or color_width * color_height > MAX_PIXELS:
        raise DatasetError(
            f"{file}: the header claims images of {color_width}x{color_height} (colour) and "
            f"{depth_width}x{depth_height} (depth) pixels"
        )
    if depth_compression not in (RAW_USHORT, ZLIB_USHORT):
        raise DatasetError(f"{file}: depth compression {depth_compression}, expected 0 (raw) or 1 (zlib)")
    if color_compression not in (RAW, PNG, JPEG) and color_width * color_height:
        raise DatasetError(f"{file}: colour compression {color_compression}, expected 0 (raw), 1 (PNG) or 2 (JPEG)")
    return _Header(
        color_intrinsics=matrices[0],
        color_extrinsics=matrices[1],
        depth_intrinsics=matrices[2],
        depth_extrinsics=matrices[3],
        color_compression=color_compression,
        depth_compression=depth_compression,
        color_shape=(color_height, color_width),
        depth_shape=(depth_height, depth_width),
        depth_scale=values[70],
        num_frames=values[71],
    )


def _read_index(file: Path, stream: BinaryIO, header: _Header) -> tuple[Array, Array, Float64, Float64]:
    """Walk over the frames; return where each begins, its sizes (N, 2), its times [us] and its poses."""
    size, position, count = file.stat().st_size, stream.tell(), header.num_frames
    if count > (size - position) // _FRAME.size:
        raise DatasetError(f"{file}: {count} frames do not fit into {size} bytes; truncated, or the header is damaged")
    if count == 0:
        raise DatasetError(f"{file}: the sequence is empty, no frame was recorded")
    offsets, sizes = np.empty(count, np.int64), np.empty((count, 2), np.int64)
    times_us, poses = np.empty(count), np.empty((count, 4, 4))
    for index in range(count):
        data = stream.read(_FRAME.size)
        values = _FRAME.unpack(data) if len(data) == _FRAME.size else None
        position += _FRAME.size
        if values is None or values[18] + values[19] > size - position:
            raise DatasetError(f"{file}: truncated within frame {index} of {count} ({size} bytes)")
        poses[index] = np.reshape(values[:16], (4, 4))
        times_us[index] = values[17] or values[16]
        offsets[index], sizes[index] = position, values[18:20]
        position = stream.seek(values[18] + values[19], 1)
    return offsets, sizes, times_us, poses


def _pinhole(matrix: Float64) -> Intrinsics:
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _color_from_depth(file: Path, header: _Header) -> Float64:
    """T_color_depth; a matrix of zeros, which some recorders write, stands for the identity."""
    known = [np.eye(4) if not matrix.any() else matrix for matrix in (header.color_extrinsics, header.depth_extrinsics)]
    with np.errstate(all="ignore"):  # absurd entries are refused below
        try:
            T = np.linalg.inv(known[0]) @ known[1]
        except np.linalg.LinAlgError:
            T = np.full((4, 4), np.nan)
        defect = np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max()
    if not np.isfinite(T).all() or not defect <= 1e-2:
        raise DatasetError(f"{file}: the extrinsics of colour and depth are no rigid transforms; the file is damaged")
    return np.asarray(T, dtype=np.float64)


def _seconds(times_us: Float64) -> Float64:
    """Times from the first frame on [s]; all 0 where they cannot be microseconds."""
    times_s = (times_us - times_us[0]) * 1e-6
    if len(times_s) > 1 and not _MIN_INTERVAL_S < float(np.median(np.diff(times_s))) < _MAX_INTERVAL_S:
        return np.zeros(len(times_s))
    return np.asarray(times_s, dtype=np.float64)


def _depth_units(where: str, data: bytes, header: _Header) -> Array:
    height, width = header.depth_shape
    wanted = 2 * height * width
    if header.depth_compression == ZLIB_USHORT:
        decoder = zlib.decompressobj()
        try:
            # At most one byte too many is unpacked, whatever the data claims to become.
            data = decoder.decompress(data, wanted + 1)
        except zlib.error as error:
            raise UnreadableFrameError(f"{where}: the depth cannot be decompressed ({error})") from None
        if not decoder.eof and len(data) == wanted:
            data = b""  # the checksum at the end is missing
    if len(data) != wanted:
        raise UnreadableFrameError(f"{where}: expected {width}x{height} depth values of 16 bits; the data is damaged")
    return np.frombuffer(data, dtype="<u2").reshape(height, width)


def _color(where: str, data: bytes, header: _Header) -> UInt8:
    height, width = header.color_shape
    if header.color_compression != RAW:
        return decode_color(data, f"{where}, colour", header.color_shape)
    if len(data) != 3 * height * width:
        raise UnreadableFrameError(f"{where}: expected {3 * height * width} bytes of colour, got {len(data)}")
    return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3).copy()
