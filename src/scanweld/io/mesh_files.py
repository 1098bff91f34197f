"""Triangle meshes in files: PLY, Wavefront OBJ and binary glTF (GLB), by the ending of the name.

PLY and OBJ keep coordinates as they are: the world of the run, whose axes are those of the first camera (x right,
y down, z forward). glTF says that y is up, so a GLB file turns the mesh by 180 degrees about x, as a transform of its
only node.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Array, UInt8
from scanweld.errors import OutputError
from scanweld.geometry.mesh import TriangleMesh
from scanweld.io.atomic import write_file

_PLY_NAMES = {"f4": "float", "u1": "uchar"}
_FLOAT, _UNSIGNED_SHORT, _UNSIGNED_INT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963


def write_mesh(path: str | os.PathLike[str], mesh: TriangleMesh) -> None:
    """Write a mesh as PLY, OBJ or GLB, complete or not at all.

    Raises
    ------
    OutputError
        When the ending of the name is another one, or the file cannot be written.
    """
    file = Path(path)
    write_file(file, writer_for(file)(mesh))


def writer_for(path: Path) -> Callable[[TriangleMesh], bytes]:
    """Return what makes the content of such a file; raises OutputError when nothing does."""
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        known = ", ".join(suffix[1:].upper() for suffix in WRITERS)
        raise OutputError(f"{path}: cannot write a mesh as '{path.suffix or 'a name without ending'}' (known: {known})")
    return writer


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """Return a binary little-endian PLY file (http://paulbourke.net/dataformats/ply)."""
    columns = mesh.columns()
    table = np.empty(len(mesh.vertices_m), [(name, "<" + values.dtype.str[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    faces = np.empty(len(mesh), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    header = [
        "ply", "format binary_little_endian 1.0", "comment scanweld, metres", f"element vertex {len(table)}",
        *(f"property {_PLY_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    return "\n".join(header).encode("ascii") + table.tobytes() + faces.tobytes()


def obj_bytes(mesh: TriangleMesh) -> bytes:
    """Return a Wavefront OBJ file, to 0.01 mm; colours are fractions after the coordinates, as most programs read."""
    columns, form = [mesh.vertices_m.astype(np.float64)], "v %.5f %.5f %.5f"
    if mesh.colors is not None:
        columns.append(mesh.colors / 255.0)
        form += " %.4f %.4f %.4f"
    parts = ["# scanweld, metres\n", _lines(form, np.concatenate(columns, axis=1))]
    corners = mesh.triangles + 1
    if mesh.normals is None:
        parts.append(_lines("f %d %d %d", corners))
    else:
        parts.append(_lines("vn %.4f %.4f %.4f", mesh.normals))
        parts.append(_lines("f %d//%d %d//%d %d//%d", np.repeat(corners, 2, axis=1)))
    return "".join(parts).encode("ascii")


def _lines(form: str, rows: Array) -> str:
    return "".join([form % tuple(row) + "\n" for row in rows.tolist()])


def glb_bytes(mesh: TriangleMesh) -> bytes:
    """Return a binary glTF 2.0 file (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, section 4).

    Colours are painted, not lit (KHR_materials_unlit), because the light is in them already.
    """
    content = bytearray()
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []

    def add(values: Array, kind: str, component: int, target: int, **more: Any) -> int:
        data = np.ascontiguousarray(values).tobytes()
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": len(data), "target": target})
        content.extend(data + bytes(-len(data) % 4))
        accessor = {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind}
        accessors.append({**accessor, **more})
        return len(accessors) - 1

    vertices = mesh.vertices_m
    bounds = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()} if len(vertices) else {}
    attributes = {"POSITION": add(vertices, "VEC3", _FLOAT, _VERTICES, **bounds)}
    if mesh.normals is not None:
        unit = np.where(mesh.normals.any(axis=1, keepdims=True), mesh.normals, np.array([0, 0, -1], np.float32))
        attributes["NORMAL"] = add(unit.astype(np.float32), "VEC3", _FLOAT, _VERTICES)
    if mesh.colors is not None:
        attributes["COLOR_0"] = add(_linear(mesh.colors), "VEC4", _UNSIGNED_SHORT, _VERTICES, normalized=True)
    indices = add(mesh.triangles.astype(np.uint32).reshape(-1), "SCALAR", _UNSIGNED_INT, _INDICES)
    unlit: dict[str, Any] = {"extensions": {"KHR_materials_unlit": {}}} if mesh.colors is not None else {}
    material = {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, **unlit}
    document = {
        "asset": {"version": "2.0", "generator": "scanweld"},
        **({"extensionsUsed": ["KHR_materials_unlit"]} if unlit else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [1.0, 0.0, 0.0, 0.0]}],  # x y z w
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(content)
    head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(content), b"BIN\0") + bytes(content)


def _linear(colors: UInt8) -> Array:
    """Return linear RGBA (N, 4) uint16 of sRGB bytes: vertex colours of glTF are linear."""
    s = np.arange(256) / 255
    curve = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    table = np.rint(65535 * curve).astype(np.uint16)
    return np.concatenate([table[colors], np.full((len(colors), 1), 65535, np.uint16)], axis=1)


WRITERS: dict[str, Callable[[TriangleMesh], bytes]] = {".ply": ply_bytes, ".obj": obj_bytes, ".glb": glb_bytes}
"""What makes a file of each kind, by the ending of its name."""
