"""What can be wrong with a recording, and how it is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeAlias


class Level(StrEnum):
    """How much a finding weighs."""

    ERROR = "error"  # the result will be wrong, or there will be none
    WARNING = "warning"  # tracking or map will suffer


WHY = {
    "depth-unit": "The map comes out too large or too small, depth beyond the range is left out, and tracking fails.",
    "intrinsics": "Surfaces bend and change with the direction they are seen from: the map doubles, the path drifts.",
    "negative-fy": "It says that y points up, as ICL-NUIM prints it; the images are upright, and y points down here.",
    "swapped": "Depth is what everything is measured with.",
    "unregistered": "Colour is painted beside its surface, and brightness and features mislead tracking.",
    "unsynchronised": "Colour is that of another place while the camera moves, and misleads tracking.",
    "truth-inverted": "The error against it would be that of another path.",
    "truth-unit": "The error against it would be that of a path of another size.",
    "truth": "The error against it says nothing, and frames that are fused at these poses give no surface.",
    "time-unit": "Times are taken for seconds: speeds, gaps and the partners of images and poses come out wrong.",
    "time-order": "Which frame came first is not known.",
    "gaps": "The camera is somewhere else after a gap, and may have to be found again.",
    "duplicates": "A repeated frame tells tracking that the camera stood still, and the next one leaps.",
    "frozen": "The camera seems to stand still, and to leap in the end; what was seen meanwhile is missing.",
    "little-depth": "What has no depth is neither tracked nor mapped.",
    "motion-blur": "Brightness and features no longer hold the motion, and the map takes the smear for its colour.",
    "exposure": "Brightness that changes from frame to frame is no longer that of the surface.",
    "fast-motion": "Frames that have little in common are hard to align, and each is blurred.",
    "unreadable": "Frames that cannot be decoded are skipped.",
    "reader": "The reader of this format has warned of it.",
}
"""Every fault by name, and why it matters."""

FIGURES = {
    "interval_s": "time from frame to frame [s]",
    "longest_gap": "longest time between frames, in usual ones",
    "principal_point_aside": "principal point beside the centre, share of the size",
    "pixel_ratio": "ratio of the focal lengths",
    "median_depth_m": "median depth [m]",
    "valid_share": "share of the pixels that have depth",
    "unreadable_share": "share of the frames that cannot be decoded",
    "repeated_share": "share of the frames that repeat the one before",
    "edge_spread_px": "pixels that sharp edges spread over",
    "brightness_factor": "largest change of brightness, a factor",
    "displacement": "way of the features from frame to frame, share of the width",
    "color_misplaced": "best place of the colour beside its own, share of the width",
    "color_misplaced_sigmas": "how much better it is there, standard deviations",
    "color_lag_frames": "best moment of the colour after its own [frames]",
    "color_lag_sigmas": "how much better it is then, standard deviations",
    "focal_factor": "best focal length over the one given",
    "truth_disagreement": "difference of true and seen motions, share of their size",
    "truth_scale": "length of the seen motions over the true ones",
}
"""Everything that is measured, by name, in the order in which it is shown."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is wrong with a recording.

    Attributes
    ----------
    fault : its name, a key of ``WHY``
    level : how much it weighs
    seen : what was seen, with numbers
    advice : what to do
    """

    fault: str
    level: Level
    seen: str
    advice: str

    @property
    def why(self) -> str:
        """Why it matters."""
        return WHY[self.fault]

    def __str__(self) -> str:
        return f"{self.fault}: {self.seen}; {self.advice}"

    def as_dict(self) -> dict[str, str]:
        """Return it as JSON has it."""
        return {
            "fault": self.fault, "level": self.level.value, "seen": self.seen, "why": self.why, "advice": self.advice,
        }  # fmt: skip


Figures: TypeAlias = dict[str, float | None]
"""What was measured, by name; None where the recording does not allow it."""

Judgement: TypeAlias = tuple[list[Finding], Figures]
"""What one check found wrong, and the figures that it judged by."""


@dataclass(frozen=True, slots=True)
class Checkup:
    """What came of looking at a recording.

    Attributes
    ----------
    name : of the sequence
    num_frames : how many it has; 0 where it could not be opened
    num_looked_at : how many were looked at
    findings : what is wrong, errors first; empty where nothing was found
    figures : what was measured, by name; None where the recording does not allow it
    """

    name: str
    num_frames: int
    num_looked_at: int
    findings: tuple[Finding, ...]
    figures: Mapping[str, float | None]

    @property
    def sound(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return {
            "name": self.name,
            "frames": self.num_frames,
            "frames_looked_at": self.num_looked_at,
            "findings": [finding.as_dict() for finding in self.findings],
            "figures": dict(self.figures),
        }
