"""`scanweld check`: what is wrong with a recording, before it is used."""

from __future__ import annotations

import json
import textwrap
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanweld.cli.sequence_options import Camera, DepthScale, Format, Frames, Topics
from scanweld.cli.width import text_columns

if TYPE_CHECKING:
    from scanweld.checkup.findings import Checkup

Option = typer.Option

UNKNOWN = "not to be told"


def check(
    sequence: Annotated[Path, typer.Argument(help="Sequence: a folder or a recording, as for slam.")],
    format_name: Format = "auto",
    topics: Topics = None,
    camera: Camera = None,
    depth_scale: DepthScale = None,
    frames: Frames = None,
    json_output: Annotated[bool, Option("--json", help="Print findings and figures as one JSON object.")] = False,
) -> int:
    """Look for what is wrong with a recording before it is used, and say what to do about it.

    Depth unit, intrinsics, colour against depth, times, gaps, repeated frames, depth, blur, exposure, pace and ground
    truth are judged by about a hundred frames, in seconds. Exit code 3 says that something was found.
    """
    started = time.perf_counter()
    from scanweld.checkup.examine import examine_input
    from scanweld.runs.input import RunInput

    source = RunInput(str(sequence), format_name, frames, camera=camera, depth_scale=depth_scale, topics=topics)
    checkup = examine_input(sequence, source.open)
    seconds = time.perf_counter() - started
    if json_output:
        typer.echo(json.dumps({**checkup.as_dict(), "seconds": seconds}))
    else:
        typer.echo("\n".join(_lines(checkup, seconds, text_columns())))
    return 0 if checkup.sound else 3


def _lines(checkup: Checkup, seconds: float, columns: int) -> Iterator[str]:
    """The findings, those that weigh most first, and what was measured, for a person."""
    looked = f"looked at {checkup.num_looked_at} of {checkup.num_frames} frames in {seconds:.1f} s"
    if checkup.sound:
        verdict = "nothing wrong was found"
    else:
        count = len(checkup.findings)
        verdict = f"{count} thing{'s' * (count > 1)} to put right"
    heading = f"{checkup.name}: {verdict}" + (f" ({looked})" if checkup.num_frames else "")
    yield from _wrapped(heading, columns, "  ")
    for finding in checkup.findings:
        yield ""
        yield f"{finding.level.value}: {finding.fault}"
        for name, text in (("seen", finding.seen), ("why", finding.why), ("do", finding.advice)):
            yield from _wrapped(f"  {name:<5} {text}", columns, " " * 8)
    if checkup.figures:
        yield ""
        yield from _table(checkup.figures, columns)


def _table(figures: Mapping[str, float | None], columns: int) -> Iterator[str]:
    """What was measured, a row each; words that have no room beside the figure go on below."""
    from scanweld.checkup.findings import FIGURES

    width = min(max(map(len, FIGURES.values())) + 2, columns - len(UNKNOWN) - 2)
    for name, words in FIGURES.items():
        value = figures[name]
        first, *others = _wrapped(f"  {words}", width, " " * 4)
        yield f"{first:<{width}}  {UNKNOWN if value is None else f'{value:.3g}'}"
        yield from others


def _wrapped(text: str, columns: int, indent: str) -> list[str]:
    """Break a line between words alone: what is to be typed, or names a file, stays in one piece."""
    return textwrap.wrap(text, columns, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
