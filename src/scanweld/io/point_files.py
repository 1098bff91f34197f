"""Point files of any known kind: PLY, XYZ / CSV / TXT, NPY; and rigid transforms as text."""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path

import numpy as np

from scanweld.arrays import Float64, as_transform, finite_rows
from scanweld.errors import FileFormatError, InvalidInputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.ply import read_ply

logger = logging.getLogger(__name__)

TEXT_SUFFIXES = (".xyz", ".csv", ".txt")
_FORMATS = "PLY, XYZ, CSV, TXT, NPY"
_SEPARATORS = str.maketrans(",;\t", "   ")


def read_points(path: str | os.PathLike[str]) -> PointCloud:
    """Read a point cloud by the ending of its name.

    ``.ply``; ``.xyz``, ``.csv`` and ``.txt`` with 2, 3 or 6 columns separated by spaces, commas or
    semicolons, a header line and ``#`` comments allowed; ``.npy`` with 2, 3 or 6 columns. Of six columns the
    last three are normals, or colours where the header says so or the values are integers up to 255. Rows
    that are not finite are dropped, and counted in the log.

    Raises
    ------
    FileFormatError
        When the file is missing, of an unknown kind, or malformed; the message names the file and the line.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if not file.is_file():
        raise FileFormatError(f"{file}: {'is a folder' if file.is_dir() else 'no such file'}")
    if suffix == ".ply":
        return read_ply(file)
    if suffix in TEXT_SUFFIXES:
        table, header = _read_text(file)
    elif suffix == ".npy":
        table, header = _read_npy(file), ""
    else:
        raise FileFormatError(f"{file}: cannot read '{suffix or 'a name without ending'}' (known: {_FORMATS})")
    return _cloud(file, table, header)


def read_transform(path: str | os.PathLike[str]) -> Float64:
    """Read a rigid transform, 4x4 (3-D) or 3x3 (2-D) numbers as text; the last row may be absent.

    Raises
    ------
    FileFormatError
        When the file is missing or does not hold a rigid transform.
    """
    file = Path(path)
    if not file.is_file():
        raise FileFormatError(f"{file}: no such file")
    matrix, _ = _read_text(file)
    if matrix.shape in ((3, 4), (2, 3)):
        matrix = np.vstack([matrix, np.eye(matrix.shape[1])[-1]])
    if matrix.shape not in ((4, 4), (3, 3)):
        raise FileFormatError(f"{file}: expected a 4x4 or 3x3 transform, got {matrix.shape[0]}x{matrix.shape[1]}")
    try:
        return as_transform(matrix, str(file), dimension=len(matrix) - 1)
    except InvalidInputError as error:
        raise FileFormatError(str(error)) from None


def _read_text(file: Path) -> tuple[Float64, str]:
    """Return the numbers (N, columns) and the header line, "" where there is none."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{file}: not a readable text file: {error}") from None
    lines = [re.split(r"#|//", line, maxsplit=1)[0].translate(_SEPARATORS).strip() for line in text.splitlines()]
    rows = [(number, line) for number, line in enumerate(lines, 1) if line]
    header = ""
    if rows and not _is_numeric(rows[0][1]):
        header = rows.pop(0)[1]
    if not rows:
        raise FileFormatError(f"{file}: holds no points")
    try:
        return np.loadtxt([line for _, line in rows], dtype=np.float64, ndmin=2, comments=None), header
    except ValueError:
        raise FileFormatError(_first_fault(file, rows)) from None


def _is_numeric(line: str) -> bool:
    try:
        [float(word) for word in line.split()]
    except ValueError:
        return False
    return True


def _first_fault(file: Path, rows: list[tuple[int, str]]) -> str:
    columns = len(rows[0][1].split())
    for number, line in rows:
        if not _is_numeric(line):
            return f"{file}, line {number}: expected {columns} numbers, got {line[:60]!r}"
        if len(line.split()) != columns:
            got = len(line.split())
            return f"{file}, line {number}: expected {columns} columns as in line {rows[0][0]}, got {got}"
    return f"{file}: not a table of numbers"


def _read_npy(file: Path) -> Float64:
    try:
        # Mapped, not read: a header that promises more than the file holds is refused before allocation.
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, OverflowError, MemoryError) as error:
        raise FileFormatError(f"{file}: not a readable NPY file of numbers: {error}") from None
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        shape = getattr(array, "shape", "no array")
        raise FileFormatError(f"{file}: expected numbers of shape (N, 2), (N, 3) or (N, 6), got {shape}")
    return np.array(array, dtype=np.float64)


def _cloud(file: Path, table: Float64, header: str) -> PointCloud:
    columns = table.shape[1]
    if columns not in (2, 3, 6):
        raise FileFormatError(f"{file}: expected 2, 3 or 6 columns (points, or points and normals), got {columns}")
    mask = finite_rows(table)
    if not mask.all():
        logger.warning("%s: %d of %d rows are not finite and were dropped", file, (~mask).sum(), len(mask))
        table = table[mask]
    if columns < 6:
        return PointCloud(table)
    points, extra = table[:, :3], table[:, 3:]
    named = [word.strip("\"'").lower() for word in header.split()]
    lengths = np.linalg.norm(extra, axis=1)
    # A normal that is zero is one that nobody knows.
    unit = bool((np.abs(lengths[lengths > 0] - 1) < 0.1).all())
    whole = bool(((extra >= 0) & (extra <= 255) & (extra == np.rint(extra))).all())
    if "nx" in named or ("red" not in named and "r" not in named and unit):
        normals = extra / np.where(lengths > 0, lengths, 1.0)[:, None]
        return PointCloud(points, normals)
    if whole:
        return PointCloud(points, None, extra.astype(np.uint8))
    raise FileFormatError(
        f"{file}: columns 4 to 6 are neither unit normals nor colours from 0 to 255; keep the first three, "
        "or name them in a header line (x y z nx ny nz)"
    )
