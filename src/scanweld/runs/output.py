"""What a run folder holds."""

from __future__ import annotations

import csv
import json
import logging
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scanweld.arrays import Float64
from scanweld.backends import get_backend
from scanweld.config import to_toml
from scanweld.datasets.base import RgbdSequence
from scanweld.evaluation.trajectory_metrics import AteResult
from scanweld.evaluation.trajectory_plot import plot_trajectory_error
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.ply import write_ply
from scanweld.io.trajectory_files import write_tum
from scanweld.mapping.rendering import render_picture
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import get_num_threads, processor, side_by_side
from scanweld.report.page import write_report
from scanweld.report.plots import plot_path, plot_tracking
from scanweld.runs.summary import Outcome
from scanweld.slam.config import SlamConfig
from scanweld.slam.motion import trajectory_of
from scanweld.trajectory import FrameResult, Trajectory

logger = logging.getLogger(__name__)

RENDER_WIDTH = 800
"""Width of the pictures of the map [pixels]."""

PICTURE_CONFIDENCE = 2.0
"""Surfels below this are left out of pictures."""

_SAMPLED = 20_000  # surfels that say where and how sure the map is

STAGES = ("surfaces", "view", "track", "fuse", "loop")


def write_run(
    folder: Path,
    outcome: Outcome,
    sequence: RgbdSequence,
    config: SlamConfig,
    metrics: dict[str, Any],
    error: AteResult | None,
    *,
    tracked_only: bool,
    description: Mapping[str, Any],
    started: float,
) -> None:
    """Write every file of a run into an empty folder; metrics["seconds_total"] is brought up to date."""
    trajectory, surfels = outcome.trajectory, outcome.map
    (folder / "config.toml").write_text(to_toml(config), encoding="utf-8")
    write_tum(folder / "trajectory.txt", trajectory_of(outcome.main_results, tracked_only=tracked_only))
    write_ply(folder / "map.ply", surfels)
    write_submaps(folder, outcome)
    write_frames(folder / "frames.csv", outcome.results)
    side_by_side(
        lambda: write_plots(folder / "plots", outcome.results, trajectory, error, sequence.name),
        lambda: write_renders(folder / "renders", surfels, trajectory, sequence.camera),
    )
    if sequence.ground_truth is not None:
        write_tum(folder / "groundtruth.txt", sequence.ground_truth)
    write_keyframes(folder / "keyframes.csv", outcome)
    recording = {"name": sequence.name, "intrinsics": asdict(sequence.camera)}
    _write_json(folder / "run.json", {**_environment(config), **recording, **description})
    metrics["seconds_total"] = time.perf_counter() - started
    _write_json(folder / "metrics.json", metrics)
    try:
        write_report(folder)
    except Exception:  # the run is there and complete: a page about it can be made again, an hour of tracking cannot
        logger.exception("report.html could not be made; `scanweld report` tries again")


def write_submaps(folder: Path, outcome: Outcome) -> None:
    """Write map-K.ply and trajectory-K.txt of each submap K that was not joined, in its own world."""
    for submap in outcome.unjoined:
        write_ply(folder / f"map-{submap}.ply", outcome.maps[submap])
        mine = [result for result in outcome.results if result.submap == submap]
        write_tum(folder / f"trajectory-{submap}.txt", trajectory_of(mine, tracked_only=True))


def write_frames(path: Path, results: Sequence[FrameResult]) -> None:
    """Write one line a frame: state, why, quality, time of each stage."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["frame", "timestamp", "status", "alignment", "rmse", "loss", "inliers", "overlap", "surfels", "submap"]
            + [f"ms_{stage}" for stage in STAGES]
            + ["note"]
        )
        for r in results:
            writer.writerow(
                [r.index, repr(r.timestamp_s), r.state.value, r.status, f"{r.rmse_m:.9g}", f"{r.loss:.9g}"]
                + [r.num_inliers, f"{r.overlap:.6f}", r.num_surfels, r.submap]
                + [f"{r.stage_ms.get(stage, 0.0):.3f}" for stage in STAGES]
                + [r.note]
            )


def write_keyframes(path: Path, outcome: Outcome) -> None:
    """Write the frame of every keyframe, and with which earlier keyframes' frames a loop ties it (space between)."""
    frames = outcome.keyframe_frames
    if frames is None:
        return
    tied: dict[int, list[str]] = {}
    for i, j in outcome.loops:
        tied.setdefault(max(i, j), []).append(str(frames[min(i, j)]))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "loop"])
        writer.writerows([frame, " ".join(tied.get(k, ()))] for k, frame in enumerate(frames))


def write_plots(
    folder: Path, results: Sequence[FrameResult], trajectory: Trajectory, error: AteResult | None, name: str
) -> None:
    """Draw how tracking went, and the path: beside the truth, where there is one."""
    folder.mkdir()
    plot_tracking(results, folder / "tracking.png")
    if error is not None:
        plot_trajectory_error(error, folder / "trajectory.png", title=name)
    else:
        plot_path(trajectory.positions_m, folder / "trajectory.png", f"{name}: estimated path")


def write_renders(folder: Path, surfels: SurfelMap, trajectory: Trajectory, camera: PinholeCamera) -> None:
    """Draw the map in RGB and normals from three places of the path and from behind it all."""
    folder.mkdir()
    view_camera = camera.scaled(RENDER_WIDTH / camera.width)
    places = {
        f"view-{k + 1}": trajectory.T_world_camera[round(s * (len(trajectory) - 1))]
        for k, s in enumerate((0.1, 0.5, 0.9))
    }
    places["overview"] = overview_pose(surfels, trajectory, view_camera)
    # What was seen about once is mostly noise at edges; a run too short to confirm anything shows all it has.
    typical = np.median(surfels.sample(_SAMPLED)["confidence"])
    least = PICTURE_CONFIDENCE if typical > 2 * PICTURE_CONFIDENCE else 0.0
    for name, T_world_camera in places.items():
        picture = render_picture(surfels, T_world_camera, view_camera, min_confidence=least)
        for kind, image in (("rgb", picture.color), ("normals", picture.normal_colors(T_world_camera))):
            _write_png(folder / f"{name}-{kind}.png", image)


def overview_pose(surfels: SurfelMap, trajectory: Trajectory, camera: PinholeCamera) -> Float64:
    """Return a pose behind and above the cameras, as near as it can be with most of the map in view."""
    poses = trajectory.T_world_camera
    up = -poses[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    sample = surfels.sample(_SAMPLED)
    points = np.stack([sample[axis] for axis in "xyz"], axis=1).astype(np.float64)
    low, high = np.percentile(points, [2, 98], axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    back = poses[:, :3, 3].mean(axis=0) - centre
    back -= up * float(back @ up)
    if np.linalg.norm(back) < 0.05 * size:  # the cameras turned about the middle of the map: any side will do
        back = -poses[0, :3, 2]
    direction = 1.7 * back / max(float(np.linalg.norm(back)), 1e-9) + 1.1 * up
    near, far = 0.1 * size, 3.0 * size
    for _ in range(12):
        distance = (near + far) / 2
        T = look_at(centre + distance * direction, centre, up)
        _, inside = camera.project(se3.transform_points(se3.inverse(T), points))
        near, far = (near, distance) if inside.mean() > 0.96 else (distance, far)
    return look_at(centre + far * direction, centre, up)


def look_at(eye_m: Float64, target_m: Float64, up: Float64) -> Float64:
    """Return T_world_camera (4, 4) of a camera at `eye_m` that looks at `target_m`, y down along -`up`."""
    forward = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye_m
    return T


def _write_png(path: Path, image: Any) -> None:
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise OSError(f"{path}: the image cannot be encoded")
    path.write_bytes(data.tobytes())


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _environment(config: SlamConfig) -> dict[str, Any]:
    packages = {}
    for name in ("numpy", "scipy", "numba", "opencv-python-headless"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "unknown"
    return {
        "scanweld": version("scanweld"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": processor(),
        "packages": packages,
        "seed": config.seed,
        "threads": get_num_threads(),
        "backend": get_backend(),
    }
