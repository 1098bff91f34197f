"""Trajectory: what it refuses, and that it cannot be changed."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.trajectory import Trajectory


def poses(count: int, seed: int = 0) -> np.ndarray:
    return se3.exp(np.random.default_rng(seed).normal(size=(count, 6)))


def test_path_length_by_hand() -> None:
    """(0, 0, 0) -> (3, 4, 0) -> (3, 4, 12): 5 + 12."""
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1:, :3, 3] = [[3, 4, 0], [3, 4, 12]]
    trajectory = Trajectory(np.arange(3.0), T)
    assert trajectory.path_length_m == pytest.approx(17)
    np.testing.assert_array_equal(trajectory.positions_m, T[:, :3, 3])
    assert len(trajectory) == 3


def test_it_keeps_a_copy_that_is_read_only() -> None:
    times, T = np.arange(3.0), poses(3)
    trajectory = Trajectory(times, T)
    times[0], T[0, 0, 3] = -1, 99
    assert trajectory.timestamps_s[0] == 0
    assert trajectory.T_world_camera[0, 0, 3] != 99
    with pytest.raises(ValueError, match="read-only"):
        trajectory.T_world_camera[0, 0, 3] = 1


def test_subset_by_index_mask_and_slice() -> None:
    trajectory = Trajectory(np.arange(5.0), poses(5))
    for selection in (slice(1, 4, 2), [1, 3], np.array([False, True, False, True, False])):
        part = trajectory.subset(selection)
        np.testing.assert_array_equal(part.timestamps_s, [1, 3])
        np.testing.assert_allclose(part.T_world_camera, trajectory.T_world_camera[[1, 3]], atol=1e-15)


def test_empty_is_allowed() -> None:
    assert Trajectory(np.empty(0), np.empty((0, 4, 4))).path_length_m == 0
    assert len(Trajectory(np.arange(5.0), poses(5)).subset([])) == 0


@pytest.mark.parametrize(
    ("times", "change", "words"),
    [
        ([0, 1], None, r"timestamps \(N,\)"),
        ([0, 1, np.nan], None, "timestamp is not finite"),
        ([0, 2, 1], None, "row 2 has 1.000000 after 2.000000"),
        ([0, 1, 1], None, "increase strictly"),
        ([0, 1, 2], (1, 0, 3, np.inf), "pose 1: has values that are not finite"),
        ([0, 1, 2], (1, 3, 3, 2.0), "pose 1: the last row"),
        ([0, 1, 2], (1, 0, 0, 5.0), "pose 1: not a rotation"),
    ],
)
def test_what_is_no_trajectory(times: list[float], change: tuple[int, int, int, float] | None, words: str) -> None:
    T = poses(3)
    if change is not None:
        index, row, column, value = change
        T[index, row, column] = value
    with pytest.raises(InvalidInputError, match=words):
        Trajectory(np.array(times), T)
