"""A walk of thousands of frames round and round a corridor, with the noise of a Kinect: does a frame's cost stay flat?

    python benchmarks/long_run.py [--frames 5200] [--size 640x480] [--budget-mb 300] [--folder FOLDER] [--json]

The frames are rendered into FOLDER first, 0.6 MB each at 640x480, unless they are there from an earlier time; a round
of 34 m takes 1 570 frames, and the noise of each is its own. They are then decoded and processed as `scanweld slam`
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
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "scanweld-long-run")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    folder = rendered(arguments.folder, arguments.size, arguments.frames)
    figures = run(
        folder, arguments.frames, MapConfig(memory_budget_mb=arguments.budget_mb, folder=str(arguments.folder))
    )
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))


def rendered(folder: Path, size: str, frames: int) -> Path:
    """Return the folder of a rendered sequence, which is rendered when it is not there."""
    sequence = folder / f"corridor-{size}-{frames}"
    if not sequence.exists():
        folder.mkdir(parents=True, exist_ok=True)
        width, height = (int(number) for number in size.split("x"))
        config = sw.RenderConfig(scene="corridor", noise="kinect", frames=frames, width=width, height=height)
        sw.render_sequence(sequence, config)
    return sequence


def run(folder: Path, frames: int, storage: MapConfig) -> dict[str, Any]:
    """Process every frame and measure."""
    compile_kernels(lambda _: None)
    sequence = sw.open_sequence(folder)
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
    assert sequence.ground_truth is not None
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
