"""LAS and LAZ files of laser scanners, through laspy (extra `las`).

The format: ASPRS, LAS Specification 1.4 R15.
"""

from __future__ import annotations

import io
import logging
import math
import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scanweld.arrays import Array, Float64
from scanweld.errors import FileFormatError, MissingDependencyError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.atomic import write_file
from scanweld.io.columns import cloud_from_columns, drop_not_finite

logger = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 26
_HEADER_LENGTHS = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}  # by minor version
_RECORD_HEADER = 54  # bytes before each variable length record
_COMPRESSED = 0xC0  # bits of the point format
_LAZ_ITEMS = 34  # where the items (type, bytes, version) of the LAZ record begin
# Layers of the items of LAS 1.4: a point, RGB, RGB and near infrared, a wave packet.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_BYTES = 14  # an item of extra bytes: a layer for each
_PLAIN, _COLORED = 0, 2  # point formats
_LARGEST_INTEGER = 2**31 - 1
_FINEST_SCALE = 1e-6


def read_las(path: str | os.PathLike[str]) -> PointCloud:
    """Read the points of a LAS or LAZ file with their colours.

    Coordinates are integer x scale + offset in float64: nothing is lost at coordinates of a map projection.
    Colours have 16 bits; where none is above 255 they are taken as 8 bits, which many programs write. Points that
    are marked as withheld are left in.

    Raises
    ------
    FileFormatError
        When the file is missing, is no LAS file, is shorter than its header promises, or is damaged.
    MissingDependencyError
        When laspy, or for LAZ its decompressor, is not installed: pip install 'scanweld[las]'.
    """
    laspy = _laspy()
    file = Path(path)
    try:
        with file.open("rb") as stream:
            _check_header(file, stream)
            stream.seek(0)
            # One thread: the parallel decompressor allocates what the file says before it looks.
            backend = laspy.LazBackend.Lazrs
            layers = laspy.DecompressionSelection
            reader = laspy.LasReader(
                stream,
                closefd=False,
                laz_backend=backend,
                read_evlrs=False,
                decompression_selection=layers.xy_returns_channel() | layers.Z | layers.RGB,
            )
            if reader.header.are_points_compressed and reader.header.point_count:
                if not backend.is_available():
                    raise MissingDependencyError("lazrs", "las")
                _check_chunks(file, stream, reader.header)
                stream.seek(reader.header.offset_to_point_data)
            return cloud_from_columns(file, _columns(reader))
    except (FileFormatError, MissingDependencyError):
        raise
    except BaseException as error:
        # laspy raises whatever it stumbles over; its decompressor is Rust, whose failed assertions are no Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        what = str(error).partition("\n")[0][:200]
        raise FileFormatError(f"{file}: not a readable LAS file: {what}") from None


def write_las(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write a cloud as LAS 1.2, compressed where the name ends in ``.laz``, complete or not at all.

    Coordinates are rounded to a multiple of the finest power of ten that 32 bits allow, and no finer than a
    micrometre: to 1e-6 m up to an extent of 2 km, 1e-5 m up to 20 km. The plane is written with z = 0. Normals have
    no place in LAS, rows that are not finite neither; the log says so when they are left out.

    Raises
    ------
    OutputError
        When the file cannot be written.
    MissingDependencyError
        When laspy is not installed: pip install 'scanweld[las]'.
    """
    laspy = _laspy()
    file = Path(path)
    compressed = file.suffix.lower() == ".laz"
    if compressed and not laspy.LazBackend.Lazrs.is_available():
        raise MissingDependencyError("lazrs", "las")
    if cloud.normals is not None:
        logger.warning("%s: normals left out, which LAS does not have", file)
    cloud = drop_not_finite(file, PointCloud(cloud.points_m, None, cloud.colors))
    points = np.zeros((len(cloud), 3))
    points[:, : cloud.dimension] = cloud.points_m
    offsets = np.floor(points.min(axis=0, initial=np.inf)) if len(points) else np.zeros(3)
    extent = float((points - offsets).max(initial=0.0))
    if not np.abs(points).max(initial=0.0) < 1e15:
        raise OutputError(f"{file}: LAS cannot hold coordinates beyond 1e15")
    scale = max(_FINEST_SCALE, 10.0 ** math.ceil(math.log10(max(extent, 1.0) / _LARGEST_INTEGER)))
    header = laspy.LasHeader(version="1.2", point_format=_PLAIN if cloud.colors is None else _COLORED)
    header.scales, header.offsets = np.full(3, scale), offsets
    table = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(points), header=header))
    for name, values in zip("XYZ", np.rint((points - offsets) / scale).astype(np.int32).T, strict=True):
        table[name] = values
    if cloud.colors is not None:
        for name, channel in zip(("red", "green", "blue"), cloud.colors.T, strict=True):
            table[name] = channel.astype(np.uint16) * 257
    buffer = io.BytesIO()
    table.write(buffer, do_compress=compressed, laz_backend=laspy.LazBackend.Lazrs)
    write_file(file, buffer.getvalue())


def _laspy() -> Any:
    try:
        import laspy
    except ImportError:
        raise MissingDependencyError("laspy", "las") from None
    return laspy


def _check_header(path: Path, stream: BinaryIO) -> None:
    """Refuse a file that cannot hold what its header promises, before laspy believes it."""
    size = os.fstat(stream.fileno()).st_size
    head = stream.read(max(_HEADER_LENGTHS.values()))
    if not head.startswith(b"LASF"):
        raise FileFormatError(f"{path}: not a LAS file: it does not begin with 'LASF'")
    if len(head) < min(_HEADER_LENGTHS.values()):
        raise FileFormatError(f"{path}: ends within the LAS header: truncated?")
    major, minor = head[24], head[25]
    if major != 1 or minor not in _HEADER_LENGTHS or len(head) < _HEADER_LENGTHS[minor]:
        raise FileFormatError(f"{path}: LAS version {major}.{minor}: expected 1.0 to 1.5, with a whole header")
    start, num_records, point_format, row, count = struct.unpack_from("<IIBHI", head, 96)
    if minor >= 4:
        (count,) = struct.unpack_from("<Q", head, 247)
    if start > size or num_records * _RECORD_HEADER > start:
        raise FileFormatError(
            f"{path}: the header promises {num_records} records and points from byte {start}; the file has {size}"
        )
    if not np.isfinite(np.frombuffer(head, "<f8", 6, 131)).all():
        raise FileFormatError(f"{path}: the scales and offsets of the LAS header are not finite")
    if row == 0 or (count * row > size - start and not point_format & _COMPRESSED):
        raise FileFormatError(
            f"{path}: the header promises {count} points of {row} bytes; the file has {size - start} after it: "
            "truncated, or the header is wrong"
        )


def _check_chunks(path: Path, stream: BinaryIO, header: Any) -> None:
    """Refuse chunks, and layers of chunks, for which the file has no room.

    The decompressor allocates what the file says, and ends the process when it cannot.
    """
    size = os.fstat(stream.fileno()).st_size
    start, row = header.offset_to_point_data, header.point_format.size
    items = np.frombuffer(header.vlrs.get("LasZipVlr")[0].record_data, "<u2", offset=_LAZ_ITEMS).reshape(-1, 3)
    try:
        table = _integer(stream, start, "<q")
        if table == -1:  # written to a stream: the last eight bytes tell
            table = _integer(stream, size - 8, "<q")
        chunks = _integer(stream, table + 4, "<I")
        fits = chunks * row <= table  # every chunk begins with a point that is not compressed
        layers = sum(_LAYERS.get(int(kind), 0) or int(length) * (kind == _BYTES) for kind, length, _ in items)
        position = start + 8
        for _ in range(chunks if fits and layers else 0):
            # After the first point: the number of points, and the size of every layer.
            stream.seek(position + row + 4)
            sizes = np.frombuffer(stream.read(4 * layers), "<u4", layers)
            position += row + 4 + 4 * layers + int(sizes.sum(dtype=np.int64))
            fits = fits and position <= table
            if not fits:
                break
    except (struct.error, ValueError, OSError, OverflowError):
        fits = False
    if not fits:
        raise FileFormatError(f"{path}: the sizes of its compressed chunks are wrong: truncated, or damaged")


def _integer(stream: BinaryIO, place: int, kind: str) -> int:
    stream.seek(place)
    (value,) = struct.unpack(kind, stream.read(struct.calcsize(kind)))
    return int(value)


def _columns(reader: Any) -> dict[str, Array]:
    scales, offsets = np.asarray(reader.header.scales), np.asarray(reader.header.offsets)
    if reader.header.are_points_compressed and reader.header.point_count:
        unpacked = reader.point_source.vlr.item_size()
        if unpacked != reader.header.point_format.size:
            raise ValueError(
                f"points of {reader.header.point_format.size} bytes promised, {unpacked} when decompressed"
            )
    colored = "red" in reader.header.point_format.dimension_names
    # Compressed data do not say how many points they hold: they are read piece by piece, until they end.
    rows = max(1, _CHUNK_BYTES // reader.header.point_format.size)
    points: list[Float64] = [np.empty((0, 3))]
    colors: list[Array] = [np.empty((0, 3), np.uint16)]
    got = 0
    for piece in reader.chunk_iterator(rows):
        whole = np.stack([piece["X"], piece["Y"], piece["Z"]], axis=1)
        points.append(whole * scales + offsets)
        got += len(whole)
        if colored:
            colors.append(np.stack([piece["red"], piece["green"], piece["blue"]], axis=1))
    if got != reader.header.point_count:
        raise ValueError(f"{reader.header.point_count} points promised, {got} found")
    columns: dict[str, Array] = dict(zip("xyz", np.concatenate(points).T, strict=True))
    if colored:
        channels = np.concatenate(colors)
        if channels.max(initial=0) <= 255:
            channels = channels.astype(np.uint8)
        columns |= zip(("red", "green", "blue"), channels.T, strict=True)
    return columns
