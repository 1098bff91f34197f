"""How fast and how lean: two laser scans, a million points, ten thousand to ten million, and the closed form.

Every system does the whole job from raw arrays; the systems take turns, so that all meet the same machine.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import scanweld as sw
from furnished_rooms import furnished_room, sample_surfaces
from rendered_pairs import motion_error, random_offset
from scanweld.geometry import se3
from scanweld.registration.closed_form import align_closed_form_batch
from studies.report import table
from studies.systems import Bench, Contender

LIDAR = [(s, m) for m in ("point-to-plane", "gicp") for s in ("scanweld", "small_gicp", "open3d")]
MILLION = [(s, "point-to-plane") for s in ("scanweld", "small_gicp", "open3d")]
NOISE_M = 0.001
GATE_M, SHIFT_M, TURN_DEG = 0.05, 0.02, 1.0  # of the million points; other sizes scale them with the spacing
SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000)
PEER_SIZE = 1_000_000


def lidar(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """Two laser scans, thinned to 0.25 m, gate 1 m, from the identity."""
    folder = arguments.data / "registration" / "lidar_scans"
    T_true = np.loadtxt(folder / "T_target_source.txt")
    source, target = (sw.read_points(folder / f"{name}.ply").points_m for name in ("source", "target"))
    request = {"voxel_m": 0.25, "gate_m": 1.0, "T_init": np.eye(4).tolist()}
    request |= {"source": bench.put("source", source), "target": bench.put("target", target)}
    rows = measure(bench.contenders(LIDAR), request, T_true, np.zeros(3), arguments.repeat or 15)
    return {"points": [len(source), len(target)], "rows": rows}


def million(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """N against N points of one room, independently sampled; point-to-plane, no thinning. Memory of each process."""
    count = arguments.points or (100_000 if arguments.quick else 1_000_000)
    request, T_true, center = room_request(bench, count, arguments.seed)
    rows = measure(bench.contenders(MILLION), request, T_true, center, arguments.repeat or 3)
    return {"points": [count, count], "gate_m": request["gate_m"], "rows": rows}


def scaling(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """The same room sampled ever more finely; gate and initial error are multiples of the spacing."""
    sizes = [n for n in SIZES if n <= (arguments.points or (100_000 if arguments.quick else SIZES[-1]))]
    rows = []
    for count in sizes:
        request, T_true, center = room_request(bench, count, arguments.seed)
        wanted = [(s, m) for s, m in MILLION if s == "scanweld" or count <= PEER_SIZE]
        measured = measure(bench.contenders(wanted), request, T_true, center, arguments.repeat or 3)
        rows += [{"points": count, "gate_m": request["gate_m"]} | row for row in measured]
        for system in bench.systems.values():
            system.request(do="forget")
    slopes = {}
    for name in dict.fromkeys(row["name"] for row in rows):
        own = [row for row in rows if row["name"] == name]
        if len(own) > 1:
            logs = np.log([[row["points"], row["seconds"]] for row in own])
            slopes[name] = float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])
    return {"rows": rows, "slope_log_log": slopes}


def closed_form(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """Paired points, in this process, warm: validation and the full result included."""
    sw.set_num_threads(bench.threads)
    rng = np.random.default_rng(arguments.seed)
    rows = []
    for count, repeats in ((10, 3000), (1000, 1000), (1_000_000, 15)):
        source = rng.standard_normal((count, 3))
        T = random_offset(40.0, 1.0, np.zeros(3), rng)
        target = se3.transform_points(T, source) + NOISE_M * rng.standard_normal((count, 3))
        for method in ("svd", "quaternion"):
            align = partial(sw.align_closed_form, source, target, method=method)
            found, row = clocked(align, min(repeats, 50) if arguments.quick else repeats)
            shift, turn = motion_error(found.T_target_source, T, np.zeros(3))
            rows.append({"name": f"{count:,} pairs, {method}"} | row | {"shift_m": shift, "turn_deg": turn})
    problems = 10_000
    source = rng.standard_normal((problems, 10, 3))
    motions = np.stack([random_offset(40.0, 1.0, np.zeros(3), rng) for _ in range(problems)])
    target = np.einsum("bij,bnj->bni", motions[:, :3, :3], source) + motions[:, None, :3, 3]
    found, row = clocked(partial(align_closed_form_batch, source, target), 15)
    errors = [motion_error(a, b, np.zeros(3)) for a, b in zip(found.T_target_source, motions, strict=True)]
    shift, turn = np.max(errors, axis=0)
    row |= {key: row[key] / problems for key in ("microseconds", "fastest_us")}
    rows.append({"name": f"10 exact pairs, each of a batch of {problems:,}"} | row)
    rows[-1] |= {"shift_m": float(shift), "turn_deg": float(turn)}
    return {"rows": rows}


def clocked(run: Callable[[], Any], repeats: int) -> tuple[Any, dict[str, float]]:
    """Return what a function returns, and its median and least time; the first calls warm up."""
    seconds = []
    for _ in range(repeats + 3):
        start = time.perf_counter()
        found = run()
        seconds.append(time.perf_counter() - start)
    return found, {"microseconds": 1e6 * statistics.median(seconds[3:]), "fastest_us": 1e6 * min(seconds[3:])}


def room_request(bench: Bench, count: int, seed: int) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Sample one room twice and move the source a little: the request, the truth, the source's centre."""
    room = furnished_room(seed)
    rng = np.random.default_rng([seed, count, 6])
    target, source = (sample_surfaces(room, count, NOISE_M, rng) for _ in range(2))
    coarseness = float(np.sqrt(1e6 / count))
    center = source.mean(axis=0)
    T_source_room = random_offset(TURN_DEG * coarseness, SHIFT_M * coarseness, center, rng)
    source = se3.transform_points(T_source_room, source)
    request = {"voxel_m": 0.0, "gate_m": GATE_M * coarseness, "T_init": np.eye(4).tolist()}
    request |= {"source": bench.put(f"source-{count}", source), "target": bench.put(f"target-{count}", target)}
    return request, se3.inverse(T_source_room), center


def measure(
    contenders: list[Contender], request: dict[str, Any], T_true: np.ndarray, center: np.ndarray, repeats: int
) -> list[dict[str, Any]]:
    """Let the contenders take turns; the first round warms up and does not count."""
    answers: dict[str, list[dict[str, Any]]] = {c.name: [] for c in contenders}
    for turn in range(repeats + 1):
        for contender in contenders:
            answer = contender.system.request(do="icp", method=contender.method, **request)
            if turn > 0:
                answers[contender.name].append(answer)
    rows = []
    for contender in contenders:
        own = answers[contender.name]
        shift, angle = motion_error(np.array(own[-1]["T_target_source"]), T_true, center)
        rows.append(
            {
                "name": contender.name,
                "system": contender.system.name,
                "method": contender.method,
                "seconds": statistics.median(a["seconds"] for a in own),
                "fastest_s": min(a["seconds"] for a in own),
                "iterations": own[-1]["iterations"],
                "status": own[-1]["status"],
                "shift_m": shift,
                "turn_deg": angle,
                "before_mb": max(a["before_mb"] for a in own),
                "peak_mb": max(a["peak_mb"] for a in own),
            }
        )
    return with_ratios(rows)


def with_ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add how much longer each row takes than ours of the same method."""
    ours = {row["method"]: row["seconds"] for row in rows if row["system"] == "scanweld"}
    return [row | {"ratio_to_scanweld": row["seconds"] / ours.get(row["method"], float("nan"))} for row in rows]


def alignments_text(figures: dict[str, Any]) -> str:
    """Table of :func:`lidar`, :func:`million` and :func:`scaling`."""
    rows = []
    for row in figures["rows"]:
        points = row.get("points", figures.get("points", [0])[0])
        rows.append(
            (
                f"{points:,}",
                row["name"],
                f"{row['seconds'] * 1e3:.1f}",
                f"{row['ratio_to_scanweld']:.2f}",
                row["iterations"] if row["iterations"] is not None else "-",
                f"{row['shift_m'] * 1e3:.2f}",
                f"{row['turn_deg']:.4f}",
                f"{row['before_mb']:.0f}",
                f"{row['peak_mb']:.0f}",
                row["status"],
            )
        )
    columns = (
        "points",
        "system, method",
        "ms",
        "time over ours",
        "steps",
        "error mm",
        "deg",
        "MB before",
        "MB peak",
        "says",
    )
    text = table(columns, rows)
    for name, slope in figures.get("slope_log_log", {}).items():
        text += f"\n\n{name}: time grows with the number of points to the power of {slope:.2f}"
    return text


def closed_form_text(figures: dict[str, Any]) -> str:
    """Table of :func:`closed_form`."""
    rows = [
        (r["name"], f"{r['microseconds']:.1f}", f"{r['fastest_us']:.1f}", f"{r['shift_m']:.1e}", f"{r['turn_deg']:.1e}")
        for r in figures["rows"]
    ]
    return table(("closed form", "median us", "fastest us", "error m", "deg"), rows)


def draw_scaling(figures: dict[str, Any], path: Path) -> None:
    """Plot time over the number of points, both logarithmic, beside a line of linear growth."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(figsize=(7.2, 4.6), dpi=160, facecolor="white")
    colors = {"scanweld": "#0b6e99", "small_gicp": "#d9730d", "open3d": "#6b6b6b"}
    for name in dict.fromkeys(row["name"] for row in figures["rows"]):
        own = [row for row in figures["rows"] if row["name"] == name]
        x, y = [row["points"] for row in own], [row["seconds"] for row in own]
        ours = own[0]["system"] == "scanweld"
        slope = figures["slope_log_log"].get(name)
        label = own[0]["system"] + (f" (slope {slope:.2f})" if slope is not None else "")
        color = colors[own[0]["system"]]
        axes.loglog(x, y, "o-", color=color, lw=2.4 if ours else 1.6, ms=6 if ours else 4.5, label=label, zorder=3)
        if ours:
            middle = float(np.exp(np.mean(np.log(np.array(y) / np.array(x)))))
            axes.loglog(x, middle * np.array(x), "--", color="#b0b0b0", lw=1.2, label="linear (slope 1)", zorder=1)
    axes.set_xlabel("points in each cloud")
    axes.set_ylabel("time, from raw points to the transform [s]")
    axes.set_title("Point-to-plane ICP of a room, gate in proportion to the spacing (5 cm at 1 M points)", fontsize=9.5)
    axes.grid(which="major", color="#dddddd", lw=0.8)
    axes.grid(which="minor", color="#f1f1f1", lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    fig.tight_layout()
    fig.savefig(path)
    plt.close(fig)
