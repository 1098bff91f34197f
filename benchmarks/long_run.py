"""A walk of thousands of frames round and round a corridor, with the noise of a Kinect: does a frame's cost stay flat?

    python benchmarks/long_run.py [--frames 5200] [--size 640x480] [--budget-mb 300] [--lap SEQUENCE] [--json]

One round of 34 m, some 1 480 frames of 0.6 MB at 640x480, is rendered first unless SEQUENCE is there; the walk is that
round again and again, noise included. The frames are then decoded and processed as `scanweld slam`
does, the next frames on a thread beside. Given are frames a second from first to last; ms a frame, waiting for the
decoder included, for the frames from 500 to 1000 and the last 500, and the ratio of these; surfels, and memory against
the budget; the error of the path.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import scanweld as sw
from big_map import peak_mb, resident_mb
from laps import Laps
from scanweld.datasets.stream import stream
from scanweld.mapping.storage.pages import MapConfig
from scanweld.slam.warmup import compile_kernels

WINDOW = 500  # frames that are compared: the second such window, and the last


def main() -> None:
    """Render if need be, run, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=5200)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--budget-mb", type=float, default=300.0)
    parser.add_argument("--lap", type=Path, help="rendered here if it is not there")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    lap = arguments.lap or Path(tempfile.gettempdir()) / f"scanweld-lap-{arguments.size}"
    if not lap.exists():
        width, height = (int(number) for number in arguments.size.split("x"))
        sw.render_sequence(lap, sw.RenderConfig(scene="corridor", noise="kinect", width=width, height=height))
    storage = MapConfig(memory_budget_mb=arguments.budget_mb, folder=str(lap.parent))
    figures = run(Laps(sw.open_sequence(lap), arguments.frames), storage)
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))


def run(sequence: Laps, storage: MapConfig) -> dict[str, Any]:
    """Process every frame and measure."""
    compile_kernels(lambda _: None)
    frames = len(sequence)
    slam = sw.build_slam(sequence.camera, sw.SlamConfig(map=storage))
    times_s, now = [], time.perf_counter()
    with contextlib.closing(stream(sequence, 2, prepare=slam.prepare)) as records:
        for record in records:
            assert record.frame is not None
            slam.process(record.frame, pyramid=record.prepared)
            times_s.append(time.perf_counter() - now)
            now += times_s[-1]
    window = min(WINDOW, frames // 4)  # of a short run, too
    early, late = times_s[window : 2 * window], times_s[-window:]
    keyframes = slam.loop_closer.database.keyframes  # type: ignore[attr-defined]
    return {
        "frames": len(times_s),
        "frames_per_second": len(times_s) / sum(times_s),
        "ms_early": 1e3 * statistics.mean(early),
        "ms_late": 1e3 * statistics.mean(late),
        "late_over_early": statistics.mean(late) / statistics.mean(early),
        "median_ms_early": 1e3 * statistics.median(early),
        "median_ms_late": 1e3 * statistics.median(late),
        "slowest_ms": 1e3 * max(times_s[window:]),
        "surfels": len(slam.map),
        "budget_mb": storage.memory_budget_mb,
        "map_resident_mb": slam.map.pages.most_resident_mb,
        "process_resident_mb": resident_mb(),
        "peak_mb": peak_mb(),
        "keyframes": len(keyframes),
        "keyframes_mb": 1e-6 * sum(keyframe.num_bytes for keyframe in keyframes),
        "loop_closures": slam.loop_closer.num_closures,
        "frames_lost": sum(result.state is sw.FrameState.LOST for result in slam.results),
        "ate_mm": 1e3 * sw.ate(slam.trajectory, sequence.ground_truth).rmse_m,
    }


def text(figures: dict[str, Any]) -> str:
    """Return the figures as a table."""
    return "\n".join(
        f"{name:>20}  {value:.2f}" if isinstance(value, float) else f"{name:>20}  {value}"
        for name, value in figures.items()
    )


if __name__ == "__main__":
    main()
