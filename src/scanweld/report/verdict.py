"""Whether a run can be trusted, why, and what to try: in words, from the files of the run alone.

The rules are few, the same for every sequence, and told in docs/report.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.report.run_files import FrameTable, read_frames, read_json
from scanweld.report.stretches import kinds_of
from scanweld.report.words import count_of, length, percent

TRUSTWORTHY, DOUBTFUL, UNTRUSTWORTHY = "trustworthy", "doubtful", "untrustworthy"

HEADLINES = {
    TRUSTWORTHY: "Trustworthy",
    DOUBTFUL: "Trustworthy with reservations",
    UNTRUSTWORTHY: "Not trustworthy",
}

DOUBTFUL_SHARE = 0.02
"""Share of frames that are unreadable, dropped, degenerate or unfinished from which on it is a reservation."""

DOUBTFUL_ERROR_M, DOUBTFUL_ERROR = 0.02, 0.01
"""Error against the truth that is a reservation: the larger of a length [m] and a share of the path."""

UNTRUSTWORTHY_ERROR_M, UNTRUSTWORTHY_ERROR = 0.10, 0.05
"""Error against the truth that no map survives, likewise."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What to think of a run.

    Attributes
    ----------
    level : TRUSTWORTHY, DOUBTFUL or UNTRUSTWORTHY
    reasons : sentences, those that weigh most first
    advice : sentences, empty where there is nothing to improve
    """

    level: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]

    @property
    def headline(self) -> str:
        """The verdict itself."""
        return HEADLINES[self.level]


_INTERRUPTED = "interrupted after"
_TOLD = (_INTERRUPTED, "frame ")  # how warnings begin that the verdict or the table of frames tells


class _Case:
    """Collects what speaks against a run."""

    def __init__(self) -> None:
        self.against: list[str] = []
        self.reservations: list[str] = []
        self.favour: list[str] = []
        self.advice: list[str] = []

    def advise(self, *sentences: str) -> None:
        self.advice += [sentence for sentence in sentences if sentence not in self.advice]

    def verdict(self) -> Verdict:
        level = UNTRUSTWORTHY if self.against else DOUBTFUL if self.reservations else TRUSTWORTHY
        return Verdict(level, (*self.against, *self.reservations, *self.favour), tuple(self.advice))


def judge(frames: FrameTable, metrics: Mapping[str, Any], run: Mapping[str, Any]) -> Verdict:
    """Return what to think of a run, by what frames.csv, metrics.json and run.json hold."""
    case = _Case()
    _judge_tracking(case, frames)
    _judge_alignment(case, frames)
    _judge_pieces(case, frames)
    _judge_truth(case, metrics)
    _judge_circumstances(case, run)
    return case.verdict()


def judge_folder(folder: Path) -> Verdict:
    """Return what to think of the run in a folder.

    Raises
    ------
    FileFormatError
        When one of the files is missing, or cannot be read.
    """
    return judge(read_frames(folder / "frames.csv"), read_json(folder / "metrics.json"), read_json(folder / "run.json"))


def _judge_tracking(case: _Case, frames: FrameTable) -> None:
    dropped, tracked = frames.state.count("dropped"), int(frames.posed.sum())
    total = len(frames) - dropped
    lost, unreadable = frames.state.count("lost"), frames.state.count("unreadable")
    relocalised = frames.state.count("relocalised")
    readable = [state for state in frames.state if state not in ("unreadable", "dropped")]
    if readable and readable[-1] == "lost":
        since = len(frames) - 1 - int(np.flatnonzero(frames.posed)[-1]) if tracked else len(frames)
        case.against.append(f"The camera was lost at the end, for the last {count_of(since, 'frame')}.")
        case.advise("Record on until the camera sees again what it has mapped before: it is found there.")
    if 2 * tracked < total:
        case.against.append(f"Only {tracked} of {total} frames were tracked, fewer than half.")
    elif lost:
        case.reservations.append(
            f"The camera was lost in {lost} of {total} frames and found again {_times(relocalised)}; nothing was fused "
            "meanwhile, and the poses of these frames are interpolated."
        )
    if lost:
        case.advise(*_advice_on_loss(frames))
    if unreadable:
        sentence = f"{count_of(unreadable, 'frame')} could not be read; the poses there are interpolated."
        (case.reservations if unreadable > DOUBTFUL_SHARE * total else case.favour).append(sentence)
        case.advise("Copy the recording again, or leave the damaged frames out with --frames.")
    if dropped:
        sentence = (
            f"{count_of(dropped, 'frame')} of {len(frames)} were dropped to keep pace with the recording; the poses "
            "there are interpolated."
        )
        (case.reservations if dropped > DOUBTFUL_SHARE * len(frames) else case.favour).append(sentence)
        case.advise("Run it without --realtime: every frame is taken then.")
    if tracked == total and not frames.aligned.any():
        case.favour.append("The poses were given: the map was fused there, and nothing was tracked.")
    elif not lost and not unreadable:
        what = f"All {total} frames" + (" that were not dropped" if dropped else "")
        case.favour.append(f"{what} were aligned with the map, and the camera was never lost.")


def _advice_on_loss(frames: FrameTable) -> list[str]:
    """Return advice for the most frequent cause of being lost."""
    causes = {"blind": 0, "slipped": 0, "elsewhere": 0}
    for state, alignment, note in zip(frames.state, frames.alignment, frames.note, strict=True):
        if state == "lost":
            slipped = alignment in ("converged", "max_iterations", "degenerate")
            blind = alignment == "too_few_correspondences" or "surfaces" in note or "usable" in note
            causes["slipped" if slipped else "blind" if blind else "elsewhere"] += 1
    return {
        "blind": [
            "Most lost frames had next to no usable depth: keep hands and the floor off the lens, and surfaces within "
            "the sensor's range (surfaces.max_depth_m)."
        ],
        "slipped": [
            "Most lost frames fitted the map, but unlike the frames before: move more slowly, or use every frame "
            "instead of every n-th."
        ],
        "elsewhere": [
            "Most lost frames did not fit the map where the camera was expected: move more slowly, use every frame, "
            "and let something that was mapped before stay in view."
        ],
    }[max(causes, key=lambda cause: causes[cause])]


def _judge_alignment(case: _Case, frames: FrameTable) -> None:
    kinds, total = kinds_of(frames), len(frames)
    degenerate, unfinished = kinds.count("degenerate"), kinds.count("unfinished")
    if degenerate:
        sentence = (
            f"{count_of(degenerate, 'frame')} ({percent(degenerate / total)}) did not determine the motion in every "
            "direction; what was free there is the motion model's guess."
        )
        (case.reservations if degenerate > DOUBTFUL_SHARE * total else case.favour).append(sentence)
        case.advise("Keep a corner, furniture or texture in view where a bare wall or floor fills the image.")
    if unfinished > DOUBTFUL_SHARE * total:
        case.reservations.append(
            f"{count_of(unfinished, 'frame')} ({percent(unfinished / total)}) had not settled when the iterations "
            "ended: the motion was fast, or the depth is noisier than the noise model says."
        )
        case.advise("Move more slowly, raise surfaces.levels, or check the unit of the depth and the intrinsics.")


def _judge_pieces(case: _Case, frames: FrameTable) -> None:
    elsewhere = kinds_of(frames).count("elsewhere")
    if elsewhere:
        others = sorted(set(frames.submap.tolist()) - {frames.main_submap})
        names = ", ".join(f"map-{submap}.ply" for submap in others)
        case.reservations.append(
            f"{count_of(elsewhere, 'frame')} {'was' if elsewhere == 1 else 'were'} tracked in another submap, never "
            f"joined with this map: what was seen there is in {names}."
        )
        case.advise("Let the recording return to places that it saw before, so that the submaps can be joined.")


def _judge_truth(case: _Case, metrics: Any) -> None:
    error, path = metrics.get("ate_rmse_m"), metrics.get("path_length_m") or 0.0
    if error is None:
        case.favour.append(
            "There was no ground truth: how accurate the run is was not measured. This verdict rests on what tracking "
            "says of itself."
        )
        return
    share = f", {percent(error / path)} of the path" if path > 0 else ""
    sentence = f"Against ground truth the camera is off by {length(error)} (ATE, root mean square{share})."
    if error > max(UNTRUSTWORTHY_ERROR_M, UNTRUSTWORTHY_ERROR * path):
        case.against.append(sentence)
    elif error > max(DOUBTFUL_ERROR_M, DOUBTFUL_ERROR * path):
        case.reservations.append(sentence)
    else:
        case.favour.append(sentence)
        return
    case.advise(
        "See in the error over time where it begins: a step is a slip or a bad relocalisation, a slow rise is drift "
        "(wrong intrinsics, a wrong depth unit, or a path that never returns)."
    )


def _judge_circumstances(case: _Case, run: Any) -> None:
    if run.get("interrupted"):
        told = next((text for text in _texts(run.get("warnings")) if text.startswith(_INTERRUPTED)), "interrupted")
        case.reservations.append(f"The run was {told}: it covers the beginning of the sequence only.")
        case.advise("Run it again to the end.")
    if other_warnings(run):
        case.reservations.append("The input gave reason for warnings; they are listed below.")


def other_warnings(run: Any) -> list[str]:
    """Return the warnings that the verdict does not tell in other words, each once."""
    return [text for text in dict.fromkeys(_texts(run.get("warnings"))) if not text.startswith(_TOLD)]


def _texts(values: Any) -> Sequence[str]:
    return [str(value) for value in values] if isinstance(values, list) else []


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")
