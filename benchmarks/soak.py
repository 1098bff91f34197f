"""Tens of thousands of frames, rendered in memory: does anything grow that should not?

    python benchmarks/soak.py [--frames 50000] [--size 160x120] [--scene corridor] [--every 1000] [--budget-mb 20]
                              [--limit-mb 1200] [--json]

One round of a walk is rendered and walked again and again. Given are resident memory, surfels, keyframes, threads, open
files and what waits in queues, every so many frames; and growth from a fifth of the run, when all places have been seen
several times, to its end. The log of the frames, a quarter of a kilobyte each, is counted apart. With a limit the
system refuses the process more memory for data than that (RLIMIT_DATA): the run ends there, should it need more.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import scanweld as sw
from big_map import resident_mb
from laps import InMemory, Laps
from scanweld.datasets.stream import stream
from scanweld.mapping.storage.pages import MapConfig
from scanweld.slam.warmup import compile_kernels

LOG_BYTES = 256
"""Of a frame, at most: `slam.frame_log`."""


def main() -> None:
    """Render, walk, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=50_000)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--scene", default="corridor")
    parser.add_argument("--every", type=int, default=1000)
    parser.add_argument("--budget-mb", type=float, default=20.0)
    parser.add_argument("--limit-mb", type=int, default=1200)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    width, height = (int(number) for number in arguments.size.split("x"))
    compile_kernels(lambda _: None)
    config = sw.RenderConfig(scene=arguments.scene, noise="kinect", width=width, height=height)
    walk = Laps(InMemory(sw.SyntheticSequence(config)), arguments.frames)
    walk.read(0)  # renders all of them
    resource.setrlimit(resource.RLIMIT_DATA, (arguments.limit_mb << 20, arguments.limit_mb << 20))
    with tempfile.TemporaryDirectory() as folder:
        samples = list(soak(walk, MapConfig(memory_budget_mb=arguments.budget_mb, folder=folder), arguments.every))
        left = sorted(path.name for path in Path(folder).iterdir())
    figures = growth(samples) | {"left_in_folder": left, "samples": samples}
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))


def soak(walk: Laps, storage: MapConfig, every: int) -> Any:
    """Process every frame; yield what there is after each so many."""
    slam, start, lost = sw.build_slam(walk.camera, sw.SlamConfig(map=storage)), time.perf_counter(), 0
    with contextlib.closing(stream(walk, 2, prepare=slam.prepare)) as records:
        for record in records:
            assert record.frame is not None
            result = slam.process(record.frame, pyramid=record.prepared)
            lost += result.state is sw.FrameState.LOST
            if record.index % every == every - 1:
                done = record.index + 1
                yield {
                    "frame": done,
                    "resident_mb": resident_mb(),
                    "log_mb": 1e-6 * LOG_BYTES * done,
                    "surfels": result.num_surfels,
                    "map_mb": slam.mapper.map.pages.resident_mb,
                    "keyframes": len(slam.loop_closer.database),  # type: ignore[attr-defined]
                    "closures": slam.loop_closer.num_closures,
                    "lost": int(lost),
                    "threads": threading.active_count(),
                    "files": len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0,
                    "seconds": time.perf_counter() - start,
                }
    yield {"frame": len(walk), "ate_mm": 1e3 * sw.ate(slam.trajectory, walk.ground_truth).rmse_m}


def growth(samples: list[dict[str, Any]]) -> dict[str, Any]:
    """Compare the end with a fifth of the run, in the median of three samples."""
    *during, end = samples
    early, late = during[len(during) // 5 :][:3], during[-3:]

    def middle(some: list[dict[str, Any]], name: str) -> float:
        return float(sorted(sample[name] for sample in some)[len(some) // 2])

    grown = {name: middle(late, name) / max(middle(early, name), 1e-9) - 1 for name in ("surfels", "keyframes")}
    before, after = (middle(some, "resident_mb") - middle(some, "log_mb") for some in (early, late))
    return {
        "frames": end["frame"],
        "ate_mm": end["ate_mm"],
        "lost": during[-1]["lost"],
        "resident_mb": middle(late, "resident_mb"),
        "growth_of_memory": after / before - 1,
        "growth_of_surfels": grown["surfels"],
        "growth_of_keyframes": grown["keyframes"],
        "most_threads": max(sample["threads"] for sample in during),
        "most_files": max(sample["files"] for sample in during),
        "ms_a_frame_early": _ms_a_frame(early),
        "ms_a_frame_late": _ms_a_frame(late),
    }


def _ms_a_frame(some: list[dict[str, Any]]) -> float:
    return float(1e3 * (some[-1]["seconds"] - some[0]["seconds"]) / (some[-1]["frame"] - some[0]["frame"]))


def text(figures: dict[str, Any]) -> str:
    """Return the figures as two tables."""
    *samples, _ = figures["samples"]
    names = ("frame", "resident_mb", "map_mb", "surfels", "keyframes", "closures", "lost", "threads", "files")
    rows = ["".join(f"{name:>13}" for name in names)]
    rows += ["".join(f"{sample[name]:13.0f}" for name in names) for sample in samples]
    rows += [f"{name:>20}  {value}" for name, value in figures.items() if name != "samples"]
    return "\n".join(rows)


if __name__ == "__main__":
    main()
