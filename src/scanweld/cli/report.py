"""`scanweld report`: the page about a run, made again from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    run: Annotated[Path, typer.Argument(help="Run folder, as slam wrote it.", metavar="RUN")],
    truth: Annotated[
        Path | None, typer.Option(help="True trajectory to compare with: TUM, KITTI rows or Redwood log.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File to write. Default: RUN/report.html.", metavar="F.html")] = None,
) -> int:
    """Write report.html: what a run came to, in words, charts and 3-D, in one file for any browser.

    slam and demo write it by themselves; this makes it again from the files of the run folder, also for runs
    of earlier versions. It needs no network, and nothing else from the folder.
    """
    from scanweld.errors import OutputError
    from scanweld.report.page import write_report

    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{out}: the report is a page; give a name that ends in .html")
    typer.echo(f"written  {write_report(run, truth=truth, out=out)}")
    return 0
