"""PCD files of the Point Cloud Library, version 0.5 to 0.7: ASCII, binary and compressed.

The format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. Binary data are little-endian.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from scanweld.arrays import Array, UInt8
from scanweld.errors import FileFormatError, InvalidInputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.atomic import write_file
from scanweld.io.columns import HasColumns, cloud_from_columns, columns_to_write
from scanweld.io.tables import number_table

Encoding = Literal["ascii", "binary", "binary_compressed"]

_HEADER_LIMIT = 1 << 16
_KINDS = {
    ("F", 4): "f4", ("F", 8): "f8", ("U", 1): "u1", ("U", 2): "u2", ("U", 4): "u4", ("U", 8): "u8",
    ("I", 1): "i1", ("I", 2): "i2", ("I", 4): "i4", ("I", 8): "i8",
}  # fmt: skip
_COLOR_NAMES = ("rgb", "rgba")
_NORMAL_NAMES = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
_BOM = b"\xef\xbb\xbf"
_LARGEST_POINT = 1 << 20  # bytes
_ROUNDING_M = 1e-5
_LZF_RATIO = 88  # three bytes become 264 at most


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    kind: str  # of NumPy, without byte order
    count: int
    offset: int  # bytes from the beginning of a point

    @property
    def size(self) -> int:
        return int(self.kind[1]) * self.count

    @property
    def is_used(self) -> bool:
        """Whether it has one value a point; the others are descriptors, or filling (named _)."""
        return self.count == 1 and self.name != "_"


@dataclass(frozen=True, slots=True)
class _Header:
    fields: list[_Field]
    num_points: int
    encoding: str
    num_lines: int
    size: int  # bytes

    @property
    def stride(self) -> int:
        return sum(f.size for f in self.fields)


def read_pcd(path: str | os.PathLike[str]) -> PointCloud:
    """Read a PCD file: ASCII, binary or compressed; organised clouds become a list of their points.

    The fields x, y and z (without z the cloud is 2-D), normal_x, normal_y, normal_z, and rgb or rgba (packed in a
    float or an integer) are used, others are ignored, and so is the viewpoint: coordinates are returned as they
    are stored. Points that are not finite (an organised cloud has them where nothing was measured) are dropped,
    and counted in the log.

    Raises
    ------
    FileFormatError
        When the file is missing, is no PCD file, is shorter than its header promises, or is damaged.
    """
    file = Path(path)
    try:
        with file.open("rb") as stream:
            header = _read_header(file, stream.read(_HEADER_LIMIT))
            _check_length(file, header, os.fstat(stream.fileno()).st_size - header.size)
            stream.seek(header.size)
            columns = _READERS[header.encoding](file, header, stream)
    except OSError as error:
        raise FileFormatError(f"{file}: {error.strerror or error}") from None
    for name in _COLOR_NAMES:
        if name in columns and columns[name].dtype.itemsize == 4:
            columns |= _unpacked(columns.pop(name))
    return cloud_from_columns(file, columns)


def write_pcd(path: str | os.PathLike[str], thing: HasColumns, *, encoding: Encoding = "binary") -> None:
    """Write the columns of `thing` as a PCD file, complete or not at all.

    Coordinates are float32, as other programs expect, where that moves none by more than 0.01 mm, which it does not
    up to 256 m from the origin; otherwise float64. (Not every program reads that: Open3D 0.20 takes binary float64
    coordinates for other numbers.)
    Colours are packed as the field rgb.

    Parameters
    ----------
    encoding : "ascii", "binary" or "binary_compressed"

    Raises
    ------
    InvalidInputError
        When there is no such encoding.
    OutputError
        When the file cannot be written, or a column's type has no place in a PCD file.
    """
    if encoding not in _READERS:
        raise InvalidInputError(f"encoding: expected one of {', '.join(_READERS)}, got {encoding!r}")
    columns = _packed(columns_to_write(Path(path), thing.columns(), _KINDS.values(), "PCD"), encoding)
    count = len(next(iter(columns.values())))
    kinds = [values.dtype.str[1:] for values in columns.values()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(kind[1:] for kind in kinds),
        "TYPE " + " ".join(kind[0].upper() for kind in kinds),
        "COUNT" + " 1" * len(columns),
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        f"DATA {encoding}",
        "",
    ]
    if encoding == "ascii":
        rows = zip(*(map(repr, values.tolist()) for values in columns.values()), strict=True)
        body = "".join(" ".join(row) + "\n" for row in rows).encode("ascii")
    elif encoding == "binary":
        table = np.empty(count, [(name, "<" + kind) for name, kind in zip(columns, kinds, strict=True)])
        for name, values in columns.items():
            table[name] = values
        body = table.tobytes()
    else:
        plain = b"".join(
            values.astype("<" + kind).tobytes() for values, kind in zip(columns.values(), kinds, strict=True)
        )
        body = _compressed(plain)
    write_file(Path(path), "\n".join(lines).encode("ascii") + body)


def _packed(columns: dict[str, Array], encoding: str) -> dict[str, Array]:
    """Name, narrow and pack columns as PCD has them."""
    packed: dict[str, Array] = {}
    axes = [np.asarray(columns[axis], dtype=np.float64) for axis in "xyz" if axis in columns]
    with np.errstate(over="ignore", invalid="ignore"):
        moved_m = max(np.nanmax(np.abs(values.astype(np.float32) - values), initial=0.0) for values in axes)
    for name, values in columns.items():
        if name in "xyz" and moved_m <= _ROUNDING_M:
            packed[name] = values.astype(np.float32)
        elif name not in ("red", "green", "blue"):
            packed[_NORMAL_NAMES.get(name, name)] = values
    if "red" in columns:
        red, green, blue = (columns[name].astype(np.uint32) for name in ("red", "green", "blue"))
        rgb = red << 16 | green << 8 | blue
        packed["rgb"] = rgb if encoding == "ascii" else rgb.view(np.float32)  # as the Point Cloud Library has it
    return packed


def _unpacked(packed: Array) -> dict[str, Array]:
    """Split 0xAARRGGBB, whose bits may be dressed as a float, into its colours."""
    bits = packed.view(f"u{packed.dtype.itemsize}")
    return {name: (bits >> shift & 255).astype(np.uint8) for name, shift in (("red", 16), ("green", 8), ("blue", 0))}


def _read_header(path: Path, head: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    position, number = (3 if head.startswith(_BOM) else 0), 0
    while "DATA" not in entries:
        end = head.find(b"\n", position)
        if end < 0 and b"DATA" not in head[position:]:
            what = "its header has no DATA line; is it truncated?" if entries else "not a PCD file"
            raise FileFormatError(f"{path}: {what}")
        end = len(head) if end < 0 else end
        words = head[position:end].decode("ascii", "replace").split("#")[0].split()
        position, number = end + 1, number + 1
        if words:
            if words[0] not in _ENTRIES:
                where = f"line {number} of the PCD header is wrong" if entries else "not a PCD file: it begins with"
                raise FileFormatError(f"{path}: {where}: {' '.join(words)[:60]!r}")
            entries["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
    names = entries.get("FIELDS", [])
    if not names:
        raise FileFormatError(f"{path}: the PCD header names no FIELDS")
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in _READERS:
        raise FileFormatError(f"{path}: DATA: expected {', '.join(_READERS)}, got {encoding[:40]!r}")
    return _Header(_fields(path, names, entries), _num_points(path, entries), encoding, number, position)


def _fields(path: Path, names: list[str], entries: dict[str, list[str]]) -> list[_Field]:
    defaults = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
    sizes, types, counts = (entries.get(key, [default] * len(names)) for key, default in defaults.items())
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise FileFormatError(
            f"{path}: the PCD header has {len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE, {len(counts)} COUNT"
        )
    fields: list[_Field] = []
    offset = 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        known = _KINDS.get((kind.upper(), _whole(path, "SIZE", size)))
        if known is None:
            raise FileFormatError(f"{path}: field '{name}' has TYPE {kind} SIZE {size}, which PCD does not have")
        fields.append(_Field(name, known, _whole(path, "COUNT", count), offset))
        offset += fields[-1].size
        if fields[-1].count == 0 or offset > _LARGEST_POINT:
            raise FileFormatError(f"{path}: field '{name}' has COUNT {count}")
    used = [f.name for f in fields if f.is_used]
    if len(set(used)) < len(used):
        raise FileFormatError(f"{path}: two fields of the PCD header have one name: {' '.join(names)[:60]}")
    return fields


def _num_points(path: Path, entries: dict[str, list[str]]) -> int:
    width, height, points = (
        _whole(path, key, " ".join(entries[key])) if key in entries else None for key in ("WIDTH", "HEIGHT", "POINTS")
    )
    grid = None if width is None else width * (1 if height is None else height)
    if points is None and grid is None:
        raise FileFormatError(f"{path}: the PCD header has neither POINTS nor WIDTH")
    if points is not None and grid is not None and points != grid:
        raise FileFormatError(f"{path}: the PCD header has POINTS {points}, but WIDTH x HEIGHT is {grid}")
    return points if points is not None else grid or 0


def _whole(path: Path, key: str, word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 20):
        raise FileFormatError(f"{path}: {key} of the PCD header: expected a whole number, got {word[:40]!r}")
    return int(word)


def _check_length(path: Path, header: _Header, body: int) -> None:
    """Refuse a file that cannot hold the points its header promises, before anything is allocated."""
    if header.encoding == "binary_compressed":
        return  # has sizes of its own
    row = header.stride if header.encoding == "binary" else 2 * sum(f.count for f in header.fields)
    if header.num_points * row > body + (header.encoding == "ascii"):
        raise FileFormatError(
            f"{path}: the header promises {header.num_points} points, at least {header.num_points * row} bytes; "
            f"the file has {max(body, 0)} after it: truncated, or the header is wrong"
        )


def _read_ascii(path: Path, header: _Header, stream: BinaryIO) -> dict[str, Array]:
    lines = stream.read().decode("utf-8", "replace").splitlines()
    table = number_table(path, lines, header.num_lines + 1, header.num_points)
    if len(table) < header.num_points:
        raise FileFormatError(
            f"{path}: the header promises {header.num_points} points, the file ends after {len(table)}: truncated?"
        )
    expected = sum(f.count for f in header.fields)
    if header.num_points == 0:
        table = np.empty((0, expected))
    if table.shape[1] != expected:
        raise FileFormatError(
            f"{path}, line {header.num_lines + 1}: expected {expected} numbers as the header says, got {table.shape[1]}"
        )
    positions = np.cumsum([0] + [f.count for f in header.fields])
    columns: dict[str, Array] = {}
    for field, position in zip(header.fields, positions[:-1], strict=True):
        if not field.is_used:
            continue
        column = table[:, position]
        # Text may hold more digits of a coordinate than its float32; only the bits of a colour need the type.
        columns[field.name] = _typed(path, field, column) if field.name in _COLOR_NAMES else column
    return columns


def _typed(path: Path, field: _Field, values: Array) -> Array:
    if field.kind[0] != "f":
        limits = np.iinfo(field.kind)
        if not ((values >= limits.min) & (values <= limits.max)).all():
            raise FileFormatError(f"{path}: field '{field.name}' has values outside {limits.min}..{limits.max}")
        return values.astype(field.kind)
    with np.errstate(over="ignore"):
        return np.where(np.isnan(values), 0.0, values).astype(field.kind)


def _read_binary(path: Path, header: _Header, stream: BinaryIO) -> dict[str, Array]:
    used = [f for f in header.fields if f.is_used]
    rows = np.frombuffer(
        stream.read(header.num_points * header.stride),
        np.dtype(
            {
                "names": [f.name for f in used],
                "formats": ["<" + f.kind for f in used],
                "offsets": [f.offset for f in used],
                "itemsize": header.stride,
            }
        ),
    )
    return {f.name: np.ascontiguousarray(rows[f.name]) for f in used}


def _read_compressed(path: Path, header: _Header, stream: BinaryIO) -> dict[str, Array]:
    """Read field after field: all x, then all y, and so on."""
    body = stream.read()
    if len(body) < 8:
        raise FileFormatError(f"{path}: ends before the sizes of its compressed data: truncated?")
    compressed, plain = struct.unpack_from("<II", body)
    needed = header.num_points * header.stride
    if plain != needed:
        raise FileFormatError(f"{path}: the header promises {needed} bytes of points, the compressed data {plain}")
    if compressed > len(body) - 8:
        raise FileFormatError(f"{path}: promises {compressed} compressed bytes, has {len(body) - 8}: truncated?")
    data = _decompressed(path, np.frombuffer(body, np.uint8, compressed, 8), plain)
    start = 0
    columns: dict[str, Array] = {}
    for field in header.fields:
        if field.is_used:
            columns[field.name] = np.frombuffer(data, "<" + field.kind, header.num_points, start)
        start += field.size * header.num_points
    return columns


def _decompressed(path: Path, compressed: UInt8, size: int) -> UInt8:
    if size > _LZF_RATIO * len(compressed):
        raise FileFormatError(f"{path}: {len(compressed)} compressed bytes cannot hold {size}: damaged?")
    from scanweld.io import kernels  # loads Numba, which only compressed files need

    plain = np.empty(size, np.uint8)
    fault = kernels.decode_lzf(compressed, plain)
    if fault:
        what = {
            kernels.TRUNCATED: "end in the middle",
            kernels.BEFORE_START: "refer to before their beginning",
            kernels.TOO_LONG: f"hold more than the {size} bytes they promise",
            kernels.TOO_SHORT: f"hold less than the {size} bytes they promise",
        }[fault]
        raise FileFormatError(f"{path}: the compressed points {what}: damaged?")
    return plain


def _compressed(plain: bytes) -> bytes:
    from scanweld.io.kernels import encode_lzf

    target = np.empty(len(plain) + len(plain) // 32 + 4, np.uint8)
    size = encode_lzf(np.frombuffer(plain, np.uint8), target)
    return struct.pack("<II", size, len(plain)) + target[:size].tobytes()


_ENTRIES = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_READERS = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
