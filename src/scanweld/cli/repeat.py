"""`scanweld repeat`: a run made again, and compared."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from scanweld.runs.comparison import Comparison


def repeat(
    run: Annotated[Path, typer.Argument(help="Run folder, as slam wrote it.", metavar="RUN")],
    out: Annotated[
        Path | None, typer.Option(help="Where the repetition is kept. Default: nowhere.", metavar="RUN")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Number of threads; any gives the same.", min=1)] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing run in --out.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print the comparison as one JSON object.")] = False,
) -> int:
    """Do a run again, with its input, configuration and options, and see whether the same comes of it.

    Trajectory, map, keyframes, and metrics but for timings are compared byte by byte. Exit code 0: all is the same; 3:
    something differs, and what of the input, the program or the machine is another one is named.
    """
    from scanweld.cli.progress import FrameProgress
    from scanweld.parallel import set_num_threads
    from scanweld.runs.reopen import read_description
    from scanweld.runs.repeat import repeat_run
    from scanweld.slam.warmup import compile_kernels

    if threads is not None:
        set_num_threads(threads)
    fingerprint = read_description(run).get("fingerprint") or {}
    with FrameProgress(fingerprint.get("number of frames"), "repeat") as progress:
        compile_kernels(lambda part: progress.say(f"compiling, once for this machine: {part}"))
        comparison = repeat_run(run, out, force=force, progress=progress.update)
    if json_output:
        typer.echo(json.dumps({"identical": comparison.identical, **asdict(comparison)}))
    else:
        typer.echo(comparison_text(comparison))
    return 0 if comparison.identical else 3


def comparison_text(comparison: Comparison) -> str:
    """Return a comparison as lines for a person."""
    rows = [("same", ", ".join(comparison.same))] if comparison.same else []
    rows += [("differs", f"{name}: {where}") for name, where in comparison.different.items()]
    rows += [("changed", cause) for cause in comparison.causes]
    if comparison.identical:
        verdict = "the same to the byte"
    elif comparison.causes:
        verdict = "not the same; what has changed since the run may be why"
    else:
        verdict = "not the same, although input and program are"
    return "\n".join(f"{name:<8} {text}" for name, text in [*rows, ("verdict", verdict)])
