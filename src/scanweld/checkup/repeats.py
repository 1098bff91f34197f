"""Frames that were recorded more than once: copies of the one before, and pictures that stand still."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from scanweld.arrays import Bool, Int64
from scanweld.checkup.evidence import Step
from scanweld.checkup.findings import Figures, Finding, Judgement, Level
from scanweld.datasets.base import FileSequence, RgbdSequence
from scanweld.datasets.selection import ResizedSequence, SelectedSequence

FROZEN_FRAMES = 5
"""Equal frames in a row that are a picture that stands still; fewer are copies."""

_Files = tuple[Path, Path | None]


def check_repeats(sequence: RgbdSequence, steps: list[Step]) -> Judgement:
    """Look for frames that equal the one before, in all files; where there are none, in the steps looked at."""
    files = _files(sequence)
    if files is None:
        return judge_steps(steps)
    return _judge(np.array([False, *(_same(a, b) for a, b in pairwise(files))]), len(files))


def judge_steps(steps: list[Step]) -> Judgement:
    """Look for frames that equal the one before in some steps."""
    if not steps:
        return [], {"repeated_share": None}
    equal = np.zeros(max(step.index for step in steps) + 2, bool)
    equal[[step.index + 1 for step in steps if step.same_depth or step.same_color]] = True
    return _judge(equal, len({step.index for step in steps}))


def _judge(equal: Bool, num_looked_at: int) -> Judgement:
    """Tell the frames that equal the one before."""
    num = int(equal.sum())
    figures: Figures = {"repeated_share": num / num_looked_at}
    if num == 0:
        return [], figures
    first, longest = _longest_run(equal)
    if longest + 1 >= FROZEN_FRAMES:
        seen = f"frames {first} to {first + longest} are the same picture; {num} of {num_looked_at} repeat the last one"
        advice = f"leave them out, --frames 0:{first + 1}, or record again: the camera or its driver hung"
        return [Finding("frozen", Level.ERROR, seen, advice)], figures
    seen = f"{num} of {num_looked_at} frames repeat colour or depth of the one before, the first is {np.argmax(equal)}"
    advice = "record each frame once, at the rate of the camera; or leave the copies out with --frames A:B:STEP"
    return [Finding("duplicates", Level.WARNING, seen, advice)], figures


def _files(sequence: RgbdSequence) -> list[_Files] | None:
    """Return the depth and colour file of every frame, or None where frames are not files."""
    if isinstance(sequence, ResizedSequence):
        return _files(sequence.base)
    if isinstance(sequence, SelectedSequence):
        files = _files(sequence.base)
        return None if files is None else [files[index] for index in sequence.indices]
    return [(row.depth, row.color) for row in sequence.frames] if isinstance(sequence, FileSequence) else None


def _same(a: _Files, b: _Files) -> bool:
    pairs = zip(a, b, strict=True)
    return any(one is not None and other is not None and _equal_files(one, other) for one, other in pairs)


def _equal_files(a: Path, b: Path) -> bool:
    try:
        # Images are compressed: two that differ hardly ever have the same size.
        return a.stat().st_size == b.stat().st_size and a.read_bytes() == b.read_bytes()
    except OSError:
        return False


def _longest_run(equal: Bool) -> tuple[int, int]:
    """Return the frame before the longest run of repeats, and the length of the run."""
    edges: Int64 = np.flatnonzero(np.diff(np.concatenate([[False], equal, [False]]).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    at = int(np.argmax(stops - starts))
    return int(starts[at]) - 1, int(stops[at] - starts[at])
