"""The whole of a checkup: what is looked at, in which order, and what one fault hides of others."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from scanweld.checkup.brims import check_brims
from scanweld.checkup.evidence import Evidence, gather, plan_bursts
from scanweld.checkup.findings import Checkup, Figures, Finding, Judgement, Level
from scanweld.checkup.motions import LEAST_PAIRS, check_focal_length, check_truth, measured_motions
from scanweld.checkup.pictures import MOST_DISPLACEMENT, check_exposure, check_pace, check_sharpness
from scanweld.checkup.repeats import check_repeats
from scanweld.checkup.times import check_times
from scanweld.datasets.base import LiveSequence, RgbdSequence
from scanweld.datasets.images import check_depth_unit
from scanweld.errors import DatasetError, InvalidInputError
from scanweld.geometry.camera import PinholeCamera

LEAST_VALID = 0.2
"""Share of the pixels that must have depth, after small holes are closed."""

OFF_CENTRE = 0.15
"""Share of width and height by which the principal point may lie beside the centre."""

SQUARE = 1.15
"""Ratio of fx and fy that is no longer a square pixel."""

MISLEADING = {"depth-unit", "intrinsics", "little-depth", "unregistered", "unsynchronised", "fast-motion"}
"""Faults beside which the motion between frames tells nothing more: they are to be put right first."""

_NO_MOTIONS = dict.fromkeys(("focal_factor", "truth_disagreement", "truth_scale"))


def examine(sequence: RgbdSequence) -> Checkup:
    """Look at a recording before it is used: times, units, intrinsics, colour against depth, pictures, ground truth.

    About a hundred frames are read, in bursts spread evenly over the recording, however long it is; the result is the
    same each time. Files that repeat are found anywhere, all else where it was looked.

    Raises
    ------
    InvalidInputError
        When it is a live camera.
    DatasetError
        When none of these frames can be decoded.
    """
    if isinstance(sequence, LiveSequence):
        raise InvalidInputError(f"{sequence.name}: a live camera cannot be looked at beforehand; record it first")
    evidence = gather(sequence, plan_bursts(len(sequence)))
    num_looked_at = len(evidence.looked_at)
    if len(evidence.unreadable) == num_looked_at:
        raise DatasetError(f"{sequence.name}: none of the {num_looked_at} frames looked at can be decoded")
    findings, figures = judge(sequence, evidence)
    repeated, share = check_repeats(sequence, evidence.steps)
    found = sorted([*findings, *repeated], key=lambda finding: finding.level is not Level.ERROR)
    return Checkup(sequence.name, len(sequence), num_looked_at, tuple(found), {**figures, **share})


def judge(sequence: RgbdSequence, evidence: Evidence) -> Judgement:
    """Return what is wrong by what was measured, and the figures that it was judged by."""
    findings: list[Finding] = []
    figures: Figures = {}

    def take(result: Judgement) -> None:
        findings.extend(result[0])
        figures.update(result[1])

    take(check_times(sequence.timestamps_s))
    take(check_camera(sequence.camera))
    take(_check_depth(evidence, sequence.depth_scale))
    take(_check_readable(evidence))
    take(check_brims(evidence.brims))
    take(check_sharpness(np.array(evidence.spreads_px)))
    # Matches of pictures with little in common are too often wrong to tell of brightness.
    take(check_exposure(np.array([s.gain for s in evidence.steps if s.displacement <= MOST_DISPLACEMENT])))
    take(check_pace(np.array([step.displacement for step in evidence.steps])))
    clear = MISLEADING.isdisjoint(finding.fault for finding in findings)
    take(_check_motions(sequence, evidence) if clear and len(evidence.pairs) >= LEAST_PAIRS else ([], _NO_MOTIONS))
    return findings, figures


def _check_motions(sequence: RgbdSequence, evidence: Evidence) -> Judgement:
    """Judge intrinsics and truth by the motions between frames; each would make the other look wrong."""
    focal, figures = check_focal_length(evidence.camera, sequence.camera, evidence.pairs)
    figures = {**_NO_MOTIONS, **figures}
    if not sequence.ground_truth:
        return focal, figures
    truth, against = check_truth(
        sequence.ground_truth, sequence.timestamps_s, measured_motions(evidence.pairs), evidence.median_depth_m,
        sequence.depth_scale,
    )  # fmt: skip
    figures = {**figures, **against}
    if any(finding.fault == "depth-unit" for finding in truth):
        return truth, figures  # noise of another size makes another focal length look better
    return focal or truth, figures


def check_camera(camera: PinholeCamera) -> Judgement:
    """Look at intrinsics beside the size of the images."""
    aside = max(
        abs(camera.cx - (camera.width - 1) / 2) / camera.width, abs(camera.cy - (camera.height - 1) / 2) / camera.height
    )
    ratio = max(camera.fx / camera.fy, camera.fy / camera.fx)
    figures: Figures = {"principal_point_aside": aside, "pixel_ratio": ratio}
    doubts = []
    if aside > OFF_CENTRE:
        doubts.append(
            f"the principal point {camera.cx:.1f}, {camera.cy:.1f} lies {aside:.0%} beside the centre of images of "
            f"{camera.width}x{camera.height}"
        )
    if ratio > SQUARE:
        doubts.append(f"fx {camera.fx:.1f} and fy {camera.fy:.1f} differ by a factor of {ratio:.2f}")
    if not doubts:
        return [], figures
    advice = "pass the intrinsics of images of this size with --camera FX,FY,CX,CY"
    return [Finding("intrinsics", Level.ERROR, "; ".join(doubts), advice)], figures


def _check_depth(evidence: Evidence, depth_scale: float) -> Judgement:
    share, median_m = float(np.median(evidence.shares)), evidence.median_depth_m
    figures: Figures = {"median_depth_m": median_m, "valid_share": share}
    findings = []
    if share < LEAST_VALID:
        seen = f"half of the frames have depth in less than {share:.0%} of their pixels"
        advice = "keep the camera within its range, away from glass, black things and the sun; see --depth-scale too"
        findings.append(Finding("little-depth", Level.WARNING, seen, advice))
    unit = check_depth_unit(median_m, depth_scale) if median_m > 0 else None
    if unit is not None:
        seen, _, advice = unit.rpartition("; ")
        findings.append(Finding("depth-unit", Level.ERROR, seen, advice))
    return findings, figures


def _check_readable(evidence: Evidence) -> Judgement:
    unreadable, looked_at = len(evidence.unreadable), len(evidence.looked_at)
    figures: Figures = {"unreadable_share": unreadable / looked_at}
    if not unreadable:
        return [], figures
    seen = f"{unreadable} of {looked_at} frames looked at cannot be decoded, the first is {min(evidence.unreadable)}"
    return [Finding("unreadable", Level.WARNING, seen, "copy the recording again")], figures


def examine_input(path: str | os.PathLike[str], open_it: Callable[[], RgbdSequence]) -> Checkup:
    """Open a recording and look at it; what its reader warns of, and a fault that it refuses, are findings, too.

    Raises
    ------
    DatasetError, FileFormatError
        When it cannot be opened, for a reason that is no fault of ``WHY``.
    """
    try:
        with _remarks() as remarks:
            sequence = open_it()
            checkup = examine(sequence)
    except DatasetError as error:
        if not error.fault:
            raise
        finding = Finding(error.fault, Level.ERROR, str(error), "see above; nothing else was looked at")
        return Checkup(Path(path).name, 0, 0, (finding,), {})
    told = {finding.fault for finding in checkup.findings}
    extra = [finding for finding in remarks if finding.fault not in told]
    return Checkup(
        checkup.name, checkup.num_frames, checkup.num_looked_at, (*checkup.findings, *extra), checkup.figures
    )


@contextmanager
def _remarks() -> Iterator[list[Finding]]:
    """Yield a list that grows by what the readers warn of meanwhile, instead of the log."""
    findings: list[Finding] = []
    handler = logging.Handler(logging.WARNING)

    def emit(record: logging.LogRecord) -> None:
        fault = getattr(record, "fault", "reader")
        findings.append(Finding(fault, Level.WARNING, record.getMessage(), "see docs/formats.md"))

    handler.emit = emit  # type: ignore[method-assign]
    readers = logging.getLogger("scanweld.datasets")
    before = readers.propagate
    readers.addHandler(handler)
    readers.propagate = False
    try:
        yield findings
    finally:
        readers.removeHandler(handler)
        readers.propagate = before
