"""Point clouds of other libraries, told by the attributes they have; none of those libraries is imported."""

from __future__ import annotations

from typing import Any

from scanweld.arrays import as_colors, as_points
from scanweld.errors import InvalidInputError
from scanweld.geometry.point_cloud import PointCloud


def as_cloud(thing: Any, name: str = "cloud") -> PointCloud:
    """Return `thing` as a PointCloud.

    Accepted are

    - a PointCloud, returned as it is;
    - points (N, 2) or (N, 3): an array of any real type, what NumPy makes one of, a tensor on any device;
    - Open3D: `geometry.PointCloud` and `t.geometry.PointCloud` (on any device) with normals and colours;
    - trimesh: `PointCloud` with colours;
    - meshes of both (`TriangleMesh`, `Trimesh`): the vertices and their normals. Vertices are dense where the surface
      bends and sparse where it is flat; better sample the surface when it is to be aligned with a scan.

    A float64 array is not copied. Rows that are not finite are kept, because their partners in other arrays
    (weights) must go with them.

    Parameters
    ----------
    name : what to call it in messages

    Raises
    ------
    InvalidInputError
        When it is none of these.
    """
    if isinstance(thing, PointCloud):
        return thing
    for attribute in ("point", "vertex"):  # of a tensor cloud, of a tensor mesh
        if hasattr(getattr(thing, attribute, None), "__contains__"):
            return _from_tensors(getattr(thing, attribute), name)
    if hasattr(thing, "points") and hasattr(thing, "normals"):
        return _cloud(name, thing.points, thing.normals, getattr(thing, "colors", None))
    if hasattr(thing, "vertices"):
        return _cloud(name, thing.vertices, getattr(thing, "vertex_normals", None), getattr(thing, "colors", None))
    return PointCloud(as_points(_on_host(thing), name))


def _from_tensors(attributes: Any, name: str) -> PointCloud:
    """Read the attribute map of an Open3D tensor cloud."""
    if "positions" not in attributes:
        raise InvalidInputError(f"{name}: the point cloud has no positions")
    columns = [_on_host(attributes[key]) if key in attributes else None for key in ("positions", "normals", "colors")]
    return _cloud(name, *columns)


def _on_host(tensor: Any) -> Any:
    """Return the array of a tensor (Open3D, PyTorch), anything else as it is."""
    if hasattr(tensor, "numpy"):
        for method in ("detach", "cpu", "numpy"):
            if hasattr(tensor, method):
                tensor = getattr(tensor, method)()
    return tensor


def _cloud(name: str, points: Any, normals: Any, colors: Any) -> PointCloud:
    """Build a cloud; absent normals and colours are None or empty."""
    return PointCloud(
        as_points(points, name),
        None if normals is None or len(normals) == 0 else as_points(normals, f"{name}.normals"),
        None if colors is None or len(colors) == 0 else as_colors(colors, f"{name}.colors"),
    )
