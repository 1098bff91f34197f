"""The surface in a grid of distances, as triangles that share their vertices."""

from __future__ import annotations

import numpy as np

from scanweld.geometry.mesh import TriangleMesh
from scanweld.meshing.extraction import kernels
from scanweld.meshing.extraction.cases import case_table
from scanweld.meshing.volume import TsdfVolume
from scanweld.parallel import run_ranges


def extract_mesh(volume: TsdfVolume, *, least_weight: float = 0.0) -> TriangleMesh:
    """Return the surface where the distance is zero, by marching cubes over all blocks.

    Vertices lie on edges of the grid and each is made once, also at the borders of blocks, so there are no seams. Cells
    with a corner that was not observed have no triangles: holes stay holes.

    Parameters
    ----------
    volume : what was fused
    least_weight : samples of this weight or less count as not observed
    """
    keys, table = volume.keys, volume.table
    distances, weights, colors = volume.distances_m, volume.weights, volume.colors
    order = np.argsort(keys)  # so that the mesh does not depend on the order in which blocks were seen
    cases = case_table()
    deepest = np.float32(volume.config.deepest)
    firsts = np.zeros(len(order) + 1, np.int64)
    corners = np.empty(0, np.int64)

    def march(write: bool) -> None:
        def blocks(start: int, stop: int) -> None:
            kernels.march_blocks(
                start, stop, order, keys, table, distances, weights, np.float32(least_weight), deepest, cases, firsts,
                write, corners,
            )  # fmt: skip

        run_ranges(len(order), blocks, grain=64)

    march(False)
    np.cumsum(firsts, out=firsts)
    corners = np.empty(int(firsts[-1]), np.int64)
    march(True)
    edges, rows = np.unique(corners, return_inverse=True)
    vertices = np.empty((len(edges), 3))
    vertex_colors = np.empty((len(edges), 3), np.uint8)

    def place(start: int, stop: int) -> None:
        kernels.place_vertices(
            start, stop, edges, keys, table, distances, colors, volume.voxel_m, vertices, vertex_colors
        )

    run_ranges(len(edges), place, grain=4096)
    triangles = rows.reshape(-1, 3).astype(np.int32)
    return TriangleMesh(vertices.astype(np.float32), triangles, colors=vertex_colors)
