"""Point files of any known kind, by the ending of their names."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from scanweld.errors import FileFormatError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.e57 import read_e57
from scanweld.io.las import read_las, write_las
from scanweld.io.pcd import read_pcd, write_pcd
from scanweld.io.ply import read_ply, write_ply
from scanweld.io.tables import read_npy, read_text, read_transform, write_npy, write_text

__all__ = ["FORMATS", "PointFormat", "read_points", "read_transform", "write_points"]

StrPath: TypeAlias = str | os.PathLike[str]


@dataclass(frozen=True, slots=True)
class PointFormat:
    """What reads and what writes files of one kind; `write` is None where nothing does."""

    read: Callable[[StrPath], PointCloud]
    write: Callable[[StrPath, Any], None] | None


FORMATS: dict[str, PointFormat] = {
    ".ply": PointFormat(read_ply, write_ply),
    ".pcd": PointFormat(read_pcd, write_pcd),
    ".xyz": PointFormat(read_text, write_text),
    ".csv": PointFormat(read_text, write_text),
    ".txt": PointFormat(read_text, write_text),
    ".npy": PointFormat(read_npy, write_npy),
    ".las": PointFormat(read_las, write_las),
    ".laz": PointFormat(read_las, write_las),
    ".e57": PointFormat(read_e57, None),
}
"""Every known kind of point file by the ending of its name."""


def read_points(path: StrPath) -> PointCloud:
    """Read a point cloud by the ending of its name.

    ``.ply``, ``.pcd``, ``.xyz``, ``.csv``, ``.txt`` and ``.npy``; with the extra `las` also ``.las`` and ``.laz``,
    with the extra `e57` also ``.e57``. What each may hold is told by its own reader (:func:`read_ply`, ...) and on
    the page about formats. Rows that are not finite are dropped, and counted in the log.

    Raises
    ------
    FileFormatError
        When the file is missing, of an unknown kind, or malformed; the message names the file and, in text, the
        line.
    MissingDependencyError
        When the format needs an extra that is not installed.
    """
    file = Path(path)
    if not file.is_file():
        raise FileFormatError(f"{file}: {'is a folder' if file.is_dir() else 'no such file'}")
    suffix = file.suffix.lower()
    if suffix not in FORMATS:
        raise FileFormatError(f"{file}: cannot read '{suffix or 'a name without ending'}' (known: {_names(FORMATS)})")
    return FORMATS[suffix].read(file)


def write_points(path: StrPath, cloud: PointCloud) -> None:
    """Write a point cloud in the format that the ending of its name says, complete or not at all.

    PLY, XYZ, CSV, TXT and NPY keep coordinates to the bit, PCD to 0.01 mm, LAS and LAZ to 1e-6 m up to an extent of
    2 km. Normals are kept as float32, but LAS and LAZ have no place for them, as NPY has none for colours; the log
    says so when they are left out.

    Raises
    ------
    OutputError
        When the ending is not known, or the file cannot be written.
    MissingDependencyError
        When the format needs an extra that is not installed.
    """
    suffix = Path(path).suffix.lower()
    write = FORMATS[suffix].write if suffix in FORMATS else None
    if write is None:
        known = _names(suffix for suffix, known in FORMATS.items() if known.write)
        raise OutputError(f"{path}: cannot write '{suffix or 'a name without ending'}' (known: {known})")
    write(path, cloud)


def _names(suffixes: Any) -> str:
    return ", ".join(suffix[1:].upper() for suffix in suffixes)
