"""trimesh and PyVista: meshes and clouds."""

from __future__ import annotations

from typing import Any

import numpy as np

from scanweld.arrays import Array, as_colors
from scanweld.errors import InvalidInputError
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.mesh import TriangleMesh
from scanweld.geometry.point_cloud import PointCloud
from scanweld.interop import imported


def to_trimesh(thing: TriangleMesh | PointCloud) -> Any:
    """Return a `trimesh.Trimesh` or a `trimesh.PointCloud`, with colours; vertices keep their order.

    A `trimesh.PointCloud` has no normals, so those of a cloud are left out.

    Raises
    ------
    MissingDependencyError
        When trimesh is not installed.
    """
    trimesh = imported("trimesh", "trimesh")
    if isinstance(thing, TriangleMesh):
        return trimesh.Trimesh(
            thing.vertices_m.astype(np.float64),
            thing.triangles,
            vertex_normals=None if thing.normals is None else thing.normals.astype(np.float64),
            vertex_colors=thing.colors,
            process=False,
        )
    cloud = as_cloud(thing)
    return trimesh.PointCloud(_three(cloud.points_m), colors=cloud.colors)


def from_trimesh(thing: Any) -> TriangleMesh | PointCloud:
    """Return the mesh of a `trimesh.Trimesh`, the cloud of a `trimesh.PointCloud`.

    Raises
    ------
    InvalidInputError
        When it is neither; a `Scene` is turned into a mesh by its `to_mesh()`.
    """
    if hasattr(thing, "faces"):
        visual = getattr(thing, "visual", None)
        painted = getattr(visual, "kind", None) == "vertex"
        return TriangleMesh(
            np.asarray(thing.vertices, np.float32),
            np.asarray(thing.faces, np.int32),
            np.asarray(thing.vertex_normals, np.float32) if len(thing.faces) else None,
            as_colors(np.asarray(visual.vertex_colors)) if painted and visual is not None else None,
        )
    if hasattr(thing, "vertices"):
        return as_cloud(thing)
    raise InvalidInputError(f"{type(thing).__name__}: is neither a Trimesh nor a PointCloud of trimesh")


def to_pyvista(thing: TriangleMesh | PointCloud) -> Any:
    """Return a `pyvista.PolyData`; normals are the point data "Normals", colours "RGB".

    Raises
    ------
    MissingDependencyError
        When PyVista is not installed.
    """
    pyvista = imported("pyvista", "pyvista")
    if isinstance(thing, TriangleMesh):
        faces = np.column_stack([np.full(len(thing), 3, np.int64), thing.triangles.astype(np.int64)])
        made = pyvista.PolyData(thing.vertices_m, faces.ravel())
        normals, colors = thing.normals, thing.colors
    else:
        cloud = as_cloud(thing)
        made = pyvista.PolyData(_three(cloud.points_m))
        normals, colors = None if cloud.normals is None else _three(cloud.normals), cloud.colors
    if normals is not None:
        made.point_data["Normals"] = normals
    if colors is not None:
        made.point_data["RGB"] = colors
    return made


def from_pyvista(thing: Any) -> TriangleMesh | PointCloud:
    """Return the mesh of a `pyvista.PolyData` of triangles, or the cloud of one without faces.

    Raises
    ------
    InvalidInputError
        When it has faces of more than three corners; its `triangulate()` makes triangles.
    """
    if not hasattr(thing, "point_data"):
        raise InvalidInputError(f"{type(thing).__name__}: is no PolyData of PyVista")
    normals = np.asarray(thing.point_data["Normals"]) if "Normals" in thing.point_data else None
    colors = as_colors(np.asarray(thing.point_data["RGB"])) if "RGB" in thing.point_data else None
    faces = np.asarray(thing.faces, np.int64)
    points = np.asarray(thing.points)
    if len(faces) == 0:
        return PointCloud(points.astype(np.float64), None if normals is None else normals.astype(np.float64), colors)
    if len(faces) % 4 or (faces[::4] != 3).any():
        raise InvalidInputError("the PolyData has faces that are no triangles; triangulate() makes triangles of them")
    triangles = faces.reshape(-1, 4)[:, 1:].astype(np.int32)
    return TriangleMesh(
        points.astype(np.float32), triangles, None if normals is None else normals.astype(np.float32), colors
    )


def _three(values: Array) -> Array:
    """Return points (N, 3); 2-D ones get z = 0."""
    return values if values.shape[1] == 3 else np.column_stack([values, np.zeros(len(values))])
