"""The results of a run come out of their columns as they went in, and move with their keyframes."""

from __future__ import annotations

import copy
from dataclasses import asdict, replace

import numpy as np
import pytest

import scanweld as sw
from scanweld.geometry import se3
from scanweld.slam.frame_log import FrameLog
from scanweld.trajectory import FrameResult, FrameState


def results(count: int) -> list[FrameResult]:
    """Results of every state, some with a note, some with stages that others have not."""
    rng, states = np.random.default_rng(0), list(FrameState)
    return [
        FrameResult(
            index=k, timestamp_s=k / 30, state=states[k % len(states)], T_world_camera=se3.exp(rng.normal(0, 1, 6)),
            status=("", "converged", "degenerate")[k % 3], rmse_m=rng.random(), loss=rng.random(),
            num_inliers=int(rng.integers(0, 10**6)), overlap=rng.random(), num_surfels=int(rng.integers(0, 10**9)),
            stage_ms={"surfaces": rng.random(), **({"loop": 0.5} if k > 10 and k % 2 else {})},
            note=f"note {k}" if k % 7 == 0 else "", submap=k % 2,
        )
        for k in range(count)
    ]  # fmt: skip


def log_of(some: list[FrameResult]) -> FrameLog:
    log = FrameLog()
    for result in some:
        log.append(result, keyframe=result.index // 10)
    return log


def same(one: FrameResult, other: FrameResult) -> bool:
    a, b = asdict(one), asdict(other)
    return bool(np.array_equal(a.pop("T_world_camera"), b.pop("T_world_camera"))) and a == b


def test_what_goes_in_comes_out() -> None:
    some = results(700)  # more than there is room for at first
    log = log_of(some)
    assert len(log) == 700
    assert all(same(a, b) for a, b in zip(log, some, strict=True))
    assert [r.index for r in log[-3:]] == [697, 698, 699]
    assert same(log[-1], some[-1])
    for wrong in (700, -701):
        with pytest.raises(IndexError, match="of 700"):
            log[wrong]


def test_what_comes_out_is_a_copy() -> None:
    log = log_of(results(3))
    log[1].T_world_camera[:] = 0
    assert log[1].T_world_camera[3, 3] == 1


def test_frames_move_with_their_keyframes() -> None:
    some = results(60)
    log, ids = log_of(some), np.array([4, 1], np.int32)
    T = np.stack([se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), se3.exp([0, 0, 1, 0.5, 0, 0])])
    log.follow(sw.MapCorrection(ids, T))
    for result, before in zip(log, some, strict=True):
        moved = {4: T[0], 1: T[1]}.get(before.index // 10, np.eye(4))
        np.testing.assert_allclose(result.T_world_camera, moved @ before.T_world_camera, atol=1e-15)
    log.follow(sw.MapCorrection(np.empty(0, np.int32), np.empty((0, 4, 4))))


def test_sizes_and_submaps_are_set_later() -> None:
    some = results(20)
    log = log_of(some)
    log.set_num_surfels(5, 123)
    log.rename(1, 0)
    assert same(log[5], replace(some[5], num_surfels=123, submap=0))
    assert log.frames_in(0).tolist() == list(range(20))
    assert log.submap(7) == 0


def test_a_quarter_of_a_kilobyte_a_frame() -> None:
    log = log_of(results(4096))
    arrays = (log._poses, log._numbers, log._counts, log._labels, log._stage_ms)
    assert sum(array.nbytes for array in arrays) / len(log) < 256


@pytest.mark.parametrize("name", ["_poses", "_labels", "_stage_ms"])
def test_a_state_of_other_frames_is_refused(name: str) -> None:
    log = copy.deepcopy(log_of(results(5)))
    log.restored()
    setattr(log, name, getattr(log, name)[:3])
    with pytest.raises(ValueError, match="rows of other frames"):
        log.restored()
