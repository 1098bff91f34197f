"""What goes wrong in recordings: the functions that do it to a sequence, and the scenario suite at small size.

At full size the suite is `benchmarks/robustness.py`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import MemorySequence, pose_error, rendered
from scanweld.datasets.selection import select
from scanweld.datasets.synthetic import RenderConfig, SyntheticSequence
from scanweld.datasets.synthetic.crossing import HEIGHT_M, CrossedSequence, Walk, build_person, walk_across
from scanweld.datasets.synthetic.paths import built_in_path
from scanweld.datasets.synthetic.rendering import render_frame
from scanweld.datasets.synthetic.scenarios import blackout, carried, find_carries, relight, unreadable
from scanweld.datasets.synthetic.twin_rooms import MIDDLE_X
from scanweld.errors import ConfigError, InvalidInputError, UnreadableFrameError
from scanweld.geometry import se3

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from scenarios import measures
from scenarios.runs import Run, fingerprint, run
from scenarios.suite import QUICK, SCENARIOS, Size

SMALL = {"width": 160, "height": 120}
TINY = {"width": 64, "height": 48}


@pytest.fixture(scope="module")
def base() -> MemorySequence:
    return rendered(noise="kinect", count=12)


@pytest.fixture(scope="module")
def crossed() -> CrossedSequence:
    config = RenderConfig(**SMALL, frames=90)
    return CrossedSequence(config, walk_across(built_in_path("orbit", 90, 30.0), 15, 60))


@pytest.fixture(scope="module")
def tracked() -> tuple[SyntheticSequence, Run]:
    sequence = SyntheticSequence(RenderConfig(**SMALL, frames=10))
    return sequence, run(sequence, keep_maps=(4,))


class TestAlterations:
    def test_blackout_covers_its_frames_and_no_other(self, base: MemorySequence) -> None:
        dark = blackout(base, 3, 4)
        for k in range(len(base)):
            frame, original = dark.read(k), base.read(k)
            assert frame.timestamp_s == original.timestamp_s
            if 3 <= k < 7:
                assert not frame.depth_m.any()
                assert frame.color is not None
                assert not frame.color.any()
            else:
                assert frame is original
        assert base.read(3).depth_m.any()  # the sequence underneath is as it was

    def test_unreadable_frames_raise_and_are_left_out_of_iteration(self, base: MemorySequence) -> None:
        damaged = unreadable(base, [2, 5])
        for k in (2, 5):
            with pytest.raises(UnreadableFrameError, match=f"frame {k} "):
                damaged.read(k)
        times = [frame.timestamp_s for frame in damaged]
        np.testing.assert_array_equal(times, np.delete(base.timestamps_s, [2, 5]))

    def test_relight_is_gain_and_offset_rounded_and_clipped(self, base: MemorySequence) -> None:
        bright = relight(base, 4, 2, gain=1.5, offset=-10)
        color = base.read(4).color
        assert color is not None
        expected = np.clip(np.rint(1.5 * color.astype(float) - 10), 0, 255).astype(np.uint8)
        np.testing.assert_array_equal(bright.read(4).color, expected)
        assert (expected == 255).any()  # some of it is clipped
        assert bright.read(4).depth_m is base.read(4).depth_m
        assert bright.read(3) is base.read(3)
        assert bright.read(6) is base.read(6)
        assert relight(base, 4, gain=0.5).read(11).color.mean() < 0.6 * base.read(11).color.mean()

    def test_alterations_compose_and_are_sequences(self, base: MemorySequence) -> None:
        sequence = relight(blackout(unreadable(base, [1]), 3), 5, gain=0.5)
        assert isinstance(sequence, sw.RgbdSequence)
        assert (len(sequence), sequence.name, sequence.camera) == (len(base), base.name, base.camera)
        assert sequence.ground_truth is base.ground_truth
        assert not sequence.read(3).depth_m.any()
        with pytest.raises(UnreadableFrameError):
            sequence.read(1)
        thinned = select(sequence, "::3")
        assert not thinned.read(1).depth_m.any()

    def test_stretches_beyond_the_end_are_refused(self, base: MemorySequence) -> None:
        with pytest.raises(InvalidInputError, match="it has 12"):
            blackout(base, 10, 3)
        with pytest.raises(InvalidInputError, match="it has 12"):
            relight(base, 13)


class TestCarried:
    def test_poses_and_times(self) -> None:
        """Frames 0..4 of the path, 3 on the way, then 8..11 of the path, each moved by T_shift; 30 frames a second."""
        path = built_in_path("orbit", 12, 30.0)
        shift = se3.exp(np.array([0.1, 0, 0, 0, 0.2, 0]))
        way = carried(path, 5, 8, 3, T_shift=shift)
        assert len(way) == 5 + 3 + 4
        np.testing.assert_allclose(way.T_world_camera[:5], path.T_world_camera[:5], atol=1e-12)
        np.testing.assert_allclose(way.T_world_camera[8:], path.T_world_camera[8:] @ shift, atol=1e-12)
        np.testing.assert_allclose(np.diff(way.timestamps_s), 1 / 30, atol=2e-6)
        # On the way the camera moves evenly from one end to the other.
        steps = [float(np.linalg.norm(np.diff(pair, axis=0))) for pair in pairwise(way.positions_m[4:9])]
        np.testing.assert_allclose(steps, steps[0], rtol=1e-6)

    def test_backwards_and_without_a_way(self) -> None:
        path = built_in_path("orbit", 12, 30.0)
        way = carried(path, 10, 2, 0)
        expected = path.T_world_camera[[*range(10), *range(2, 12)]]
        np.testing.assert_allclose(way.T_world_camera, expected, atol=1e-12)
        with pytest.raises(InvalidInputError, match="do not fit a path of 12"):
            carried(path, 5, 12)

    def test_found_carries_are_as_far_as_asked(self) -> None:
        path = built_in_path("orbit", 350, 30.0)
        pairs = find_carries(path, 10, earliest=100)
        assert len(set(pairs)) == 10
        for at, to in pairs:
            assert at >= 100
            distance, turn = pose_error(path.T_world_camera[to], path.T_world_camera[at - 1])
            assert distance == pytest.approx(2.0, rel=0.1)
            assert turn == pytest.approx(60.0, rel=0.1)
        with pytest.raises(InvalidInputError, match="take a longer path"):
            find_carries(path, 1, earliest=100, distance_m=50.0)

    def test_given_poses_are_rendered_like_those_of_a_path(self) -> None:
        config = RenderConfig(**TINY, noise="kinect")
        path = built_in_path("orbit", 5, 30.0)
        given, named = SyntheticSequence(config, trajectory=path), SyntheticSequence(replace(config, frames=5))
        np.testing.assert_array_equal(given.read(4).depth_m, named.read(4).depth_m)
        assert given.name == "room-given-kinect"
        with pytest.raises(ConfigError, match="leave both out"):
            SyntheticSequence(replace(config, path="sweep"), trajectory=path)


class TestPerson:
    def test_a_person_has_the_size_of_one(self) -> None:
        """Looked at from 20 m, where the picture is nearly a parallel projection; an upright box of 2 % tolerance."""
        camera = sw.PinholeCamera(2000.0, 2000.0, 199.5, 199.5, 400, 400)
        T = np.eye(4)
        T[:3, 3] = [0, -HEIGHT_M / 2, -20.0]
        _, depth_m = render_frame(build_person(), camera, T)
        points = camera.back_project(depth_m)[depth_m > 0]
        size = points.max(axis=0) - points.min(axis=0)
        assert size[1] == pytest.approx(HEIGHT_M, rel=0.02)
        assert 0.5 < size[0] < 0.75

    def test_only_its_own_pixels_change_and_they_come_nearer(self, crossed: CrossedSequence) -> None:
        still = SyntheticSequence(crossed.config)
        for k in (10, 35, 45, 80):
            mask = crossed.object_mask(k)
            (color, depth_m), (color_still, depth_still) = crossed.exact(k), still.exact(k)
            np.testing.assert_array_equal(depth_m[~mask], depth_still[~mask])
            np.testing.assert_array_equal(color[~mask], color_still[~mask])
            assert (depth_m[mask] < depth_still[mask]).all()
            points = se3.transform_points(
                still.ground_truth.T_world_camera[k], still.camera.back_project(depth_m)[mask].astype(np.float64)
            )
            assert crossed.in_object(points, 0.002).all()
        assert not crossed.object_mask(10).any()
        assert not crossed.object_mask(80).any()

    def test_it_fills_about_30_percent_of_the_view_and_comes_in_and_goes(self, crossed: CrossedSequence) -> None:
        shares = [crossed.object_mask(k).mean() for k in range(15, 75, 5)]
        assert 0.25 < max(shares) < 0.40
        assert shares[0] < 0.01
        assert shares[-1] < 0.02

    def test_the_room_is_not_the_person(self, crossed: CrossedSequence) -> None:
        """Nothing of what is seen before the person comes is where the person will be, but what it walks through."""
        depth_m = SyntheticSequence(crossed.config).exact(0)[1]
        points = se3.transform_points(
            crossed.ground_truth.T_world_camera[0], crossed.camera.back_project(depth_m).reshape(-1, 3)
        )
        assert crossed.in_object(points).mean() < 0.05

    def test_a_walk_must_fit(self) -> None:
        path = built_in_path("orbit", 20, 30.0)
        with pytest.raises(InvalidInputError, match="path of 20"):
            walk_across(path, 10, 11)
        with pytest.raises(InvalidInputError, match="the sequence has 20"):
            CrossedSequence(RenderConfig(**TINY, frames=20), Walk(15, np.tile(np.eye(4), (6, 1, 1))))


class TestScenes:
    def test_the_twin_rooms_look_alike(self) -> None:
        """Half a turn about the middle of the corridor leaves the rooms as they are, to the light through the door."""
        sequence = SyntheticSequence(RenderConfig(**SMALL, scene="twin-rooms"))
        half_turn = np.diag([-1.0, 1.0, -1.0, 1.0])
        poses = built_in_path("visit", 0, 30.0).T_world_camera[[150, 230]]
        there = SyntheticSequence(
            RenderConfig(**SMALL, scene="twin-rooms"),
            trajectory=sw.Trajectory(np.arange(4.0), np.concatenate([poses, half_turn @ poses])),
        )
        assert len(sequence) > 1000
        assert np.linalg.norm(poses[0, [0, 2], 3] - [-MIDDLE_X, 0]) < 2.0
        for k in (0, 1):
            (color, depth_m), (color_b, depth_b) = there.exact(k), there.exact(k + 2)
            np.testing.assert_allclose(depth_m, depth_b, atol=1e-4)
            assert np.abs(color.astype(int) - color_b).mean() < 2.0

    @pytest.mark.parametrize(("path", "contrast"), [("plain", (0.0, 1.0)), ("brick", (4.0, 60.0))])
    def test_the_wall_fills_the_view_for_two_seconds(self, path: str, contrast: tuple[float, float]) -> None:
        """Then its depth is a plane, and neighbours in its picture are alike, but where it has bricks."""
        sequence = SyntheticSequence(RenderConfig(**SMALL, scene="wall", path=path, fps=10.0, frames=90))
        first, last = measures.first_stretch(measures.flat_frames(sequence))
        assert first > 10
        assert last - first + 1 >= 20
        color = sequence.read((first + last) // 2).color
        assert color is not None
        difference = np.abs(np.diff(color.astype(int), axis=1)).mean()
        assert contrast[0] <= difference <= contrast[1]


class TestMeasures:
    def test_a_good_run(self, tracked: tuple[SyntheticSequence, Run]) -> None:
        sequence, result = tracked
        assert result.ate().rmse_m < 2e-3
        assert measures.motion_error(result, 2, 8) < 3e-3
        assert measures.motion_model_error(result, 4, 9) > measures.motion_error(result, 4, 9)
        mean_m, seen = measures.surface_error(result, sequence, every=3)
        assert 0 < mean_m < 3e-3
        assert seen > 0.95
        moved = result.points_m
        assert not np.shares_memory(moved, result.slam.map.positions_m)
        assert list(result.maps) == [4]

    def test_the_fingerprint_changes_with_any_surfel(self, tracked: tuple[SyntheticSequence, Run]) -> None:
        sequence, _ = tracked
        slam = sw.build_slam(sequence.camera, sw.SlamConfig())
        slam.process(sequence.read(0))
        before = fingerprint(slam.map)
        assert fingerprint(slam.map) == before
        table = slam.map.table()
        table["positions_m"][1, 77] += 1e-3
        slam.map.replace(table)
        assert fingerprint(slam.map) != before

    def test_recovery_of_a_run_that_went_on(self, tracked: tuple[SyntheticSequence, Run]) -> None:
        """The lens was not covered: never LOST, mapped surfaces in view at once, right at once."""
        sequence, result = tracked
        found = measures.recovery(result, sequence, 5, 2)
        assert found.frames_until_lost is None
        assert (found.mapped_from, found.frames_until_recovered, found.wrong_poses) == (7, 0, 0)


WAITING: dict[str, str] = {}
"""Scenarios whose stage is being built, and what they wait for; the suite says when one of them passes."""

# At 10 frames a second a walking person is seen too seldom: 1.02 % of its surfels are left, at 15 none.
SIZES = {"twin-rooms": Size(160, 120, 6.0, 1), "crossing": Size(160, 120, 15.0, 1)}
LONG = {"corridor"}
"""Not at small size: 36 m take a thousand frames."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.xfail(reason=WAITING[name], strict=False) if name in WAITING else ())
        for name, scenario in SCENARIOS.items()
        if not scenario.data and name not in LONG
    ],
)
def test_scenario(name: str) -> None:
    """Everything that a scenario asks for is reached, at 160x120 and 10 frames a second."""
    size = SIZES.get(name, replace(QUICK, fps=10.0, kidnaps=1))
    missed = [check for check in SCENARIOS[name].checks(size) if check.passed is False]
    assert not missed, "; ".join(f"{check.asked}: {check.reached}" for check in missed)
