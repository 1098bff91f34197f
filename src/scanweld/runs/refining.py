"""What follows a run: its keyframes are refined, or its camera is calibrated and the run made again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from scanweld.datasets.base import RgbdSequence
from scanweld.refinement.config import RefinementConfig
from scanweld.refinement.refine import Refinement
from scanweld.runs.calibrated import CalibratedSequence
from scanweld.slam.system import Slam


def calibrate(slam: Slam, sequence: RgbdSequence, config: RefinementConfig) -> tuple[RgbdSequence, Refinement]:
    """Calibrate the camera on the keyframes of a run.

    Returns the sequence as a camera of that calibration recorded it, or as it was where calibration did not help, and
    what was found. The run itself is not changed. What the configuration does not choose is all of it.
    """
    if not (config.calibrate_intrinsics or config.calibrate_depth):
        config = replace(config, calibrate_intrinsics=True, calibrate_depth=True)
    found = slam.refine(sequence.camera, config, apply=False)
    return (CalibratedSequence(sequence, found.camera, found.depth) if found.recalibrated else sequence), found


def described(refinements: Sequence[Refinement]) -> list[dict[str, Any]]:
    """Return what run.json holds of refinements."""
    return [
        {
            "status": found.status.value,
            "note": found.note,
            "held_out_loss": list(found.held_out),
            "intrinsics": asdict(found.camera),
            "inverse_depth_offset_per_m": found.depth.inverse_depth_offset_per_m,
            "sigmas": found.sigmas,
            "not_determined": list(found.held),
            "iterations": len(found.iterations),
        }
        for found in refinements
    ]
