"""Which frames were not plainly tracked, why, and how it ended: what the table of a report says."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from scanweld.report.run_files import POSED_STATES, FrameTable

KINDS = {
    "lost": "LOST",
    "unreadable": "UNREADABLE",
    "dropped": "DROPPED",
    "relocalised": "RELOCALISED",
    "degenerate": "DEGENERATE",
    "unfinished": "UNFINISHED",
    "elsewhere": "OTHER SUBMAP",
}
"""What a frame can be besides plainly tracked, and what it is called on the page."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive frames to which the same happened.

    Attributes
    ----------
    kind : a key of :data:`KINDS`
    first, last : positions in the table, both included
    reasons : (note, number of frames) of alike notes, the most frequent first; the note is that of the first frame
    ending : how it ended, "" where nothing is to be said
    """

    kind: str
    first: int
    last: int
    reasons: tuple[tuple[str, int], ...]
    ending: str = ""

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.last - self.first + 1


def kind_of(state: str, alignment: str) -> str:
    """Return what a frame was besides plainly tracked: a key of :data:`KINDS`, or "" for plainly tracked."""
    if state in ("lost", "unreadable", "dropped", "relocalised"):
        return state
    return {"degenerate": "degenerate", "max_iterations": "unfinished"}.get(alignment, "")


def kinds_of(frames: FrameTable) -> list[str]:
    """Return the kind of every frame."""
    main = frames.main_submap
    return [
        "elsewhere" if submap != main and state in POSED_STATES else kind_of(state, alignment)
        for state, alignment, submap in zip(frames.state, frames.alignment, frames.submap, strict=True)
    ]


def find_stretches(frames: FrameTable) -> list[Stretch]:
    """Return all stretches in order; a relocalised frame is told in the ending of the stretch before it, and how many
    frames were dropped in the verdict: they come one by one, all over a run."""
    kinds = kinds_of(frames)
    stretches: list[Stretch] = []
    first = 0
    for i in range(1, len(kinds) + 1):
        if i < len(kinds) and kinds[i] == kinds[first]:
            continue
        if kinds[first] not in ("", "relocalised", "dropped"):
            stretches.append(_stretch(frames, kinds, first, i - 1))
        first = i
    return stretches


def _stretch(frames: FrameTable, kinds: Sequence[str], first: int, last: int) -> Stretch:
    notes = [frames.note[i] or _spelt(frames.alignment[i]) for i in range(first, last + 1)]
    if kinds[first] == "elsewhere":
        notes = [
            f"tracked in submap {frames.submap[i]}, which was not joined with this map" for i in range(first, last + 1)
        ]
    # Numbers differ from frame to frame; what they are said of does not.
    alike = [re.sub(r"[-+]?\d+(\.\d+)?", "#", note) for note in notes]
    reasons = tuple((notes[alike.index(text)], count) for text, count in Counter(alike).most_common() if text)
    ending = _ending(frames, kinds, last) if kinds[first] in ("lost", "unreadable") else ""
    return Stretch(kinds[first], first, last, reasons, ending)


def _ending(frames: FrameTable, kinds: Sequence[str], last: int) -> str:
    if last + 1 == len(kinds):
        return "the run ends here"
    after = frames.number[last + 1]
    note = frames.note[last + 1]
    return {
        "relocalised": f"found again at {after}" + (f": {note}" if note else ""),
        "lost": f"LOST from {after} on",
        "unreadable": f"followed by a frame that cannot be read, {after}",
    }.get(kinds[last + 1], "")


def _spelt(alignment: str) -> str:
    """Return the aligner's status for a person; nothing where it says nothing."""
    return "" if alignment in ("", "converged") else alignment.replace("_", " ")
