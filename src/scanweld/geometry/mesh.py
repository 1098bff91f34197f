"""Triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Array, Float32, Float64, Int32, UInt8
from scanweld.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class TriangleMesh:
    """Triangles over shared vertices; seen from outside, the corners of a triangle go anticlockwise.

    Attributes
    ----------
    vertices_m : (N, 3) float32, world frame [m]
    triangles : (M, 3) int32, rows of vertices
    normals : (N, 3) float32, unit, or None; (0, 0, 0) where unknown
    colors : (N, 3) uint8 RGB, or None

    Raises
    ------
    InvalidInputError
        When shapes do not match, or a triangle names a vertex that there is not.
    """

    vertices_m: Float32
    triangles: Int32
    normals: Float32 | None = None
    colors: UInt8 | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_m, np.float32)
        triangles = np.ascontiguousarray(self.triangles, np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
            raise InvalidInputError(
                f"mesh: expected vertices (N, 3) and triangles (M, 3), got {vertices.shape} and {triangles.shape}"
            )
        if len(triangles) and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
            raise InvalidInputError(f"mesh: a triangle names a vertex outside 0..{len(vertices) - 1}")
        object.__setattr__(self, "vertices_m", vertices)
        object.__setattr__(self, "triangles", triangles)
        if self.normals is not None:
            object.__setattr__(self, "normals", self._one_per_vertex(self.normals, np.float32, "normals"))
        if self.colors is not None:
            object.__setattr__(self, "colors", self._one_per_vertex(self.colors, np.uint8, "colors"))

    def _one_per_vertex(self, values: npt.ArrayLike, dtype: npt.DTypeLike, name: str) -> Array:
        array = np.asarray(values)
        if array.shape != self.vertices_m.shape or (dtype == np.uint8 and array.dtype != np.uint8):
            expected = f"{self.vertices_m.shape} {np.dtype(dtype).name}"
            raise InvalidInputError(f"mesh: {name}: expected {expected}, got {array.shape} {array.dtype}")
        return np.ascontiguousarray(array, dtype)

    def __len__(self) -> int:
        """Return the number of triangles."""
        return len(self.triangles)

    @property
    def doubled_areas(self) -> Float64:
        """Vectors (M, 3) along the triangles' normals, as long as twice their areas [m^2]."""
        a, b, c = (self.vertices_m[self.triangles[:, k]].astype(np.float64) for k in range(3))
        return np.asarray(np.cross(b - a, c - a))

    @property
    def area_m2(self) -> float:
        """Area of the surface [m^2]."""
        return float(np.linalg.norm(self.doubled_areas, axis=1).sum() / 2)

    def columns(self) -> dict[str, Array]:
        """Return the vertices as columns of a PLY file in their usual order."""
        columns: dict[str, Array] = dict(zip("xyz", self.vertices_m.T, strict=True))
        if self.normals is not None:
            columns |= zip(("nx", "ny", "nz"), self.normals.T, strict=True)
        if self.colors is not None:
            columns |= zip(("red", "green", "blue"), self.colors.T, strict=True)
        return columns

    def select(self, rows: npt.ArrayLike) -> TriangleMesh:
        """Return the mesh of the selected triangles, a mask or indices, without vertices that none of them uses."""
        triangles = self.triangles[np.asarray(rows)]
        used = np.zeros(len(self.vertices_m), np.bool_)
        used[triangles] = True
        new_row = (np.cumsum(used) - 1).astype(np.int32)
        return TriangleMesh(
            self.vertices_m[used],
            new_row[triangles],
            None if self.normals is None else self.normals[used],
            None if self.colors is None else self.colors[used],
        )

    def transformed(self, T_new_old: npt.ArrayLike) -> TriangleMesh:
        """Return the mesh moved by a rigid transform (4, 4)."""
        T = np.asarray(T_new_old, np.float64)
        vertices = self.vertices_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        normals = None if self.normals is None else (self.normals @ T[:3, :3].T).astype(np.float32)
        return replace(self, vertices_m=vertices.astype(np.float32), normals=normals)

    def with_normals(self) -> TriangleMesh:
        """Return the mesh with vertex normals: those of the triangles around, weighted by area."""
        doubled = self.doubled_areas
        total = np.empty((len(self.vertices_m), 3))
        corners = self.triangles.ravel()
        for axis in range(3):
            total[:, axis] = np.bincount(corners, np.repeat(doubled[:, axis], 3), minlength=len(total))
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return replace(self, normals=(total / np.where(length > 0, length, 1.0)).astype(np.float32))
