"""What a run came to, in numbers."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from scanweld.errors import InvalidInputError
from scanweld.evaluation.surface_metrics import compression_ratio
from scanweld.evaluation.trajectory_metrics import AteResult, ate, rpe
from scanweld.slam.motion import POSED
from scanweld.trajectory import FrameState, Trajectory

if TYPE_CHECKING:
    from scanweld.runs.fragments.outcome import FragmentsOutcome
    from scanweld.slam.system import Slam

logger = logging.getLogger(__name__)


Outcome: TypeAlias = "Slam | FragmentsOutcome"
"""What a run came to: a :class:`~scanweld.slam.system.Slam` that has seen all frames, or fragments put together."""


def summarise(
    outcome: Outcome, truth: Trajectory | None, num_points_input: int
) -> tuple[dict[str, Any], AteResult | None]:
    """Return what metrics.json holds, but for seconds_total, and the trajectory error where there is a truth."""
    results = outcome.main_results
    apart = outcome.unjoined
    states = [result.state for result in results]
    frame_ms = [sum(result.stage_ms.values()) for result in results if result.stage_ms]
    error: AteResult | None = None
    motion: tuple[float | None, float | None] = (None, None)
    if truth is not None:
        try:
            error = ate(outcome.trajectory, truth)
            if error.num_pairs > 1:
                relative = rpe(outcome.trajectory, truth)
                motion = relative.rmse_trans_m, float(np.degrees(relative.rmse_rot_rad))
        except InvalidInputError as fault:
            logger.warning("not evaluated: %s", fault)
    median_ms = float(np.median(frame_ms)) if frame_ms else None
    return {
        "frames": len(results),
        "frames_tracked": sum(state in POSED for state in states),
        "frames_lost": states.count(FrameState.LOST),
        "frames_unreadable": states.count(FrameState.UNREADABLE),
        "frames_dropped": states.count(FrameState.DROPPED),
        "relocalisations": states.count(FrameState.RELOCALISED),
        "loop_closures": outcome.num_closures,
        "submaps_joined": outcome.num_joins,
        "submaps_unjoined": len(apart),
        "frames_in_unjoined_submaps": sum(r.state in POSED and r.submap in apart for r in outcome.results),
        "ate_rmse_m": error.rmse_m if error else None,
        "ate_max_m": error.max_m if error else None,
        "rpe_trans_m": motion[0],
        "rpe_rot_deg": motion[1],
        "path_length_m": outcome.trajectory.path_length_m,
        "num_surfels": len(outcome.map),
        "num_points_input": num_points_input,
        "compression_ratio": compression_ratio(num_points_input, len(outcome.map)) if len(outcome.map) else None,
        "ms_per_frame_median": median_ms,
        "fps": 1e3 / median_ms if median_ms else None,
        "peak_rss_mb": peak_rss_mb(),
    }, error


def peak_rss_mb() -> float | None:
    """Largest resident memory of this process so far [MB]; None where the platform does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3
