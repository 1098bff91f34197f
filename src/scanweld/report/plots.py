"""Pictures of a run: what happened to each frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scanweld.trajectory import FrameResult, FrameState

_BLUE, _GRAY, _RED = "#2563eb", "#6b7280", "#dc2626"


def plot_tracking(results: Sequence[FrameResult], path: Path) -> None:
    """Draw loss, matched share, map size and time of every frame; lost and unreadable frames are shaded."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 1, sharex=True)
    frames = np.arange(len(results))
    aligned = np.array([bool(result.status) for result in results])
    rows = (
        ("loss at the last iteration", [r.loss for r in results], "mean Huber loss", True),
        ("matched share of the visible map", [r.overlap for r in results], "share", True),
        ("map", [r.num_surfels / 1e3 for r in results], "surfels [1000]", False),
        ("time", [sum(r.stage_ms.values()) for r in results], "[ms]", False),
    )
    for axis, (title, values, label, tracked_only) in zip(axes, rows, strict=True):
        shown = np.where(aligned, values, np.nan) if tracked_only else np.asarray(values, dtype=np.float64)
        axis.plot(frames, shown, color=_BLUE, linewidth=1.3)
        for frame, result in enumerate(results):
            if result.state in (FrameState.LOST, FrameState.UNREADABLE):
                color = _RED if result.state is FrameState.LOST else _GRAY
                axis.axvspan(frame - 0.5, frame + 0.5, color=color, alpha=0.15, linewidth=0)
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_ylabel(label, fontsize=9)
        axis.set_ylim(bottom=0)
        axis.grid(color="#e5e7eb", linewidth=0.8)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    # The first frames compile or warm caches: they must not set the scale of the time axis.
    steady = np.asarray(rows[3][1])[min(5, len(results) - 1) :]
    axes[3].set_ylim(0, 1.3 * max(float(np.percentile(steady, 98)), 1.0))
    axes[1].set_ylim(0, 1.05)
    axes[3].set_xlabel("frame")
    axes[3].set_xlim(-0.5, max(len(results) - 0.5, 0.5))
    figure.savefig(path, dpi=130)


def plot_path(positions_m: np.ndarray, path: Path, title: str) -> None:
    """Draw a path (N, 3) [m] seen along the direction in which it varies least."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    first, second = np.sort(np.argsort(-np.ptp(positions_m, axis=0), kind="stable")[:2])
    axis.plot(positions_m[:, first], positions_m[:, second], color=_BLUE, linewidth=1.6)
    axis.plot(positions_m[0, first], positions_m[0, second], "o", color="black", markersize=5, label="start")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel(f"{'xyz'[first]} [m]")
    axis.set_ylabel(f"{'xyz'[second]} [m]")
    axis.set_title(title, loc="left", fontsize=10)
    axis.legend(frameon=False, fontsize=8)
    axis.grid(color="#e5e7eb", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
