"""`scanweld datasets`: the formats of sequences that are read, and whether a sequence can be."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from scanweld.cli.completion import formats
from scanweld.errors import DatasetError


class Action(StrEnum):
    """What to do."""

    list = "list"
    check = "check"


def datasets(
    action: Annotated[Action, typer.Argument(help="list: the formats; check: open a sequence and say what it holds.")],
    sequence: Annotated[Path | None, typer.Argument(help="Sequence to check.")] = None,
    format_name: Annotated[
        str, typer.Option("--format", help="Format of the sequence to check.", autocompletion=formats)
    ] = "auto",
) -> int:
    """List the formats of sequences, or look into one: camera, frames, times, truth, and how much depth there is."""
    from scanweld.datasets.open import FORMATS, open_sequence

    if action is Action.list:
        width = max(len(row.name) for row in FORMATS)
        typer.echo("\n".join(f"{row.name:<{width}}  {row.layout}" for row in FORMATS))
        return 0
    if sequence is None:
        raise DatasetError("datasets check: which sequence? For example: scanweld datasets check FOLDER")
    opened = open_sequence(sequence, format=format_name)
    frame = opened.read(0)
    camera, times = opened.camera, opened.timestamps_s
    seen = frame.depth_m[frame.depth_m > 0]
    rows = {
        "name": opened.name,
        "frames": f"{len(opened)}, {times[-1] - times[0]:.1f} s",
        "camera": f"{camera.width}x{camera.height}, fx {camera.fx:.1f} fy {camera.fy:.1f} "
        f"cx {camera.cx:.1f} cy {camera.cy:.1f}",
        "depth": f"{opened.depth_scale:g} units per metre; in the first frame {seen.size / frame.depth_m.size:.0%} of "
        "the pixels" + (f", {seen.min():.2f} to {seen.max():.2f} m" if seen.size else ""),
        "colour": "none" if frame.color is None else "yes",
        "truth": "none" if opened.ground_truth is None else f"{len(opened.ground_truth)} poses",
    }
    typer.echo("\n".join(f"{name:<7}  {value}" for name, value in rows.items()))
    return 0
