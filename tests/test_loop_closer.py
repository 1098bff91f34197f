"""Loop closure: a drifted path comes back, a false place is refused, and a lost camera is found."""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, blind, pose_error, rendered
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.loop_closure.held_out import fits_better, fits_in_place
from scanweld.loop_closure.keyframes import KeyframeConfig
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser, LoopClosingConfig
from scanweld.loop_closure.place_recognition import PlaceConfig
from scanweld.loop_closure.search import Edge, Found
from scanweld.parallel import limited_threads
from scanweld.trajectory import FrameResult, FrameState

COUNT = 240
STEP = 10
DENSE = LoopClosingConfig(
    places=PlaceConfig(keyframes=KeyframeConfig(max_shift=0.05, max_turn_rad=0.08)), min_gap=6, drift=0.05, lag_frames=0
)


def sequence() -> tuple[list[sw.Frame], list[np.ndarray]]:
    """There and back again along the room's path: frames 0, 10, ..., 230, ..., 10, 0, and their true poses."""
    whole = rendered("room", "kinect", count=COUNT)
    order = [*range(0, COUNT, STEP), *range(COUNT - 2 * STEP, -1, -STEP)]
    assert whole.ground_truth is not None
    frames = [replace(whole.frames[i], timestamp_s=float(k)) for k, i in enumerate(order)]  # type: ignore[type-var]
    return frames, [whole.ground_truth.T_world_camera[i] for i in order]


def tracked(index: int, T_world_camera: np.ndarray) -> FrameResult:
    return FrameResult(index=index, timestamp_s=float(index), state=FrameState.TRACKING, T_world_camera=T_world_camera)


def drifting(poses: list[np.ndarray], bias: np.ndarray) -> list[np.ndarray]:
    """Poses whose every step is off by the same twist."""
    drifted = [poses[0]]
    for before, after in pairwise(poses):
        drifted.append(drifted[-1] @ se3.inverse(before) @ after @ se3.exp(bias))
    return drifted


def feed(closer: KeyframeLoopCloser, frames: list[sw.Frame], poses: list[np.ndarray]) -> list[np.ndarray]:
    """Process frames at estimated poses; every correction moves the poses that follow, as tracking would."""
    moved = np.eye(4)
    found = []
    for k, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        correction = closer.process(sw.build_pyramid(frame), tracked(k, moved @ T))
        if correction is not None:
            found.append(k)
            moved = correction.T_new_old[-1] @ moved
    return found


def test_a_drifted_path_is_bent_back() -> None:
    frames, true = sequence()
    drifted = drifting(true, np.array([0.006, 0.003, -0.004, 0.0, 0.003, 0.002]))
    assert pose_error(drifted[-1], true[-1])[0] > 0.2
    closer = KeyframeLoopCloser(DENSE)
    closed = feed(closer, frames, drifted)
    assert closed
    assert closer.num_closures == len(closed)
    last = closer.database.keyframes[-1]
    off, turn = pose_error(last.T_world_camera, true[last.frame_index])
    assert off < 0.25 * pose_error(drifted[last.frame_index], true[last.frame_index])[0]
    assert turn < 1.5


class TestLag:
    """What was found out about a keyframe takes effect so many frames later, never mind when it was known."""

    BIAS = np.array([0.006, 0.003, -0.004, 0.0, 0.003, 0.002])

    @staticmethod
    def run(lag: int, threads: int = 2) -> tuple[KeyframeLoopCloser, list[int], list[np.ndarray]]:
        """Frames are looked at again and again, so that keyframes are ten frames apart."""
        frames, true = sequence()
        closer, drifted = KeyframeLoopCloser(replace(DENSE, lag_frames=lag)), drifting(true, TestLag.BIAS)
        seen = [k // 10 for k in range(10 * len(frames))]
        with limited_threads(threads):
            closed = feed(closer, [replace(frames[k], timestamp_s=float(i)) for i, k in enumerate(seen)],
                          [drifted[k] for k in seen])  # fmt: skip
        return closer, closed, [keyframe.T_world_camera for keyframe in closer.database.keyframes]

    def test_the_same_loops_later(self) -> None:
        _, at_once, poses = self.run(0)
        _, later, lagging = self.run(7)
        assert later[0] == at_once[0] + 7
        np.testing.assert_allclose(lagging[: at_once[0] // 10], poses[: at_once[0] // 10], atol=0.02)

    def test_the_number_of_threads_changes_nothing(self) -> None:
        (_, one, poses), (_, two, others) = self.run(7, 1), self.run(7, 2)
        assert one == two != []
        assert np.stack(poses).tobytes() == np.stack(others).tobytes()

    def test_keyframes_since_move_with_the_last_before(self) -> None:
        """With a lag of 25 frames there are keyframes that the search did not know of."""
        frames, true = sequence()
        closer, drifted = KeyframeLoopCloser(replace(DENSE, lag_frames=25)), drifting(true, self.BIAS)
        for k in range(10 * len(frames)):
            before = np.stack([np.eye(4), *(keyframe.T_world_camera for keyframe in closer.database.keyframes)])[1:]
            known = closer._known
            found = closer.process(sw.build_pyramid(frames[k // 10]), tracked(k, drifted[k // 10]))
            if found is not None:
                break
        assert known < len(before)
        assert found.keyframe_ids.tolist() == list(range(len(before)))
        after = np.stack([keyframe.T_world_camera for keyframe in closer.database.keyframes])
        np.testing.assert_allclose(found.T_new_old @ before, after, atol=1e-12)
        np.testing.assert_allclose(found.T_new_old[known:], found.T_new_old[[known - 1] * (len(before) - known)])
        np.testing.assert_allclose(
            se3.inverse(after[known - 1]) @ after[known:], se3.inverse(before[known - 1]) @ before[known:], atol=1e-12
        )

    def test_keyframes_since_move_with_the_one_that_they_came_after(self) -> None:
        """Back at the first of four keyframes the camera turns elsewhere: what is new there moves with the first."""
        frames, true = sequence()
        closer = KeyframeLoopCloser(DENSE)
        feed(closer, frames[:4], true[:4])
        assert len(closer.database) == 4
        closer._current[0] = 0
        sighting = closer.database.sight(sw.build_pyramid(frames[5]))
        for k, keyframe in ((5, 0), (6, 4)):
            closer._add(sighting, true[k], k)
            assert (closer._edges[-1].i, closer._edges[-1].j) == (keyframe, closer.keyframe)
        old = np.stack([keyframe.T_world_camera for keyframe in closer.database.keyframes])
        T = np.stack([se3.exp([0.01 * (k + 1), 0, 0, 0, 0.01 * k, 0]) for k in range(4)])
        loop = Edge(0, 3, np.eye(4), np.eye(6), True)
        found = closer._close(Found(loop, T @ old[:4], ()), np.arange(4))
        np.testing.assert_allclose(found.T_new_old, T[[0, 1, 2, 3, 0, 0]], atol=1e-12)
        new = np.stack([keyframe.T_world_camera for keyframe in closer.database.keyframes])
        np.testing.assert_allclose(new, found.T_new_old @ old, atol=1e-12)

    def test_what_is_under_way_can_be_had_at_once_and_copied(self) -> None:
        frames, true = sequence()
        drifted = drifting(true, self.BIAS)
        closer = KeyframeLoopCloser(replace(DENSE, lag_frames=10**6))
        assert not feed(closer, frames, drifted)
        other = copy.deepcopy(closer)
        found = closer.conclude()
        assert found is not None
        while closer.conclude() is not None:
            pass
        assert closer.conclude() is None
        np.testing.assert_array_equal(other.conclude().T_new_old, found.T_new_old)

    def test_few_wait(self) -> None:
        frames, true = sequence()
        closer = KeyframeLoopCloser(replace(DENSE, lag_frames=10**6))
        feed(closer, frames, true)
        assert len(closer._queries) == 4


def test_the_first_keyframe_stays_and_all_poses_are_rigid() -> None:
    frames, true = sequence()
    closer = KeyframeLoopCloser(DENSE)
    assert feed(closer, frames, drifting(true, np.array([0.006, 0.003, -0.004, 0.0, 0.003, 0.002])))
    np.testing.assert_allclose(closer.database[0].T_world_camera, true[0], atol=1e-12)
    for keyframe in closer.database.keyframes:
        R = keyframe.T_world_camera[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def test_a_path_without_drift_is_left_alone() -> None:
    frames, true = sequence()
    closer = KeyframeLoopCloser(DENSE)
    assert not feed(closer, frames, true)
    assert len(closer.database) > 10


def test_places_that_are_known_need_no_more_keyframes() -> None:
    """There and back and there again, each step of the way back between two keyframes: hardly any is added."""
    frames, true = sequence()
    closer = KeyframeLoopCloser(replace(DENSE, places=PlaceConfig(keyframes=KeyframeConfig(max_shift=0.08))))
    counts, at = [], []
    for i in range(3 * len(frames)):
        k = i % len(frames)
        frame = replace(frames[k], timestamp_s=float(i))
        closer.process(sw.build_pyramid(frame), tracked(i, true[k]))
        counts.append(len(closer.database))
        at.append(closer.keyframe)
        off, turn = pose_error(closer.database[closer.keyframe].T_world_camera, true[k])
        assert off < 0.4
        assert turn < 20
    assert counts[len(frames) // 2] > 8
    assert counts[-1] <= counts[len(frames) // 2] + 2
    assert min(at[len(frames) :]) < 3  # the camera is at old ones again


def test_a_twin_room_is_no_loop() -> None:
    """The same views five metres on, as in a room that is an exact copy: no drift of the odometry explains that."""
    frames, true = sequence()
    half = len(frames) // 2
    away = np.eye(4)
    away[0, 3] = 5.0
    poses = [*true[:half], *(away @ T for T in true[half:])]
    closer = KeyframeLoopCloser(DENSE)
    assert not feed(closer, frames, poses)
    assert closer.num_closures == 0


def test_held_out_keyframes_tell_right_from_wrong() -> None:
    frames, true = sequence()
    closer = KeyframeLoopCloser(DENSE)
    feed(closer, frames[:30], true[:30])
    keyframes = closer.database.keyframes
    right = np.stack([keyframe.T_world_camera for keyframe in keyframes])
    wrong = right.copy()
    count = len(keyframes)
    wrong[count // 2 :] = se3.exp([0.1, 0.0, 0.1, 0.0, 0.05, 0.0]) @ wrong[count // 2 :]
    surfaces = closer.config.places.keyframes.surfaces
    i, j = count // 2 - 2, count // 2 + 1
    assert fits_better(keyframes, wrong, right, i, j, surfaces)
    assert not fits_better(keyframes, right, wrong, i, j, surfaces)
    pyramid = keyframes[j].pyramid(surfaces)
    assert fits_in_place(pyramid, keyframes[i], se3.inverse(right[i]) @ right[j], surfaces)
    assert not fits_in_place(pyramid, keyframes[i], se3.inverse(wrong[i]) @ wrong[j], surfaces)


@pytest.mark.parametrize("away", [30, 60])
def test_a_carried_camera_is_found_again(away: int) -> None:
    """The lens is covered while the camera is carried back: LOST at once, nothing fused, then found where it is."""
    whole = rendered("room", "kinect", count=COUNT)
    assert whole.ground_truth is not None
    true = whole.ground_truth.T_world_camera
    slam = sw.build_slam(CAMERA, T_world_first=true[0])
    order = [*range(0, 120, 3), *[-1] * 8, *range(119 - away, 119 - away + 8)]
    size = 0
    for k, i in enumerate(order):
        frame = whole.frames[max(i, 0)]
        assert frame is not None
        frame = replace(frame, timestamp_s=k / 10)
        result = slam.process(blind(frame) if i < 0 else frame)
        size = len(slam.map) if i >= 0 else size
        if i < 0:
            assert result.state is FrameState.LOST
            assert len(slam.map) == size
    states = [result.state for result in slam.results[48:]]
    assert states == [FrameState.RELOCALISED] + [FrameState.TRACKING] * 7
    for result, i in zip(slam.results[48:], order[48:], strict=True):
        off, turn = pose_error(result.T_world_camera, true[i])
        assert off < 0.02
        assert turn < 0.5


def test_an_unknown_place_stays_lost() -> None:
    whole, other = rendered("room", "kinect", count=COUNT), rendered("corridor", "kinect", count=60)
    slam = sw.build_slam(CAMERA)
    order = [*whole.frames[:60:3], *[blind(whole.frames[0])] * 4, *other.frames[30:50:3]]  # type: ignore[arg-type]
    for k, frame in enumerate(order):
        slam.process(replace(frame, timestamp_s=k / 10))  # type: ignore[type-var]
    assert {result.state for result in slam.results[24:]} == {FrameState.LOST}


def test_given_poses_are_not_corrected() -> None:
    frames, true = sequence()
    slam = sw.build_slam(CAMERA, sw.SlamConfig(loop_closing=DENSE))
    given = drifting(true, np.array([0.006, 0.003, -0.004, 0.0, 0.003, 0.002]))
    for frame, T in zip(frames, given, strict=True):
        slam.process(frame, T_world_camera=T)
    np.testing.assert_allclose(slam.trajectory.T_world_camera, given, atol=1e-12)
    assert slam.loop_closer.num_closures == 0


def test_none_does_without() -> None:
    slam = sw.build_slam(CAMERA, sw.SlamConfig(loop_closer="none"))
    assert isinstance(slam.loop_closer, sw.NoLoopCloser)
    with pytest.raises(ConfigError, match="loop_closer"):
        sw.SlamConfig(loop_closer="ferns")
