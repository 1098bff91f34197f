"""How near the mesh of a run is to what was measured, and the picture of it in the documentation.

    scanweld slam SEQUENCE --out RUN
    scanweld mesh RUN
    python benchmarks/mesh.py SEQUENCE RUN [--picture docs/images/mesh.png]

SEQUENCE needs true poses and depth without noise. The world of the run is put on the true one by the pose of the first
frame; the rest of the path is as the run has it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from plyfile import PlyData

import scanweld as sw
from scanweld.evaluation.surface_metrics import frame_points
from scanweld.geometry import se3
from scanweld.geometry.mesh import TriangleMesh
from scanweld.meshing.rendering import render_mesh
from scanweld.runs.output import look_at

REFERENCE_STEP, DRAWN_STEP = 4, 20
VERTEX_STEP = 3


def read_mesh(path: Path) -> TriangleMesh:
    """Read a mesh as `scanweld mesh` writes it."""
    file = PlyData.read(str(path))

    def columns(*names: str) -> np.ndarray:
        return np.stack([file["vertex"][name] for name in names], axis=1)

    triangles = np.vstack(file["face"]["vertex_indices"])
    return TriangleMesh(columns("x", "y", "z"), triangles, columns("nx", "ny", "nz"), columns("red", "green", "blue"))


def measure(mesh: TriangleMesh, sequence: sw.RgbdSequence, poses: np.ndarray) -> dict[str, float]:
    """Return the distances of vertices to measured points, and across the surface where the mesh is drawn again."""
    rows = range(0, len(sequence), REFERENCE_STEP)
    reference = np.concatenate([frame_points(sequence.read(i), poses[i]) for i in rows])
    nearest = sw.surface_accuracy(mesh.vertices_m[::VERTEX_STEP], reference)
    across, covered = [], []
    for i in range(5, len(sequence), DRAWN_STEP):
        level = sw.build_pyramid(sequence.read(i)).levels[0]
        view = render_mesh(mesh, poses[i], sequence.camera)
        seen = level.normals.any(axis=2)
        both = seen & (view.depth_m > 0)
        off = sequence.camera.back_project(view.depth_m) - level.vertices_m
        across.append(np.abs(np.einsum("hwd,hwd->hw", off, level.normals)[both]))
        covered.append(both.sum() / seen.sum())
    return {
        "triangles": len(mesh),
        "reference_points": len(reference),
        "nearest_mean_mm": 1e3 * nearest.mean_m,
        "nearest_median_mm": 1e3 * nearest.median_m,
        "nearest_within_1_cm": nearest.within[0.01],
        "across_median_mm": 1e3 * float(np.median(np.concatenate(across))),
        "covered": float(np.mean(covered)),
    }


def picture(mesh: TriangleMesh, poses: np.ndarray, camera: sw.PinholeCamera) -> np.ndarray:
    """Return the mesh from behind the cameras, in its colours and as a shape, side by side."""
    low, high = np.percentile(mesh.vertices_m, [1, 99], axis=0)
    middle, up = poses[len(poses) // 2], -poses[:, :3, 1].mean(axis=0)
    eye = poses[:, :3, 3].mean(axis=0) - 1.6 * middle[:3, 2] + 0.9 * up
    view = render_mesh(mesh, look_at(eye, (low + high) / 2, up), camera)
    used = np.flatnonzero((view.triangle >= 0).any(axis=1))
    pair = np.hstack([view.color, view.shaded()])[used[0] : used[-1] + 1]
    return cv2.resize(pair, None, fx=0.86, fy=0.86, interpolation=cv2.INTER_AREA)


def main() -> None:
    """Measure, and draw when that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--mesh", type=Path, help="default: RUN/mesh.ply")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    sequence = sw.open_sequence(options.sequence)
    path = sw.read_trajectory(options.run / "trajectory.txt")
    mesh = read_mesh(options.mesh or options.run / "mesh.ply")
    if sequence.ground_truth is None or len(sequence.ground_truth) != len(sequence):
        parser.error(f"{options.sequence}: has no true pose for each frame")
    poses = sequence.ground_truth.T_world_camera
    T_true_run = poses[0] @ se3.inverse(path.T_world_camera[0])
    print(json.dumps(measure(mesh.transformed(T_true_run), sequence, poses), indent=2))
    if options.picture:
        image = picture(mesh, path.T_world_camera, sequence.camera)
        cv2.imwrite(str(options.picture), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
