"""What makes a mesh fit to be passed on: without crumbs, and with small holes closed where that is wanted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scanweld.arrays import Float32, Int32, Int64, UInt8
from scanweld.geometry.mesh import TriangleMesh


def without_small_pieces(mesh: TriangleMesh, least_triangles: int) -> TriangleMesh:
    """Return the mesh without connected pieces of fewer triangles; noise in front of edges leaves such crumbs."""
    if least_triangles <= 1 or len(mesh) == 0:
        return mesh
    a, b, c = mesh.triangles.T
    size = len(mesh.vertices_m)
    links = coo_array((np.ones(2 * len(a), np.bool_), (np.r_[a, b], np.r_[b, c])), shape=(size, size))
    _, piece = connected_components(links, directed=False)
    of_triangle = piece[a]
    return mesh.select(np.bincount(of_triangle)[of_triangle] >= least_triangles)


def border_loops(mesh: TriangleMesh) -> list[Int64]:
    """Return the borders of the holes as rows of vertices, in the direction in which triangles that fill them go.

    Loops that touch at a vertex are left out: which way they go on there is not determined.
    """
    if len(mesh) == 0:
        return []
    tail, head = mesh.triangles.ravel().astype(np.int64), np.roll(mesh.triangles, -1, axis=1).ravel().astype(np.int64)
    count = len(mesh.vertices_m)
    alone = ~np.isin(tail * count + head, head * count + tail)
    tail, head = head[alone], tail[alone]  # a triangle beyond the border runs along it the other way
    simple = (np.bincount(tail, minlength=count) <= 1) & (np.bincount(head, minlength=count) <= 1)
    following = np.full(count, -1, np.int64)
    following[tail] = head
    loops, done = [], np.zeros(count, np.bool_)
    for first in np.unique(tail):
        if done[first]:
            continue
        loop, at = [], first
        while at >= 0 and not done[at]:
            done[at] = True
            loop.append(at)
            at = following[at]
        if at == first and simple[loop].all():
            loops.append(np.array(loop))
    return loops


def with_small_holes_filled(mesh: TriangleMesh, longest_border_m: float) -> TriangleMesh:
    """Return the mesh with holes closed whose border is at most so long [m], by a fan about the middle of the border.

    What is filled was not observed. Borders of at least three vertices only; the outer border of a surface that small
    would be one as well, so leave small pieces out first.
    """
    if longest_border_m <= 0:
        return mesh
    vertices: list[Float32] = [mesh.vertices_m]
    colors: list[UInt8] = [] if mesh.colors is None else [mesh.colors]
    triangles: list[Int32] = [mesh.triangles]
    row = len(mesh.vertices_m)
    for loop in border_loops(mesh):
        corners = mesh.vertices_m[loop]
        length = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())
        if len(loop) < 3 or length > longest_border_m:
            continue
        if len(loop) == 3:
            triangles.append(loop[None].astype(np.int32))
            continue
        vertices.append(corners.mean(axis=0, keepdims=True))
        if mesh.colors is not None:
            colors.append(np.rint(mesh.colors[loop].mean(axis=0, keepdims=True)).astype(np.uint8))
        fan = np.stack([loop, np.roll(loop, -1), np.full(len(loop), row)], axis=1)
        triangles.append(fan.astype(np.int32))
        row += 1
    return replace(
        mesh,
        vertices_m=np.concatenate(vertices),
        triangles=np.concatenate(triangles),
        normals=None,
        colors=np.concatenate(colors) if colors else None,
    )
