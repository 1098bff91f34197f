"""A recording of tens of thousands of frames, rendered in memory, run in fragments by several processes.

    python benchmarks/fragments.py [--frames 20000] [--fragments 20] [--size 160x120] [--scene corridor] [--workers 2]
                                   [--out RUN] [--json]

One round of a walk is rendered and walked again and again; every process renders it for itself. Given are the error of
the path, also as a share of its length, what became of the fragments, and the largest memory that this process and
any worker had at any time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import scanweld as sw
from laps import rendered_walk
from scanweld.runs.fragments.run import run_fragments
from scanweld.slam.warmup import compile_kernels


def main() -> None:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--fragments", type=int, default=20)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--scene", default="corridor")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="run folder; a temporary one by default")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    width, height = (int(number) for number in arguments.size.split("x"))
    config = sw.RenderConfig(scene=arguments.scene, noise="kinect", width=width, height=height)
    compile_kernels(lambda _: None)
    with tempfile.TemporaryDirectory() as folder:
        out = arguments.out or Path(folder) / "run"
        walk = partial(rendered_walk, config, arguments.frames)
        figures = run(walk, arguments.fragments, arguments.workers, out)
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))


def run(walk: Any, number: int, workers: int, out: Path) -> dict[str, Any]:
    """Run a walk in so many fragments and measure."""
    begun, stages = time.perf_counter(), {}

    def progress(what: str, done: int, total: int) -> None:
        stages[what] = time.perf_counter() - begun
        print(f"{stages[what]:7.0f} s  {what} {done}/{total}", flush=True)

    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn) as executor:
        summary = run_fragments(walk, number, out=out, force=True, executor=executor, progress=progress)
    seconds = time.perf_counter() - begun
    metrics, run_json = summary.metrics, json.loads((out / "run.json").read_text())
    length_m = walk().ground_truth.path_length_m
    return {
        "frames": metrics["frames"],
        "fragments": number,
        "workers": workers,
        "path_m": length_m,
        "ate_mm": 1e3 * metrics["ate_rmse_m"],
        "ate_percent_of_path": 100 * metrics["ate_rmse_m"] / length_m,
        "frames_lost": metrics["frames_lost"],
        "unconnected": metrics["submaps_unjoined"],
        "edges_between_fragments": sum(link["edges"] for link in run_json["fragments"]["links"]),
        "edges_kept": sum(link["kept"] for link in run_json["fragments"]["links"]),
        "surfels": metrics["num_surfels"],
        "seconds": seconds,
        "stages_ended_s": {what: round(end, 1) for what, end in stages.items()},
        "peak_mb_of_this_process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "peak_mb_of_any_worker": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3,
    }


def text(figures: dict[str, Any]) -> str:
    """Return the figures as a table."""
    return "\n".join(
        f"{name:>25}  {value:.4g}" if isinstance(value, float) else f"{name:>25}  {value}"
        for name, value in figures.items()
    )


if __name__ == "__main__":
    main()
