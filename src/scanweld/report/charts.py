"""What the charts of a report show: named columns, which the page's own script draws at the width it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanweld.arrays import Array, Float64, Int64
from scanweld.errors import InvalidInputError
from scanweld.evaluation.trajectory_metrics import AteResult, ate, rpe
from scanweld.report.run_files import FrameTable, RunFiles
from scanweld.report.scene import floats
from scanweld.report.words import length, percent
from scanweld.trajectory import Trajectory

DRIFT_FRACTIONS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Parts of the path over which drift is measured."""

STAGE_NAMES = {
    "surfaces": "depth to surfaces", "view": "view of the map", "track": "alignment", "fuse": "fusion",
    "loop": "places and loops",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a chart; `x` is given where it is not the number of the frame."""

    name: str
    y: Array
    x: Array | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A chart and its words.

    Attributes
    ----------
    key : its name in the page
    title, about : what it shows, and what to look for
    summary : figures in words, also for those who cannot see the chart
    kind : "frames" (over the frames of the run), "lines" (over x) or "path" (x and y at one scale)
    unit, x_label : of the axes
    stacked : series are parts of a whole
    wide : it takes a row of its own
    top : highest value shown, None for the highest there is
    """

    key: str
    title: str
    about: str
    summary: str
    series: Sequence[Series]
    kind: str = "frames"
    unit: str = ""
    x_label: str = "frame"
    stacked: bool = False
    wide: bool = False
    top: float | None = None

    def data(self) -> dict[str, Any]:
        """Return what the script needs."""
        return {
            "kind": self.kind,
            "unit": self.unit,
            "xLabel": self.x_label,
            "stacked": self.stacked,
            "top": self.top,
            "series": [
                {"name": s.name, "y": floats(s.y)} | ({} if s.x is None else {"x": floats(s.x)}) for s in self.series
            ],
        }


def evaluate(trajectory: Trajectory, truth: Trajectory | None) -> AteResult | None:
    """Return the error of a path, or None where it cannot be told."""
    if truth is None or len(trajectory) == 0:
        return None
    try:
        return ate(trajectory, truth)
    except InvalidInputError:
        return None


def accuracy_charts(files: RunFiles, error: AteResult, shown: Int64) -> list[Chart]:
    """Return error over the frames, from frame to frame, over the way, and the two paths."""
    times = files.frames.timestamp_s
    factor, unit = (1e3, "mm") if error.max_m < 0.5 else (1.0, "m")
    charts = [
        Chart(
            key="ate",
            title="Error of the position",
            about="Distance to the true camera centre after one rigid alignment of the whole path (ATE). A step is a "
            "slip or a bad relocalisation, a slow rise is drift.",
            summary=f"rms {length(error.rmse_m)}, median {length(error.median_m)}, largest {length(error.max_m)}",
            series=[Series("error", _at_frames(times, error.timestamps_s, error.errors_m * factor)[shown])],
            unit=unit,
            wide=True,
        )
    ]
    assert files.truth is not None
    try:
        step = rpe(files.trajectory, files.truth)
    except InvalidInputError:
        step = None
    if step is not None:
        degrees = np.degrees(step.errors_rot_rad)
        charts += [
            Chart(
                key="rpe",
                title="Error from frame to frame, translation",
                about="Error of the motion from each frame to the next (RPE): peaks are frames that slipped, the level "
                "is the jitter of the tracking.",
                summary=f"rms {length(step.rmse_trans_m)}, largest {length(float(step.errors_trans_m.max()))}",
                series=[Series("error", _at_frames(times, step.timestamps_s, step.errors_trans_m * 1e3)[shown])],
                unit="mm",
            ),
            Chart(
                key="rpe_rot",
                title="Error from frame to frame, rotation",
                about="The same for the direction in which the camera looks.",
                summary=f"rms {np.degrees(step.rmse_rot_rad):.3g}°, largest {degrees.max():.3g}°",
                series=[Series("error", _at_frames(times, step.timestamps_s, degrees)[shown])],
                unit="°",
            ),
        ]
    drift = _drift_chart(files.trajectory, files.truth, error)
    if drift is not None:
        charts.append(drift)
    charts.append(_path_chart(error))
    return charts


def _drift_chart(trajectory: Trajectory, truth: Trajectory, error: AteResult) -> Chart | None:
    # The truth may begin earlier and end later than the run.
    total = float(np.linalg.norm(np.diff(error.positions_truth_m, axis=0), axis=1).sum())
    ways, errors, rates = [], [], []
    for fraction in DRIFT_FRACTIONS:
        try:
            result = rpe(trajectory, truth, delta=max(fraction * total, 1e-9), unit="metres", all_pairs=True)
        except InvalidInputError:
            continue
        ways.append(fraction * total)
        errors.append(result.rmse_trans_m * 1e3)
        rates.append(result.rmse_trans_m / (fraction * total))
    if len(ways) < 2:
        return None
    return Chart(
        key="drift",
        title="Drift over the way",
        about="Error of the motion over parts of the path of a given length, from every start. A map that the camera "
        "comes back to keeps the line flat; odometry lets it rise.",
        summary=f"{percent(rates[0])} over {length(ways[0])}, {percent(rates[-1])} over {length(ways[-1])}",
        series=[Series("error", np.array(errors), np.array(ways))],
        kind="lines",
        unit="mm",
        x_label="way [m]",
    )


def _path_chart(error: AteResult) -> Chart:
    """Both paths, along the two axes in which the camera moved most."""
    first, second = np.sort(np.argsort(-np.ptp(error.positions_truth_m, axis=0), kind="stable")[:2])
    rows = np.linspace(0, error.num_pairs - 1, min(error.num_pairs, 2000)).astype(int)
    true, estimated = error.positions_truth_m[rows], error.positions_aligned_m[rows]
    return Chart(
        key="path",
        title="Path, true and estimated",
        about=f"Seen along the axis in which the camera moved least, {'xyz'[first]} to the right and "
        f"{'xyz'[second]} upwards, in the frame of the truth.",
        summary=f"{error.num_pairs:,} poses have a true partner",
        series=[
            Series("truth", true[:, second], true[:, first]),
            Series("estimate", estimated[:, second], estimated[:, first]),
        ],
        kind="path",
        unit="m",
        x_label=f"{'xyz'[first]} [m]",
    )


def tracking_charts(frames: FrameTable, shown: Int64, *, final_surfels: float | None = None) -> list[Chart]:
    """Return residual, overlap and inliers, time of each stage, and growth of the map.

    The map that a run ends with has `final_surfels`: fragments and submaps are put together after the last frame.
    """
    aligned = frames.aligned & (frames.inliers > 0)  # an alignment without a single match measured nothing
    # Lines go on level over dropped frames: single frames between them would be no line.
    dropped = np.array([state == "dropped" for state in frames.state])
    held = np.maximum.accumulate(np.where(dropped, 0, np.arange(len(frames))))

    def where_aligned(values: Float64) -> Float64:
        return np.asarray(np.where(aligned, values, np.nan)[held])

    def spread(values: Float64, form: str) -> str:
        usual = values[aligned & frames.posed]
        if len(usual) == 0:
            return "no frame was aligned"
        middle, high = np.percentile(usual, [50, 99])
        return f"median {form.format(middle)}, 99 % of the tracked frames below {form.format(high)}"

    def least(values: Float64, form: str) -> str:
        usual = values[aligned & frames.posed]
        if len(usual) == 0:
            return "no frame was aligned"
        low, middle = np.percentile(usual, [1, 50])
        return f"median {form.format(middle)}, 99 % of the tracked frames above {form.format(low)}"

    total_ms = np.sum(list(frames.stage_ms.values()), axis=0) if frames.stage_ms else np.zeros(len(frames))
    # The first frames compile or fill caches: they must not set the scale.
    taken_ms = total_ms[~dropped]
    steady = taken_ms[min(5, len(taken_ms) - 1) :]
    grown = f"{frames.surfels[-1]:,.0f} surfels at the last frame"
    if final_surfels is not None and final_surfels != frames.surfels[-1]:
        grown += f", {final_surfels:,.0f} in the final map"
    return [
        Chart(
            key="rmse",
            title="Residual",
            about="Root mean square distance of map and frame, at the points that were matched. It should stay near "
            "the noise of the sensor; a rise without more noise is a slip.",
            summary=spread(frames.rmse_m * 1e3, "{:.3g} mm"),
            series=[Series("residual", where_aligned(frames.rmse_m * 1e3)[shown])],
            unit="mm",
        ),
        Chart(
            key="overlap",
            title="Overlap",
            about="Share of the visible map that the frame matched. It drops where the camera looks at something new, "
            "something moves, or the pose is wrong.",
            summary=least(frames.overlap * 100, "{:.0f} %"),
            series=[Series("overlap", where_aligned(frames.overlap * 100)[shown])],
            unit="%",
            top=100.0,
        ),
        Chart(
            key="inliers",
            title="Inliers",
            about="Matched points whose residual is within the noise: what the pose rests on.",
            summary=least(frames.inliers, "{:,.0f}"),
            series=[Series("inliers", where_aligned(frames.inliers)[shown])],
        ),
        Chart(
            key="surfels",
            title="Size of the map",
            about="It grows where the camera sees something new, and should stop growing where it returns. Growth on "
            "known ground means surfaces are doubled.",
            summary=grown,
            series=[Series("surfels", frames.surfels[shown] / 1e3)],
            unit="thousand surfels",
        ),
        Chart(
            key="time",
            title="Time by stage",
            about="Wall time of each frame. The first frames fill caches and may leave the scale.",
            summary=f"median {np.median(steady):.0f} ms a frame, 99 % below {np.percentile(steady, 99):.0f} ms",
            series=[
                Series(STAGE_NAMES.get(name, name), values[held][shown]) for name, values in frames.stage_ms.items()
            ],
            unit="ms",
            stacked=True,
            wide=True,
            top=1.3 * max(float(np.percentile(steady, 98)), 1.0),
        ),
    ]


def _at_frames(times_s: Float64, some_times_s: Float64, values: Float64) -> Float64:
    """Spread values that belong to some of the frames over all frames; NaN elsewhere."""
    spread = np.full(len(times_s), np.nan)
    nearest = np.clip(np.searchsorted(times_s, some_times_s - 1e-4), 0, len(times_s) - 1)
    spread[nearest] = values
    return spread
