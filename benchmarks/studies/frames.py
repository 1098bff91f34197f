"""Pairs of RGB-D frames that lie far apart, from the identity."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

import scanweld as sw
from rendered_pairs import motion_error
from scanweld.geometry import se3
from studies.report import table
from studies.systems import Bench

PAIRS = ((10, 40), (100, 130), (10, 50), (10, 100), (100, 200))
CLOSE_M, CLOSE_DEG = 0.01, 0.5


def run(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """Align the frame pairs of `livingroom1` by `align_frames`."""
    sw.set_num_threads(bench.threads)
    sequence = sw.open_sequence(arguments.data / "livingroom1")
    assert sequence.ground_truth is not None
    poses = sequence.ground_truth.T_world_camera
    rows = []
    for a, b in PAIRS:
        T_true = se3.inverse(poses[b]) @ poses[a]
        frame_a, frame_b = sequence.read(a), sequence.read(b)
        sw.align_frames(frame_a, frame_b)  # the kernels that this pair needs are compiled
        start = time.perf_counter()
        result = sw.align_frames(frame_a, frame_b)
        seconds = time.perf_counter() - start
        shift, turn = motion_error(result.T_target_source, T_true, np.zeros(3))
        moved, turned = motion_error(np.eye(4), T_true, np.zeros(3))
        rows.append(
            {
                "pair": f"{a} -> {b}",
                "motion_m": moved,
                "motion_deg": turned,
                "status": result.status.value,
                "shift_m": shift,
                "turn_deg": turn,
                "solved": result.status.success and shift < CLOSE_M and turn < CLOSE_DEG,
                "seconds": seconds,
            }
        )
    return {"rows": rows}


def text(figures: dict[str, Any]) -> str:
    """One line a pair."""
    rows = [
        (
            row["pair"],
            f"{row['motion_m']:.2f} m, {row['motion_deg']:.1f} deg",
            row["status"],
            f"{row['shift_m'] * 100:.3f}",
            f"{row['turn_deg']:.4f}",
            "yes" if row["solved"] else "no",
            f"{row['seconds']:.2f}",
        )
        for row in figures["rows"]
    ]
    solved = f"within {CLOSE_M * 100:.0f} cm and {CLOSE_DEG} deg"
    return table(("livingroom1", "motion", "says", "error cm", "deg", solved, "s"), rows)
