"""Trajectory files: TUM, KITTI (3x4 rows, also in blocks), Redwood log and ICL-NUIM; plain or gzipped.

    format   content                                                    time
    tum      `timestamp tx ty tz qx qy qz qw` a line                    in the file [s]
    kitti    12 numbers (3x4, row-major) or 16 (4x4) a line, or
             blocks of three (four) lines of four numbers               line number / 30
    redwood  blocks of a line of three integers and a 4x4 matrix        block number / 30
    icl      tum or kitti content with the y axes flipped (ICL-NUIM)    as in that format

All hold T_world_camera in metres. ICL-NUIM describes its camera as x right, y up, z forward (which is why its
calibration prints fy = -480) in a world that is mirrored likewise; reading as `icl` turns both y axes:
T = F T_file F with F = diag(1, -1, 1, 1). Files named `*.gt.freiburg` and `*.gt.sim` are taken as ICL-NUIM.
"""

from __future__ import annotations

import gzip
import io
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.errors import FileFormatError, InvalidInputError
from scanweld.geometry import se3
from scanweld.io.atomic import write_file
from scanweld.trajectory import Trajectory

FRAMES_PER_SECOND = 30.0
"""Rate at which poses without a timestamp are taken."""

MAX_BYTES = 1 << 28
"""Largest trajectory text that is read (about two million poses); a gzip file must not unpack without end."""

POSE_TOLERANCE = 1e-3
"""Largest departure from a unit quaternion or a rotation that printing with few digits explains."""

_Rows = list[tuple[int, list[float]]]  # (line number, numbers)


def read_trajectory(path: str | os.PathLike[str], format: str = "auto") -> Trajectory:
    """Read T_world_camera over time from a file.

    Parameters
    ----------
    path : file, gzipped when its content says so
    format : "auto" (by name and content), "tum", "kitti", "redwood" or "icl"

    Raises
    ------
    FileFormatError
        When the file is missing, empty, of another format, or has a line that is not numbers, a timestamp
        that does not increase, or a pose that is not finite or not rigid; the message names file and line.
    InvalidInputError
        When the format is not one of the above.
    """
    path = Path(path)
    if format not in ("auto", *_PARSERS, "icl"):
        known = ", ".join(["auto", *_PARSERS, "icl"])
        raise InvalidInputError(f"trajectory format '{format}' is not known; known are {known}")
    rows = _number_rows(path)
    if not rows:
        raise FileFormatError(f"{path}: holds no pose")
    name = path.name.removesuffix(".gz")
    is_icl = format == "icl" or (format == "auto" and name.endswith((".gt.freiburg", ".gt.sim")))
    content = _guess(path, rows) if format in ("auto", "icl") else format
    lines, times, poses = _PARSERS[content](path, rows)
    _require_increasing(path, lines, times)
    if is_icl:
        poses = flip_y_axes(poses)
    return Trajectory(times, poses)


def read_pose(path: str | os.PathLike[str]) -> Float64 | None:
    """Read one T_world_camera (4, 4) from a text file of three or four lines of four numbers.

    Returns None when a value is not finite: recorders write such a matrix where they had lost the camera.

    Raises
    ------
    FileFormatError
        When the file is missing or holds anything but one rigid transform.
    """
    path = Path(path)
    rows = _number_rows(path)
    if len(rows) not in (3, 4) or any(len(values) != 4 for _, values in rows):
        raise FileFormatError(f"{path}: expected a 4x4 matrix, four lines of four numbers")
    matrix = np.array([[values for _, values in rows]])
    return _rigid(path, [rows[0][0]], matrix)[0] if np.isfinite(matrix).all() else None


def flip_y_axes(T_world_camera: npt.ArrayLike) -> Float64:
    """Return F T F, F = diag(1, -1, 1, 1), of (..., 4, 4): ICL-NUIM's y-up axes to ours, and back."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return np.asarray(flip @ np.asarray(T_world_camera, dtype=np.float64) @ flip)


def write_tum(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write `timestamp tx ty tz qx qy qz qw` lines at full precision (evo and the TUM tools read them).

    Raises
    ------
    OutputError
        When the file cannot be written; nothing is left half-written.
    """
    quaternions_xyzw = se3.quaternion_xyzw_from_rotation(trajectory.T_world_camera[:, :3, :3])
    rows = np.column_stack([trajectory.timestamps_s, trajectory.positions_m, quaternions_xyzw])
    _write(Path(path), "# timestamp_s tx ty tz qx qy qz qw (T_world_camera, m)\n" + _lines(rows))


def write_kitti(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write the 3x4 part of every pose as one line of 12 numbers; timestamps are not kept.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    _write(Path(path), _lines(trajectory.T_world_camera[:, :3].reshape(-1, 12)))


def write_redwood_log(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write blocks of `i i i+1` and a 4x4 matrix; timestamps are not kept.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    blocks = (f"{i} {i} {i + 1}\n{_lines(T)}" for i, T in enumerate(trajectory.T_world_camera))
    _write(Path(path), "".join(blocks))


def _lines(rows: Iterable[Float64]) -> str:
    # repr of a Python float is the shortest text that reads back as the same number.
    return "".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows)


def _write(path: Path, text: str) -> None:
    """Write aside, then rename: the file is complete or absent."""
    data = text.encode("ascii")
    if path.suffix == ".gz":
        data = gzip.compress(data, mtime=0)
    write_file(path, data)


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        if raw.startswith(b"\x1f\x8b"):
            with gzip.open(io.BytesIO(raw)) as unpacked:
                raw = unpacked.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise FileFormatError(f"{path}: is a folder, expected a trajectory file") from None
    except (OSError, EOFError, zlib.error) as error:
        raise FileFormatError(f"{path}: cannot be read: {error}") from None
    if len(raw) > MAX_BYTES:
        raise FileFormatError(f"{path}: larger than {MAX_BYTES >> 20} MB, which no trajectory is")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: not a text file") from None


def _number_rows(path: Path) -> _Rows:
    rows: _Rows = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        content = line.partition("#")[0].replace(",", " ").split()
        if not content:
            continue
        try:
            rows.append((number, [float(word) for word in content]))
        except ValueError:
            raise FileFormatError(f"{path}, line {number}: not numbers: {line.strip()[:60]!r}") from None
    return rows


def _guess(path: Path, rows: _Rows) -> str:
    first = len(rows[0][1])
    second = len(rows[1][1]) if len(rows) > 1 else 0
    if first == 8:
        return "tum"
    if first in (12, 16) or (first == 4 and second == 4):
        return "kitti"
    if first == 3 and second == 4:
        return "redwood"
    raise FileFormatError(
        f"{path}, line {rows[0][0]}: {first} numbers; expected 8 (TUM), 12 or blocks of three lines of 4 "
        "(KITTI), or 3 integers and a 4x4 matrix (Redwood log)"
    )


_Parsed = tuple[list[int], Float64, Float64]  # line numbers, timestamps_s (N,), T_world_camera (N, 4, 4)


def _parse_tum(path: Path, rows: _Rows) -> _Parsed:
    for line, values in rows:
        if len(values) != 8:
            raise FileFormatError(
                f"{path}, line {line}: expected 8 numbers (timestamp tx ty tz qx qy qz qw), got {len(values)}"
            )
    table = np.array([values for _, values in rows])
    lines = [line for line, _ in rows]
    _require_finite(path, lines, table)
    with np.errstate(over="ignore"):  # an absurd entry is refused below
        norms = np.linalg.norm(table[:, 4:], axis=1)
    wrong = np.abs(norms - 1) > POSE_TOLERANCE
    if wrong.any():
        at = int(np.argmax(wrong))
        raise FileFormatError(
            f"{path}, line {lines[at]}: the quaternion has norm {norms[at]:.4g}, expected 1; "
            "the columns are timestamp tx ty tz qx qy qz qw"
        )
    return lines, table[:, 0], se3.from_quaternion_xyzw(table[:, 4:], table[:, 1:4])


def _parse_kitti(path: Path, rows: _Rows) -> _Parsed:
    size = len(rows[0][1])
    if size in (12, 16):
        lines, matrices = _matrices(path, rows, 1, size)
    else:
        # Three or four lines a pose: only a 4x4 matrix has the fourth line 0 0 0 1.
        height = 4 if len(rows) > 3 and rows[3][1] == [0, 0, 0, 1] else 3
        lines, matrices = _matrices(path, rows, height, 4)
    return lines, np.arange(len(lines)) / FRAMES_PER_SECOND, _rigid(path, lines, matrices)


def _parse_redwood(path: Path, rows: _Rows) -> _Parsed:
    if len(rows) % 5:
        raise FileFormatError(f"{path}: {len(rows)} lines are no multiple of 5 (three integers and a 4x4); truncated?")
    for start in range(0, len(rows), 5):
        line, header = rows[start]
        if len(header) != 3:
            raise FileFormatError(f"{path}, line {line}: expected three integers, got {len(header)} numbers")
    lines, matrices = _matrices(path, [row for i, row in enumerate(rows) if i % 5], 4, 4)
    return lines, np.arange(len(lines)) / FRAMES_PER_SECOND, _rigid(path, lines, matrices)


_PARSERS: dict[str, Callable[[Path, _Rows], _Parsed]] = {
    "tum": _parse_tum,
    "kitti": _parse_kitti,
    "redwood": _parse_redwood,
}


def _matrices(path: Path, rows: _Rows, height: int, width: int) -> tuple[list[int], Float64]:
    """Group `height` rows of `width` numbers into matrices (N, 3 or 4, 4); return the line each begins at."""
    for line, values in rows:
        if len(values) != width:
            raise FileFormatError(f"{path}, line {line}: expected {width} numbers, got {len(values)}")
    if len(rows) % height:
        raise FileFormatError(f"{path}: {len(rows)} lines are no multiple of {height} (a matrix each); truncated?")
    table = np.array([values for _, values in rows])
    _require_finite(path, [line for line, _ in rows], table)
    count = len(rows) // height
    return [rows[i * height][0] for i in range(count)], table.reshape(count, -1, 4)


def _rigid(path: Path, lines: list[int], matrices: Float64) -> Float64:
    """Return (N, 4, 4) from (N, 3 or 4, 4); rotations are checked, then made exactly orthonormal."""
    poses = np.tile(np.eye(4), (len(matrices), 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    rotations = poses[:, :3, :3]
    with np.errstate(all="ignore"):  # absurd entries are refused below
        defect = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
        determinant = np.linalg.det(rotations)
    last_row = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1)
    wrong = ~(defect <= POSE_TOLERANCE) | ~(determinant > 0) | (last_row > POSE_TOLERANCE)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise FileFormatError(
            f"{path}, line {lines[at]}: not a rigid pose (|R^T R - I| = {defect[at]:.2g}, "
            f"det R = {determinant[at]:.3g}); remove it, or divide a scale out"
        )
    u, _, vt = np.linalg.svd(rotations)
    poses[:, :3, :3] = u @ vt
    poses[:, 3] = [0, 0, 0, 1]
    return poses


def _require_finite(path: Path, lines: list[int], table: Float64) -> None:
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise FileFormatError(f"{path}, line {lines[int(np.argmax(bad))]}: a value is not finite; remove the pose")


def _require_increasing(path: Path, lines: list[int], times: Float64) -> None:
    wrong = np.diff(times) <= 0
    if wrong.any():
        at = int(np.argmax(wrong)) + 1
        what = "repeats" if times[at] == times[at - 1] else "is before"
        fix = "remove one of the two" if times[at] == times[at - 1] else "sort the file by its first column"
        raise FileFormatError(
            f"{path}, line {lines[at]}: timestamp {times[at]:.6f} {what} {times[at - 1]:.6f} above it; {fix}"
        )
