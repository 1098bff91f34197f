"""The SLAM loop: states, poses of lost frames, given poses, replaced stages."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, MemorySequence, blind, pose_error, rendered
from scanweld.geometry import se3
from scanweld.registration.result import FreeDirection
from scanweld.slam.motion import ConstantVelocity, Unsteadiness, trajectory_of
from scanweld.slam.system import Slam

TRACKING, LOST = sw.FrameState.TRACKING, sw.FrameState.LOST
RELOCALISED, UNREADABLE = sw.FrameState.RELOCALISED, sw.FrameState.UNREADABLE


def map_bytes(surfels: sw.SurfelMap) -> bytes:
    names = ("positions_m", "normals", "colors", "radii_m", "confidences", "created", "last_seen")
    return b"".join(np.array(getattr(surfels, name)).tobytes() for name in names)


def run(frames: object, **options: object) -> sw.Slam:
    slam = sw.build_slam(CAMERA, **options)
    for frame in frames:
        slam.process(frame)
    return slam


def in_first_frame(sequence: MemorySequence) -> np.ndarray:
    """True poses with the first camera as the world."""
    poses = sequence.ground_truth.T_world_camera
    return se3.inverse(poses[0]) @ poses


class TestStates:
    def test_results_of_a_good_run(self) -> None:
        sequence = rendered(count=40)
        slam = run(sequence.frames[:8])
        assert [r.state for r in slam.results] == [TRACKING] * 8
        assert [r.index for r in slam.results] == list(range(8))
        assert [r.timestamp_s for r in slam.results] == [f.timestamp_s for f in sequence.frames[:8]]
        assert slam.results[0].status == ""
        assert {r.status for r in slam.results[1:]} == {"converged"}
        assert slam.results[-1].num_surfels == len(slam.map)
        assert all(r.overlap > 0.5 and r.num_inliers > 1000 and r.rmse_m > 0 for r in slam.results[1:])
        assert all({"surfaces", "view", "track", "fuse"} <= set(r.stage_ms) for r in slam.results)
        np.testing.assert_array_equal(slam.trajectory.T_world_camera[0], np.eye(4))

    def test_map_starts_with_the_first_frame_that_has_depth(self) -> None:
        sequence = rendered(count=40)
        slam = run([blind(f) for f in sequence.frames[:3]] + list(sequence.frames[3:8]))
        assert [r.state for r in slam.results] == [LOST] * 3 + [TRACKING] * 5
        assert "no map yet" in slam.results[0].note
        np.testing.assert_array_equal(slam.trajectory.T_world_camera[:4], np.tile(np.eye(4), (4, 1, 1)))
        G = sequence.ground_truth.T_world_camera
        assert pose_error(slam.trajectory.T_world_camera[7], se3.inverse(G[3]) @ G[7])[0] < 3e-3

    def test_blind_frames_are_lost_never_fused_and_interpolated(self) -> None:
        """Ten frames without depth: the map does not change by a byte, the poses go on as the camera moved, and are
        interpolated once tracking is regained."""
        sequence = rendered(count=40)
        true = in_first_frame(sequence)
        slam = run(sequence.frames[:10])
        before = map_bytes(slam.map)
        for k in range(10, 20):
            result = slam.process(blind(sequence.frames[k]))
            assert result.state is LOST
            assert result.status == "too_few_correspondences"
            assert result.note
            assert np.isfinite(result.T_world_camera).all()
        assert map_bytes(slam.map) == before
        assert slam.results[-1].num_surfels == slam.results[9].num_surfels
        # The motion model goes on in the right direction, slower and slower, and never past the camera.
        travelled = [float(np.linalg.norm(r.T_world_camera[:3, 3] - true[9][:3, 3])) for r in slam.results[10:]]
        actual = [float(np.linalg.norm(T[:3, 3] - true[9][:3, 3])) for T in true[10:20]]
        steps = np.diff([0, *travelled])
        assert (steps > 0).all()
        assert (np.diff(steps) < 0).all()
        assert travelled[0] == pytest.approx(actual[0], rel=0.15)
        assert travelled[-1] < actual[-1]
        held = slam.trajectory.T_world_camera[19].copy()
        for k in range(20, 26):
            slam.process(sequence.frames[k])
        assert [r.state for r in slam.results[20:]] == [RELOCALISED] + [TRACKING] * 5
        for k in range(26):
            assert pose_error(slam.trajectory.T_world_camera[k], true[k])[0] < 5e-3
        assert pose_error(held, true[19])[0] > 0.05  # it is the interpolation that brought the poses right

    def test_prediction_after_a_loss_does_not_overshoot(self) -> None:
        """While lost the model lags behind; the jump back is no speed of the camera."""
        sequence = rendered(count=40)
        true = in_first_frame(sequence)
        slam = run([*sequence.frames[:10], *map(blind, sequence.frames[10:20]), sequence.frames[20]])
        assert slam.results[-1].state is RELOCALISED
        predicted = slam._motion.predict(sequence.frames[21].timestamp_s)
        assert pose_error(predicted, true[21])[0] < 0.01

    def test_regained_after_a_loss_and_an_unreadable_frame_is_relocalised(self) -> None:
        sequence = rendered(count=40)
        slam = run([*sequence.frames[:5], blind(sequence.frames[5])])
        slam.skip(sequence.frames[6].timestamp_s, "damaged")
        assert slam.process(sequence.frames[7]).state is RELOCALISED
        assert slam.process(sequence.frames[8]).state is TRACKING

    def test_skip(self) -> None:
        sequence = rendered(count=40)
        true = in_first_frame(sequence)
        slam = run(sequence.frames[:5])
        before = map_bytes(slam.map)
        result = slam.skip(sequence.frames[5].timestamp_s, "damaged file")
        assert (result.state, result.note, result.index) == (UNREADABLE, "damaged file", 5)
        assert map_bytes(slam.map) == before
        assert slam.process(sequence.frames[6]).state is TRACKING
        assert len(slam.trajectory) == 7
        assert pose_error(slam.trajectory.T_world_camera[5], true[5])[0] < 2e-3

    def test_skip_before_there_is_a_map(self) -> None:
        start = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
        slam = sw.build_slam(CAMERA, T_world_first=start)
        np.testing.assert_allclose(slam.skip(0.0, "damaged").T_world_camera, start, atol=1e-12)
        np.testing.assert_allclose(slam.process(rendered(count=40).frames[1]).T_world_camera, start, atol=1e-12)

    @pytest.mark.parametrize("change", ["pairs", "gap"])
    def test_irregular_timestamps_do_not_lose_the_camera(self, change: str) -> None:
        """Frames stamped two by two 0.5 ms apart, and a pause of ten seconds in which the camera stood still."""
        times = np.arange(12) / 30
        if change == "pairs":
            times[1::2] = times[0::2] + 0.0005
        else:
            times[6:] += 10
        frames = rendered(count=40).frames[:12]
        slam = run([replace(frame, timestamp_s=float(t)) for frame, t in zip(frames, times, strict=True)])
        assert {result.state for result in slam.results} == {TRACKING}

    def test_blind_frame_at_a_given_pose_keeps_the_world(self) -> None:
        frames, start = rendered(count=40).frames, se3.exp([5, 0, 0, 0, 0, 0.3])
        slam = sw.build_slam(CAMERA)
        slam.process(blind(frames[0]), T_world_camera=start)
        np.testing.assert_allclose(slam.process(frames[1]).T_world_camera, start, atol=1e-12)

    def test_world_frame_is_the_callers(self) -> None:
        start = rendered(count=40).ground_truth.T_world_camera[0]
        slam = run(rendered(count=40).frames[:6], T_world_first=start)
        error = pose_error(slam.trajectory.T_world_camera[5], rendered(count=40).ground_truth.T_world_camera[5])
        assert error[0] < 2e-3
        with pytest.raises(sw.InvalidInputError, match="T_world_first"):
            sw.build_slam(CAMERA, T_world_first=np.diag([1.0, 1, -1, 1]))

    @pytest.mark.parametrize("timestamp_s", [0.1, 0.05, -1.0, float("nan"), float("inf")])
    def test_time_must_increase(self, timestamp_s: float) -> None:
        """Before anything is fused: a frame that is refused leaves no trace."""
        frame = rendered(count=40).frames[0]
        slam = run([replace(frame, timestamp_s=0.0), replace(frame, timestamp_s=0.1)])
        before = map_bytes(slam.map)
        for attempt in (
            lambda: slam.process(replace(frame, timestamp_s=timestamp_s)),
            lambda: slam.skip(timestamp_s, "x"),
        ):
            with pytest.raises(sw.InvalidInputError, match="timestamp"):
                attempt()
        assert len(slam.results) == 2
        assert map_bytes(slam.map) == before

    def test_unrelated_frame_is_lost_and_not_fused(self) -> None:
        slam = run(rendered(count=40).frames[:5])
        before = map_bytes(slam.map)
        foreign = replace(rendered("corridor", count=40).frames[0], timestamp_s=slam.results[-1].timestamp_s + 1 / 30)
        assert slam.process(foreign).state is LOST
        assert map_bytes(slam.map) == before


class TestGivenPoses:
    def test_frames_are_fused_where_they_are(self) -> None:
        sequence = rendered(count=40)
        slam = sw.build_slam(CAMERA)
        mapper = sw.SurfelMapper()
        for frame, pose in zip(sequence.frames[:6], sequence.ground_truth.T_world_camera, strict=False):
            result = slam.process(frame, T_world_camera=pose)
            assert result.state is TRACKING
            mapper.fuse(sw.build_pyramid(frame), pose)
        np.testing.assert_allclose(slam.trajectory.T_world_camera, sequence.ground_truth.T_world_camera[:6], atol=1e-12)
        assert map_bytes(slam.map) == map_bytes(mapper.map)

    def test_pose_that_is_none_is_refused_before_anything_is_fused(self) -> None:
        slam = run(rendered(count=40).frames[:1])
        before = map_bytes(slam.map)
        for bad in (np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), np.eye(3)):
            with pytest.raises(sw.InvalidInputError, match="T_world_camera"):
                slam.process(rendered(count=40).frames[1], T_world_camera=bad)
        assert map_bytes(slam.map) == before
        assert len(slam.results) == 1

    def test_poses_far_from_the_origin_are_refused(self) -> None:
        T = np.eye(4)
        T[1, 3] = -2e4
        with pytest.raises(sw.InvalidInputError, match="20000 m from the origin, expected at most 10000 m"):
            sw.build_slam(CAMERA, T_world_first=T)

    def test_the_callers_pose_is_copied(self) -> None:
        pose = np.eye(4)
        slam = sw.build_slam(CAMERA)
        slam.process(rendered(count=40).frames[0], T_world_camera=pose)
        pose[0, 3] = 7
        assert slam.trajectory.T_world_camera[0, 0, 3] == 0


class FakeTracker:
    """Says what it is told to."""

    def __init__(self, status: sw.Status) -> None:
        self.status, self.calls = status, 0

    def track(self, pyramid: object, view: object, T_world_camera: np.ndarray) -> sw.RegistrationResult:
        self.calls += 1
        return sw.RegistrationResult(
            T_target_source=se3.exp([self.calls, 0, 0, 0, 0, 0]), status=self.status, information=np.eye(6),
            rmse_m=0.5, overlap=0.25, num_inliers=7, note="told so",
        )  # fmt: skip


class FakeMapper:
    """Counts what it is asked for."""

    def __init__(self) -> None:
        self.map: list[np.ndarray] = []
        self.asked: Counter[str] = Counter()

    def view(self, T_world_camera: np.ndarray, camera: sw.PinholeCamera) -> sw.ModelView:
        self.asked["view"] += 1
        none = np.zeros((3, 0), np.float32)
        return sw.ModelView(T_world_camera, camera, none, none, none[0], np.full(camera.shape, -1, np.int32))

    def fuse(self, pyramid: object, T_world_camera: np.ndarray, *, keyframe: int, moving: object) -> None:
        assert keyframe == FakeLoopCloser.keyframe
        self.asked["fuse"] += 1
        self.map.append(T_world_camera)

    def apply(self, correction: sw.MapCorrection) -> None:
        self.asked["apply"] += 1


class FakeLoopCloser:
    keyframe = 7
    num_closures = 0

    def relocalise(self, pyramid: object) -> sw.RegistrationResult:
        return sw.NoLoopCloser().relocalise(sw.build_pyramid(rendered(count=40).frames[0]))

    def process(self, pyramid: object, result: sw.FrameResult) -> sw.MapCorrection | None:
        return sw.MapCorrection(np.zeros(1, np.int32), np.eye(4)[None]) if result.index == 2 else None


class TestReplacedStages:
    @pytest.mark.parametrize(
        ("status", "state"),
        [
            (sw.Status.CONVERGED, TRACKING), (sw.Status.MAX_ITERATIONS, TRACKING), (sw.Status.DEGENERATE, TRACKING),
            (sw.Status.NO_OVERLAP, LOST), (sw.Status.TOO_FEW_CORRESPONDENCES, LOST),
        ],
    )  # fmt: skip
    def test_every_stage_behind_its_protocol(self, status: sw.Status, state: sw.FrameState) -> None:
        tracker, mapper = FakeTracker(status), FakeMapper()
        slam = Slam(tracker=tracker, mapper=mapper, loop_closer=FakeLoopCloser())
        for frame in rendered(count=40).frames[:4]:
            slam.process(frame)
        assert [r.state for r in slam.results] == [TRACKING] + [state] * 3
        assert tracker.calls == 3
        tracked = state is TRACKING
        assert mapper.asked == {"view": 4, "fuse": 4 if tracked else 1, **({"apply": 1} if tracked else {})}
        assert slam.map is mapper.map
        last = slam.results[-1]
        assert (last.status, last.note) == (status.value, "told so")
        assert (last.rmse_m, last.overlap, last.num_inliers) == (0.5, 0.25, 7)
        assert slam.trajectory.T_world_camera[3, 0, 3] == (3 if tracked else 0)

    def test_what_moved_in_a_tracked_frame_is_not_cut_out_of_a_placed_one(self) -> None:
        frames = rendered(count=40).frames[:3]
        mapper, cut = FakeMapper(), []
        fuse = mapper.fuse
        mapper.fuse = lambda *args, **kept: (cut.append(kept["moving"]), fuse(*args, **kept))  # type: ignore[method-assign]
        slam = Slam(tracker=FakeTracker(sw.Status.CONVERGED), mapper=mapper, loop_closer=FakeLoopCloser())
        slam.process(frames[0])
        slam._moving = np.ones(CAMERA.shape, np.bool_)
        slam.process(frames[1], T_world_camera=np.eye(4))
        slam.process(frames[2])
        assert cut == [None, None, None]

    def test_build_slam_takes_stages_and_names_a_wrong_one(self) -> None:
        tracker = FakeTracker(sw.Status.CONVERGED)
        assert sw.build_slam(CAMERA, tracker=tracker).tracker is tracker
        with pytest.raises(sw.InvalidInputError, match="traker"):
            sw.build_slam(CAMERA, traker=tracker)

    def test_configuration_reaches_the_stages(self) -> None:
        config = sw.SlamConfig(
            tracking=sw.TrackingConfig(stable_fraction=0.5), fusion=sw.FusionConfig(max_confidence=7.0),
            surfaces=sw.SurfaceConfig(max_depth_m=2.5),
        )  # fmt: skip
        slam = run(rendered(count=40).frames[:1], config=config)
        assert slam.tracker.config.stable_fraction == 0.5
        assert slam.mapper.config.max_confidence == 7.0
        assert slam.map.positions_m[2].max() <= 2.5

    def test_no_loop_closer_corrects_nothing(self) -> None:
        slam = run(rendered(count=40).frames[:1])
        assert sw.NoLoopCloser().process(sw.build_pyramid(rendered(count=40).frames[0]), slam.results[0]) is None


def test_part_of_a_sequence_is_the_sequence_of_that_part() -> None:
    """Frames [k, n) of a sequence give the same bytes as a sequence that holds only them (golden 6)."""
    from scanweld.datasets.selection import select

    sequence = rendered(noise="kinect", count=40)
    selected = run(select(sequence, "12:20"))
    sliced = run(sequence.part(12, 20))
    assert len(selected.results) == 8
    assert selected.trajectory.T_world_camera.tobytes() == sliced.trajectory.T_world_camera.tobytes()
    assert map_bytes(selected.map) == map_bytes(sliced.map)


class TestMotionModel:
    def test_constant_twist_is_predicted_exactly(self) -> None:
        model, twist = ConstantVelocity(), np.array([0.3, -0.1, 0.2, 0.4, 0.1, -0.2])
        start = se3.exp([1, 2, 3, 0.5, 0.5, 0.5])
        for time in (0.0, 0.1, 0.25):
            model.observe(time, start @ se3.exp(time * twist))
        np.testing.assert_allclose(model.predict(0.4), start @ se3.exp(0.4 * twist), atol=1e-12)

    def test_first_pose_stands_still(self) -> None:
        model = ConstantVelocity()
        np.testing.assert_array_equal(model.predict(3.0), np.eye(4))
        model.observe(0.0, se3.exp([1, 0, 0, 0, 0, 0]))
        np.testing.assert_array_equal(model.predict(3.0), se3.exp([1, 0, 0, 0, 0, 0]))

    def test_misses_slow_down(self) -> None:
        """A step of 1 m a second and decay 0.8: the k-th missed second moves 0.8^(k-1) m, 5 m in the end."""
        model = ConstantVelocity(decay=0.8)
        model.observe(0.0, np.eye(4))
        model.observe(1.0, se3.exp([1, 0, 0, 0, 0, 0]))
        positions = [model.miss(2.0 + k)[0, 3] for k in range(60)]
        np.testing.assert_allclose(positions[:3], [2.0, 2.8, 3.44])
        assert positions[-1] == pytest.approx(6.0, abs=1e-4)

    def test_velocity_after_misses_is_that_between_the_measurements(self) -> None:
        model = ConstantVelocity()
        for time in (0.0, 1.0):
            model.observe(time, se3.exp([time, 0, 0, 0, 0, 0]))
        for time in (2.0, 3.0, 4.0):
            model.miss(time)
        model.observe(5.0, se3.exp([5, 0, 0, 0, 0, 0]))
        assert model.predict(6.0)[0, 3] == pytest.approx(6.0)

    def test_timestamps_that_are_too_near_do_not_throw_the_camera(self) -> None:
        """0.01 m within 0.5 ms is 20 m/s; carried on for the next 66 ms it would be 1.3 m, at most it is 0.04 m."""
        model = ConstantVelocity()
        model.observe(0.0, np.eye(4))
        model.observe(0.0005, se3.exp([0.01, 0, 0, 0, 0, 0]))
        assert model.predict(0.0665)[0, 3] == pytest.approx(0.05)

    def test_motion_is_not_carried_over_a_long_gap(self) -> None:
        """0.01 m in 0.1 s; a minute later four such steps have been taken, a tenth of a second later one."""
        model = ConstantVelocity()
        for k in range(2):
            model.observe(0.1 * k, se3.exp([0.01 * k, 0, 0, 0, 0, 0]))
        assert model.predict(0.2)[0, 3] == pytest.approx(0.02)
        assert model.predict(60.0)[0, 3] == pytest.approx(0.05)
        assert model.miss(60.0)[0, 3] == pytest.approx(0.05)

    def test_jitter_and_change_are_told_apart(self) -> None:
        """Steps whose velocity wanders by 2 mm a frame and 1 mrad, at poses that jitter by 1 mm and 1 mrad."""
        rng, unsteadiness = np.random.default_rng(0), Unsteadiness()
        change, jitter = np.repeat([0.002, 0.001], 3), np.full(6, 0.001)
        velocity = np.cumsum(change * rng.standard_normal((61, 6)), axis=0)
        poses = np.cumsum(velocity, axis=0) + jitter * rng.standard_normal((61, 6))
        for step in np.diff(poses, axis=0):
            unsteadiness.observe(step, 0.1)
        np.testing.assert_allclose(unsteadiness.jitter, jitter**2, rtol=0.5)
        np.testing.assert_allclose(unsteadiness.change(0.1), (change / 0.1) ** 2, rtol=0.5)

    @staticmethod
    def walking(jitter_m: float = 0.001) -> ConstantVelocity:
        """15 frames, 0.1 s and 0.1 m along x apart, their steps longer and shorter in turn."""
        model = ConstantVelocity()
        for k in range(15):
            model.observe(0.1 * k, se3.exp([0.1 * k + jitter_m * (k % 3), 0, 0, 0, 0, 0]))
        return model

    @staticmethod
    def before_a_wall(T_world_camera: np.ndarray, sigma_m: float = 1e-4) -> sw.RegistrationResult:
        """An alignment that knows the plane z = 1.5 m of the camera and nothing else."""
        x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
        p, n = np.stack([x, y, np.full(81, 1.5)], axis=1), np.tile([0, 0, -1.0], (81, 1))
        rows = np.concatenate([n, np.cross(p, n)], axis=1) @ se3.adjoint(se3.inverse(T_world_camera)) / sigma_m
        free = FreeDirection("translation along (1.00, 0.00, 0.00)", np.eye(6)[0])
        return sw.RegistrationResult(
            T_target_source=T_world_camera, status=sw.Status.DEGENERATE, information=rows.T @ rows, unobservable=(free,)
        )

    def test_a_tilt_of_the_wall_turns_the_camera_where_it_is(self) -> None:
        """The alignment turns the wall by 0.02 rad about its middle, 1.5 m away, which takes the camera 30 mm aside.
        The wall's tilt is a fact, and the way aside a choice: the camera was not expected there."""
        model = self.walking()
        expected = model.predict(1.5)
        pivot = se3.exp([0, 0, 1.5, 0, 0, 0])
        aligned = expected @ pivot @ se3.exp([0, 0, 0, 0, 0.02, 0]) @ se3.inverse(pivot)
        assert abs(aligned[0, 3] - expected[0, 3]) == pytest.approx(0.03, abs=1e-3)
        answer = model.weigh(1.5, self.before_a_wall(aligned)).T_target_source
        np.testing.assert_allclose(answer[:3, :3], aligned[:3, :3], atol=1e-4)
        assert answer[2, 3] == pytest.approx(aligned[2, 3], abs=1e-3)  # 0.02 rad times 30 mm are second order
        assert abs(answer[0, 3] - expected[0, 3]) < 3e-3

    def test_what_was_guessed_for_long_is_no_speed_when_it_is_seen_again(self) -> None:
        """Ten frames before a wall, then a pose 40 mm further than guessed: 4 to 6 mm a frame, and not 40 in one."""
        model = self.walking()
        for k in range(15, 25):
            answer = model.weigh(0.1 * k, self.before_a_wall(model.predict(0.1 * k)))
            model.observe(0.1 * k, answer.T_target_source, partly=True)
        before = model.predict(2.5)
        seen = before @ se3.exp([0.04, 0, 0, 0, 0, 0])
        model.observe(2.5, seen)
        step = (model.predict(2.6)[0, 3] - seen[0, 3]) - (before[0, 3] - answer.T_target_source[0, 3])
        assert 0.003 < step < 0.008


class TestTrajectoryOfResults:
    @staticmethod
    def results(*states: sw.FrameState) -> list[sw.FrameResult]:
        """Measured frames at x = time, the others somewhere else."""
        times = [0.0, 1.0, 1.5, 4.0, 5.0, 6.0][: len(states)]
        return [
            sw.FrameResult(
                index=k, timestamp_s=time, state=state,
                T_world_camera=se3.exp([time if state in (TRACKING, RELOCALISED) else 99, 0, 0, 0, 0, 0]),
            )
            for k, (time, state) in enumerate(zip(times, states, strict=True))
        ]  # fmt: skip

    def test_gaps_are_interpolated_in_time_and_ends_are_kept(self) -> None:
        results = self.results(LOST, TRACKING, LOST, UNREADABLE, RELOCALISED, LOST)
        x = trajectory_of(results).positions_m[:, 0]
        np.testing.assert_allclose(x, [99, 1.0, 1.5, 4.0, 5.0, 99])

    def test_tracked_only(self) -> None:
        trajectory = trajectory_of(self.results(LOST, TRACKING, LOST, UNREADABLE, RELOCALISED, LOST), tracked_only=True)
        np.testing.assert_array_equal(trajectory.timestamps_s, [1.0, 5.0])

    def test_nothing_measured(self) -> None:
        assert len(trajectory_of(self.results(LOST, LOST))) == 2
        assert len(trajectory_of(self.results(LOST, LOST), tracked_only=True)) == 0
        assert len(trajectory_of([])) == 0


class TestGapsBeforeAWall:
    """What is free before a wall must not drown what is seen, however the frames are spaced."""

    def drift(self, times: list[float], skipped: int = 0) -> float:
        """How far a still camera before a blank wall with 2 mm of noise is off in the end [m]."""
        camera = sw.PinholeCamera(130, 130, 79.5, 59.5, 160, 120)
        rng = np.random.default_rng(5)
        slam = sw.build_slam(camera, sw.SlamConfig(loop_closer="none"))
        for k, time_s in enumerate(times):
            if 12 <= k < 12 + skipped:
                slam.skip(time_s, "damaged")
                continue
            depth = (1.4 + 0.002 * rng.standard_normal(camera.shape)).astype(np.float32)
            slam.process(sw.Frame(time_s, depth, None, camera))
        return float(np.linalg.norm(slam.results[-1].T_world_camera[:3, 3]))

    @pytest.mark.parametrize("gap_s", [0.033, 2.0, 60.0, 1e5])
    def test_a_pause(self, gap_s: float) -> None:
        times = [0.033 * k for k in range(15)]
        assert self.drift([*times, *(times[-1] + gap_s + 0.033 * k for k in range(12))]) < 0.02

    def test_frames_that_cannot_be_read(self) -> None:
        assert self.drift([0.033 * k for k in range(12 + 200 + 12)], skipped=200) < 0.02

    def test_stamps_that_nearly_agree(self) -> None:
        assert self.drift([0.033 * k - (0.0325 if k % 3 == 2 else 0) for k in range(30)]) < 0.02


def test_a_camera_that_was_carried_is_expected_to_stand_still() -> None:
    model = ConstantVelocity()
    for k in range(5):
        model.observe(0.1 * k, se3.exp([0.1 * k, 0, 0, 0, 0, 0]))
    model.forget()
    model.observe(0.5, se3.exp([9, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(model.predict(0.6), se3.exp([9, 0, 0, 0, 0, 0]), atol=1e-9)


def test_a_mask_of_what_moved_is_not_carried_over_to_images_of_another_size() -> None:
    """Something moves before a small camera; the next frame is of a larger one."""
    slam = sw.build_slam(CAMERA, sw.SlamConfig(loop_closer="none"))
    sequence = rendered(count=40)
    for frame in sequence.frames[:3]:
        slam.process(frame)
    slam._moving = np.ones((30, 40), np.bool_)
    assert slam.process(sequence.frames[3]).state is sw.FrameState.TRACKING
