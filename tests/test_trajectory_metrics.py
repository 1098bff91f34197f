"""ATE and RPE: by hand, by invariance, and against evo."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanweld.errors import InvalidInputError
from scanweld.evaluation.trajectory_metrics import associate, ate, root_mean_square, rpe
from scanweld.geometry import se3
from scanweld.io.timestamps import associate_times
from scanweld.io.trajectory_files import read_trajectory
from scanweld.trajectory import Trajectory

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D


def walk(seed: int, count: int = 40, step: float = 0.1) -> Trajectory:
    """A random walk at 10 poses a second."""
    rng = np.random.default_rng(seed)
    T = [se3.exp(rng.normal(size=6))]
    for _ in range(count - 1):
        T.append(T[-1] @ se3.exp(rng.normal(scale=step, size=6)))
    return Trajectory(np.arange(count) / 10, np.stack(T))


def noisy(trajectory: Trajectory, seed: int, noise: float = 0.02) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = trajectory.T_world_camera @ se3.exp(rng.normal(scale=noise, size=(len(trajectory), 6)))
    return Trajectory(trajectory.timestamps_s + rng.uniform(-0.004, 0.004, len(trajectory)), T)


def moved(trajectory: Trajectory, T_new_old: np.ndarray, scale: float = 1.0) -> Trajectory:
    T = trajectory.T_world_camera.copy()
    T[:, :3, 3] *= scale
    return Trajectory(trajectory.timestamps_s, T_new_old @ T)


def along_x(*positions_m: float) -> Trajectory:
    T = np.tile(np.eye(4), (len(positions_m), 1, 1))
    T[:, 0, 3] = positions_m
    return Trajectory(np.arange(len(positions_m), dtype=float), T)


# --- by hand ----------------------------------------------------------------------------------


def test_root_mean_square() -> None:
    """Golden 8: sqrt((9 + 16) / 2) = sqrt 12.5."""
    assert root_mean_square(np.array([3.0, 4.0])) == pytest.approx(np.sqrt(12.5), rel=1e-15)


def test_ate_without_alignment_by_hand() -> None:
    """Errors 3 and 4 m: rmse sqrt 12.5, mean and median 3.5, max 4."""
    result = ate(along_x(3, 14), along_x(0, 10), align="none")
    assert result.rmse_m == pytest.approx(np.sqrt(12.5))
    assert (result.mean_m, result.median_m, result.max_m, result.num_pairs) == (3.5, 3.5, 4, 2)
    np.testing.assert_array_equal(result.T_truth_estimate, np.eye(4))


def test_ate_rigid_alignment_by_hand() -> None:
    """Truth 0, 2, 4; estimate 0, 3, 6 on a line. The best shift matches the means: errors 1, 0, 1."""
    result = ate(along_x(0, 3, 6), along_x(0, 2, 4))
    np.testing.assert_allclose(result.errors_m, [1, 0, 1], atol=1e-12)
    assert result.rmse_m == pytest.approx(np.sqrt(2 / 3))
    assert result.scale == 1


def test_ate_similarity_by_hand() -> None:
    """The same with scale: 2 / 3 makes it exact."""
    result = ate(along_x(0, 3, 6), along_x(0, 2, 4), align="sim3")
    assert result.rmse_m == pytest.approx(0, abs=1e-12)
    assert result.scale == pytest.approx(2 / 3)


def test_rpe_by_hand() -> None:
    """True steps 1, 1, 1; estimated 1, 4, 1: errors 0, 3, 0, rmse sqrt 3; no rotation."""
    result = rpe(along_x(0, 1, 5, 6), along_x(0, 1, 2, 3))
    np.testing.assert_allclose(result.errors_trans_m, [0, 3, 0], atol=1e-12)
    assert result.rmse_trans_m == pytest.approx(np.sqrt(3))
    assert result.rmse_rot_rad == 0
    np.testing.assert_array_equal(result.pairs, [[0, 1], [1, 2], [2, 3]])


def test_rpe_rotation_by_hand() -> None:
    """The camera turns by 0.1 rad about z in each step, the estimate says 0.3: the error is 0.2 rad."""

    def turning(rate: float) -> Trajectory:
        xi = np.zeros((4, 6))
        xi[:, 5] = rate * np.arange(4)
        return Trajectory(np.arange(4.0), se3.exp(xi))

    result = rpe(turning(0.3), turning(0.1))
    np.testing.assert_allclose(result.errors_rot_rad, 0.2, rtol=1e-12)
    assert result.rmse_trans_m == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("delta", "unit", "all_pairs", "expected"),
    [
        (2, "frames", False, [[0, 2], [2, 4]]),
        (2, "frames", True, [[0, 2], [1, 3], [2, 4], [3, 5]]),
        (2.5, "seconds", False, [[0, 3]]),
        (2.5, "seconds", True, [[0, 3], [1, 4], [2, 5]]),
        (3, "metres", False, [[0, 3], [3, 4]]),
    ],
)
def test_rpe_pairs_by_hand(delta: float, unit: str, all_pairs: bool, expected: list[list[int]]) -> None:
    """Poses a second apart at 0, 1, 2, 3, 7, 8 m: three metres from pose 0 is pose 3, from there pose 4."""
    trajectory = along_x(0, 1, 2, 3, 7, 8)
    result = rpe(trajectory, trajectory, delta=delta, unit=unit, all_pairs=all_pairs)
    np.testing.assert_array_equal(result.pairs, expected)
    assert result.rmse_trans_m == 0


def test_association_takes_the_nearest_first_and_each_once() -> None:
    """0.011 and 0.014 both prefer 0.013; 0.014 is nearer and gets it, 0.011 gets 0.0."""
    pairs = associate_times(np.array([0.011, 0.014, 5.0]), np.array([0.0, 0.013, 9.0]), 0.02)
    assert pairs == [(0, 0), (1, 1)]


# --- invariance -------------------------------------------------------------------------------


@given(st.integers(0, 10_000))
def test_a_moved_truth_has_no_error(seed: int) -> None:
    truth = walk(seed)
    T = se3.exp(np.random.default_rng(seed + 1).normal(size=6))
    result = ate(moved(truth, T), truth)
    assert result.max_m < 1e-9
    np.testing.assert_allclose(result.T_truth_estimate, se3.inverse(T), atol=1e-9)
    scaled = ate(moved(truth, T, scale=2.5), truth, align="sim3")
    assert scaled.max_m < 1e-9
    assert scaled.scale == pytest.approx(1 / 2.5)
    assert rpe(moved(truth, T), truth).rmse_trans_m < 1e-9


@given(st.integers(0, 10_000))
def test_errors_do_not_depend_on_the_world_of_the_estimate(seed: int) -> None:
    truth = walk(seed)
    estimate = noisy(truth, seed)
    T = se3.exp(np.random.default_rng(seed + 1).normal(size=6))
    assert ate(moved(estimate, T), truth).rmse_m == pytest.approx(ate(estimate, truth).rmse_m, rel=1e-6)
    assert rpe(moved(estimate, T), truth).rmse_rot_rad == pytest.approx(rpe(estimate, truth).rmse_rot_rad, rel=1e-6)


@given(st.integers(0, 10_000))
def test_more_freedom_never_makes_it_worse(seed: int) -> None:
    truth = walk(seed)
    estimate = noisy(truth, seed, noise=0.2)
    none, rigid, similar = (ate(estimate, truth, align=a).rmse_m for a in ("none", "se3", "sim3"))
    assert similar <= rigid + 1e-12 <= none + 2e-12


def test_degenerate_paths_have_a_finite_error() -> None:
    """A camera that stands still leaves the rotation free; positions still compare."""
    still, truth = along_x(1, 1, 1), along_x(5, 5, 5)
    assert ate(still, truth).rmse_m == pytest.approx(0, abs=1e-12)
    assert ate(still, truth, align="sim3").rmse_m == pytest.approx(0, abs=1e-12)
    assert ate(along_x(1), along_x(4)).rmse_m == pytest.approx(0, abs=1e-12)


# --- against evo ------------------------------------------------------------------------------


def to_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_camera), timestamps=trajectory.timestamps_s.copy())


def evo_ape(estimate: Trajectory, truth: Trajectory, align: str) -> dict[str, float]:
    reference, matched = to_evo(truth), to_evo(estimate)
    if align != "none":
        matched.align(reference, correct_scale=align == "sim3")
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((reference, matched))
    return metric.get_all_statistics()


def evo_rpe(
    estimate: Trajectory,
    truth: Trajectory,
    relation: metrics.PoseRelation,
    delta: float,
    unit: metrics.Unit,
    all_pairs: bool,
) -> float:
    metric = metrics.RPE(relation, delta=delta, delta_unit=unit, all_pairs=all_pairs, pairs_from_reference=True)
    metric.process_data((to_evo(truth), to_evo(estimate)))
    return float(metric.get_statistic(metrics.StatisticsType.rmse))


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=15)
@given(st.integers(0, 10_000), st.sampled_from(["se3", "sim3", "none"]))
def test_ate_equals_evo_on_random_paths(seed: int, align: str) -> None:
    truth = walk(seed)
    estimate = noisy(truth, seed)
    ours, theirs = ate(estimate, truth, align=align), evo_ape(estimate, truth, align)
    for mine, name in (
        (ours.rmse_m, "rmse"),
        (ours.mean_m, "mean"),
        (ours.median_m, "median"),
        (ours.max_m, "max"),
    ):
        assert mine == pytest.approx(theirs[name], rel=1e-9)


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=15)
@given(st.integers(0, 10_000), st.sampled_from([1, 3]), st.booleans())
def test_rpe_equals_evo_on_random_paths(seed: int, delta: int, all_pairs: bool) -> None:
    truth = walk(seed)
    estimate = noisy(truth, seed)
    ours = rpe(estimate, truth, delta=delta, all_pairs=all_pairs)
    translation, rotation = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    frames = metrics.Unit.frames
    assert ours.rmse_trans_m == pytest.approx(evo_rpe(estimate, truth, translation, delta, frames, all_pairs), rel=1e-9)
    assert ours.rmse_rot_rad == pytest.approx(evo_rpe(estimate, truth, rotation, delta, frames, all_pairs), rel=1e-6)


@pytest.mark.filterwarnings("ignore")
def test_rpe_per_metre_equals_evo() -> None:
    truth = walk(4, count=200)
    estimate = noisy(truth, 4)
    ours = rpe(estimate, truth, delta=1.0, unit="metres")
    theirs = evo_rpe(estimate, truth, metrics.PoseRelation.translation_part, 1.0, metrics.Unit.meters, False)
    assert ours.rmse_trans_m == pytest.approx(theirs, rel=1e-9)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-rgbdslam_drift.txt"])
@pytest.mark.parametrize("align", ["se3", "sim3", "none"])
def test_a_recorded_estimate_equals_evo(shared_data: Path, name: str, align: str) -> None:
    folder = shared_data / "camera_paths"
    estimate, truth = (
        read_trajectory(folder / name),
        read_trajectory(folder / "freiburg1_xyz-groundtruth.txt"),
    )
    reference, matched = sync.associate_trajectories(to_evo(truth), to_evo(estimate), max_diff=0.02)
    ours = ate(estimate, truth, align=align)
    assert ours.num_pairs == matched.num_poses
    if align != "none":
        matched.align(reference, correct_scale=align == "sim3")
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((reference, matched))
    assert ours.rmse_m == pytest.approx(metric.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    if align == "none":
        metric = metrics.RPE(metrics.PoseRelation.rotation_angle_rad, 1, metrics.Unit.frames, all_pairs=False)
        metric.process_data((reference, matched))
        assert rpe(estimate, truth).rmse_rot_rad == pytest.approx(
            metric.get_statistic(metrics.StatisticsType.rmse), rel=1e-6
        )


# --- errors -----------------------------------------------------------------------------------


def test_no_common_time_says_both_ranges() -> None:
    late = Trajectory(walk(0).timestamps_s + 1000, walk(0).T_world_camera)
    with pytest.raises(InvalidInputError, match=r"40 poses from 0.000 to 3.900 s, the truth 40 poses from 1000.000"):
        ate(walk(0), late)
    with pytest.raises(InvalidInputError, match="no pose"):
        associate(Trajectory(np.empty(0), np.empty((0, 4, 4))), late)


def test_options_are_checked() -> None:
    with pytest.raises(InvalidInputError, match="known are se3, sim3, none"):
        ate(walk(0), walk(0), align="affine")
    with pytest.raises(InvalidInputError, match="known are frames, seconds, metres"):
        rpe(walk(0), walk(0), unit="degrees")
    for delta in (0, -1, float("nan"), 1.5):
        with pytest.raises(InvalidInputError, match="delta"):
            rpe(walk(0), walk(0), delta=delta)
    with pytest.raises(InvalidInputError, match="no two of the 40 matched poses are 100 frames apart"):
        rpe(walk(0), walk(0), delta=100)


def test_metrics_leave_their_arguments_alone() -> None:
    truth, estimate = walk(1), noisy(walk(1), 1)
    before = estimate.T_world_camera.copy()
    ate(estimate, truth, align="sim3")
    np.testing.assert_array_equal(estimate.T_world_camera, before)
