"""The demo at several image sizes, beside Open3D's dense SLAM where that is installed."""

from __future__ import annotations

import importlib.util
import json
import logging
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from scanweld.benchmarking import open3d_peer
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.open import open_sequence
from scanweld.datasets.synthetic import RenderConfig, render_sequence
from scanweld.errors import InvalidInputError, OutputError
from scanweld.evaluation.trajectory_metrics import ate
from scanweld.runs.run import run_sequence
from scanweld.trajectory import FrameResult, Trajectory

logger = logging.getLogger(__name__)

SIZES = ((160, 120), (320, 240), (640, 480))
"""Width and height of the images."""

OURS, OPEN3D = "scanweld", "open3d"

SETTLING_FRAMES = 5
"""Frames at the start that are not counted."""

Say = Callable[[str], object]


@dataclass(frozen=True, slots=True)
class SpeedResult:
    """How fast a program was on one size.

    Attributes
    ----------
    program : "scanweld" or "open3d"
    width, height : of the images
    frames : number of them
    ms_per_frame : wall time of a frame [ms]: ours with decoding and all, Open3D's without decoding
    cpu_ms_per_frame : of all threads [ms]; None where it is not known
    ate_rmse_m : error of the trajectory [m]
    """

    program: str
    width: int
    height: int
    frames: int
    ms_per_frame: float
    cpu_ms_per_frame: float | None
    ate_rmse_m: float


def run_sizes(
    folder: Path,
    sizes: Sequence[tuple[int, int]] = SIZES,
    *,
    frames: int = 60,
    peer_python: str | None = None,
    say: Say = lambda text: None,
    rendering: Callable[[int, int], None] | None = None,
    progress: Callable[[FrameResult], object] | None = None,
) -> list[SpeedResult]:
    """Render the demo's room in each size into a folder, and run every program on it.

    Parameters
    ----------
    folder : where the sequences are rendered to
    sizes : (width, height) of the images
    frames : of each size; more than those that are not counted
    peer_python : an interpreter that has Open3D; default this one, if it has
    say : is told what begins
    rendering, progress : called after each rendered, and after each processed frame

    Raises
    ------
    InvalidInputError
        When there are too few frames.
    """
    if frames <= SETTLING_FRAMES + 1:
        raise InvalidInputError(
            f"frames: expected more than {SETTLING_FRAMES + 1}, as the first {SETTLING_FRAMES} are not counted; "
            f"got {frames}"
        )
    peer = peer_python or (sys.executable if importlib.util.find_spec("open3d") else None)
    results = []
    for width, height in sizes:
        say(f"{width}x{height}: rendering {frames} frames")
        config = RenderConfig(scene="room", noise="kinect", frames=frames, width=width, height=height)
        place = folder / f"{width}x{height}"
        render_sequence(place, config, progress=rendering)
        say(f"{width}x{height}: {OURS}")
        sequence = open_sequence(place)
        results.append(_run_ours(sequence, progress))
        if peer is not None:
            say(f"{width}x{height}: {OPEN3D}")
            found = _run_open3d(peer, place, sequence)
            results.extend([found] if found else [])
    return results


def _run_ours(sequence: RgbdSequence, progress: Callable[[FrameResult], object] | None) -> SpeedResult:
    """One run, without writing it."""
    moments: list[tuple[float, float]] = []

    def note(result: FrameResult) -> None:
        moments.append((time.perf_counter(), time.process_time()))
        if progress is not None:
            progress(result)

    summary = run_sequence(sequence, progress=note)
    (wall, cpu), (end_wall, end_cpu) = moments[SETTLING_FRAMES], moments[-1]
    counted = len(moments) - 1 - SETTLING_FRAMES
    camera = sequence.camera
    return SpeedResult(
        OURS, camera.width, camera.height, len(moments), 1e3 * (end_wall - wall) / counted,
        1e3 * (end_cpu - cpu) / counted, float(summary.metrics["ate_rmse_m"]),
    )  # fmt: skip


def _run_open3d(python: str, folder: Path, sequence: RgbdSequence) -> SpeedResult | None:
    """Open3D in a process of its own; None, and a warning, where it does not work."""
    command = [python, str(Path(open3d_peer.__file__)), str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=True)
        found = json.loads(done.stdout.strip().splitlines()[-1])
    except (OSError, subprocess.CalledProcessError, ValueError, IndexError) as error:
        words = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        logger.warning("Open3D is left out: %s", words[-1] if words else error)
        return None
    centres = np.array(found["centres_m"])
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, 3] = centres
    assert sequence.ground_truth is not None
    error_m = ate(Trajectory(sequence.timestamps_s, poses), sequence.ground_truth).rmse_m
    camera = sequence.camera
    return SpeedResult(
        OPEN3D, camera.width, camera.height, len(centres), median(found["ms"][SETTLING_FRAMES:]), None, error_m
    )


def plot_sizes(results: Sequence[SpeedResult], path: Path) -> None:
    """Draw time per frame over the number of pixels, a line for each program.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for program, color in ((OURS, "#2563eb"), (OPEN3D, "#6b7280")):
        rows = [result for result in results if result.program == program]
        if rows:
            axes.plot(
                [r.width * r.height for r in rows], [r.ms_per_frame for r in rows], "o-", color=color, label=program
            )
    ticks = sorted({(r.width * r.height, f"{r.width}x{r.height}") for r in results})
    axes.set(xscale="log", yscale="log", xlabel="image", ylabel="ms a frame", title="Dense SLAM of a rendered room")
    axes.set_xticks([pixels for pixels, _ in ticks], [name for _, name in ticks])
    axes.minorticks_off()
    for fps in (30, 60, 150):
        axes.axhline(1e3 / fps, color="#d1d5db", linewidth=0.8, zorder=0)
        axes.annotate(
            f"{fps} a second", (1, 1e3 / fps), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8
        )
    axes.legend(frameon=False)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be written ({error})") from None
