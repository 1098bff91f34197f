"""The hot operations by themselves, on all threads: what one takes, beside copying as many bytes as it moves.

    python benchmarks/kernels.py [--data FOLDER] [--surfels MILLIONS] [--json]

The projective step with every pixel of the model as a point, the pyramid of a frame, and the view of a map: of
`livingroom1`, and of a map of millions of surfels of which half a million are in view. Medians and minima of 60 calls.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import scanweld as sw
from scanweld.geometry import se3
from scanweld.geometry.depth import build_pyramid
from scanweld.mapping.mapper import SurfelMapper
from scanweld.registration.projective import ProjectiveConfig, projective_step

CALLS = 60
STARTED = 12  # frames of the map that the step is tried with


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("SCANWELD_DATA") or Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--surfels", type=float, default=5.0, metavar="MILLIONS")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    figures = {**on_frames(arguments.data / "livingroom1"), **on_a_large_map(round(arguments.surfels * 1e6))}
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))


def timed(call: Callable[[], object]) -> dict[str, float]:
    """Milliseconds of a call: median and least."""
    call()
    taken = []
    for _ in range(CALLS):
        start = time.perf_counter()
        call()
        taken.append((time.perf_counter() - start) * 1e3)
    return {"median_ms": statistics.median(taken), "min_ms": min(taken)}


def on_frames(path: Path) -> dict[str, dict[str, float]]:
    """The step and the pyramid on recorded frames."""
    sequence = sw.open_sequence(path, frames=f"0:{STARTED}")
    mapper, frames = SurfelMapper(), list(sequence)
    slam = sw.build_slam(sequence.camera, mapper=mapper)
    for frame in frames:
        slam.process(frame)
    pyramid, T_world_camera = build_pyramid(frames[-1]), slam.results[-1].T_world_camera
    view = mapper.view(T_world_camera, sequence.camera)
    order = view.index_map[view.index_map >= 0]
    whole = np.concatenate([order, order])[: sequence.camera.width * sequence.camera.height]  # as many as pixels
    positions_m, normals = np.take(view.positions_m, whole, axis=1), np.take(view.normals, whole, axis=1)
    T_camera_world = se3.inverse(T_world_camera)
    centroid_m = se3.transform_points(T_camera_world, positions_m.T).mean(axis=0)
    config = ProjectiveConfig()

    def step() -> object:
        return projective_step(
            positions_m, normals, T_camera_world, pyramid.levels[0], config.fine_gate_m, config, centroid_m, 1.0
        )

    return {
        f"projective step, {positions_m.shape[1]} points": timed(step),
        "pyramid of 640x480, three levels, with brightness": timed(lambda: build_pyramid(frames[-1])),
        f"view of {len(mapper.map)} surfels, {len(view)} seen": timed(
            lambda: SurfelMapper.view(_forgetful(mapper), T_world_camera, sequence.camera)
        ),
    }


def on_a_large_map(count: int) -> dict[str, dict[str, float]]:
    """The view of a map of walls all around, a tenth of it before the camera."""
    camera = sw.PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
    rng = np.random.default_rng(0)
    in_view = count // 10
    u, v = rng.uniform(0, camera.width, in_view), rng.uniform(0, camera.height, in_view)
    depth = 2.5 + 0.5 * np.sin(u / 80) * np.cos(v / 60)
    near = np.stack([(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth])
    far = rng.uniform(-1, 1, (3, count - in_view)) * np.array([[15.0], [1.5], [0.0]])
    far[2] = -2.0  # a wall behind the camera
    mapper = SurfelMapper()
    for positions in (near, far):
        facing = (-positions / np.linalg.norm(positions, axis=0)).astype(np.float32)
        size = positions.shape[1]
        mapper.map.append(
            positions.astype(np.float32), facing, rng.integers(0, 256, (3, size)), np.full(size, 0.004, np.float32),
            np.full(size, 9, np.float32), 0,
        )  # fmt: skip
    pose = np.eye(4)
    seen = len(mapper.view(pose, camera))
    return {
        f"view of {count} surfels, {in_view} in view, {seen} seen": timed(
            lambda: SurfelMapper.view(_forgetful(mapper), pose, camera)
        )
    }


def _forgetful(mapper: SurfelMapper) -> SurfelMapper:
    """The mapper, which has to look at the map again."""
    mapper.last_seen = None
    return mapper


def text(figures: dict[str, dict[str, float]]) -> str:
    """A table for a person."""
    return "\n".join(f"{name:<58} {took['median_ms']:6.2f} ms ({took['min_ms']:.2f})" for name, took in figures.items())


if __name__ == "__main__":
    main()
