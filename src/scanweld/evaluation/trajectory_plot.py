"""A picture of a trajectory's error: seen from above, and over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanweld.arrays import Float64
from scanweld.errors import OutputError
from scanweld.evaluation.trajectory_metrics import AteResult

FORMATS = (".png", ".pdf", ".svg")
"""Endings of the pictures that are drawn."""

TRUTH_COLOR = "#8a8f98"
ERROR_COLOR = "#2563eb"
GRID_COLOR = "#e5e7eb"


def plot_trajectory_error(result: AteResult, path: Path, *, title: str = "") -> None:
    """Draw the true path and the aligned estimate coloured by its error, and the error over time.

    The paths are seen along the direction in which the camera moved least: from above for a camera that is
    carried around. The file's suffix chooses the format (png, pdf, svg).

    Raises
    ------
    OutputError
        When the file cannot be written or its format is not known.
    """
    if path.suffix.lower() not in FORMATS:
        raise OutputError(f"{path}: a picture's name must end in {' or '.join(FORMATS)}")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    above, over_time = figure.subplots(1, 2, width_ratios=[1, 1.25])
    factor, unit = _unit(result.max_m)
    errors = result.errors_m * factor

    first, second = _ground_axes(result.positions_truth_m)
    true, estimated = (
        result.positions_truth_m[:, [first, second]],
        result.positions_aligned_m[:, [first, second]],
    )
    above.plot(*true.T, color=TRUTH_COLOR, linewidth=3.5, solid_capstyle="round", label="truth", alpha=0.6)
    segments = np.stack([estimated[:-1], estimated[1:]], axis=1)
    lines = LineCollection(list(segments), cmap="viridis", linewidth=1.6)
    lines.set_array((errors[:-1] + errors[1:]) / 2)
    lines.set_clim(0, max(float(errors.max()), 1e-12))
    above.add_collection(lines)
    above.plot(*true[0], "o", color="black", markersize=5, label="start")
    above.set_aspect("equal", adjustable="datalim")
    above.autoscale_view()
    above.set_xlabel(f"{'xyz'[first]} [m]")
    above.set_ylabel(f"{'xyz'[second]} [m]")
    above.set_title("path", loc="left", fontsize=10)
    above.legend(frameon=False, fontsize=8)
    figure.colorbar(lines, ax=above, label=f"error [{unit}]", shrink=0.85)

    time = result.timestamps_s - result.timestamps_s[0]
    over_time.fill_between(time, errors, color=ERROR_COLOR, alpha=0.12, linewidth=0)
    over_time.plot(time, errors, color=ERROR_COLOR, linewidth=1.4)
    over_time.axhline(result.rmse_m * factor, color="black", linewidth=1, linestyle="--")
    over_time.set_xlim(0, float(time[-1]) if len(time) > 1 else 1)
    over_time.set_ylim(bottom=0)
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel(f"error of the position [{unit}]")
    over_time.set_title(
        f"absolute trajectory error, rmse {result.rmse_m * factor:.3g} {unit} (dashed)",
        loc="left",
        fontsize=10,
    )
    for axes in (above, over_time):
        axes.grid(color=GRID_COLOR, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    if title:
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: the plot cannot be written: {getattr(error, 'strerror', None) or error}") from None


def _ground_axes(positions_m: Float64) -> tuple[int, int]:
    """The two axes along which the camera moved most, in alphabetical order."""
    most = np.sort(np.argsort(-np.ptp(positions_m, axis=0), kind="stable")[:2])
    return int(most[0]), int(most[1])


def _unit(largest_m: float) -> tuple[float, str]:
    return (1000.0, "mm") if largest_m < 0.1 else (1.0, "m")
