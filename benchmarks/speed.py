"""How fast the whole main job is, beside Open3D's dense SLAM in the same run. Prints a table, or JSON.

    python benchmarks/speed.py [--data FOLDER] [--large SEQUENCE] [--peer-python PYTHON --peer-script open3d_slam.py]
        [--runs N] [--json]

Every run is a process of its own, start, decoding and outputs included; ours and the peer's take turns, so that both
meet the same machine. The peer's figure is the median of its own time per frame, without its start.

A further frame is what a process of 211 frames takes more than one of 11, over 200: as recorded, at half the size, of
a SEQUENCE of 1280x720 (`scanweld render --size 1280x720 --frames 130`), and with one core kept busy by another process.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FIRST_FRAMES = """
import sys, time
import scanweld as sw
sequence = sw.open_sequence(sys.argv[1], frames="0:2")
slam = sw.build_slam(sequence.camera)
for frame in sequence:
    slam.process(frame)
assert slam.results[-1].status == "converged"
"""


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("SCANWELD_DATA") or Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--large", type=Path)
    parser.add_argument("--peer-python", type=Path)
    parser.add_argument("--peer-script", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    sequence = arguments.data / "livingroom1"
    figures: dict[str, Any] = {"first_frame": first_frame(sequence)}
    ours, peer = [], []
    for _ in range(arguments.runs):
        ours.append(run_ours(sequence))
        if arguments.peer_python:
            peer.append(run_peer(arguments.peer_python, arguments.peer_script, sequence))
    figures["ours"] = summary(ours)
    figures["further_frame_ms"] = {
        "640x480": further_frame(sequence, arguments.runs),
        "320x240": further_frame(sequence, arguments.runs, "--scale", "0.5"),
        **({"1280x720": further_frame(arguments.large, arguments.runs, last=130)} if arguments.large else {}),
    }
    with busy_core():
        figures["further_frame_ms"]["640x480, one core busy"] = further_frame(sequence, arguments.runs)
    if peer:
        figures["open3d"] = summary(peer)
        ratios = [b["ms_per_frame"] / a["ms_per_frame"] for a, b in zip(ours, peer, strict=True)]
        figures["ratio_open3d_to_ours"] = {"median": statistics.median(ratios), "all": ratios}
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))


def run_ours(sequence: Path) -> dict[str, float]:
    """One whole warm process."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "scanweld", "slam", str(sequence), "--out", f"{folder}/run", "--json"]
        start = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        seconds = time.perf_counter() - start
    metrics = json.loads(done.stdout)
    return {
        "ms_per_frame": seconds * 1e3 / metrics["frames"],
        "ms_in_loop_median": metrics["ms_per_frame_median"],
        "ate_mm": metrics["ate_rmse_m"] * 1e3,
        "peak_rss_mb": metrics["peak_rss_mb"],
    }


def further_frame(sequence: Path, runs: int, *options: str, last: int = 211) -> float:
    """Milliseconds of a frame in a process that goes on: the median of several pairs of processes."""
    taken = []
    for _ in range(runs):
        seconds = []
        for frames in (11, last):
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, "-m", "scanweld", "slam", str(sequence), "--frames", f"0:{frames}"]
                start = time.perf_counter()
                subprocess.run([*command, "--out", f"{folder}/run", *options], capture_output=True, check=True)
                seconds.append(time.perf_counter() - start)
        taken.append((seconds[1] - seconds[0]) * 1e3 / (last - 11))
    return statistics.median(taken)


@contextmanager
def busy_core() -> Iterator[None]:
    """Keep one core busy with another process."""
    spinning = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        spinning.kill()
        spinning.wait()


def run_peer(python: Path, script: Path, sequence: Path) -> dict[str, float]:
    """The peer's own time per frame."""
    done = subprocess.run([python, script, sequence], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.strip().splitlines()[-1])
    return {"ms_per_frame": found["ms_per_frame_median"], "ate_mm": found["ate_rmse_m"] * 1e3}


def first_frame(sequence: Path) -> dict[str, float]:
    """Seconds of a process until its second frame is tracked, with cold and with warm kernels."""
    cache = Path(tempfile.mkdtemp(prefix="scanweld-cold-"))
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    seconds = {}
    try:
        for name in ("cold", "warm", "warm_again"):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", FIRST_FRAMES, str(sequence)], env=environment, check=True)
            seconds[name] = time.perf_counter() - start
    finally:
        shutil.rmtree(cache)
    return {"cold_s": seconds["cold"], "warm_s": min(seconds["warm"], seconds["warm_again"])}


def summary(runs: list[dict[str, float]]) -> dict[str, float]:
    """Median of each figure."""
    return {key: statistics.median(run[key] for run in runs) for key in runs[0]}


def text(figures: dict[str, Any]) -> str:
    """A table for a person."""
    lines = [
        f"first tracked frame: {figures['first_frame']['warm_s']:.2f} s warm, "
        f"{figures['first_frame']['cold_s']:.1f} s with cold kernels"
    ]
    for name in ("ours", "open3d"):
        if name in figures:
            lines.append(f"{name:<8}" + ", ".join(f"{key} {value:.3g}" for key, value in figures[name].items()))
    lines += [f"a further frame at {name}: {ms:.1f} ms" for name, ms in figures["further_frame_ms"].items()]
    if "ratio_open3d_to_ours" in figures:
        lines.append(f"Open3D's time over ours: {figures['ratio_open3d_to_ours']['median']:.1f}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
