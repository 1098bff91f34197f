"""`scanweld evaluate`: trajectory error against ground truth."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from scanweld.evaluation.trajectory_metrics import AteResult, RpeResult


class Alignment(StrEnum):
    """What the estimate may be moved by before it is compared."""

    SE3 = "se3"
    SIM3 = "sim3"
    NONE = "none"


def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Estimated trajectory: TUM, KITTI rows or Redwood log, also .gz.")],
    truth: Annotated[Path, typer.Argument(help="True trajectory, in any of these formats.")],
    align: Annotated[
        Alignment, typer.Option(help="Move the estimate onto the truth: rigidly, with scale, or not at all.")
    ] = Alignment.SE3,
    json_output: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the paths and the error over time (.png, .pdf, .svg).")
    ] = None,
) -> int:
    """Compare a trajectory with the truth: ATE and RPE, as the TUM RGB-D benchmark defines them.

    ATE is the distance between estimated and true camera centres after one alignment of the whole
    trajectory: it tells how good a map can be. RPE is the error of the motion from each frame to the next:
    it tells how much the tracking drifts. Poses are matched by time, at most 0.02 s apart.
    """
    from scanweld.cli.outputs import check_file
    from scanweld.evaluation.trajectory_metrics import ate, rpe
    from scanweld.evaluation.trajectory_plot import FORMATS, plot_trajectory_error
    from scanweld.io.trajectory_files import read_trajectory

    if plot is not None:
        check_file("--plot", plot, FORMATS)
    estimated, true = read_trajectory(estimate), read_trajectory(truth)
    absolute = ate(estimated, true, align=align.value)
    relative = rpe(estimated, true) if absolute.num_pairs > 1 else None
    if plot is not None:
        plot_trajectory_error(absolute, plot, title=f"{estimate.name} against {truth.name}")
    figures = _figures(absolute, relative, len(estimated))
    if json_output:
        typer.echo(json.dumps(figures))
    else:
        typer.echo(_table(figures, align.value, plot))
    return 0


def _figures(absolute: AteResult, relative: RpeResult | None, num_poses: int) -> dict[str, Any]:
    import math

    return {
        "ate_rmse_m": absolute.rmse_m,
        "ate_mean_m": absolute.mean_m,
        "ate_median_m": absolute.median_m,
        "ate_max_m": absolute.max_m,
        "rpe_trans_m": None if relative is None else relative.rmse_trans_m,
        "rpe_rot_deg": None if relative is None else math.degrees(relative.rmse_rot_rad),
        "scale": absolute.scale,
        "num_pairs": absolute.num_pairs,
        "num_poses": num_poses,
    }


def _table(figures: dict[str, Any], align: str, plot: Path | None) -> str:
    def length(value: float) -> str:
        return f"{value * 1000:.3f} mm" if value < 0.1 else f"{value:.4f} m"

    rotation = figures["rpe_rot_deg"]
    moved = {"se3": "rigid", "sim3": f"with scale {figures['scale']:.6g}", "none": "none"}[align]
    rows = [
        ("matched poses", f"{figures['num_pairs']} of {figures['num_poses']}"),
        ("alignment", moved),
        ("ATE rmse", length(figures["ate_rmse_m"])),
        ("ATE mean", length(figures["ate_mean_m"])),
        ("ATE median", length(figures["ate_median_m"])),
        ("ATE max", length(figures["ate_max_m"])),
        ("RPE translation", "-" if rotation is None else length(figures["rpe_trans_m"]) + " a frame (rmse)"),
        ("RPE rotation", "-" if rotation is None else f"{rotation:.4f} degrees a frame (rmse)"),
    ]
    if plot is not None:
        rows.append(("plot", str(plot)))
    return "\n".join(f"{name:<16} {value}" for name, value in rows)
