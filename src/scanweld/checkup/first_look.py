"""A checkup of the first frames of a run while it goes by, on frames that are read anyway."""

from __future__ import annotations

from dataclasses import dataclass

from scanweld.checkup.evidence import Burst, gather
from scanweld.checkup.examine import check_camera, judge
from scanweld.checkup.findings import Finding
from scanweld.checkup.repeats import judge_steps
from scanweld.checkup.times import check_times
from scanweld.datasets.base import RgbdSequence, WrappedSequence
from scanweld.geometry.frame import Frame

MOST_FRAMES = 11
FRAMES_FOR_ONE = 60
"""Frames of the run for each one that is looked at: a look takes about as long as half a frame of tracking."""

_LEAST_FRAMES = 3


@dataclass(frozen=True, slots=True)
class _Kept(WrappedSequence):
    """The first frames of a sequence, in memory."""

    frames: list[Frame]

    def read(self, index: int) -> Frame:
        """Return a frame that was kept."""
        return self.frames[index]


class FirstLook:
    """Keeps the first frames of a run, and judges them once they are together."""

    def __init__(self, sequence: RgbdSequence) -> None:
        self._sequence = sequence
        wanted = min(MOST_FRAMES, len(sequence) // FRAMES_FOR_ONE)
        self._wanted = wanted if wanted >= _LEAST_FRAMES else 0
        self._frames: list[Frame] = []
        self._told = {"depth-unit"}

    def see(self, index: int, frame: Frame) -> list[Finding]:
        """Take frame `index` of the run, and return what is found wrong by it: each fault once.

        The unit of the depth is left to the run, which tells it at the first frame.
        """
        findings: list[Finding] = []
        if index == 0:
            findings += check_times(self._sequence.timestamps_s)[0] + check_camera(self._sequence.camera)[0]
        if index == len(self._frames) < self._wanted:
            self._frames.append(frame)
            if len(self._frames) == self._wanted:
                findings += self._judge()
        new = [finding for finding in findings if finding.fault not in self._told]
        self._told.update(finding.fault for finding in new)
        return new

    def _judge(self) -> list[Finding]:
        kept = _Kept(self._sequence, self._frames)
        evidence = gather(kept, [Burst(0, self._wanted // 2, self._wanted, None)])
        self._wanted, self._frames = 0, []
        return judge(self._sequence, evidence)[0] + judge_steps(evidence.steps)[0]
