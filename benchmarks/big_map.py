"""What a frame costs at one place while the map grows to 100 million surfels, and what of it is in memory.

    python benchmarks/big_map.py [--millions 1,5,20,100] [--budget-mb 1000] [--folder FOLDER] [--save] [--json]

The camera looks at a wall of a million surfels, half of them in view of 640x480 pixels; further walls of a million
each go up behind it. A view is that of a camera that has moved; a frame is fused from where the last one was.
The file in FOLDER takes about 95 bytes a surfel and is gone at the end; --save writes the largest map as PLY, too.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import scanweld as sw
from scanweld.arrays import Float32
from scanweld.geometry import se3
from scanweld.mapping.storage.pages import MapConfig

CAMERA = sw.PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
SIDE = 1000  # surfels of a wall, up and along
NEAR_M, NEAR_SPACING_M = 3.0, 0.0045  # the wall before the camera
FAR_SPACING_M = 0.01  # of the walls behind it
LOOKS = 30  # of which the median is given


def main() -> None:
    """Grow a map and measure at each size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--millions", type=lambda text: [int(number) for number in text.split(",")], default=[1, 5, 20, 100]
    )
    parser.add_argument("--budget-mb", type=float, default=1000.0)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--save", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    mapper = sw.SurfelMapper(storage=MapConfig(memory_budget_mb=arguments.budget_mb, folder=str(arguments.folder)))
    figures, walls, seconds = [], 0, 0.0
    for size in sorted(arguments.millions):
        start = time.perf_counter()
        while walls < size:
            add_wall(mapper.map, walls)
            walls += 1
        seconds += time.perf_counter() - start
        figures.append(measured(mapper) | {"seconds_to_grow": seconds})
        if not arguments.json:
            print(line(figures[-1]), flush=True)
    if arguments.save:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            start = time.perf_counter()
            sw.write_ply(Path(folder) / "map.ply", mapper.map)
            figures[-1] |= {"seconds_to_save": time.perf_counter() - start, "peak_mb_after_saving": peak_mb()}
    if arguments.json:
        print(json.dumps({"budget_mb": arguments.budget_mb, "sizes": figures}, indent=1))
    elif arguments.save:
        print(
            f"saved in {figures[-1]['seconds_to_save']:.1f} s, peak memory {figures[-1]['peak_mb_after_saving']:.0f} MB"
        )


def add_wall(surfels: sw.SurfelMap, number: int) -> None:
    """Add a million surfels that face the camera: wall 0 in front of it, the others behind, one beyond the other."""
    spacing = FAR_SPACING_M if number else NEAR_SPACING_M
    rng = np.random.default_rng(number)
    along, up = np.meshgrid(np.arange(SIDE) - SIDE / 2, np.arange(SIDE) - SIDE / 2)
    positions = np.stack([spacing * along.ravel(), spacing * up.ravel(), np.full(SIDE * SIDE, NEAR_M - 5.0 * number)])
    positions[:2] += rng.uniform(-0.2, 0.2, (2, SIDE * SIDE)) * spacing
    normals = np.repeat(np.array([[0.0], [0.0], [-1.0]], np.float32), SIDE * SIDE, axis=1)
    flat: Float32 = np.ones(SIDE * SIDE, np.float32)
    surfels.append(
        positions.astype(np.float32), normals, rng.integers(0, 256, (3, SIDE * SIDE)).astype(np.float32),
        flat * np.float32(spacing), 50 * flat, 0,
    )  # fmt: skip


def measured(mapper: sw.SurfelMapper) -> dict[str, Any]:
    """Look and fuse at the fixed place."""
    depth_m = np.full(CAMERA.shape, NEAR_M, np.float32)
    frame = sw.Frame(0.0, depth_m, np.full((*CAMERA.shape, 3), 128, np.uint8), CAMERA)
    pyramid, places = sw.build_pyramid(frame), [se3.exp([0.4 * (k % 2), 0, 0, 0, 0, 0]) for k in range(LOOKS)]
    mapper.fuse(pyramid, np.eye(4))  # compiles, and has the place in memory again
    seen = len(mapper.view(places[1], CAMERA))
    return {
        "surfels": len(mapper.map),
        "pages": len(mapper.map.pages.live),
        "seen": seen,
        "view_ms": median_ms([lambda T=T: mapper.view(T, CAMERA) for T in places[1::2]]),
        "fuse_ms": median_ms([lambda: mapper.fuse(pyramid, np.eye(4)) for _ in places]),
        "map_resident_mb": mapper.map.pages.resident_mb,
        "process_resident_mb": resident_mb(),
        "peak_mb": peak_mb(),
    }


def median_ms(calls: list[Callable[[], object]]) -> float:
    """Median time of calls [ms]."""
    times = []
    for call in calls:
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def resident_mb() -> float | None:
    """Memory of the process now [MB]; None where the system does not tell."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    return next(float(row.split()[1]) for row in status.read_text().splitlines() if row.startswith("VmRSS")) / 1024


def peak_mb() -> float:
    """Largest memory of the process so far [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def line(figures: dict[str, Any]) -> str:
    """Return one size as text."""
    return (
        f"{figures['surfels'] / 1e6:6.1f} M surfels: view {figures['view_ms']:6.2f} ms, "
        f"fuse {figures['fuse_ms']:6.2f} ms, "
        f"map in memory {figures['map_resident_mb']:5.0f} MB, process {figures['process_resident_mb'] or 0:5.0f} MB, "
        f"grown in {figures['seconds_to_grow']:.0f} s"
    )


if __name__ == "__main__":
    main()
