"""How accurate the whole main job is, on every recorded sequence that is at hand. Prints a table, or JSON.

    python benchmarks/accuracy.py [--data FOLDER] [--json] [--check | --store]

One default configuration for all; nothing is tuned per sequence. `--check` compares the errors with those that are
stored beside this file and ends with 1 where one is worse by more than the tolerance; `--store` stores them, after a
change that was meant to be one.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import scanweld as sw
from scanweld.evaluation.surface_metrics import depth_completeness
from scanweld.geometry import se3

STORED = Path(__file__).parent / "accuracy.json"
"""Errors, in mm, or percent of the input that the map does not cover."""

TOLERANCE, FLOOR = 0.05, 0.02
"""Share, and mm or percent, by which an error may grow."""

PAIRS = ((10, 40), (100, 130), (10, 50), (10, 100), (100, 200))


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("SCANWELD_DATA") or Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--store", action="store_true")
    arguments = parser.parse_args()
    rows = [*trajectories(arguments.data), *fusion(arguments.data), *pairs(arguments.data), *rendered()]
    if arguments.json:
        print(json.dumps(rows, indent=1))
    else:
        for row in rows:
            print(f"{row['what']:<62} {row['measured']:<44} asked: {row['asked']}")
    if arguments.store:
        errors = {row["what"]: round(row["error"], 4) for row in rows}
        STORED.write_text(json.dumps(errors, indent=1) + "\n")
    if arguments.check:
        worse = list(worse_than(json.loads(STORED.read_text()), rows))
        print("\n".join(worse) or "nothing is worse than what is stored", file=sys.stderr)
        sys.exit(bool(worse))


def worse_than(stored: dict[str, float], rows: list[dict[str, Any]]) -> Iterator[str]:
    """Name what is worse than it was, or missing; another processor rounds differently, so errors differ a little."""
    errors = {row["what"]: row["error"] for row in rows}
    for what, before in stored.items():
        if what not in errors:
            yield f"{what}: not measured"
        elif not errors[what] <= before * (1 + TOLERANCE) + FLOOR:
            yield f"{what}: {errors[what]:.4f}, {before:.4f} before"


def trajectories(data: Path) -> Iterator[dict[str, Any]]:
    """ATE of recorded sequences."""
    for name, asked in (("livingroom1", "ATE <= 0.2 mm"), ("shelf_realsense", "ATE <= 5 mm")):
        yield from with_and_without_brightness(sw.open_sequence(data / name), f"{name}, all frames", asked)


def rendered() -> Iterator[dict[str, Any]]:
    """ATE on rendered sequences with sensor noise."""
    for config in (
        sw.RenderConfig(scene="room", noise="kinect", width=320, height=240),
        sw.RenderConfig(scene="room", path="sweep", noise="realsense", width=320, height=240),
        sw.RenderConfig(scene="corridor", noise="kinect", width=320, height=240, frames=400),
    ):
        sequence = sw.SyntheticSequence(config)
        yield from with_and_without_brightness(sequence, f"rendered {sequence.name} 320x240", "-")


def with_and_without_brightness(sequence: sw.RgbdSequence, name: str, asked: str) -> Iterator[dict[str, Any]]:
    """Two runs: brightness may never make a trajectory more than 5 % worse."""
    auto, off = (
        sw.run_sequence(sequence, sw.SlamConfig(tracking=sw.TrackingConfig(photometry=photometry))).metrics
        for photometry in ("auto", "off")
    )
    change = auto["ate_rmse_m"] / off["ate_rmse_m"] - 1
    yield row(name, trajectory_text(auto), asked, 1e3 * auto["ate_rmse_m"])
    text = f"{trajectory_text(off)}; auto is {change:+.0%}"
    yield row(f"{name}, photometry = off", text, "auto at most 5 % worse", 1e3 * off["ate_rmse_m"])


def trajectory_text(metrics: Any) -> str:
    """ATE, how many frames were tracked, and the length of the path."""
    return (
        f"{metrics['ate_rmse_m'] * 1e3:.3f} mm, max {metrics['ate_max_m'] * 1e3:.2f}; "
        f"{metrics['frames_tracked']}/{metrics['frames']}; {metrics['path_length_m']:.1f} m"
    )


def fusion(data: Path) -> Iterator[dict[str, Any]]:
    """Compression ratio, and the share of the input within 1 cm of the map."""
    sequence = sw.open_sequence(data / "livingroom1", frames="0:200", scale=0.5)
    truth = sequence.ground_truth
    for kind in ("given", "estimated"):
        summary = sw.run_sequence(sequence, poses=truth if kind == "given" else None)
        poses = [r.T_world_camera for r in summary.results]
        points = summary.map.positions_m.T.astype(np.float64)
        frames = ((sequence.read(k), poses[k]) for k in range(len(sequence)))
        share = depth_completeness(points, frames, stride=2, thresholds_m=(0.01,), num_threads=-1).within[0.01]
        yield row(
            f"livingroom1 --scale 0.5 --frames 0:200, {kind} poses",
            f"ratio {summary.metrics['compression_ratio']:.1f}, {share:.2%} within 1 cm",
            "ratio > 11.28, >= 99 % within 1 cm",
            100 * (1 - share),
        )


def pairs(data: Path) -> Iterator[dict[str, Any]]:
    """Two frames from the identity."""
    sequence = sw.open_sequence(data / "livingroom1")
    truth = sequence.ground_truth.T_world_camera
    for a, b in PAIRS:
        result = sw.align_frames(sequence.read(a), sequence.read(b))
        asked = "1 mm, 0.1 deg" if (a, b) in PAIRS[:2] else "1 cm, 0.5 deg"
        yield pair_row(f"livingroom1 {a} -> {b}", result, se3.inverse(truth[b]) @ truth[a], asked)
    camera = sw.PinholeCamera(525, 525, 319.5, 239.5, 640, 480)
    for case in sorted((data / "tum_pairs").glob("case_*")):
        frames, poses = [], []
        for which in ("prev", "curr"):
            depth = cv2.imread(str(case / f"dep_{which}.png"), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000
            values = np.loadtxt(case / f"pose_{which}.txt")
            frames.append(sw.Frame(0.0, depth, None, camera))
            poses.append(se3.from_quaternion_xyzw(values[3:], values[:3]))
        result = sw.align_frames(*frames)
        yield pair_row(f"tum_pairs {case.name}", result, se3.inverse(poses[1]) @ poses[0], "5 mm, 0.7 deg")


def pair_row(what: str, result: sw.RegistrationResult, T_true: np.ndarray, asked: str) -> dict[str, Any]:
    """Status and error of a two-frame alignment."""
    error = se3.inverse(T_true) @ result.T_target_source
    shift, turn = float(np.linalg.norm(error[:3, 3]) * 1e3), np.degrees(se3.rotation_angle_rad(error))
    return row(what, f"{result.status.value}: {shift:.2f} mm, {turn:.3f} deg", asked, shift)


def row(what: str, measured: str, asked: str, error: float) -> dict[str, Any]:
    """One line of the table."""
    return {"what": what, "measured": measured, "asked": asked, "error": error}


if __name__ == "__main__":
    main()
