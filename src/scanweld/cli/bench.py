"""`scanweld bench`: how fast this machine is, at several sizes or stage by stage."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from scanweld.benchmarking.machine import Machine
    from scanweld.benchmarking.sizes import SpeedResult
    from scanweld.benchmarking.stages import StageCost
    from scanweld.cli.progress import CountProgress
    from scanweld.datasets.base import RgbdSequence

Option = typer.Option

RENDERED_FRAMES = 60


class Kind(StrEnum):
    """What is measured."""

    SIZES = "sizes"
    STAGES = "stages"


def bench(
    kind: Annotated[
        Kind, typer.Argument(help="sizes: the demo at several sizes, beside Open3D; stages: where a frame's time goes.")
    ] = Kind.SIZES,
    sequence: Annotated[
        Path | None, typer.Argument(help="Sequence to profile the stages on. Default: a rendered room, 640x480.")
    ] = None,
    frames: Annotated[int, Option(help="Number of frames, of each size.", min=7)] = RENDERED_FRAMES,
    sizes: Annotated[
        str | None, Option(help="Sizes to render. Default: 160x120,320x240,640x480.", metavar="WxH,...")
    ] = None,
    peer_python: Annotated[
        str | None,
        Option(help="Interpreter that has Open3D, to compare with. Default: this one, if it has.", metavar="PYTHON"),
    ] = None,
    plot: Annotated[Path | None, Option(help="Draw time over size (.png, .pdf, .svg).", metavar="F.png")] = None,
    threads: Annotated[int | None, Option(help="Number of threads. Default: all cores.", min=1)] = None,
    json_output: Annotated[bool, Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Measure the speed of dense SLAM on this machine.

    Milliseconds are those of a frame once the first few have gone by; what else runs at the same time counts, too.
    Over floor is the time of a stage over that of copying as many bytes as it moves at least.
    """
    from scanweld.benchmarking.machine import measure_machine
    from scanweld.cli.image_size import parse_size
    from scanweld.cli.outputs import check_file
    from scanweld.cli.progress import CountProgress
    from scanweld.evaluation.trajectory_plot import FORMATS as PICTURES
    from scanweld.parallel import set_num_threads
    from scanweld.slam.warmup import compile_kernels

    if kind is Kind.STAGES and (plot is not None or peer_python is not None):
        raise typer.BadParameter("--plot and --peer-python belong to `bench sizes`")
    if kind is Kind.SIZES and sequence is not None:
        raise typer.BadParameter("a sequence belongs to `bench stages`")
    if plot is not None:
        check_file("--plot", plot, PICTURES)
    chosen = [] if sizes is None else [parse_size(size) for size in sizes.split(",")]
    if threads is not None:
        set_num_threads(threads)
    with CountProgress() as progress, tempfile.TemporaryDirectory(prefix="scanweld-bench-") as folder:
        compile_kernels(lambda part: progress.begin(f"compiling, once for this machine: {part}"))
        machine = measure_machine()
        if kind is Kind.STAGES:
            profiled = _sequence_to_profile(sequence, chosen, frames, Path(folder), progress)
            figures, table = _profile(profiled, machine, progress)
        else:
            figures, table = _compare(chosen, frames, peer_python, plot, Path(folder), progress)
    if json_output:
        typer.echo(json.dumps({"machine": asdict(machine), **figures}))
    else:
        typer.echo(f"{table}\n{_machine_text(machine)}")
    return 0


def _sequence_to_profile(
    given: Path | None, sizes: Sequence[tuple[int, int]], frames: int, folder: Path, progress: CountProgress
) -> RgbdSequence:
    """Open the given sequence, or render one to files: reading them is a stage."""
    from scanweld.datasets.open import open_sequence
    from scanweld.datasets.synthetic import RenderConfig, render_sequence

    if given is not None:
        return open_sequence(given, frames=f"0:{frames}")
    width, height = sizes[-1] if sizes else (640, 480)
    progress.begin(f"{width}x{height}: rendering {frames} frames")
    config = RenderConfig(scene="room", noise="kinect", frames=frames, width=width, height=height)
    render_sequence(folder / "room", config, progress=progress.update)
    return open_sequence(folder / "room")


def _profile(sequence: RgbdSequence, machine: Machine, progress: CountProgress) -> tuple[dict[str, Any], str]:
    """Return the stages' costs as figures and as a table."""
    from scanweld.benchmarking.stages import profile_stages

    progress.begin(f"{sequence.name}: profiling")
    costs = profile_stages(sequence, machine, progress=progress.update)
    camera = sequence.camera
    about = {"sequence": sequence.name, "frames": len(sequence), "width": camera.width, "height": camera.height}
    heading = "{sequence}, {frames} frames, {width}x{height}".format(**about)
    return {**about, "stages": [asdict(cost) for cost in costs]}, f"{heading}\n{_stages_text(costs)}"


def _compare(
    sizes: Sequence[tuple[int, int]],
    frames: int,
    peer_python: str | None,
    plot: Path | None,
    folder: Path,
    progress: CountProgress,
) -> tuple[dict[str, Any], str]:
    """Return the speed at several sizes as figures and as a table, and draw it."""
    from scanweld.benchmarking.sizes import SIZES, plot_sizes, run_sizes

    results = run_sizes(
        folder, sizes or SIZES, frames=frames, peer_python=peer_python, say=progress.begin, rendering=progress.update,
        progress=lambda result: progress.update(result.index + 1, frames),
    )  # fmt: skip
    table = _sizes_text(results)
    if plot is not None:
        plot_sizes(results, plot)
        table += f"\ndrawn in {plot}"
    return {"results": [asdict(result) for result in results]}, table


def _machine_text(machine: Machine) -> str:
    return (
        f"{machine.processor}, {machine.cores} cores, {machine.threads} threads; memory reads {machine.read_gb_s:.1f} "
        f"GB/s, copies {machine.copy_gb_s:.1f} GB/s"
    )


def _stages_text(costs: Sequence[StageCost]) -> str:
    lines = [f"{'stage':<10}{'ms':>8}{'CPU ms':>9}{'MB moved':>10}{'over floor':>12}"]
    for cost in costs:
        ratio = "" if cost.over_floor is None else f"{cost.over_floor:.1f}"
        moved = f"{cost.bytes_moved / 1e6:.1f}" if cost.bytes_moved else ""
        lines.append(f"{cost.name:<10}{cost.wall_ms:>8.2f}{cost.cpu_ms:>9.2f}{moved:>10}{ratio:>12}")
    wall, cpu = sum(cost.wall_ms for cost in costs), sum(cost.cpu_ms for cost in costs)
    lines.append(f"{'sum':<10}{wall:>8.2f}{cpu:>9.2f}")
    lines.append("In a run, decode and surfaces of the next frames overlap with the rest.")
    return "\n".join(lines)


def _sizes_text(results: Sequence[SpeedResult]) -> str:
    lines = [f"{'size':<12}{'program':<10}{'ms/frame':>10}{'frames/s':>10}{'CPU ms':>9}{'ATE mm':>9}"]
    for r in results:
        cpu = "" if r.cpu_ms_per_frame is None else f"{r.cpu_ms_per_frame:.1f}"
        size = f"{r.width}x{r.height}"
        lines.append(
            f"{size:<12}{r.program:<10}{r.ms_per_frame:>10.1f}{1e3 / r.ms_per_frame:>10.1f}{cpu:>9}"
            f"{1e3 * r.ate_rmse_m:>9.2f}"
        )
    if not any(r.program == "open3d" for r in results):
        lines.append("Open3D is not installed here: nothing to compare with (--peer-python names another interpreter).")
    return "\n".join(lines)
