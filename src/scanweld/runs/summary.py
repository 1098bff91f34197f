"""What a run came to, in numbers."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from scanweld.errors import InvalidInputError
from scanweld.evaluation.surface_metrics import compression_ratio
from scanweld.evaluation.trajectory_metrics import AteResult, ate, rpe
from scanweld.slam.motion import POSED
from scanweld.trajectory import FrameResult, FrameState, Trajectory

logger = logging.getLogger(__name__)


class Outcome(Protocol):
    """What a run came to: a :class:`~scanweld.slam.system.Slam` that has seen all frames, or fragments put together."""

    @property
    def results(self) -> Sequence[FrameResult]:
        """One per frame, each in the world of its submap."""
        ...

    @property
    def main_results(self) -> Sequence[FrameResult]:
        """The same in the world of the main submap; frames of others are LOST there."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """One pose per frame, in the world of the main submap."""
        ...

    @property
    def map(self) -> Any:
        """The map of the main submap."""
        ...

    @property
    def maps(self) -> Mapping[int, Any]:
        """The map of each submap."""
        ...

    @property
    def unjoined(self) -> Sequence[int]:
        """The submaps whose place in the world of the main one is not known."""
        ...

    @property
    def num_closures(self) -> int:
        """Number of loops closed."""
        ...

    @property
    def num_joins(self) -> int:
        """Number of submaps joined with others."""
        ...

    @property
    def keyframe_frames(self) -> Sequence[int] | None:
        """The frame of each keyframe; None where nothing is remembered."""
        ...

    @property
    def loops(self) -> Sequence[tuple[int, int]]:
        """Pairs of keyframes that loops tie together."""
        ...


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
