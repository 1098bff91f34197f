"""How a recording is cut into fragments: parts that overlap, so that neighbours have seen the same frames."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from scanweld.config import check_ranges, setting
from scanweld.errors import InvalidInputError


@dataclass(frozen=True, slots=True, kw_only=True)
class FragmentConfig:
    """How a recording is cut into fragments."""

    overlap: int = setting(
        60,
        "frames that two neighbouring fragments share; raise where the camera moves slowly or is lost at a seam, costs "
        "time: they are tracked twice",
        low=4,
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class Part:
    """Frames start..stop - 1 of a recording.

    Attributes
    ----------
    index : of the part
    start, stop : frames
    shared : so many of the first are in the part before, too
    """

    index: int
    start: int
    stop: int
    shared: int

    def __len__(self) -> int:
        return self.stop - self.start

    def __str__(self) -> str:
        return f"fragment {self.index} (frames {self.start} to {self.stop - 1})"


def parts_of(num_frames: int, number: int, overlap: int) -> list[Part]:
    """Cut a recording into so many parts of equal length; each shares frames with its neighbours and no others.

    Each has at least as many frames of its own as it shares with a neighbour: with an overlap of V frames, N parts need
    V (2 N + 1) frames; two, which have one neighbour each, 3 V.

    Raises
    ------
    InvalidInputError
        When there are too few frames for so many parts.
    """
    if number < 1:
        raise InvalidInputError(f"fragments: expected at least 1, got {number}")
    if number == 1:
        return [Part(0, 0, num_frames, 0)]
    needed = _frames_needed(number, overlap)
    if num_frames < needed:
        most = max((num_frames - overlap) // (2 * overlap), 2 if num_frames >= _frames_needed(2, overlap) else 1)
        raise InvalidInputError(
            f"fragments: {number} that share {overlap} frames with each neighbour and have as many of their own need "
            f"{needed} frames; {num_frames} frames make at most {most} fragment{'' if most == 1 else 's'}; lower "
            "fragments.overlap, or the number"
        )
    starts = [(num_frames - overlap) * k // number for k in range(number + 1)]
    return [Part(k, start, after + overlap, overlap if k else 0) for k, (start, after) in enumerate(pairwise(starts))]


def _frames_needed(number: int, overlap: int) -> int:
    """Return how many frames two or more parts need: a part between two others shares frames at both its ends."""
    return overlap * (3 if number == 2 else 2 * number + 1)
