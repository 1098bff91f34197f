"""PLY files: read points with normals and colours, write any object that offers columns.

The format: http://paulbourke.net/dataformats/ply. Only the vertices are read; faces after them are not touched.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scanweld.arrays import Array
from scanweld.errors import FileFormatError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.atomic import write_file
from scanweld.io.columns import HasBatches, HasColumns, cloud_from_columns, columns_to_write
from scanweld.io.tables import number_table

_HEADER_LIMIT = 1 << 16
_TYPES = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
    "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "f4": "float", "f8": "double", "u1": "uchar", "i1": "char",
    "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int",
}  # fmt: skip
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    kind: str  # of NumPy, without byte order
    count_kind: str = ""  # of the number before the entries of a list; "" for one value


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def smallest_row(self, ascii_file: bool) -> int:
        """Bytes that a row takes at least: "0 " for each value in ASCII, an empty list in binary."""
        if ascii_file:
            return 2 * len(self.properties)
        return sum(np.dtype(p.count_kind or p.kind).itemsize for p in self.properties)


@dataclass(frozen=True, slots=True)
class _Header:
    byte_order: str  # "" for ASCII
    elements: list[_Element]
    num_lines: int
    size: int  # bytes


def write_ply(path: str | os.PathLike[str], thing: HasColumns) -> None:
    """Write the columns of `thing` as a binary little-endian PLY file, complete or not at all.

    Columns keep their type (float32, float64 and integers up to 32 bits). Of what has `batches` of columns, as a
    SurfelMap does, one is in memory at a time.

    Raises
    ------
    OutputError
        When the file cannot be written, or a column's type has no place in a PLY file.
    """
    if isinstance(thing, HasBatches) and len(thing):
        parts = (columns_to_write(Path(path), columns, _NAMES, "PLY") for columns in thing.batches())
        write_file(Path(path), _binary(parts, len(thing)))
    else:
        columns = columns_to_write(Path(path), thing.columns(), _NAMES, "PLY")
        write_file(Path(path), _binary([columns], len(next(iter(columns.values())))))


def _binary(parts: Iterable[dict[str, Array]], count: int) -> Iterator[bytes]:
    """Yield the bytes of a file of so many vertices, whose columns come in parts of the same names and types."""
    fields: list[tuple[str, str]] = []
    for columns in parts:
        if not fields:
            fields = [(name, "<" + values.dtype.str[1:]) for name, values in columns.items()]
            lines = ["ply", "format binary_little_endian 1.0", "comment scanweld, metres", f"element vertex {count}"]
            lines += [f"property {_NAMES[kind[1:]]} {name}" for name, kind in fields]
            yield "\n".join([*lines, "end_header", ""]).encode("ascii")
        table = np.empty(len(next(iter(columns.values()))), dtype=fields)
        for name, values in columns.items():
            table[name] = values
        yield table.tobytes()


def read_ply(path: str | os.PathLike[str]) -> PointCloud:
    """Read the vertices of a PLY file (ASCII or binary, either byte order).

    The properties x, y and z (without z the cloud is 2-D), nx, ny, nz, and red, green, blue are used, others
    are ignored. Colours stored as fractions are scaled to 0..255. Rows that are not finite are dropped, and
    counted in the log.

    Raises
    ------
    FileFormatError
        When the file is missing, is no PLY file, is shorter than its header promises, or has no x and y.
    """
    return cloud_from_columns(Path(path), read_ply_columns(path))


def read_ply_columns(path: str | os.PathLike[str]) -> dict[str, Array]:
    """Read every single-valued property of a PLY file's vertices, by name, as it is stored.

    Raises
    ------
    FileFormatError
        As :func:`read_ply`, but for what the columns mean.
    """
    file = Path(path)
    try:
        with file.open("rb") as stream:
            header = _read_header(file, stream.read(_HEADER_LIMIT))
            _check_length(file, header, os.fstat(stream.fileno()).st_size - header.size)
            stream.seek(header.size)
            body = stream.read()
    except OSError as error:
        raise FileFormatError(f"{file}: {error.strerror or error}") from None
    return (_read_binary if header.byte_order else _read_ascii)(file, header, body)


def _read_header(path: Path, head: bytes) -> _Header:
    if not head.startswith(b"ply"):
        raise FileFormatError(f"{path}: not a PLY file: it does not begin with 'ply'")
    newline = b"\r\n" if head[3:5] == b"\r\n" else head[3:4]
    end = head.find(newline + b"end_header")
    if end < 0 or newline not in (b"\n", b"\r", b"\r\n"):
        raise FileFormatError(f"{path}: the PLY header does not end; is the file truncated?")
    byte_order = None
    elements: list[_Element] = []
    lines = head[:end].decode("ascii", "replace").splitlines()
    for number, line in enumerate(lines, 1):
        words = line.split()
        try:
            if words[:1] == ["format"]:
                byte_order = _BYTE_ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], _count(words[2])))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_property(words))
        except (IndexError, KeyError, ValueError):
            raise FileFormatError(f"{path}: line {number} of the PLY header is wrong: {line.strip()[:60]!r}") from None
    if byte_order is None:
        raise FileFormatError(f"{path}: the PLY header has no format line")
    if all(element.name != "vertex" for element in elements):
        raise FileFormatError(f"{path}: the PLY header has no vertices (element vertex)")
    for element in elements:
        names = [p.name for p in element.properties]
        if not names or len(set(names)) < len(names):
            fault = "has two properties of one name" if names else "has no properties"
            raise FileFormatError(f"{path}: element '{element.name}' {fault} in the PLY header")
    size = end + len(newline + b"end_header" + newline)
    return _Header(byte_order, elements, len(lines) + 1, size)


def _count(word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 20):
        raise ValueError(word)
    return int(word)


def _property(words: list[str]) -> _Property:
    if words[1] != "list":
        return _Property(words[2], _TYPES[words[1]])
    count_kind = _TYPES[words[2]]
    if count_kind.startswith("f"):
        raise ValueError(words[2])
    return _Property(words[4], _TYPES[words[3]], count_kind)


def _check_length(path: Path, header: _Header, body: int) -> None:
    """Refuse a file that cannot hold what its header promises, before anything is allocated."""
    needed = sum(element.count * element.smallest_row(not header.byte_order) for element in header.elements)
    if needed > body + 1:  # the last line of an ASCII file may lack its end
        promised = ", ".join(f"{element.count} x {element.name}" for element in header.elements)
        raise FileFormatError(
            f"{path}: the header promises {promised}, at least {needed} bytes; the file has {max(body, 0)} "
            "after it: truncated, or the header is wrong"
        )


def _read_binary(path: Path, header: _Header, body: bytes) -> dict[str, Array]:
    position = 0
    for element in header.elements:
        if any(p.count_kind for p in element.properties):
            columns, position = _walk(path, element, header.byte_order, body, position)
        else:
            row = np.dtype([(p.name, header.byte_order + p.kind) for p in element.properties])
            start, position = position, position + element.count * row.itemsize
            if position > len(body):
                raise _truncated(path, element, (len(body) - start) // row.itemsize)
            rows = np.frombuffer(body, row, element.count, start) if element.count else np.empty(0, row)
            columns = {name: rows[name] for name in row.names or ()}
        if element.name == "vertex":
            break
    return columns


def _walk(path: Path, element: _Element, byte_order: str, body: bytes, position: int) -> tuple[dict[str, Array], int]:
    """Read the single values of an element whose rows hold lists, hence differ in length; return its end too."""
    raw = {p.name: bytearray() for p in element.properties if not p.count_kind}
    layout = [
        (p.name, np.dtype(p.kind).itemsize, p.count_kind and struct.Struct(byte_order + np.dtype(p.count_kind).char))
        for p in element.properties
    ]
    for row in range(element.count):
        for name, size, length in layout:
            if not length:
                raw[name] += body[position : position + size]
                position += size
            elif position + length.size <= len(body):
                (entries,) = length.unpack_from(body, position)
                if entries < 0:
                    raise FileFormatError(f"{path}: the list '{name}' of {element.name} {row} has {entries} entries")
                position += length.size + entries * size
            else:
                position = len(body) + 1
        if position > len(body):
            raise _truncated(path, element, row)
    kinds = {p.name: byte_order + p.kind for p in element.properties}
    return {name: np.frombuffer(values, kinds[name]) for name, values in raw.items()}, position


def _read_ascii(path: Path, header: _Header, body: bytes) -> dict[str, Array]:
    lines = body.decode("utf-8", "replace").splitlines()
    first_line = header.num_lines + 1
    for element in header.elements:
        if element.name == "vertex":
            break
        skipped = _lines_with(lines, element.count)
        lines, first_line = lines[skipped:], first_line + skipped
    if any(p.count_kind for p in element.properties):
        lines = [
            _without_lists(path, element, number, line) if line.strip() else ""
            for number, line in enumerate(lines[: _lines_with(lines, element.count)], first_line)
        ]
    table = number_table(path, lines, first_line, element.count)
    if len(table) < element.count:
        raise _truncated(path, element, len(table))
    single = [p for p in element.properties if not p.count_kind]
    if element.count and table.shape[1] != len(single):
        raise FileFormatError(
            f"{path}, line {first_line}: expected {len(single)} numbers as the header says, got {table.shape[1]}"
        )
    columns = table.T if element.count else np.empty((len(single), 0))
    return {p.name: _typed(path, p, values) for p, values in zip(single, columns, strict=True)}


def _lines_with(lines: list[str], rows: int) -> int:
    """Number of lines at the beginning that hold so many rows, empty lines included."""
    filled = [i for i, line in enumerate(lines) if line.strip()]
    return filled[rows - 1] + 1 if 0 < rows <= len(filled) else len(lines) if rows else 0


def _typed(path: Path, p: _Property, values: Array) -> Array:
    """Cast numbers read from text to the integer type of their property, which they must fit; keep fractions whole."""
    if p.kind.startswith("f"):
        return values
    limits = np.iinfo(p.kind)
    if not ((values >= limits.min) & (values <= limits.max)).all():
        raise FileFormatError(f"{path}: property '{p.name}' has values outside {limits.min}..{limits.max}")
    return values.astype(p.kind)


def _without_lists(path: Path, element: _Element, number: int, line: str) -> str:
    words = line.split()
    kept = []
    i = 0
    try:
        for p in element.properties:
            if p.count_kind:
                i += 1 + _count(words[i])
            else:
                kept.append(words[i])
                i += 1
    except (IndexError, ValueError):
        raise FileFormatError(f"{path}, line {number}: not a {element.name}: {line[:60]!r}") from None
    return " ".join(kept)


def _truncated(path: Path, element: _Element, got: int) -> FileFormatError:
    return FileFormatError(
        f"{path}: the header promises {element.count} x {element.name}, the file ends after {got}: truncated?"
    )
