"""PLY files: read points with normals and colours, write any object that offers columns."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import plyfile

from scanweld.arrays import Array, UInt8
from scanweld.errors import FileFormatError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.atomic import write_file

logger = logging.getLogger(__name__)

_HEADER_LIMIT = 1 << 16
_SIZES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip
_NAMES = {
    "f4": "float", "f8": "double", "u1": "uchar", "i1": "char",
    "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int",
}  # fmt: skip


class HasColumns(Protocol):
    """Anything that can be written as PLY: a PointCloud, a SurfelMap."""

    def columns(self) -> dict[str, Array]:
        """Return equally long 1-D arrays by property name, in file order."""


def write_ply(path: str | os.PathLike[str], thing: HasColumns) -> None:
    """Write the columns of `thing` as a binary little-endian PLY file, complete or not at all.

    Columns keep their type (float32, float64 and integers up to 32 bits).

    Raises
    ------
    OutputError
        When the file cannot be written, or a column's type has no place in a PLY file.
    """
    columns = {name: np.asarray(values) for name, values in thing.columns().items()}
    lengths = {name: values.shape for name, values in columns.items()}
    if len(set(lengths.values())) != 1 or any(values.ndim != 1 for values in columns.values()):
        raise OutputError(f"{path}: a PLY file needs columns of one length, got {lengths}")
    count = len(next(iter(columns.values())))
    fields = []
    for name, values in columns.items():
        kind = values.dtype.str[1:]
        if kind not in _NAMES:
            raise OutputError(f"{path}: column '{name}' has type {values.dtype}, which PLY cannot hold")
        fields.append((name, "<" + kind))
    table = np.empty(count, dtype=fields)
    for name, values in columns.items():
        table[name] = values
    lines = ["ply", "format binary_little_endian 1.0", "comment scanweld, metres", f"element vertex {count}"]
    lines += [f"property {_NAMES[kind[1:]]} {name}" for name, kind in fields]
    write_file(Path(path), "\n".join([*lines, "end_header", ""]).encode("ascii") + table.tobytes())


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
    _check_header(Path(path))
    try:
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        names = [p.name for p in vertex.properties]
        columns = {name: np.asarray(vertex[name]) for name in names if vertex[name].dtype != object}
    except (plyfile.PlyParseError, ValueError, KeyError, EOFError, UnicodeDecodeError, OSError) as error:
        raise FileFormatError(f"{path}: not a readable PLY file: {error}") from None
    if "x" not in columns or "y" not in columns:
        raise FileFormatError(f"{path}: the vertices have no x and y, only {', '.join(names) or 'nothing'}")
    axes = [axis for axis in "xyz" if axis in columns]
    normals = None
    if all("n" + axis in columns for axis in axes):
        normals = np.stack([columns["n" + axis] for axis in axes], axis=1).astype(np.float64)
    points = np.stack([columns[axis] for axis in axes], axis=1).astype(np.float64)
    cloud = PointCloud(points, normals, _colors(columns))
    kept = cloud.finite()
    if len(kept) < len(cloud):
        logger.warning("%s: %d of %d points are not finite and were dropped", path, len(cloud) - len(kept), len(cloud))
    return kept


def _colors(columns: dict[str, Array]) -> UInt8 | None:
    names = ("red", "green", "blue") if "red" in columns else ("r", "g", "b")
    if not all(name in columns for name in names):
        return None
    colors = np.stack([columns[name] for name in names], axis=1)
    if colors.dtype.kind == "f":
        colors = np.nan_to_num(colors) * (255.0 if np.nanmax(colors, initial=0.0) <= 1.0 else 1.0)
    elif colors.dtype.itemsize == 2:
        colors = colors / 257.0
    whole: UInt8 = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    return whole


def _check_header(path: Path) -> None:
    """Refuse a file that cannot hold the vertices its header promises, before anything is allocated."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_LIMIT)
            total = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise FileFormatError(f"{path}: {error.strerror or error}") from None
    if not head.startswith(b"ply"):
        raise FileFormatError(f"{path}: not a PLY file: it does not begin with 'ply'")
    end = head.find(b"end_header")
    if end < 0:
        raise FileFormatError(f"{path}: the PLY header does not end; is the file truncated?")
    body = total - end - len(b"end_header\n")
    ascii_file = b"format ascii" in head[:end]
    needed, vertices = 0, 0
    for element in _elements(path, head[:end].decode("ascii", "replace")):
        scalars = [kind for kind in element["properties"] if kind in _SIZES]
        lists = len(element["properties"]) - len(scalars)
        # The least a row can take: "0 " for each value in ASCII, an empty list in binary.
        row = 2 * len(element["properties"]) if ascii_file else sum(_SIZES[kind] for kind in scalars) + lists
        needed += element["count"] * row
        vertices += element["count"] if element["name"] == "vertex" else 0
    if needed > body + 1:
        raise FileFormatError(
            f"{path}: the header promises {vertices} vertices, at least {needed} bytes; the file has "
            f"{max(body, 0)} after it: truncated, or the header is wrong"
        )


def _elements(path: Path, header: str) -> list[dict[str, Any]]:
    elements: list[dict[str, Any]] = []
    for number, line in enumerate(header.splitlines(), 1):
        words = line.split()
        try:
            if words[:1] == ["element"]:
                count = int(words[2])
                if count < 0:
                    raise ValueError
                elements.append({"name": words[1], "count": count, "properties": []})
            elif words[:1] == ["property"]:
                if words[1] != "list" and words[1] not in _SIZES:
                    raise ValueError
                elements[-1]["properties"].append(words[1])
        except (IndexError, ValueError):
            raise FileFormatError(f"{path}: line {number} of the PLY header is wrong: {line.strip()!r}") from None
    return elements
