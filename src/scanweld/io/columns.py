"""What every point format shares: named columns become a cloud, and a cloud becomes named columns."""

from __future__ import annotations

import logging
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from scanweld.arrays import Array, Float64, UInt8, as_colors
from scanweld.errors import FileFormatError, OutputError
from scanweld.geometry.point_cloud import PointCloud

logger = logging.getLogger(__name__)

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
COLOR_NAMES = frozenset(name for names in _COLORS for name in names)


class HasColumns(Protocol):
    """Anything that can be written as a table of points: a PointCloud, a SurfelMap."""

    def columns(self) -> dict[str, Array]:
        """Return equally long 1-D arrays by property name, in file order."""


@runtime_checkable
class HasBatches(HasColumns, Protocol):
    """What can be written part by part, because it may be larger than memory: a SurfelMap."""

    def __len__(self) -> int:
        """Return the number of rows in all."""

    def batches(self) -> Iterator[dict[str, Array]]:
        """Yield `columns()` in parts, in order."""


def cloud_from_columns(path: Path, columns: Mapping[str, Array]) -> PointCloud:
    """Build a cloud from columns named as in PLY or PCD files.

    The columns x, y and z (without z the cloud is 2-D), nx, ny, nz or normal_x, normal_y, normal_z, and red,
    green, blue or r, g, b are used, in either case; others are ignored. Rows that are not finite are dropped,
    and counted in the log.

    Raises
    ------
    FileFormatError
        When there is no x and y.
    """
    named = {name.lower(): values for name, values in columns.items()}
    if "x" not in named or "y" not in named:
        raise FileFormatError(f"{path}: the points have no x and y, only {', '.join(columns) or 'nothing'}")
    axes = [axis for axis in "xyz" if axis in named]
    points = _stacked(named, axes)
    normals = None
    for prefix in ("n", "normal_"):
        if all(prefix + axis in named for axis in axes):
            normals = _stacked(named, [prefix + axis for axis in axes])
            break
    return drop_not_finite(path, PointCloud(points, normals, _colors(named)))


def columns_to_write(
    path: Path, columns: Mapping[str, Array], kinds: Container[str], file_kind: str
) -> dict[str, Array]:
    """Return columns as arrays of one length and of types that the file can hold.

    Parameters
    ----------
    kinds : NumPy's names of the types without byte order: "f4", "u1"
    file_kind : for the message: "PLY"

    Raises
    ------
    OutputError
        When the lengths differ, or a type has no place in the file.
    """
    columns = {name: np.asarray(values) for name, values in columns.items()}
    lengths = {name: values.shape for name, values in columns.items()}
    if len(set(lengths.values())) != 1 or any(values.ndim != 1 for values in columns.values()):
        raise OutputError(f"{path}: a {file_kind} file needs columns of one length, got {lengths}")
    for name, values in columns.items():
        if values.dtype.str[1:] not in kinds:
            raise OutputError(f"{path}: column '{name}' has type {values.dtype}, which {file_kind} cannot hold")
    return columns


def drop_not_finite(path: Path, cloud: PointCloud) -> PointCloud:
    """Return the cloud without the rows that hold a NaN or an infinity; the log says how many there were."""
    kept = cloud.finite()
    if len(kept) < len(cloud):
        logger.warning("%s: %d of %d points are not finite and were dropped", path, len(cloud) - len(kept), len(cloud))
    return kept


def _stacked(columns: Mapping[str, Array], names: list[str]) -> Float64:
    table = np.empty((len(columns[names[0]]), len(names)))
    with np.errstate(invalid="ignore"):  # a float32 that is a signalling NaN is a NaN like any other
        for i, name in enumerate(names):
            table[:, i] = columns[name]
    return table


def _colors(columns: Mapping[str, Array]) -> UInt8 | None:
    for names in _COLORS:
        if all(name in columns for name in names):
            break
    else:
        return None
    return as_colors(np.stack([columns[name] for name in names], axis=1))
