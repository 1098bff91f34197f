"""`scanweld slam`: from a sequence to a trajectory, a map and an evaluation."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scanweld.cli.sequence_options import (
    Camera,
    CheckpointEvery,
    Config,
    DepthScale,
    Format,
    Frames,
    Overrides,
    Scale,
    Topics,
)
from scanweld.cli.view import HOST, PORT, opened_observers

if TYPE_CHECKING:
    from scanweld.datasets.base import RgbdSequence
    from scanweld.runs.input import RunInput
    from scanweld.runs.run import RunSummary
    from scanweld.slam.config import SlamConfig

Option = typer.Option


def slam(
    sequence: Annotated[
        str,
        typer.Argument(
            help="Sequence: a folder or a recording (TUM, ScanNet, Record3D, a ROS bag, ...: see docs/formats.md), "
            "also behind a URL (s3://, ..), or realsense: for a camera."
        ),
    ],
    out: Annotated[
        str | None, Option(help="Run folder; with --fragments also a URL. Default: runs/SEQUENCE-N.", metavar="RUN")
    ] = None,
    format_name: Format = "auto",
    topics: Topics = None,
    camera: Camera = None,
    depth_scale: DepthScale = None,
    frames: Frames = None,
    scale: Scale = 1.0,
    poses: Annotated[str | None, Option(help="Fuse at given poses instead of tracking.", metavar="truth|FILE")] = None,
    config: Config = None,
    overrides: Overrides = None,
    threads: Annotated[int | None, Option(help="Number of threads. Default: all cores.", min=1)] = None,
    tracked_only: Annotated[
        bool, Option("--tracked-only", help="Leave frames without a measured pose out of trajectory.txt.")
    ] = False,
    calibrate: Annotated[
        bool, Option("--calibrate", help="Estimate intrinsics and depth offset, then run again with them.")
    ] = False,
    refine: Annotated[bool, Option("--refine", help="Adjust all keyframes together in the end.")] = False,
    realtime: Annotated[
        bool, Option("--realtime", help="Play the recording at its own speed; drop frames instead of falling behind.")
    ] = False,
    resume: Annotated[
        bool, Option("--resume", help="Continue a run that was interrupted or killed, from its checkpoint.")
    ] = False,
    checkpoint_every: CheckpointEvery = None,
    view: Annotated[bool, Option("--view", help="Show the run in the browser while it goes by.")] = False,
    view_host: Annotated[
        str, Option(help="Where --view listens; others than this machine need the token of its address.")
    ] = HOST,
    view_port: Annotated[int, Option(help="Port of --view.", min=0, max=65535)] = PORT,
    rerun: Annotated[
        str | None, Option(help="Record the run for Rerun, or show it there.", metavar="F.rrd|live|URL")
    ] = None,
    fragments: Annotated[
        int | None,
        Option(
            help="Cut a long recording into so many overlapping parts, run these in processes, and join them.", min=1
        ),
    ] = None,
    scheduler: Annotated[
        str | None, Option(help="Run fragments on the workers of a Dask scheduler.", metavar="tcp://HOST:8786")
    ] = None,
    workers: Annotated[
        int | None,
        Option(help="Processes that run fragments. Default: one per core.", min=1),
    ] = None,
    force: Annotated[bool, Option("--force", help="Replace an existing run.")] = False,
    json_output: Annotated[bool, Option("--json", help="Print the metrics as one JSON object.")] = False,
) -> int:
    """Track the camera through an RGB-D sequence and fuse a coloured surfel map.

    Exit code 3 says that the run ended LOST or tracked fewer than half of the frames; its folder is complete.
    """
    started = time.perf_counter()
    from scanweld.errors import ConfigError
    from scanweld.runs.folder import next_run_folder
    from scanweld.runs.input import RunInput, collected_warnings
    from scanweld.runs.reopen import given_poses
    from scanweld.runs.storage.urls import is_url

    if fragments is None and (scheduler is not None or workers is not None):
        raise typer.BadParameter("--scheduler and --workers are for --fragments N")
    alone = {
        "--poses": poses, "--calibrate": calibrate, "--refine": refine, "--realtime": realtime, "--view": view,
        "--rerun": rerun, "--checkpoint-every": checkpoint_every,
    }  # fmt: skip
    refused = [name for name, value in alone.items() if value not in (None, False)]
    if fragments is not None and refused:
        raise typer.BadParameter(f"--fragments: a run in fragments takes no {refused[0]}")
    if fragments is None and out is not None and is_url(out):
        raise typer.BadParameter("--out: a URL is for --fragments; `scanweld batch` writes other runs to URLs")
    settings = load_config(config, overrides or [])
    source = RunInput(sequence, format_name, frames, scale, camera, depth_scale, topics)
    with collected_warnings() as warnings:
        opened = source.open()
    if resume and out is None:
        raise ConfigError("--resume: --out RUN has to say which run is to be continued")
    place = out or str(next_run_folder(opened.name))
    poses_from = poses if poses in (None, "truth") else str(Path(poses).resolve())
    given = None if poses_from is None else given_poses(opened, poses_from)
    description = {
        **source.described(), "poses": poses_from, "config": str(config) if config else None, "set": overrides or [],
        "warnings": warnings,
    }  # fmt: skip
    if fragments is not None:
        summary = run_in_fragments(
            source, settings, place, fragments, scheduler=scheduler, workers=workers, threads=threads, force=force,
            resume=resume, tracked_only=tracked_only, description=description, started=started,
        )  # fmt: skip
        return print_summary(summary, json_output=json_output, place=place)
    with (
        kept_told(place, lambda: "" if realtime else checkpoint_kept(place)),
        opened_observers(opened.name, view=view, host=view_host, port=view_port, rerun=rerun) as observers,
    ):
        summary = run_with_progress(
            opened, settings, Path(place), force=force, poses=given, threads=threads, tracked_only=tracked_only,
            calibrate=calibrate, refine=refine, realtime=realtime, observers=observers.all, description=description,
            resume=resume, checkpoint_every_s=checkpoint_every, started=started,
        )  # fmt: skip
        code = print_summary(summary, json_output=json_output)
        if not summary.interrupted:
            observers.stay()
    return code


def load_config(path: Path | None, overrides: list[str]) -> SlamConfig:
    """Return the configuration: defaults < file < `--set`."""
    from scanweld.config import from_mapping, load_toml, merge, parse_override
    from scanweld.slam.config import SlamConfig

    values: dict[str, Any] = load_toml(path) if path else {}
    if path is not None:
        from_mapping(SlamConfig, values, str(path))  # a fault in the file is told with the file's name
    for text in overrides:
        values = merge(values, parse_override(text))
    return from_mapping(SlamConfig, values, "--set" if overrides else str(path))


def run_with_progress(
    sequence: RgbdSequence,
    config: SlamConfig,
    folder: Path,
    *,
    threads: int | None = None,
    title: str = "slam",
    started: float,
    **options: Any,
) -> RunSummary:
    """Run a sequence with progress on standard error."""
    from scanweld.cli.progress import FrameProgress
    from scanweld.parallel import set_num_threads
    from scanweld.runs.folder import check_writable
    from scanweld.runs.run import run_sequence
    from scanweld.slam.warmup import compile_kernels

    if threads is not None:
        set_num_threads(threads)
    check_writable(folder, force=options.get("force", False), resume=options.get("resume", False))
    then = "adjusting all keyframes together" if options.get("refine") else ""
    if options.get("calibrate"):
        then = "calibrating the camera; where that helps, all frames are tracked again"
    with FrameProgress(len(sequence) or None, title, then) as progress:
        compile_kernels(lambda part: progress.say(f"compiling, once for this machine: {part}"))
        return run_sequence(sequence, config, out=folder, progress=progress.update, started=started, **options)


@contextlib.contextmanager
def kept_told(place: str, kept: Callable[[], str]) -> Iterator[None]:
    """Say, where Ctrl-C ends the block and something is `kept`, that --resume goes on from there."""
    try:
        yield
    except KeyboardInterrupt:
        what = kept()
        then = f"{what} kept: the same command with --out {place} --resume goes on from there" if what else ""
        raise KeyboardInterrupt(then) from None


def checkpoint_kept(place: str) -> str:
    """Say that a run folder has a checkpoint, "" where it has none."""
    from scanweld.runs.folder import CHECKPOINT

    return "the last checkpoint is" if (Path(place) / CHECKPOINT).is_file() else ""


def fragments_kept(place: str) -> str:
    """Say how many fragments are finished beside a run folder, "" where none is, or nobody can say."""
    from scanweld.errors import OutputError
    from scanweld.runs.fragments.exchange import exchange_beside
    from scanweld.runs.fragments.making import finished_in

    try:
        count = len(finished_in(exchange_beside(place)))
    except OutputError:  # the storage does not answer, which may be why there was Ctrl-C
        return ""
    return "" if count == 0 else "1 finished fragment is" if count == 1 else f"{count} finished fragments are"


def run_in_fragments(
    source: RunInput,
    config: SlamConfig,
    out: str,
    number: int,
    *,
    scheduler: str | None,
    workers: int | None,
    threads: int | None,
    **options: Any,
) -> RunSummary:
    """Run a sequence in fragments with progress on standard error."""
    from scanweld.cli.progress import CountProgress
    from scanweld.cluster.executors import opened_executor
    from scanweld.runs.fragments.run import check_out, run_fragments
    from scanweld.slam.warmup import compile_kernels

    check_out(out, force=options["force"], resume=options["resume"])
    with kept_told(out, lambda: fragments_kept(out)), CountProgress("fragments") as progress:
        compile_kernels(lambda part: progress.begin(f"compiling, once for this machine: {part}"))

        def told(what: str, done: int, total: int) -> None:
            if done == 0:
                progress.begin(what)
            progress.update(done, total)

        with opened_executor(scheduler, workers=workers) as executor:
            return run_fragments(
                source.open, number, config, out=out, executor=executor, threads=threads or 1, progress=told, **options
            )


def print_summary(summary: RunSummary, *, json_output: bool, place: str | None = None) -> int:
    """Print what a run came to, and the place where it is if that is not in the summary; return its exit code."""
    if json_output:
        typer.echo(json.dumps(summary.metrics))
    else:
        typer.echo(summary_text(summary))
        if summary.folder is not None:
            typer.echo(verdict_text(summary.folder))
        if place is not None and summary.folder is None:
            typer.echo(f"{'written':<8} {place}")
    if summary.interrupted:
        return 130
    if not summary.trustworthy:
        m = summary.metrics
        print(
            f"warning: tracked {m['frames_tracked']} of {m['frames']} frames, last frame "
            f"{summary.results[-1].state.name}: frames.csv says why",
            file=sys.stderr,
        )
        return 3
    return 0


def verdict_text(folder: Path) -> str:
    """Say what the report of a run says first."""
    from scanweld.report.verdict import TRUSTWORTHY, judge_folder

    verdict = judge_folder(folder)
    why = "" if verdict.level == TRUSTWORTHY else f": {verdict.reasons[0]}"
    return f"{'verdict':<8} {verdict.headline}{why}"


def apart_text(metrics: Mapping[str, Any]) -> str:
    """Say what became of submaps that were not joined with the main map."""
    count, frames = metrics["submaps_unjoined"], metrics["frames_in_unjoined_submaps"]
    what = "1 submap" if count == 1 else f"{count} submaps"
    return f"{what} with {frames} frames, counted as lost: no place in common with the map was found"


def summary_text(summary: RunSummary) -> str:
    """Return the summary of a run as lines for a person."""
    m = summary.metrics
    lost = [f"{m['frames_lost']} lost"] if m["frames_lost"] else []
    lost += [f"{m['frames_unreadable']} unreadable"] if m["frames_unreadable"] else []
    lost += [f"{m['frames_dropped']} dropped to keep pace"] if m.get("frames_dropped") else []
    rows = [
        ("frames", f"{m['frames_tracked']} of {m['frames']} tracked" + "".join(f", {x}" for x in lost)),
        ("map", f"{m['num_surfels']:,} surfels from {m['num_points_input']:,} points"),
        ("path", f"{m['path_length_m']:.2f} m"),
    ]
    if m["submaps_unjoined"]:
        rows.append(("apart", apart_text(m)))
    for found in summary.refinements:
        if found.sigmas or found.held:  # the camera was to be found, too
            c = found.camera
            numbers = f"fx {c.fx:.2f} fy {c.fy:.2f} cx {c.cx:.2f} cy {c.cy:.2f}" if found.recalibrated else "as given"
            rows.append(("camera", f"{numbers}; {found.note}"))
        else:
            rows.append(("refined", found.note))
    if m["ate_rmse_m"] is not None:
        rows.append(("ATE", f"{m['ate_rmse_m'] * 1e3:.2f} mm rmse, {m['ate_max_m'] * 1e3:.2f} mm at most"))
    if m["rpe_trans_m"] is not None:
        rows.append(("RPE", f"{m['rpe_trans_m'] * 1e3:.2f} mm and {m['rpe_rot_deg']:.3f} deg a frame"))
    if m["fps"] is not None:
        rows.append(("speed", f"{m['fps']:.1f} frames a second; {m['seconds_total']:.1f} s in all"))
    if summary.folder is not None:
        rows.append(("written", f"{summary.folder}/"))
    if summary.resumable:
        rows.append(("resume", f"the same command with --out {summary.folder} --resume goes on from here"))
    return "\n".join(f"{name:<8} {text}" for name, text in rows)
