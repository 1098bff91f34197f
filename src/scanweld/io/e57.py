"""E57 files of terrestrial scanners, through pye57 (extra `e57`).

The format: ASTM E2807-11; surface normals by the extension http://www.libe57.org/E57_EXT_surface_normals.txt.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Array, Float64, as_colors
from scanweld.errors import FileFormatError, MissingDependencyError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.columns import cloud_from_columns

_CHUNK = 1_000_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


def read_e57(path: str | os.PathLike[str]) -> PointCloud:
    """Read all scans of an E57 file as one cloud, each moved by its pose into the frame of the file.

    Normals and colours are kept where every scan has them. See :func:`read_e57_scans` for the scans one by one.

    Raises
    ------
    FileFormatError
        When the file is missing, is no E57 file, is damaged, or holds no scan.
    MissingDependencyError
        When pye57 is not installed: pip install 'scanweld[e57]'.
    """
    scans = read_e57_scans(path)
    normals = [scan.normals for scan in scans if scan.normals is not None]
    colors = [scan.colors for scan in scans if scan.colors is not None]
    return PointCloud(
        np.concatenate([scan.points_m for scan in scans]),
        np.concatenate(normals) if len(normals) == len(scans) else None,
        np.concatenate(colors) if len(colors) == len(scans) else None,
    )


def read_e57_scans(path: str | os.PathLike[str]) -> list[PointCloud]:
    """Read the scans of an E57 file, each moved by its pose into the frame of the file.

    Cartesian and spherical coordinates are read, colours, and normals of the extension. Points that the scanner
    marked as invalid, or that are not finite, are dropped, and counted in the log.

    Raises
    ------
    FileFormatError
        When the file is missing, is no E57 file, is damaged, or holds no scan.
    MissingDependencyError
        When pye57 is not installed: pip install 'scanweld[e57]'.
    """
    try:
        from pye57 import libe57
    except ImportError:
        raise MissingDependencyError("pye57", "e57") from None
    file = Path(path)
    _check_header(file)
    image = None
    try:
        image = libe57.ImageFile(str(file), "r")
        root = image.root()
        data = root["data3D"] if root.isDefined("data3D") else []
        nodes = [data[i] for i in range(len(data))]
        scans = [cloud_from_columns(file, _columns(libe57, image, node, file.stat().st_size)) for node in nodes]
    except (libe57.E57Exception, RuntimeError, ValueError, TypeError, KeyError, IndexError, MemoryError) as error:
        raise FileFormatError(f"{file}: not a readable E57 file: {str(error).partition(chr(10))[0]}") from None
    finally:
        if image is not None:
            image.close()
    if not scans:
        raise FileFormatError(f"{file}: holds no scan")
    return scans


def _check_header(path: Path) -> None:
    try:
        with path.open("rb") as stream:
            signature = stream.read(8)
    except OSError as error:
        raise FileFormatError(f"{path}: {error.strerror or error}") from None
    if signature != b"ASTM-E57":
        raise FileFormatError(f"{path}: not an E57 file: it does not begin with 'ASTM-E57'")


def _columns(libe57: Any, image: Any, scan: Any, file_size: int) -> dict[str, Array]:
    """Read one scan as columns in the frame of the file."""
    points = scan["points"]
    prototype = libe57.StructureNode(points.prototype())
    names = {prototype.get(i).elementName() for i in range(prototype.childCount())}
    place = next((group for group in (_CARTESIAN, _SPHERICAL) if names.issuperset(group)), None)
    if place is None:
        raise ValueError("a scan without cartesian or spherical coordinates")
    groups = [group for group in (place, _COLORS, _NORMALS) if names.issuperset(group)]
    wanted = [name for group in groups for name in group] + [name for name in _INVALID if name in names]
    bits = sum(_bits(libe57, prototype[name]) for name in names)
    count = points.childCount()
    if count * max(bits, 1) > 8 * file_size:
        raise ValueError(f"a scan promises {count} points of {bits} bits, the file has {file_size} bytes")
    table = _read(libe57, image, points, wanted, count)

    xyz = np.stack([table[name] for name in place], axis=1)
    if place is _SPHERICAL:
        xyz = _from_spherical(xyz)
    for name in _INVALID:
        if name in table:
            xyz[table[name] != 0] = np.nan
    T_file_scan = _pose(scan)
    cloud = PointCloud(xyz, np.stack([table[name] for name in _NORMALS], axis=1) if _NORMALS in groups else None)
    columns = cloud.transformed(T_file_scan).columns()
    if _COLORS in groups:
        colors = np.stack([table[name] for name in _COLORS], axis=1)
        largest = _number(scan, "colorLimits", "colorRedMaximum")
        if not largest > 0:
            largest = 255.0 if colors.max(initial=0.0) <= 255 else 65535.0
        columns |= zip(("red", "green", "blue"), as_colors(np.clip(colors / largest, 0, 1)).T, strict=True)
    return columns


def _read(libe57: Any, image: Any, points: Any, names: list[str], count: int) -> dict[str, Float64]:
    """Read the named fields as float64, piece by piece: memory is taken for what the file holds, not what it says."""
    size = max(1, min(count, _CHUNK))
    pieces = {name: np.empty(size) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name in names:
        buffers.append(libe57.SourceDestBuffer(image, name, pieces[name], size, True, True))
    parts: dict[str, list[Float64]] = {name: [] for name in names}
    reader = points.reader(buffers)
    got = 0
    while got < count and (rows := reader.read()):
        got += rows
        for name in names:
            parts[name].append(pieces[name][:rows].copy())
    reader.close()
    if got != count:
        raise ValueError(f"a scan promises {count} points, and has {got}")
    return {name: np.concatenate([np.empty(0), *part]) for name, part in parts.items()}


def _bits(libe57: Any, node: Any) -> int:
    """Bits that a value takes in the file at least: none where its limits leave one value, or it is text."""
    if isinstance(node, libe57.FloatNode):
        return 32 if node.precision() == libe57.E57_SINGLE else 64
    if isinstance(node, libe57.IntegerNode | libe57.ScaledIntegerNode):
        return int(node.maximum() - node.minimum()).bit_length()
    return 0


def _from_spherical(range_azimuth_elevation: Float64) -> Float64:
    """Convert to x, y, z: azimuth from x towards y, elevation from the x-y plane, radians (E2807, 8.4.4)."""
    distance, azimuth, elevation = range_azimuth_elevation.T
    level = distance * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _pose(scan: Any) -> Float64:
    """Return T_file_scan (4, 4), the identity where the scan has no pose."""
    quaternion = [_number(scan, "pose", "rotation", axis, default=float(axis == "w")) for axis in "xyzw"]
    translation = [_number(scan, "pose", "translation", axis) for axis in "xyz"]
    with np.errstate(all="ignore"):  # absurd numbers are refused below
        size = np.linalg.norm(quaternion)
    if not abs(size - 1) < 1e-3 or not np.isfinite(translation).all():
        raise ValueError(f"a scan's pose is no rigid transform: quaternion {quaternion}, translation {translation}")
    return se3.from_quaternion_xyzw(quaternion, translation)


def _number(node: Any, *names: str, default: float = 0.0) -> float:
    for name in names:
        if not node.isDefined(name):
            return default
        node = node[name]
    return float(node.scaledValue() if hasattr(node, "scaledValue") else node.value())
