"""Submaps: a camera that is lost for good begins a map of its own, which is joined with the other one, or told of."""

from __future__ import annotations

import copy
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, blind, pose_error, rendered
from scanweld.cli.slam import apart_text
from scanweld.datasets.synthetic.paths import built_in_path
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.loop_closure import joining
from scanweld.loop_closure.joining import Join, JoinFinder, PlacePair
from scanweld.loop_closure.keyframes import sighting_of
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser
from scanweld.runs.output import write_frames, write_submaps
from scanweld.runs.run import summarise
from scanweld.slam.motion import POSED
from scanweld.slam.submaps import Atlas, SubmapConfig, in_one_world, main_submap
from scanweld.trajectory import FrameResult, FrameState

TRACKING, LOST, RELOCALISED = FrameState.TRACKING, FrameState.LOST, FrameState.RELOCALISED

BLIND = -1
FIRST = range(0, 100, 5)
"""Steps of the path around the room that are seen before the lens is covered."""
ELSEWHERE = range(290, 400, 5)
"""Where it is uncovered: the other half of the room."""
BACK = [*range(400, 450, 5), *range(0, 40, 5)]
"""From there on to where the path began."""


class Walk:
    """The path around the room, frame by frame at 10 Hz, in any order."""

    def __init__(self, slam: sw.Slam, sequence: sw.SyntheticSequence) -> None:
        self.slam, self.sequence = slam, sequence
        self.steps: list[int] = []

    def on(self, steps: object) -> Walk:
        for step in steps:  # type: ignore[attr-defined]
            frame = replace(self.sequence.read(max(step, 0)), timestamp_s=len(self.steps) / 10)
            self.slam.process(blind(frame) if step == BLIND else frame)
            self.steps.append(step)
        return self

    def truth(self, index: int) -> np.ndarray:
        """T_world_camera with the first camera as the world."""
        poses = self.sequence.ground_truth.T_world_camera
        return np.asarray(se3.inverse(poses[0]) @ poses[max(self.steps[index], 0)])

    def errors_m(self, submap: int) -> list[float]:
        return [
            pose_error(r.T_world_camera, self.truth(r.index))[0]
            for r in self.slam.results
            if r.state in POSED and r.submap == submap
        ]

    def copy(self) -> Walk:
        other = Walk(copy.deepcopy(self.slam), self.sequence)
        other.steps = list(self.steps)
        return other


@pytest.fixture(scope="module")
def walked() -> Walk:
    """Half of the room, a covered lens, a part of the other half: nothing in common yet."""
    config = sw.RenderConfig(width=CAMERA.width, height=CAMERA.height, noise="kinect")
    sequence = sw.SyntheticSequence(config, trajectory=built_in_path("sweep", 450, 30.0))
    return Walk(sw.build_slam(CAMERA), sequence).on([*FIRST, *[BLIND] * 4, *ELSEWHERE])


@pytest.fixture
def apart(walked: Walk) -> Walk:
    """Return a walk of the test's own: whoever asks for the maps ends what is under way."""
    return walked.copy()


class TestApart:
    def test_ten_frames_without_a_known_place_begin_a_submap(self, apart: Walk) -> None:
        results = apart.slam.results
        assert [r.state for r in results[:20]] == [TRACKING] * 20
        assert [r.state for r in results[20:34]] == [LOST] * 14  # four of them dark, ten for a second of patience
        assert [r.state for r in results[34:]] == [TRACKING] * (len(results) - 34)
        assert [r.submap for r in results] == [0] * 34 + [1] * (len(results) - 34)
        assert "submap 1 begins here" in results[34].note
        np.testing.assert_array_equal(results[34].T_world_camera, np.eye(4))  # the origin of a world of its own
        assert results[33].num_surfels == results[19].num_surfels  # nothing was fused meanwhile

    def test_it_is_a_map_of_its_own(self, apart: Walk) -> None:
        slam = apart.slam
        assert sorted(slam.maps) == [0, 1]
        assert len(slam.maps[0]) == slam.results[19].num_surfels
        assert len(slam.maps[1]) == slam.results[-1].num_surfels
        own = se3.inverse(apart.truth(34))
        for r in slam.results[34:]:
            assert pose_error(r.T_world_camera, own @ apart.truth(r.index))[0] < 5e-3

    def test_the_world_is_that_of_most_frames_and_the_others_are_lost_in_it(self, apart: Walk) -> None:
        slam, count = apart.slam, len(apart.steps)
        assert main_submap(slam.results) == 0
        assert slam.unjoined == (1,)
        assert slam.map is slam.maps[0]
        poses = slam.trajectory.T_world_camera
        for k in range(20):
            assert pose_error(poses[k], apart.truth(k))[0] < 1e-2
        np.testing.assert_allclose(poses[34:], np.tile(slam.results[33].T_world_camera, (count - 34, 1, 1)), atol=1e-12)
        assert {r.state for r in slam.main_results[34:]} == {LOST}
        metrics, _ = summarise(slam, None, 1)
        assert (metrics["frames_tracked"], metrics["frames_lost"]) == (20, count - 20)
        assert (metrics["submaps_joined"], metrics["submaps_unjoined"]) == (0, 1)
        assert metrics["frames_in_unjoined_submaps"] == count - 34
        assert metrics["num_surfels"] == len(slam.maps[0])
        assert f"1 submap with {count - 34} frames" in apart_text(metrics)

    def test_the_run_folder_has_both(self, apart: Walk, tmp_path: Path) -> None:
        write_submaps(tmp_path, apart.slam)
        write_frames(tmp_path / "frames.csv", apart.slam.results)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["frames.csv", "map-1.ply", "trajectory-1.txt"]
        assert len(sw.read_ply(tmp_path / "map-1.ply").points_m) == len(apart.slam.maps[1])
        read = sw.read_trajectory(tmp_path / "trajectory-1.txt")
        np.testing.assert_allclose(read.timestamps_s, [r.timestamp_s for r in apart.slam.results[34:]])
        rows = list(csv.DictReader((tmp_path / "frames.csv").read_text().splitlines()))
        assert [int(row["submap"]) for row in rows] == [r.submap for r in apart.slam.results]


class TestTogether:
    def test_back_on_seen_ground_the_maps_are_joined(self, apart: Walk) -> None:
        walk = apart.copy().on(BACK)
        slam = walk.slam
        assert sorted(slam.maps) == [0]
        assert slam.atlas.num_joins == 1
        assert slam.unjoined == ()
        assert {r.submap for r in slam.results} == {0}
        assert {r.state for r in slam.results[34:]} == {TRACKING}  # joined in passing, without a loss
        errors = walk.errors_m(0)
        assert len(errors) == len(walk.steps) - 14
        assert np.sqrt(np.mean(np.square(errors))) < 4e-3
        assert max(errors) < 8e-3
        # Every keyframe is where its frame is, and the surfels of both maps still move with their own.
        closer = slam.loop_closer
        assert isinstance(closer, KeyframeLoopCloser)
        for keyframe in closer.database.keyframes:
            assert pose_error(keyframe.T_world_camera, walk.truth(keyframe.frame_index))[0] < 8e-3
        begun = next(k.index for k in closer.database.keyframes if k.frame_index == 34)
        assert set(np.unique(slam.map.anchors)) >= {0, begun, begun + 1}
        # The surfels that the other half brought lie where the other half is: the true depth there says so.
        step = walk.sequence.ground_truth.T_world_camera
        _, depth_m = walk.sequence.exact(340)
        seen = slam.mapper.view(se3.inverse(step[0]) @ step[340], CAMERA)
        T_camera_world = se3.inverse(se3.inverse(step[0]) @ step[340])
        z = se3.transform_points(T_camera_world, seen.positions_m.T.astype(np.float64))[:, 2]
        true = depth_m.ravel()[seen.pixels]
        assert np.median(np.abs(z - true)[true > 0]) < 6e-3

    def test_a_loss_on_the_way_is_found_again_in_the_old_map(self, apart: Walk) -> None:
        walk = apart.copy().on([*[BLIND] * 3, *range(30, 60, 5)])
        found = walk.slam.results[len(apart.steps) + 3 :]
        assert found[0].state is RELOCALISED
        assert {r.submap for r in found} == {0}
        assert max(walk.errors_m(0)) < 8e-3
        assert walk.slam.unjoined == (1,)
        assert len(walk.slam.maps[1]) == len(apart.slam.maps[1])

    def test_given_poses_are_in_the_world_of_the_run(self, apart: Walk) -> None:
        walk = apart.copy()
        frame = replace(walk.sequence.read(0), timestamp_s=len(walk.steps) / 10)
        assert walk.slam.process(frame, T_world_camera=np.eye(4)).submap == 0


class TestTwins:
    """The two ends of the corridor between the twin rooms: the same but for their pictures."""

    ONE, OTHER = range(560, 790, 14), range(1400, 1650, 14)

    def feed(self) -> list[Join]:
        config = sw.RenderConfig(scene="twin-rooms", width=CAMERA.width, height=CAMERA.height, noise="kinect")
        sequence = sw.SyntheticSequence(config)
        closer, joins = KeyframeLoopCloser(sw.LoopClosingConfig(lag_frames=0)), []
        for steps in (self.ONE, self.OTHER):
            for k in steps:
                pyramid, T = sw.build_pyramid(sequence.read(k)), sequence.ground_truth.T_world_camera[k]
                if k == self.OTHER.start:
                    assert closer.begin_submap(pyramid, T, k) == 1
                    continue
                state = FrameResult(index=k, timestamp_s=float(k), state=TRACKING, T_world_camera=T)
                found = closer.process(pyramid, state)
                joins += [found] if isinstance(found, Join) else []
        return joins

    def test_they_are_not_joined(self) -> None:
        assert self.feed() == []

    def test_it_is_the_other_keyframes_that_speak_against_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Without them, two pairs agree that one end of the corridor is the other: turned by half a turn."""
        monkeypatch.setattr(joining, "fits_together", lambda *_: "")
        joins = self.feed()
        assert joins
        assert pose_error(joins[0].T_kept_joined, np.diag([-1.0, 1.0, -1.0, 1.0]))[1] < 3


class TestOneMap:
    """Stages that know nothing of submaps."""

    class Mapper:
        """A mapper of one map."""

        def __init__(self) -> None:
            self.inner = sw.SurfelMapper()
            self.map, self.view, self.fuse, self.apply = (
                self.inner.map, self.inner.view, self.inner.fuse, self.inner.apply,
            )  # fmt: skip

    def test_they_begin_none(self) -> None:
        pyramid = sw.build_pyramid(rendered(count=40).frames[0])
        for mapper, closer in ((self.Mapper(), KeyframeLoopCloser()), (sw.SurfelMapper(), sw.NoLoopCloser())):
            atlas = Atlas(mapper, closer)
            assert atlas.begin(pyramid, 3) is None
            assert list(atlas.mappers) == [0]

    def test_a_state_with_several_maps_is_not_theirs(self) -> None:
        atlas = Atlas(self.Mapper(), KeyframeLoopCloser())
        with pytest.raises(ValueError, match="a mapper of one map has several"):
            atlas.submaps = [0, 1]
        atlas.active = 3
        with pytest.raises(ValueError, match="submap 3, which is not there"):
            atlas.restored()


class TestEvidence:
    @staticmethod
    def pair(i: int, j: int, T_i_j: np.ndarray) -> PlacePair:
        return PlacePair(i, j, T_i_j, np.eye(6))

    def test_two_pairs_of_four_keyframes_must_say_the_same(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Keyframes 0..2 stand a metre apart in world 0; 3..5 are the same places in a world moved by T."""
        monkeypatch.setattr(joining, "fits_together", lambda *_: "")
        T = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        sighting = sighting_of(sw.build_pyramid(rendered(count=40).frames[0]), sw.KeyframeLoopCloser().database.ferns)
        from scanweld.loop_closure.keyframes import keyframe_of

        places = [se3.exp([float(k), 0, 0, 0, 0, 0]) for k in range(3)]
        keyframes = [keyframe_of(sighting, P, index=k, frame_index=k) for k, P in enumerate(places)]
        keyframes += [keyframe_of(sighting, T @ P, index=3 + k, frame_index=3 + k) for k, P in enumerate(places)]
        submaps = [0, 0, 0, 1, 1, 1]
        surfaces = sw.SurfaceConfig()
        same, off = np.eye(4), se3.exp([0.2, 0, 0, 0, 0, 0])

        finder = JoinFinder(0.01, surfaces)
        assert finder.add(self.pair(0, 3, same), keyframes, submaps) is None  # alone
        assert finder.add(self.pair(0, 3, same), keyframes, submaps) is None  # the same two again
        assert finder.add(self.pair(1, 3, places[1] @ same), keyframes, submaps) is None  # one of them again
        assert finder.add(self.pair(1, 4, off), keyframes, submaps) is None  # says something else
        join = finder.add(self.pair(2, 5, same), keyframes, submaps)
        assert join is not None
        assert (join.kept, join.joined) == (0, 1)
        np.testing.assert_allclose(join.T_kept_joined, se3.inverse(T), atol=1e-9)
        # The older submap is kept, whichever of the two the camera is in.
        finder = JoinFinder(0.01, surfaces)
        finder.add(self.pair(3, 0, same), keyframes, submaps)
        join = finder.add(self.pair(5, 2, same), keyframes, submaps)
        assert join is not None
        np.testing.assert_allclose(join.T_kept_joined, se3.inverse(T), atol=1e-9)


class TestPatience:
    @staticmethod
    def lost(atlas: Atlas, times: list[float], *, dark: bool = False) -> list[bool]:
        frame = rendered(count=40).frames[0]
        assert frame is not None
        pyramid = sw.build_pyramid(blind(frame) if dark else frame)
        return [
            atlas.gives_up(FrameResult(index=0, timestamp_s=t, state=LOST, T_world_camera=np.eye(4)), pyramid)
            for t in times
        ]

    def test_time_and_tries_with_depth(self) -> None:
        def atlas(**values: object) -> Atlas:
            return Atlas(sw.SurfelMapper(), KeyframeLoopCloser(), SubmapConfig(**values))  # type: ignore[arg-type]

        assert self.lost(atlas(), [k / 10 for k in range(12)]) == [False] * 10 + [True] * 2
        assert self.lost(atlas(), [k / 30 for k in range(31)]) == [False] * 30 + [True]
        assert not any(self.lost(atlas(), [float(k) for k in range(9)]))  # nine tries, whatever the clock says
        assert not any(self.lost(atlas(), [k / 10 for k in range(50)], dark=True))  # a covered lens is no place
        assert not any(self.lost(atlas(most=1), [k / 10 for k in range(50)]))
        assert self.lost(atlas(patience_s=3.0), [k / 10 for k in range(31)]) == [False] * 30 + [True]

    def test_settings_out_of_range(self) -> None:
        with pytest.raises(ConfigError, match="most"):
            SubmapConfig(most=0)

    def test_stages_that_know_no_submaps_stay_lost(self) -> None:
        frames = rendered(count=40).frames
        other = rendered("corridor", count=14).frames
        slam = sw.build_slam(CAMERA, loop_closer=sw.NoLoopCloser())
        for k, frame in enumerate([*frames[:3], *other]):
            assert frame is not None
            slam.process(replace(frame, timestamp_s=k / 10))
        assert {r.state for r in slam.results[3:]} == {LOST}
        assert slam.unjoined == ()


def test_frames_of_other_worlds_have_no_pose_in_this_one() -> None:
    """x = time in the world of submap 1, which has most frames, and 50 elsewhere."""
    submaps, states = [0, 1, 1, 0, 0, 1, 1], [TRACKING, TRACKING, TRACKING, LOST, TRACKING, TRACKING, LOST]
    results = [
        FrameResult(
            index=k, timestamp_s=float(k), state=state, submap=submap,
            T_world_camera=se3.exp([k if submap else 50.0, 0, 0, 0, 0, 0]),
        )
        for k, (submap, state) in enumerate(zip(submaps, states, strict=True))
    ]  # fmt: skip
    assert main_submap(results) == 1
    seen = in_one_world(results, 1)
    assert [r.state for r in seen] == [LOST, TRACKING, TRACKING, LOST, LOST, TRACKING, LOST]
    np.testing.assert_allclose([r.T_world_camera[0, 3] for r in seen], [1, 1, 2, 2, 2, 5, 6])
    assert seen[4].note == "in submap 0"
    assert main_submap(results[:1]) == 0
    assert main_submap([]) == 0
