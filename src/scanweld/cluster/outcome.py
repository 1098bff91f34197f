"""What became of each sequence of a batch: read from its run folder, whether that is new or was there before."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from scanweld.config import from_mapping, load_toml
from scanweld.errors import ConfigError, FileFormatError, OutputError
from scanweld.report.run_files import check_run_folder, read_frames, read_json
from scanweld.report.verdict import UNTRUSTWORTHY, judge
from scanweld.runs.checkpoint.identity import differences
from scanweld.runs.folder import MARK
from scanweld.slam.config import SlamConfig

SMALL_FILES = (MARK, "metrics.json", "frames.csv", "config.toml")
"""Files of a run folder that tell what became of the run."""

LISTED = "files"
"""What run.json has under this name tells the files that a run was made from."""


class State(StrEnum):
    """How far a sequence of a batch came."""

    DONE = "done"
    KEPT = "kept"
    """It was finished before, and was not run again."""
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    """Ctrl-C came before its end; the same command goes on."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one sequence.

    Attributes
    ----------
    number : of the task in the batch
    state : see :class:`State`
    verdict : TRUSTWORTHY, DOUBTFUL or UNTRUSTWORTHY, "" where there is no run
    reason : why it failed, or what weighs most in the verdict, in one line
    metrics : what metrics.json holds
    resumed : how often the run went on from a checkpoint
    seconds : that the task took this time, with fetching, opening and writing
    host : name of the machine that ran it
    version : of scanweld that ran it
    """

    number: int
    state: State
    verdict: str = ""
    reason: str = ""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    resumed: int = 0
    seconds: float = 0.0
    host: str = ""
    version: str = ""

    @property
    def good(self) -> bool:
        """Whether there is a run that can be trusted, if with reservations."""
        return self.state in (State.DONE, State.KEPT) and self.verdict != UNTRUSTWORTHY


def failed(number: int, reason: str, seconds: float = 0.0) -> Outcome:
    """Return the outcome of a sequence that has no run."""
    return Outcome(number, State.FAILED, reason=reason, seconds=seconds, host=platform.node())


def read_outcome(number: int, folder: Path, state: State, seconds: float) -> Outcome:
    """Return what became of a run, from the small files of its folder.

    Raises
    ------
    FileFormatError
        When one of them is missing, or cannot be read.
    """
    check_run_folder(folder, SMALL_FILES)
    run, metrics = read_json(folder / MARK), read_json(folder / "metrics.json")
    verdict = judge(read_frames(folder / "frames.csv"), metrics, run)
    return Outcome(
        number, state, verdict.level, verdict.reasons[0], metrics, len(run.get("resumed_at", ())), seconds,
        str(run.get("host", "")), str(run.get("scanweld", "")),
    )  # fmt: skip


def is_finished(folder: Path, asked: Mapping[str, Any], config: SlamConfig) -> bool:
    """Whether a folder holds the whole run of just this input and configuration.

    Where the map was kept (`map.*`) makes no difference.

    Parameters
    ----------
    folder : of the run
    asked : what run.json must hold of the input
    config : resolved

    Raises
    ------
    OutputError
        When it holds a run of something else.
    """
    if not all((folder / name).is_file() for name in SMALL_FILES):
        return False
    try:
        run, values = read_json(folder / MARK), load_toml(folder / "config.toml")
    except (FileFormatError, ConfigError):  # an upload that was cut off
        return False
    if run.get("interrupted"):
        return False
    try:
        made_with = asdict(replace(from_mapping(SlamConfig, values), map=config.map))
    except ConfigError as error:
        raise _another(folder, str(error)) from None
    pairs = ({name: run.get(name) for name in asked}, asked), (made_with, asdict(config))
    for there, here in pairs:
        for key, (was, wanted) in differences(there, here):
            raise _another(folder, f"{key} {_short(was)}, here {_short(wanted)}")
    return True


def _another(folder: Path, what: str) -> OutputError:
    return OutputError(f"{folder}: holds another run ({what}); --force replaces it, --out writes elsewhere")


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 40 else f"{text[:8]}.."
