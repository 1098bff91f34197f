"""Tables of numbers: text (XYZ, CSV, TXT) and NPY files, read and written, and rigid transforms as text."""

from __future__ import annotations

import io
import logging
import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from scanweld.arrays import Array, Float64, as_transform
from scanweld.errors import FileFormatError, InvalidInputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.atomic import write_file
from scanweld.io.columns import COLOR_NAMES, HasColumns, cloud_from_columns, drop_not_finite

logger = logging.getLogger(__name__)

_COMMENT = re.compile(r"(#|//)[^\r\n]*")
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


def read_text(path: str | os.PathLike[str]) -> PointCloud:
    """Read points from text: one point a line, separated by spaces, commas, semicolons or tabs.

    A header line that names the columns (x y z nx ny nz red green blue; others are ignored) says what they are.
    Without one there are 2, 3 or 6 columns, of which the last three are unit normals, or colours where they are
    integers from 0 to 255. Comments start with ``#`` or ``//``. Rows that are not finite are dropped, and counted
    in the log.

    Raises
    ------
    FileFormatError
        When the file is missing or malformed; the message names the file and the line.
    """
    table, header = _read_text_table(Path(path))
    names = [word.strip("\"'").lower() for word in header.split()]
    if len(names) != table.shape[1] or not {"x", "y"} <= set(names):
        return _cloud(Path(path), table)
    columns: dict[str, Array] = dict(zip(names, table.T, strict=True))
    colors = np.nan_to_num(table[:, [name in COLOR_NAMES for name in names]])
    if _are_bytes(colors):  # not fractions: 0 0 1 is nearly black
        columns |= zip((name for name in names if name in COLOR_NAMES), colors.astype(np.uint8).T, strict=True)
    cloud = cloud_from_columns(Path(path), columns)
    return cloud if cloud.normals is None else replace(cloud, normals=_normalised(cloud.normals))


def read_npy(path: str | os.PathLike[str]) -> PointCloud:
    """Read points from a NumPy file of shape (N, 2), (N, 3) or (N, 6), as text without a header.

    Raises
    ------
    FileFormatError
        When the file is missing, is no array of numbers, is shorter than its header promises, or of another shape.
    """
    try:
        # Mapped, not read: a header that promises more than the file holds is refused before allocation.
        array = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # the header is Python source: its parser raises what it likes
        raise FileFormatError(f"{path}: not a readable NPY file of numbers: {_one_line(error)}") from None
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise FileFormatError(
            f"{path}: expected numbers of shape (N, 2), (N, 3) or (N, 6), got {array.shape} {array.dtype}"
        )
    return _cloud(Path(path), np.array(array, dtype=np.float64))


def write_text(path: str | os.PathLike[str], thing: HasColumns) -> None:
    """Write the columns of `thing` with a header line that names them; every number reads back to the bit.

    Columns are separated by commas where the name ends in ``.csv``, by spaces otherwise.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    file = Path(path)
    separator = "," if file.suffix.lower() == ".csv" else " "
    columns = thing.columns()
    texts = [map(repr, values.tolist()) for values in columns.values()]  # repr reads back to the same number
    lines = [separator.join(columns), *map(separator.join, zip(*texts, strict=True)), ""]
    write_file(file, "\n".join(lines).encode("ascii"))


def write_npy(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write the points (N, D) as float64, in 3-D with their normals (N, 6); colours have no place there.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    table = cloud.points_m
    left_out = [] if cloud.colors is None else ["colours"]
    if cloud.normals is not None and cloud.dimension == 3:
        table = np.hstack([table, cloud.normals])
    elif cloud.normals is not None:
        left_out.append("normals")
    if left_out:
        logger.warning("%s: %s left out, which a plain array does not name", path, " and ".join(left_out))
    buffer = io.BytesIO()
    np.save(buffer, table)
    write_file(Path(path), buffer.getvalue())


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
    matrix, _ = _read_text_table(file)
    if matrix.shape in ((3, 4), (2, 3)):
        matrix = np.vstack([matrix, np.eye(matrix.shape[1])[-1]])
    if matrix.shape not in ((4, 4), (3, 3)):
        raise FileFormatError(f"{file}: expected a 4x4 or 3x3 transform, got {matrix.shape[0]}x{matrix.shape[1]}")
    try:
        return as_transform(matrix, str(file), dimension=len(matrix) - 1)
    except InvalidInputError as error:
        raise FileFormatError(str(error)) from None


def number_table(path: Path, lines: list[str], first_line: int, max_rows: int | None = None) -> Float64:
    """Parse lines of numbers separated by blanks into (N, columns); empty lines are passed over.

    Parameters
    ----------
    path, first_line : for messages: the file, and the number that the first of `lines` has in it
    max_rows : where to stop

    Raises
    ------
    FileFormatError
        When a line holds something else, or not as many numbers as the first one; it names the line.
    """
    rows = lines if max_rows is None else [line for line in lines if line.strip()][:max_rows]
    if not any(map(str.strip, rows)):
        return np.empty((0, 0))
    try:
        return np.loadtxt(rows, dtype=np.float64, ndmin=2, comments=None)
    except ValueError:
        raise FileFormatError(_first_fault(path, enumerate(lines, first_line))) from None


def _read_text_table(path: Path) -> tuple[Float64, str]:
    """Return the numbers (N, columns) and the header line, "" where there is none."""
    try:
        content = path.read_bytes()
        if content.startswith(_UTF16):
            raise FileFormatError(f"{path}: not a readable text file: UTF-16; save it as UTF-8")
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: not a readable text file: {_one_line(error)}") from None
    if "\0" in text:
        raise FileFormatError(f"{path}: not a readable text file: it holds zero bytes (binary, or UTF-16?)")
    if "#" in text or "//" in text:
        text = _COMMENT.sub("", text)
    if "," in text and ";" in text:
        raise FileFormatError(
            f"{path}: holds both ',' and ';': write numbers with decimal points, and separate them by one of the two"
        )
    for sign, replacement in ((",", " "), (";", " "), ("\r\n", "\n"), ("\r", "\n")):
        text = text.replace(sign, replacement)
    lines = text.split("\n")
    first = next((i for i, line in enumerate(lines) if line.strip()), len(lines))
    header = ""
    if first < len(lines) and not _is_numeric(lines[first]):
        header = lines[first].strip()
        first += 1
    table = number_table(path, lines[first:], first + 1)
    if len(table) == 0:
        raise FileFormatError(f"{path}: holds no points")
    return table, header


def _is_numeric(line: str) -> bool:
    try:
        [float(word) for word in line.split()]
    except ValueError:
        return False
    return "_" not in line  # Python reads 1_000, nobody else does


def _first_fault(path: Path, lines: Iterable[tuple[int, str]]) -> str:
    rows = ((number, line) for number, line in lines if line.strip())
    first, columns = 0, 0
    for number, line in rows:
        got = len(line.split())
        first, columns = first or number, columns or got
        if not _is_numeric(line):
            return f"{path}, line {number}: expected {columns} numbers, got {line.strip()[:60]!r}"
        if got != columns:
            return f"{path}, line {number}: expected {columns} columns as in line {first}, got {got}"
    return f"{path}: not a table of numbers"


def _cloud(path: Path, table: Float64) -> PointCloud:
    """Build a cloud from columns that have no names."""
    columns = table.shape[1]
    if columns not in (2, 3, 6):
        raise FileFormatError(
            f"{path}: expected 2, 3 or 6 columns (points, or points and normals), got {columns}; "
            "name them in a header line of a text file (x y z intensity), or keep the first three"
        )
    if columns < 6:
        return drop_not_finite(path, PointCloud(table))
    kept = drop_not_finite(path, PointCloud(table[:, :3], table[:, 3:]))
    extra = kept.normals
    assert extra is not None
    lengths = _lengths(extra)[:, 0]
    if (np.abs(lengths[lengths > 0] - 1) < 0.1).all():  # a normal that is zero is one that nobody knows
        return replace(kept, normals=_normalised(extra))
    if _are_bytes(extra):
        return PointCloud(kept.points_m, None, extra.astype(np.uint8))
    raise FileFormatError(
        f"{path}: columns 4 to 6 are neither unit normals nor colours from 0 to 255; keep the first three, "
        "or name them in a header line (x y z nx ny nz)"
    )


def _are_bytes(values: Float64) -> bool:
    return bool(((values >= 0) & (values <= 255) & (values == np.rint(values))).all())


def _lengths(vectors: Float64) -> Float64:
    with np.errstate(over="ignore"):  # beyond 1e154: infinite, hence no unit length
        return np.asarray(np.linalg.norm(vectors, axis=1, keepdims=True))


def _normalised(vectors: Float64) -> Float64:
    """Scale vectors to unit length, but for those that are zero, and those that are as good as unit (float32)."""
    lengths = _lengths(vectors)
    return np.where((lengths > 0) & (np.abs(lengths - 1) > 1e-6), vectors / np.where(lengths > 0, lengths, 1), vectors)


def _one_line(error: BaseException) -> str:
    return str(error).partition("\n")[0][:200]
