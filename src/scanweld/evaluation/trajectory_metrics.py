"""Absolute trajectory error (ATE) and relative pose error (RPE).

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. The figures agree with
those of evo for the same pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.io.timestamps import MAX_TIME_DIFFERENCE_S, associate_times
from scanweld.registration.closed_form import fit_horn
from scanweld.trajectory import Trajectory

ALIGNMENTS = ("se3", "sim3", "none")
DELTA_UNITS = ("frames", "seconds", "metres")


@dataclass(frozen=True, slots=True, kw_only=True)
class AteResult:
    """Distances between true and estimated camera centres, after one alignment of the whole trajectory.

    Attributes
    ----------
    rmse_m, mean_m, median_m, max_m : of ``errors_m`` [m]
    errors_m : (N,), one for each matched pose [m]
    timestamps_s : (N,), of the matched estimated poses [s]
    T_truth_estimate : (4, 4), the alignment's rigid part: x_truth = scale R x + t
    scale : 1 unless the alignment was "sim3"
    positions_truth_m : (N, 3), true camera centres
    positions_aligned_m : (N, 3), estimated camera centres in the frame of the truth
    """

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    errors_m: Float64
    timestamps_s: Float64
    T_truth_estimate: Float64
    scale: float
    positions_truth_m: Float64
    positions_aligned_m: Float64

    @property
    def num_pairs(self) -> int:
        """Number of estimated poses that have a true partner."""
        return len(self.errors_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class RpeResult:
    """Errors of the motion between pairs of poses; no alignment takes part.

    Attributes
    ----------
    rmse_trans_m, rmse_rot_rad : root mean square over the pairs
    errors_trans_m, errors_rot_rad : (K,), length and angle of E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)
    pairs : (K, 2), the indices i, j into the matched poses
    timestamps_s : (K,), of pose j [s]
    """

    rmse_trans_m: float
    rmse_rot_rad: float
    errors_trans_m: Float64
    errors_rot_rad: Float64
    pairs: Int64
    timestamps_s: Float64


def associate(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_TIME_DIFFERENCE_S
) -> tuple[Trajectory, Trajectory]:
    """Return the poses of both trajectories that belong together, one row each, at their own timestamps.

    Nearest timestamps are paired first, each pose is used once.

    Raises
    ------
    InvalidInputError
        When no pose has a partner; the message gives the time ranges.
    """
    pairs = associate_times(estimate.timestamps_s, truth.timestamps_s, max_difference_s)
    if not pairs:
        raise InvalidInputError(
            f"no timestamp of the estimate is within {max_difference_s:g} s of the truth: the estimate has "
            f"{_range(estimate)}, the truth {_range(truth)}; are both in seconds of one clock?"
        )
    rows = np.array(pairs)
    return estimate.subset(rows[:, 0]), truth.subset(rows[:, 1])


def _range(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "no pose"
    times = trajectory.timestamps_s
    return f"{len(times)} poses from {times[0]:.3f} to {times[-1]:.3f} s"


def ate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    align: str = "se3",
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> AteResult:
    """Compute the absolute trajectory error of the camera centres.

    Parameters
    ----------
    estimate, truth : T_world_camera; their world frames need not agree unless `align` is "none"
    align : "se3" moves the estimate onto the truth rigidly; "sim3" may scale it too (least squares, Umeyama
        1991);
        "none" compares as given
    max_difference_s : largest time between matched poses [s]

    Raises
    ------
    InvalidInputError
        When no timestamps match, or `align` is unknown.
    """
    if align not in ALIGNMENTS:
        raise InvalidInputError(f"align '{align}' is not known; known are {', '.join(ALIGNMENTS)}")
    matched, reference = associate(estimate, truth, max_difference_s)
    T_truth_estimate, scale = np.eye(4), 1.0
    if align != "none":
        mode = "least_squares" if align == "sim3" else "none"
        fit = fit_horn(matched.positions_m, reference.positions_m, scale=mode)
        T_truth_estimate, scale = fit.transform, fit.scale
    aligned = se3.transform_points(T_truth_estimate, scale * matched.positions_m)
    errors = np.linalg.norm(aligned - reference.positions_m, axis=1)
    return AteResult(
        rmse_m=root_mean_square(errors),
        mean_m=float(errors.mean()),
        median_m=float(np.median(errors)),
        max_m=float(errors.max()),
        errors_m=errors,
        timestamps_s=matched.timestamps_s,
        T_truth_estimate=T_truth_estimate,
        scale=float(scale),
        positions_truth_m=reference.positions_m,
        positions_aligned_m=aligned,
    )


def rpe(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    delta: float = 1,
    unit: str = "frames",
    all_pairs: bool = False,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> RpeResult:
    """Compute the relative pose error: how wrong the estimated motion over `delta` is.

    Parameters
    ----------
    estimate, truth : T_world_camera; the error does not depend on their world frames
    delta : length of a motion, in `unit`; the default is from one matched pose to the next
    unit : "frames" (matched poses), "seconds", or "metres" along the true path
    all_pairs : begin a motion at every pose, not only where the last one ended
    max_difference_s : largest time between matched poses [s]

    Notes
    -----
    E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) with truth Q and estimate P (Sturm et al., eq. 1). In seconds and
    metres, j is the first pose that is at least `delta` after i.

    Raises
    ------
    InvalidInputError
        When no timestamps match, no two matched poses are `delta` apart, or an option is out of range.
    """
    if unit not in DELTA_UNITS:
        raise InvalidInputError(f"unit '{unit}' is not known; known are {', '.join(DELTA_UNITS)}")
    if not delta > 0 or (unit == "frames" and delta != int(delta)):
        raise InvalidInputError(f"delta: expected a positive number (whole for frames), got {delta}")
    matched, reference = associate(estimate, truth, max_difference_s)
    if unit == "frames":
        progress = np.arange(len(reference), dtype=np.float64)
    elif unit == "seconds":
        progress = reference.timestamps_s - reference.timestamps_s[0]
    else:
        steps = np.linalg.norm(np.diff(reference.positions_m, axis=0), axis=1)
        progress = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = _pairs(progress, delta, all_pairs)
    if len(pairs) == 0:
        raise InvalidInputError(f"no two of the {len(reference)} matched poses are {delta:g} {unit} apart")
    motion_true = _motions(reference, pairs)
    motion_estimated = _motions(matched, pairs)
    error = se3.inverse(motion_true) @ motion_estimated
    errors_trans_m = np.linalg.norm(error[:, :3, 3], axis=1)
    errors_rot_rad = se3.rotation_angle_rad(error)
    return RpeResult(
        rmse_trans_m=root_mean_square(errors_trans_m),
        rmse_rot_rad=root_mean_square(errors_rot_rad),
        errors_trans_m=errors_trans_m,
        errors_rot_rad=errors_rot_rad,
        pairs=pairs,
        timestamps_s=matched.timestamps_s[pairs[:, 1]],
    )


def _pairs(progress: Float64, delta: float, all_pairs: bool) -> Int64:
    """Index pairs (K, 2): j is the first with progress[j] >= progress[i] + delta."""
    # Sums of decimals may end a rounding error short of delta.
    ends = np.searchsorted(progress, progress + delta * (1 - 1e-9), side="left")
    pairs = []
    start = 0
    while start < len(progress) and ends[start] < len(progress):
        pairs.append((start, int(ends[start])))
        start = start + 1 if all_pairs else int(ends[start])
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _motions(trajectory: Trajectory, pairs: Int64) -> Float64:
    """T_i^-1 T_j (K, 4, 4)."""
    T = trajectory.T_world_camera
    return se3.inverse(T[pairs[:, 0]]) @ T[pairs[:, 1]]


def root_mean_square(values: Float64) -> float:
    """Return the square root of the mean square of values (N,), N >= 1."""
    return float(np.sqrt(np.mean(np.square(values))))
