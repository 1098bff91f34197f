"""A run folder written by hand, small and with everything that a report has words for; no SLAM runs."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import scanweld as sw
from scanweld.config import to_toml
from scanweld.geometry import se3
from scanweld.io.ply import write_ply
from scanweld.io.trajectory_files import write_tum

COUNT = 40
STEP_S = 0.1

RED, GREEN, GREY = (220, 30, 30), (30, 170, 60), (150, 150, 150)


class Columns:
    """What `write_ply` takes."""

    def __init__(self, columns: Mapping[str, np.ndarray]) -> None:
        self._columns = columns

    def columns(self) -> Mapping[str, np.ndarray]:
        return self._columns


def corner(count: int = 6000) -> dict[str, np.ndarray]:
    """A red wall at z = 3 m, a green one at x = -2 m, a grey floor at y = 1 m; y points down, as in a camera."""
    rng = np.random.default_rng(4)
    a, b = rng.uniform(0, 1, (2, count))
    wall = np.repeat([0, 1, 2], -(-count // 3))[:count]
    x = np.where(wall == 1, -2.0, -2 + 4 * a)
    y = np.where(wall == 2, 1.0, -1 + 2 * b)
    z = np.where(wall == 0, 3.0, 3 * np.where(wall == 1, a, b))
    normal = np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]])[wall]
    color = np.array([RED, GREEN, GREY], np.uint8)[wall]
    columns = {name: values.astype(np.float32) for name, values in (("x", x), ("y", y), ("z", z))}
    columns |= {f"n{axis}": normal[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    columns |= {name: color[:, k] for k, name in enumerate(("red", "green", "blue"))}
    columns["radius"] = np.full(count, 0.06, np.float32)
    columns["confidence"] = np.linspace(5, 100, count).astype(np.float32)
    return columns


def path(count: int = COUNT) -> sw.Trajectory:
    """A camera that moves 1 m to the right while it turns a little."""
    s = np.linspace(0, 1, count)
    poses = np.stack([se3.exp([v - 0.5, 0.1 * np.sin(6 * v), 0.0, 0.0, -0.3 * v, 0.0]) for v in s])
    return sw.Trajectory(np.arange(count) * STEP_S, poses)


def rows(count: int = COUNT) -> list[dict[str, Any]]:
    """Lines of frames.csv: frames 10 to 14 lost, 15 found again, 20 unreadable, 25 and 26 degenerate."""
    table = []
    for i in range(count):
        row = {
            "frame": i, "timestamp": repr(i * STEP_S), "status": "tracking", "alignment": "converged" if i else "",
            "rmse": 0.002 + 0.0005 * np.sin(i), "loss": 0.1, "inliers": 5000 if i else 0, "overlap": 0.9 if i else 0,
            "surfels": 3000 + 75 * i, "ms_surfaces": 5, "ms_view": 6, "ms_track": 20, "ms_fuse": 7, "ms_loop": 1,
            "note": "",
        }  # fmt: skip
        if 10 <= i < 15:
            row |= {"status": "lost", "alignment": "no_overlap", "overlap": 0.1}
            row["note"] = f"residual 0.0{i} m, usually below 0.0040 m; overlap 10%, usually above 60%"
        elif i == 15:
            row["status"] = "relocalised"
        elif i == 20:
            row |= {"status": "unreadable", "alignment": "", "note": "depth/20.png is damaged"}
        elif i in (25, 26):
            row |= {"alignment": "degenerate", "note": "translation along (1.00, 0.00, 0.00) is free"}
        table.append(row)
    return table


def write_frames(folder: Path, table: list[dict[str, Any]]) -> None:
    """Write frames.csv."""
    with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def write_run_folder(
    folder: Path,
    *,
    name: str = "corner",
    table: list[dict[str, Any]] | None = None,
    truth: bool = True,
    points: int = 6000,
    error_m: float = 0.0,
    config: sw.SlamConfig | None = None,
    run: Mapping[str, Any] | None = None,
) -> Path:
    """Write a run folder; the estimate is off the truth by a wave of `error_m`."""
    folder.mkdir(parents=True, exist_ok=True)
    table = rows() if table is None else table
    write_frames(folder, table)
    trajectory = path(len(table))
    write_tum(folder / "trajectory.txt", trajectory)
    figures: dict[str, Any] = {
        "frames": len(table), "path_length_m": trajectory.path_length_m, "num_surfels": points,
        "num_points_input": 40 * points, "fps": 25.0, "ms_per_frame_median": 40.0, "loop_closures": 1,
        "peak_rss_mb": 300.0, "seconds_total": 3.0, "ate_rmse_m": None, "ate_max_m": None, "rpe_trans_m": None,
        "rpe_rot_deg": None,
    }  # fmt: skip
    if truth:
        poses = trajectory.T_world_camera.copy()
        poses[:, 1, 3] += error_m * np.sin(np.arange(len(table)))
        true = sw.Trajectory(trajectory.timestamps_s, poses)
        write_tum(folder / "groundtruth.txt", true)
        figures["ate_rmse_m"], figures["ate_max_m"] = (sw.ate(trajectory, true).rmse_m, sw.ate(trajectory, true).max_m)
        figures["rpe_trans_m"], figures["rpe_rot_deg"] = error_m, 0.0
    (folder / "metrics.json").write_text(json.dumps(figures))
    (folder / "config.toml").write_text(to_toml(config or sw.SlamConfig()), encoding="utf-8")
    write_ply(folder / "map.ply", Columns(corner(points)))
    described = {"scanweld": "0.1.0", "python": "3.11", "packages": {"numpy": "2.0"}, "name": name, "warnings": []}
    described["intrinsics"] = {"fx": 131.25, "fy": 131.25, "cx": 79.5, "cy": 59.5, "width": 160, "height": 120}
    (folder / "run.json").write_text(json.dumps({**described, **(run or {})}))
    (folder / "keyframes.csv").write_text("frame,loop\n0,\n8,\n30,0\n")
    (folder / "renders").mkdir(exist_ok=True)
    picture = np.full((60, 80, 3), 128, np.uint8)
    for kind in ("rgb", "normals"):
        assert cv2.imwrite(str(folder / f"renders/overview-{kind}.png"), picture)
    return folder
