"""`scanweld batch`: many sequences, on all cores of this machine or on a cluster."""

from __future__ import annotations

import json
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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

if TYPE_CHECKING:
    from scanweld.cluster.outcome import Outcome
    from scanweld.cluster.task import RunTask

Option = typer.Option

MOST_FAULTS = 12
"""Faults that are printed below the table; the page and the Parquet file have them all."""


def batch(
    sequences: Annotated[
        list[str],
        typer.Argument(help="Sequences, as for slam: paths, or URLs such as s3://lab/desk.", metavar="SEQUENCE"),
    ],
    out: Annotated[str, Option(help="Folder for the run folders and their comparison; path or URL.", metavar="RUNS")],
    scheduler: Annotated[
        str | None, Option(help="Dask scheduler to use. Default: workers on this machine.", metavar="tcp://HOST:PORT")
    ] = None,
    workers: Annotated[
        int | None, Option(help="Sequences at a time on this machine. Default: as many as cores.", min=1)
    ] = None,
    sweep: Annotated[
        list[str] | None, Option(help="Run every sequence with each value of a setting.", metavar="KEY=A,B,...")
    ] = None,
    overrides: Overrides = None,
    config: Config = None,
    format_name: Format = "auto",
    topics: Topics = None,
    camera: Camera = None,
    depth_scale: DepthScale = None,
    frames: Frames = None,
    scale: Scale = 1.0,
    threads: Annotated[
        int | None, Option(help="Threads of each sequence. Default: all cores are used; 1 with --scheduler.", min=1)
    ] = None,
    memory: Annotated[str | None, Option(help="Memory that each sequence may take.", metavar="4GB")] = None,
    retries: Annotated[
        int, Option(help="How often a sequence is begun again, or continued, whose worker was lost.", min=0)
    ] = 2,
    checkpoint_every: CheckpointEvery = None,
    force: Annotated[bool, Option("--force", help="Run again what is finished, and replace it.")] = False,
    json_output: Annotated[bool, Option("--json", help="Print the table as one JSON object.")] = False,
) -> int:
    """Run many sequences at a time, with one configuration or several, and compare what comes of them.

    The same command goes on where it was interrupted: what is finished is not run again. RUNS holds a run folder for
    each sequence, batch.parquet with all metrics, and report.html, which compares the runs. Exit code 3 says that a
    sequence failed or that its run is not trustworthy; the others are complete.
    """
    begun = time.perf_counter()
    from scanweld.cli.progress import BatchProgress
    from scanweld.cli.slam import load_config
    from scanweld.cli.width import text_columns
    from scanweld.cluster.batch import ClusterOptions, run_batch
    from scanweld.cluster.plan import plan_batch
    from scanweld.cluster.scheduler import load_distributed
    from scanweld.cluster.table import TABLE_FILE, load_pyarrow, rows_of, write_table
    from scanweld.io.atomic import check_holds
    from scanweld.report.batch_page import make_batch_page
    from scanweld.report.page import REPORT_FILE
    from scanweld.runs.input import RunInput
    from scanweld.runs.storage.urls import is_url, join, name_of, write_to
    from scanweld.slam.warmup import compile_kernels

    load_distributed()
    load_pyarrow()  # what is missing is told before hours of work
    given, sweeps = overrides or [], sweep or []
    options = ClusterOptions(
        scheduler=scheduler, workers=workers, threads=threads, memory=memory, retries=retries,
        dashboard=find_spec("bokeh") is not None,
    )  # fmt: skip
    tasks = plan_batch(
        sequences, out, RunInput("", format_name, frames, scale, camera, depth_scale, topics),
        lambda swept: load_config(config, [*given, *swept]), sweeps=sweeps, force=force,
        checkpoint_every_s=checkpoint_every,
        description={"config": str(config) if config else None, "set": given},
    )  # fmt: skip
    if not is_url(out):
        check_holds(Path(out))
    with BatchProgress([task.name for task in tasks]) as progress:
        if scheduler is None:  # all at once would compile the same
            compile_kernels(lambda part: progress.say(f"compiling, once for this machine: {part}"))
        outcomes = run_batch(tasks, options, progress)
    rows, swept = rows_of(tasks, outcomes), list(tasks[0].swept)
    page = make_batch_page(name_of(out), rows, swept, time.perf_counter() - begun)
    write_table(rows, join(out, TABLE_FILE))
    write_to(join(out, REPORT_FILE), page.encode("utf-8"))
    if json_output:
        typer.echo(json.dumps({"runs": rows, "seconds": time.perf_counter() - begun}))
    else:
        typer.echo("\n".join(_lines(tasks, outcomes, join(out, REPORT_FILE), text_columns())))
    if any(outcome.state == "interrupted" for outcome in outcomes):
        print("interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    return 0 if all(outcome.good for outcome in outcomes) else 3


def _lines(tasks: Sequence[RunTask], outcomes: Sequence[Outcome], page: str, columns: int) -> Iterator[str]:
    """Yield the table, why what failed did, and where all of it is."""
    from scanweld.cluster.table import table_lines

    yield from table_lines(tasks, outcomes, columns)
    faults = [f"{task.name}: {o.reason}" for task, o in zip(tasks, outcomes, strict=True) if o.reason and not o.good]
    for fault in faults[:MOST_FAULTS]:
        yield ""
        yield from textwrap.wrap(fault, columns, subsequent_indent="  ")
    if len(faults) > MOST_FAULTS:
        yield f"and {len(faults) - MOST_FAULTS} more"
    yield ""
    if any(outcome.state == "kept" for outcome in outcomes):
        yield from textwrap.wrap("* was finished before, and was not run again", columns)
    yield f"written  {page}"
