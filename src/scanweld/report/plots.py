"""Pictures of a run: what happened to each frame."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from scanweld.report.stretches import KINDS, kind_of
from scanweld.trajectory import FrameResult, FrameState

_BLUE = "#2563eb"

SHADES = {
    "lost": "#dc2626",
    "unreadable": "#6b7280",
    "dropped": "#9ca3af",
    "relocalised": "#0d9488",
    "degenerate": "#d97706",
    "unfinished": "#a16207",
}
"""Colours of frames that were not plainly tracked."""


def plot_tracking(results: Sequence[FrameResult], path: Path) -> None:
    """Draw loss, matched share, map size and time of every frame; the not plainly tracked are shaded."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(9, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 1, sharex=True)
    # Lines lead over dropped frames, which have nothing to show: single frames between them would be no line.
    frames = np.array([k for k, result in enumerate(results) if result.state is not FrameState.DROPPED])
    aligned = np.array([bool(result.status) and result.num_inliers > 0 for result in results])
    kinds = [kind_of(result.state.value, result.status) for result in results]
    rows = (
        ("loss at the last iteration", [r.loss for r in results], "mean Huber loss", True),
        ("matched share of the visible map", [r.overlap for r in results], "share", True),
        ("map", [r.num_surfels / 1e3 for r in results], "surfels [1000]", False),
        ("time", [sum(r.stage_ms.values()) for r in results], "[ms]", False),
    )
    for axis, (title, values, label, tracked_only) in zip(axes, rows, strict=True):
        shown = np.where(aligned, values, np.nan) if tracked_only else np.asarray(values, dtype=np.float64)
        axis.plot(frames, shown[frames], color=_BLUE, linewidth=1.3)
        for kind, first, last in _stretches(kinds):
            axis.axvspan(first - 0.5, last + 0.5, color=SHADES[kind], alpha=0.22, linewidth=0)
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_ylabel(label, fontsize=9)
        axis.set_ylim(bottom=0)
        axis.grid(color="#e5e7eb", linewidth=0.8)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    # The first frames compile or warm caches: they must not set the scale of the time axis.
    steady = np.asarray(rows[3][1])[frames[min(5, len(frames) - 1) :]]
    axes[3].set_ylim(0, 1.3 * max(float(np.percentile(steady, 98)), 1.0))
    axes[1].set_ylim(0, 1.05)
    axes[3].set_xlabel("frame")
    axes[3].set_xlim(-0.5, max(len(results) - 0.5, 0.5))
    seen = [Patch(color=SHADES[kind], alpha=0.4, label=KINDS[kind].lower()) for kind in SHADES if kind in kinds]
    if seen:
        figure.legend(handles=seen, loc="outside upper right", ncols=len(seen), frameon=False, fontsize=9)
    figure.savefig(path, dpi=130)


def _stretches(kinds: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return runs of frames of one kind: (kind, first, last); none for plainly tracked ones."""
    found, first = [], 0
    for kind, group in groupby(kinds):
        count = len(list(group))
        if kind:
            found.append((kind, first, first + count - 1))
        first += count
    return found


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
