"""Two runs held side by side: what of them is the same to the byte, and what may have made the rest differ."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, BinaryIO

from scanweld.errors import FileFormatError
from scanweld.report.run_files import TRUTH_FILE, read_json
from scanweld.runs.reopen import read_description

TIMINGS = ("seconds_total", "ms_per_frame_median", "fps", "peak_rss_mb")
"""Metrics that are another each time."""

RESULTS = ("trajectory.txt", "map.ply", "keyframes.csv", "trajectory-*.txt", "map-*.ply")
"""Files that are compared byte by byte; those with a number are of submaps."""

PROGRAM = ("scanweld", "python", "backend", "platform", "processor")
"""What run.json says of the program, beside its packages."""

_PART = 1 << 20  # bytes that are compared at a time


@dataclass(frozen=True, slots=True)
class Comparison:
    """What is the same of two runs.

    Attributes
    ----------
    same : names of the files that agree
    different : what differs, by the name of its file
    causes : what of the input and the program is another one, as "name value, was value"
    """

    same: tuple[str, ...]
    different: Mapping[str, str]
    causes: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Whether all results agree."""
        return not self.different


def compare_runs(folder: Path, earlier: Path) -> Comparison:
    """Compare the results of a run with those of an earlier one, but for timings.

    Raises
    ------
    FileFormatError
        When one of the two is no run folder, or a table of it cannot be read.
    """
    found: dict[str, str] = {}
    for name in sorted({path.name for place in (folder, earlier) for kind in RESULTS for path in place.glob(kind)}):
        found[name] = _difference_of_files(folder / name, earlier / name)
    for name, compare in (("frames.csv", _difference_of_frames), ("metrics.json", _difference_of_metrics)):
        found[name] = compare(folder / name, earlier / name)
    return Comparison(
        same=tuple(name for name, fault in found.items() if not fault),
        different={name: fault for name, fault in found.items() if fault},
        causes=tuple(_differences_of_circumstance(folder, earlier)),
    )


def differences_of_fingerprints(now: Mapping[str, Any], earlier: Mapping[str, Any]) -> list[str]:
    """Return what tells two inputs apart, as "input: name value, was value"."""
    return [f"input: {change}" for change in _changed(now, earlier)]


def _differences_of_circumstance(folder: Path, earlier: Path) -> list[str]:
    """Return what of input and program is another one; what an earlier version did not note is not compared."""
    now, before = read_description(folder), read_description(earlier)
    programs = [{key: run[key] for key in PROGRAM if key in run} | _part(run, "packages") for run in (now, before)]
    changes = differences_of_fingerprints(_part(now, "fingerprint"), _part(before, "fingerprint"))
    truths = [place / TRUTH_FILE for place in (folder, earlier)]
    if any(path.is_file() for path in truths) and (where := _difference_of_files(*truths)):
        changes.append(f"input: the true poses differ {where}")
    return [*changes, *_changed(*programs)]


def _part(run: Mapping[str, Any], name: str) -> dict[str, Any]:
    part = run.get(name)
    return part if isinstance(part, dict) else {}


def _changed(now: Mapping[str, Any], before: Mapping[str, Any]) -> Iterator[str]:
    for key, value in now.items():
        if key in before and before[key] != value:
            yield f"{key} {_short(value)}, was {_short(before[key])}"


def _short(value: Any) -> str:
    """Show a value; of a digest the beginning tells enough."""
    text = str(value)
    return text if len(text) < 40 or " " in text else f"{text[:8]}.."


def _difference_of_files(path: Path, earlier: Path) -> str:
    """Return where two files begin to differ, "" where they agree."""
    for place in (path, earlier):
        if not place.is_file():
            return f"there is none in {place.parent}"
    with path.open("rb") as here, earlier.open("rb") as there:
        at = _first_difference(here, there)
        if at is None:
            return ""
        if path.suffix == ".ply":
            return f"from byte {at} of {path.stat().st_size}, was {earlier.stat().st_size} bytes"
        here.seek(0)
        return f"from line {here.read(at).count(10) + 1}"


def _first_difference(here: BinaryIO, there: BinaryIO) -> int | None:
    at = 0
    while True:
        mine, other = here.read(_PART), there.read(_PART)
        if mine != other:
            pairs = enumerate(zip(mine, other, strict=False))
            return at + next((k for k, (a, b) in pairs if a != b), min(len(mine), len(other)))
        if not mine:
            return None
        at += len(mine)


def _difference_of_frames(path: Path, earlier: Path) -> str:
    """Return the first frame that differs; how long its stages took is left out."""
    for k, (now, before) in enumerate(zip_longest(_rows(path), _rows(earlier))):
        if now is None or before is None:
            return f"{'fewer' if now is None else 'more'} than {k} frames"
        for key in dict.fromkeys([*now, *before]):
            if not key.startswith("ms_") and now.get(key) != before.get(key):
                return f"from frame {k}: {key} {now.get(key)}, was {before.get(key)}"
    return ""


def _rows(path: Path) -> Iterator[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                yield {str(key): str(value) for key, value in row.items()}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path}: not a readable table: {error}") from None


def _difference_of_metrics(path: Path, earlier: Path) -> str:
    """Return the figures that differ, but for timings."""
    now, before = read_json(path), read_json(earlier)
    names = [name for name in dict.fromkeys([*now, *before]) if name not in TIMINGS]
    changed = [name for name in names if now.get(name) != before.get(name)]
    return "; ".join(f"{name} {now.get(name)}, was {before.get(name)}" for name in changed)
