"""Accuracy and completeness by hand."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.evaluation import surface_metrics
from scanweld.evaluation.surface_metrics import (
    compression_ratio,
    depth_completeness,
    frame_points,
    surface_accuracy,
    surface_completeness,
)
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame

SPACING = np.array([[x, y, 0.0] for x in range(5) for y in range(5)])  # 1 m apart
CAMERA = PinholeCamera(8, 8, 3.5, 2.5, 8, 6)


def frame(depth: float | np.ndarray) -> Frame:
    return Frame(0.0, np.broadcast_to(np.float32(depth), (6, 8)).astype(np.float32), None, CAMERA)


def test_accuracy_by_hand() -> None:
    """Map points 0, 3 and 4 cm off: mean 7 / 3, median 3, rmse sqrt(25 / 3) cm; one of three within 1 cm."""
    points = SPACING[[0, 7, 13]] + np.array([[0, 0, 0], [0, 0, 0.03], [0, 0, -0.04]])
    result = surface_accuracy(points, SPACING)
    assert result.num_points == 3
    assert result.mean_m == pytest.approx(0.07 / 3)
    assert result.median_m == pytest.approx(0.03)
    assert result.rmse_m == pytest.approx(np.sqrt(0.0025 / 3))
    assert result.within == {0.01: pytest.approx(1 / 3), 0.05: 1.0}


def test_completeness_by_hand() -> None:
    """A map of one row of the 5x5 grid covers 5 of 25 points; the rows lie 0, 1, 2, 3 and 4 m from it."""
    result = surface_completeness(SPACING[:5], SPACING, thresholds_m=(0.5, 2.0))
    assert result.within == {0.5: pytest.approx(0.2), 2.0: pytest.approx(0.6)}
    assert result.mean_m == pytest.approx(2)


def test_the_two_directions_differ() -> None:
    assert surface_accuracy(SPACING[:5], SPACING).mean_m == 0
    assert surface_completeness(SPACING[:5], SPACING).mean_m > 1


def test_points_that_are_not_finite_are_left_out() -> None:
    points = np.vstack([SPACING[:2], [[np.nan, 0, 0]]])
    assert surface_accuracy(points, SPACING).num_points == 2


@pytest.mark.parametrize("num_threads", [1, 2])
def test_chunks_and_thinning_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch, num_threads: int) -> None:
    """With chunks of 7 points and a median from at most 50 of 1000 sorted distances, k / 1000 m each."""
    points = np.column_stack([np.zeros(1000), np.zeros(1000), np.arange(1000) / 1000])
    whole = surface_accuracy(points, np.zeros((1, 3)))
    assert whole.median_m == pytest.approx(0.4995)
    monkeypatch.setattr(surface_metrics, "CHUNK", 7)
    monkeypatch.setattr(surface_metrics, "_MEDIAN_SAMPLE", 50)
    chunked = surface_accuracy(points, np.zeros((1, 3)), num_threads=num_threads)
    assert chunked.mean_m == pytest.approx(whole.mean_m)
    assert chunked.rmse_m == pytest.approx(whole.rmse_m)
    assert chunked.within == whole.within
    assert chunked.median_m == pytest.approx(0.4995, abs=0.032 / 2 + 1e-9), "every 32nd distance is kept"


def test_frame_points_are_in_the_world() -> None:
    """2 m deep at pixel (u, v) is ((u - 3.5) / 4, (v - 2.5) / 4, 2) for the camera, which is at x = 1 m."""
    T = np.eye(4)
    T[0, 3] = 1
    depth = np.zeros((6, 8))
    depth[1, 6] = 2
    np.testing.assert_allclose(frame_points(frame(depth), T), [[1 + 2.5 / 4, -1.5 / 4, 2]])
    assert len(frame_points(frame(2.0), T, stride=2)) == 3 * 4
    assert frame_points(frame(0.0), T).shape == (0, 3)


def test_depth_completeness_counts_the_input_that_the_map_keeps() -> None:
    """A map of the left half of a wall, seen twice: half of the depth lies on it, whatever the pose."""
    wall = frame_points(frame(2.0), np.eye(4))
    T = se3.exp(np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.3]))
    half = se3.transform_points(T, wall[wall[:, 0] < 0])
    result = depth_completeness(half, [(frame(2.0), T), (frame(2.0), T)])
    assert result.num_points == 96
    assert result.within[0.01] == pytest.approx(0.5)


def test_frames_are_read_one_at_a_time() -> None:
    alive = 0

    def frames():  # type: ignore[no-untyped-def]
        nonlocal alive
        for _ in range(3):
            alive += 1
            yield frame(2.0), np.eye(4)

    depth_completeness(np.zeros((1, 3)), frames())
    assert alive == 3


def test_compression_ratio() -> None:
    """1,362,157 of 15,360,000 points are kept: 11.28."""
    assert compression_ratio(15_360_000, 1_362_157) == pytest.approx(11.28, abs=0.005)
    assert compression_ratio(10, 0) == 0


def test_what_cannot_be_measured() -> None:
    with pytest.raises(InvalidInputError, match="reference: the set is empty"):
        surface_accuracy(SPACING, np.empty((0, 3)))
    with pytest.raises(InvalidInputError, match="no point to measure"):
        surface_accuracy(np.empty((0, 3)), SPACING)
    with pytest.raises(InvalidInputError, match="valid depth"):
        depth_completeness(SPACING, [(frame(0.0), np.eye(4))])
    with pytest.raises(InvalidInputError, match="expected shape"):
        surface_accuracy(SPACING[:, :2], SPACING)
    with pytest.raises(InvalidInputError, match="stride"):
        depth_completeness(SPACING, [], stride=0)
