"""Many scans: what agrees is put together, what does not belong is left out, and nothing is placed at a guess."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest

from scanweld.errors import ConfigError, FileFormatError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.many import ManyConfig, register_many
from scanweld.registration.pose_graph import PoseGraphConfig
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.scan_graph import Alignments, bridges, solve, tree_poses, triangle_votes, trustworthy

SIGMA = np.array([0.005] * 3 + [0.002] * 3)


def courtyard(count=3000):
    """Points of a bumpy round wall with a floor, radius about 4 m."""
    rng = np.random.default_rng(7)
    angle, height = rng.uniform(-np.pi, np.pi, count), rng.uniform(0, 2, count)
    radius = 4 + 0.4 * np.sin(3 * angle) + 0.25 * np.cos(7 * angle + 2 * height) + 0.2 * np.sin(4 * height + angle)
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    r, a = 3.8 * np.sqrt(rng.uniform(0, 1, count // 3)), rng.uniform(-np.pi, np.pi, count // 3)
    floor = np.stack([r * np.cos(a), r * np.sin(a), 0.15 * np.sin(2 * r) * np.cos(3 * a)], axis=1)
    return np.concatenate([wall, floor])


def scans_around(count=8, half_angle=1.2):
    """Scans of the parts of the courtyard that looks in `count` directions show, and T_world_scan (count, 4, 4)."""
    points = courtyard()
    rng = np.random.default_rng(1)
    poses = se3.exp(rng.normal(size=(count, 6)) * np.array([1.0, 1, 0.3, 0.2, 0.2, 2.0]))
    angle = np.arctan2(points[:, 1], points[:, 0])
    clouds = []
    for k, T in enumerate(poses):
        off = np.abs((angle - 2 * np.pi * k / count + np.pi) % (2 * np.pi) - np.pi)
        seen = points[off < half_angle]
        clouds.append(se3.transform_points(se3.inverse(T), seen[: len(seen) // 50 * 50 - k]))  # all sizes differ
    return clouds, poses


class KnownPairs:
    """Stands for an aligner: knows the poses, errs by its covariance, and lies where it is told to.

    Scans are told apart by their sizes.
    """

    def __init__(self, clouds, poses, *, reach=2, lies=()):
        self.sizes = {len(cloud): k for k, cloud in enumerate(clouds)}
        assert len(self.sizes) == len(clouds)
        self.poses, self.reach, self.lies = poses, reach, dict(lies)
        self.calls = []

    def __call__(self, source, target, T_init):
        j, i = self.sizes[len(source)], self.sizes[len(target)]
        self.calls.append((i, j))
        count = len(self.poses)
        near = min((i - j) % count, (j - i) % count) <= self.reach if max(i, j) < count else False
        if (i, j) in self.lies:
            return self.result(self.lies[i, j], Status.CONVERGED)
        if not near:
            return self.result(np.eye(4), Status.NO_OVERLAP)
        rng = np.random.default_rng([i, j])
        error = se3.exp(SIGMA * rng.normal(size=6))
        return self.result(error @ se3.inverse(self.poses[i]) @ self.poses[j], Status.CONVERGED)

    @staticmethod
    def result(T, status):
        return RegistrationResult(
            T_target_source=T,
            status=status,
            information=np.eye(6),
            covariance=np.diag(SIGMA**2),
            overlap=0.4,
            num_inliers=400,
            rmse_m=0.01,
        )


def errors(result, poses, scans):
    """Largest translation [m] and rotation [rad] error of some scans, seen from the first of them."""
    scans = list(scans)
    got = se3.inverse(result.T_world_scan[scans[0]]) @ result.T_world_scan[scans]
    off = se3.log(se3.inverse(se3.inverse(poses[scans[0]]) @ poses[scans]) @ got)
    return np.linalg.norm(off[:, :3], axis=1).max(), np.linalg.norm(off[:, 3:], axis=1).max()


WRONG = se3.exp([1.5, -1, 0.3, 0.2, 0.1, 1.5])


def test_scans_around_a_loop():
    clouds, poses = scans_around()
    align = KnownPairs(clouds, poses)
    result = register_many(clouds, align=align)
    assert sorted(align.calls[:28]) == [(i, j) for i in range(8) for j in range(i + 1, 8)]
    assert result.status is Status.CONVERGED
    assert result.components == (tuple(range(8)),)
    assert set(result.scan_status) == {Status.CONVERGED}
    np.testing.assert_array_equal(result.T_world_scan[0], np.eye(4))
    shift, turn = errors(result, poses, range(8))
    assert shift < 0.03
    assert turn < 0.01
    assert sum(pair.used for pair in result.pairs) == 16
    assert all(pair.used == pair.verified for pair in result.pairs)
    assert result.rmse_m == pytest.approx(0.01)
    assert result.note == ""
    # Uncertainty grows with the distance from the first scan, and is zero there.
    spread = np.sqrt(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2))
    assert spread[0] == 0
    assert 0 < spread[1] < spread[3]


def test_an_unrelated_scan_is_left_out():
    clouds, poses = scans_around()
    rng = np.random.default_rng(0)
    clouds.insert(3, rng.uniform(-1, 1, (333, 3)))  # a box of points
    known = KnownPairs([c for k, c in enumerate(clouds) if k != 3], poses)

    def align(source, target, T_init):
        if 333 in (len(source), len(target)):
            return KnownPairs.result(np.eye(4), Status.NO_OVERLAP)
        return known(source, target, T_init)

    result = register_many(clouds, align=align)
    assert result.status is Status.NO_OVERLAP
    assert result.components == ((0, 1, 2, 4, 5, 6, 7, 8), (3,))
    assert result.scan_status[3] is Status.NO_OVERLAP
    assert "scans 3 connect to no other" in result.note
    np.testing.assert_array_equal(result.T_world_scan[3], np.eye(4))
    expected = np.insert(poses, 3, np.eye(4), axis=0)
    assert errors(result, expected, (0, 1, 2, 4, 5, 6, 7, 8))[0] < 0.03


@pytest.mark.parametrize("wrong", [(2, 3), (0, 4)])
def test_a_wrong_pair_is_dropped(wrong):
    """Between neighbours, where the true alignment is missing then, and between scans that share nothing."""
    clouds, poses = scans_around()
    result = register_many(clouds, align=KnownPairs(clouds, poses, lies={wrong: WRONG}.items()))
    assert result.status is Status.CONVERGED
    pair = next(pair for pair in result.pairs if (pair.target, pair.source) == wrong)
    assert pair.result.status is Status.CONVERGED
    assert not pair.used
    assert pair.chi2 > 100
    assert pair.triangles_closed == 0
    assert sum(pair.used for pair in result.pairs) == (15 if wrong == (2, 3) else 16)
    assert errors(result, poses, range(8))[0] < 0.03
    assert str(wrong) in result.note


def test_many_wrong_pairs_are_dropped():
    """Eight pairs lie, each its own lie, of 24 that claim to be aligned."""
    clouds, poses = scans_around()
    rng = np.random.default_rng(5)
    lies = {
        pair: se3.exp(rng.normal(size=6)) for pair in [(0, 3), (0, 4), (1, 4), (1, 5), (2, 6), (3, 7), (2, 7), (2, 5)]
    }
    result = register_many(clouds, align=KnownPairs(clouds, poses, lies=lies.items()))
    assert result.status is Status.CONVERGED
    assert not any(pair.used for pair in result.pairs if (pair.target, pair.source) in lies)
    assert sum(pair.used for pair in result.pairs) == 16
    assert errors(result, poses, range(8))[0] < 0.03


def test_where_nobody_can_tell_which_pair_is_wrong_neither_is_believed():
    """A ring of four, each aligned with its neighbours only, one of them wrong: the ring does not close.

    One alignment is at odds with the three others together, and any of the four could be the one. Nothing connects.
    """
    clouds, poses = scans_around(4, half_angle=1.3)
    result = register_many(clouds, align=KnownPairs(clouds, poses, reach=1, lies={(1, 2): WRONG}.items()))
    assert result.status is Status.NO_OVERLAP
    assert len(result.components) == 4
    assert not any(pair.used for pair in result.pairs)
    assert "contradict" in result.note


def test_a_scan_that_is_aligned_everywhere_else_is_left_out():
    """An unrelated scan that an aligner takes for part of the place with every other scan, half of the time alike."""
    clouds, poses = scans_around()
    place, rng = poses[0], np.random.default_rng(4)
    lies = {(k, 8): se3.inverse(poses[k]) @ place if k % 2 else se3.exp(rng.normal(size=6)) for k in range(8)}
    stray = clouds[0][:777]
    align = KnownPairs([*clouds, stray], [*poses, np.eye(4)], lies=lies.items())
    align.poses = poses
    result = register_many([*clouds, stray], align=align)
    assert result.components == (tuple(range(8)), (8,))
    assert result.scan_status[8] is Status.NO_OVERLAP
    assert errors(result, np.concatenate([poses, np.eye(4)[None]]), range(8))[0] < 0.03


def test_groups_that_do_not_connect_have_worlds_of_their_own():
    """Scans 0-3 and 4-7 see two rooms; scan 7 holds three points, too few to say anything."""
    clouds, poses = scans_around()

    class TwoRooms(KnownPairs):
        def __call__(self, source, target, T_init):
            j, i = self.sizes[len(source)], self.sizes[len(target)]
            if (i < 4) != (j < 4):
                return self.result(np.eye(4), Status.NO_OVERLAP)
            return super().__call__(source, target, T_init)

    clouds[7] = clouds[7][:3]
    result = register_many(clouds, align=TwoRooms(clouds, poses))
    assert result.components == ((0, 1, 2, 3), (4, 5, 6), (7,))
    assert result.status is Status.NO_OVERLAP
    assert result.scan_status[:7] == (Status.CONVERGED,) * 7
    assert result.scan_status[7] is Status.TOO_FEW_CORRESPONDENCES
    for first in (0, 4, 7):
        np.testing.assert_array_equal(result.T_world_scan[first], np.eye(4))
    assert errors(result, poses, range(4))[0] < 0.03
    assert errors(result, poses, range(4, 7))[0] < 0.03
    assert "2 groups" in result.note
    assert all(7 not in (pair.target, pair.source) for pair in result.pairs)


def test_a_pair_alone_is_used_and_said_to_be_unconfirmed():
    clouds, poses = scans_around()
    chain = KnownPairs(clouds[:3], poses[:3], reach=3, lies=())
    chain.lies = {}

    def align(source, target, T_init):
        i, j = chain.sizes[len(target)], chain.sizes[len(source)]
        return chain(source, target, T_init) if j - i == 1 else KnownPairs.result(np.eye(4), Status.NO_OVERLAP)

    result = register_many(clouds[:3], align=align, config=ManyConfig(rounds=0))
    assert result.status is Status.CONVERGED
    assert [(pair.used, pair.verified) for pair in result.pairs] == [(True, False), (False, False), (True, False)]
    assert "no other confirms: (0, 1), (1, 2)" in result.note


def test_of_many_scans_only_near_ones_are_tried_until_poses_say_more():
    """Twelve scans in the order of a walk: neighbours first; where the walk closes, the poses tell which to add."""
    clouds, poses = scans_around(12)
    align = KnownPairs(clouds, poses)
    result = register_many(clouds, align=align, config=ManyConfig(all_pairs_up_to=5, window=1))
    first = [(k, k + 1) for k in range(11)]
    assert align.calls[:11] == first
    assert (0, 11) in align.calls[11:]
    assert (0, 2) in align.calls[11:]
    assert result.status is Status.CONVERGED
    assert all(pair.verified for pair in result.pairs if pair.used)
    assert errors(result, poses, range(12))[0] < 0.05


def test_each_scan_is_prepared_once_and_the_caller_keeps_its_arrays():
    clouds, poses = scans_around()
    before = [cloud.copy() for cloud in clouds]
    known, prepared = KnownPairs(clouds, poses), []

    def prepare(cloud):
        assert isinstance(cloud, PointCloud)
        prepared.append(len(cloud))
        return cloud.points_m

    result = register_many(clouds, align=known, prepare=prepare)
    assert prepared == [len(cloud) for cloud in clouds]
    again = register_many(clouds, align=KnownPairs(clouds, poses))
    assert result.T_world_scan.tobytes() == again.T_world_scan.tobytes()
    assert all(np.array_equal(a, b) for a, b in zip(before, clouds, strict=True))


def test_real_alignments_from_rough_guesses():
    """Point-to-plane ICP from guesses that are off by centimetres and degrees; the points are sampled anew per scan."""
    rng = np.random.default_rng(3)
    poses = se3.exp(rng.normal(size=(5, 6)) * np.array([1.0, 1, 0.3, 0.2, 0.2, 2.0]))
    wall = courtyard(60_000)
    angle = np.arctan2(wall[:, 1], wall[:, 0])
    clouds = []
    for k, T in enumerate(poses):
        off = np.abs((angle - 2 * np.pi * k / 5 + np.pi) % (2 * np.pi) - np.pi)
        rows = rng.choice(np.flatnonzero(off < 1.3), 4000, replace=False)
        noisy = wall[rows] + 0.003 * rng.normal(size=(4000, 3))
        clouds.append(se3.transform_points(se3.inverse(T), noisy))
    guesses = poses @ se3.exp(rng.normal(size=(5, 6)) * np.array([0.04] * 3 + [0.015] * 3))

    def align(source, target, T_init):
        config = IcpConfig(method="point-to-plane", max_correspondence_distance_m=0.3)
        return icp(source, target, T_init=T_init, config=config)

    result = register_many(clouds, T_init=guesses, align=align)
    assert result.status is Status.CONVERGED, result.note
    assert result.components == ((0, 1, 2, 3, 4),)
    shift, turn = errors(result, poses, range(5))
    assert shift < 0.01
    assert turn < 0.003
    assert all(pair.verified for pair in result.pairs)


# --- the parts -------------------------------------------------------------------------------------------------------


def alignments_of(ends, poses, wrong=()):
    T = np.stack([se3.inverse(poses[i]) @ poses[j] for i, j in ends])
    for k in wrong:
        T[k] = T[k] @ WRONG
    information = np.broadcast_to(np.diag(1 / SIGMA**2), (len(ends), 6, 6))
    return Alignments(np.array(ends), T, information, np.arange(len(ends), dtype=float))


def test_triangles_vote():
    """Four scans, all six pairs: each pair is in two triangles. The wrong pair breaks both of its own."""
    poses = se3.exp(np.random.default_rng(0).normal(size=(4, 6)))
    ends = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    triangles, closed = triangle_votes(alignments_of(ends, poses, wrong=[0]), 24.0)
    np.testing.assert_array_equal(triangles, 2)
    # (0, 1) is in 012 and 013. The other four sides of these lose one vote, the opposite side (2, 3) keeps both.
    np.testing.assert_array_equal(closed, [0, 1, 1, 1, 1, 2])


def test_the_tolerance_of_a_triangle_is_the_sum_of_its_covariances():
    """Three translations with variance 1 along x: chi-square of a gap g is g^2 / 3."""
    T = np.tile(np.eye(4), (3, 1, 1))
    T[2, 0, 3] = 6.0
    alignments = Alignments(np.array([(0, 1), (1, 2), (0, 2)]), T, np.tile(np.eye(6), (3, 1, 1)), np.ones(3))
    for limit, votes in ((11.9, 0), (12.1, 1)):
        np.testing.assert_array_equal(triangle_votes(alignments, limit)[1], votes)


def test_tree_poses_follow_the_votes():
    poses = se3.exp(np.random.default_rng(0).normal(size=(4, 6)))
    alignments = alignments_of([(0, 1), (0, 2), (1, 2)], poses, wrong=[0])
    got = tree_poses(alignments, np.array([0, 1, 1]), 4)
    np.testing.assert_allclose(got[:3], se3.inverse(poses[0]) @ poses[:3], atol=1e-12)
    np.testing.assert_array_equal(got[3], np.eye(4))


def test_bridges_and_what_contradicts_them():
    """0-1-2 is a triangle, 2-3 a bridge, 3-4 another; a rejected pair (0, 3) speaks against the first one only.

    Scan 0 has two kept pairs and one rejected one, and may stay; 3 and 4 hold each other.
    """
    ends = np.array([(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (0, 3)])
    assert sorted(bridges(ends[:5], 5)) == [3, 4]
    kept = np.array([True] * 5 + [False])
    np.testing.assert_array_equal(trustworthy(ends, kept, 5), [True, True, True, False, True, False])


def test_a_scan_whose_pairs_disagree_is_dropped_and_the_others_stay():
    """Scans 0-3 with all six pairs; scan 4 claims two places: with 0 and 1 (kept), with 2 and 3 (rejected)."""
    ends = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (0, 4), (1, 4), (2, 4), (3, 4)])
    kept = np.arange(10) < 8
    np.testing.assert_array_equal(trustworthy(ends, kept, 5), np.arange(10) < 6)
    kept = np.arange(10) < 9  # three against one: it stays
    np.testing.assert_array_equal(trustworthy(ends, kept, 5), kept)


def test_components_are_solved_together():
    poses = se3.exp(np.random.default_rng(0).normal(size=(5, 6)))
    alignments = alignments_of([(0, 2), (1, 4)], poses)
    start = tree_poses(alignments, np.zeros(2), 5)
    got, kept, covariance, loose = solve(alignments, start, PoseGraphConfig(), robust=False)
    assert kept.all()
    assert not loose.any()
    np.testing.assert_array_equal(got[[0, 1, 3]], np.tile(np.eye(4), (3, 1, 1)))
    np.testing.assert_allclose(got[4], se3.inverse(poses[1]) @ poses[4], atol=1e-9)
    np.testing.assert_allclose(covariance[2], np.diag(SIGMA**2), atol=1e-12)


def test_first_guesses_spare_the_search():
    """Poses that are off by 5 cm and a degree: each pair starts there, and ends at the truth."""
    clouds, poses = scans_around(3, half_angle=2.0)
    guesses = poses @ se3.exp(np.array([0.03, -0.03, 0.02, 0.01, -0.01, 0.01]))
    result = register_many(clouds, T_init=guesses)
    assert result.status is Status.CONVERGED
    translation_m, rotation_rad = errors(result, poses, range(3))
    assert translation_m < 0.01
    assert rotation_rad < 0.005


def test_an_alignment_that_leaves_a_motion_free_makes_the_whole_degenerate():
    clouds, poses = scans_around(2)
    known = KnownPairs(clouds, poses)

    def align(source, target, T_init):
        result = known(source, target, T_init)
        return replace(result, covariance=np.diag([0.0, *SIGMA[1:] ** 2]))

    assert register_many(clouds, align=align).status is Status.DEGENERATE


def test_what_the_caller_got_wrong_is_said():
    clouds, _ = scans_around()
    with pytest.raises(InvalidInputError, match="at least two scans"):
        register_many(clouds[:1])
    with pytest.raises(InvalidInputError, match="scan 1: expected points in 3-D"):
        register_many([clouds[0], clouds[1][:, :2]])
    with pytest.raises(InvalidInputError, match=r"T_init: expected shape \(8, 4, 4\)"):
        register_many(clouds, T_init=np.eye(4))
    with pytest.raises(InvalidInputError, match="not finite"):
        register_many(clouds, T_init=np.full((8, 4, 4), np.nan))
    with pytest.raises(ConfigError, match="window"):
        replace(ManyConfig(), window=0)


class Sent(ThreadPoolExecutor):
    """Stands for processes: whatever goes to a task and comes back is pickled on the way."""

    def __init__(self):
        super().__init__(max_workers=2)
        self.sent_bytes = []

    def submit(self, call, /, *arguments):
        parcel = pickle.dumps((call, arguments))
        self.sent_bytes.append(len(parcel))

        def unpacked():
            call, arguments = pickle.loads(parcel)
            return pickle.loads(pickle.dumps(call(*arguments)))

        return super().submit(unpacked)


@dataclass(frozen=True)
class Terrain:
    """A scan of 5 m around a place on a line 200 scans long, made where it is needed."""

    index: int

    def __call__(self):
        rng = np.random.default_rng(7)
        points = rng.uniform([-5, -5, 0], [2 * SCANS + 5, 5, 1], (30 * SCANS, 3))
        near = points[np.abs(points[:, 0] - 2 * self.index) < 5]
        return se3.transform_points(se3.inverse(self.pose), near)

    @property
    def pose(self):
        return se3.exp([2 * self.index, 0, 0, 0, 0, 0]) @ se3.exp([0, 0, 0, 0, 0, 0.1 * self.index])


SCANS = 200


def align_terrain(source, target, T_init):
    """Stand for an aligner that tells the scans by their first points, and errs by its covariance.

    What is more than 6 m apart it does not align.
    """
    rows = [
        terrain_rows()[tuple(np.round(np.linalg.norm(cloud.points_m[:2], axis=1), 6))] for cloud in (source, target)
    ]
    j, i = rows
    if abs(i - j) > 3:
        return KnownPairs.result(np.eye(4), Status.NO_OVERLAP)
    error = se3.exp(SIGMA * np.random.default_rng([i, j]).normal(size=6))
    T = error @ se3.inverse(Terrain(i).pose) @ Terrain(j).pose
    return KnownPairs.result(T, Status.CONVERGED)


def first_ranges(points):
    """How far the first two points are from the scanner [m]."""
    return tuple(np.round(np.linalg.norm(points[:2], axis=1), 6))


@lru_cache
def terrain_rows():
    """Return the number of each scan by its first ranges."""
    return {first_ranges(Terrain(k)()): k for k in range(SCANS)}


class TestExecutor:
    def test_hundreds_of_scans_in_tasks_come_to_the_same(self):
        """Scans are sent as what makes them: no task is sent any points."""
        scans = [Terrain(k) for k in range(SCANS)]
        with Sent() as executor:
            result = register_many(scans, align=align_terrain, executor=executor, num_threads=1)
        assert max(executor.sent_bytes) < 2000
        assert result.status is Status.CONVERGED
        assert result.components == (tuple(range(SCANS)),)
        same = register_many([scan() for scan in scans], align=align_terrain)
        np.testing.assert_array_equal(result.T_world_scan, same.T_world_scan)
        np.testing.assert_array_equal(result.covariance, same.covariance)
        assert [(pair.target, pair.source, pair.used) for pair in result.pairs] == [
            (pair.target, pair.source, pair.used) for pair in same.pairs
        ]
        # Headings add up 200 errors of 2 mrad, less where pairs overlap: 28 mrad, or 6.5 m after 400 m.
        truth = np.array([Terrain(k).pose for k in range(SCANS)])
        assert np.linalg.norm(result.T_world_scan[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 6.5

    def test_scans_in_files(self, tmp_path):
        clouds, poses = scans_around(4)
        files = [tmp_path / f"{k}.npy" for k in range(4)]
        for file, cloud in zip(files, clouds, strict=True):
            np.save(file, cloud)
        align = KnownPairs(clouds, poses)
        with Sent() as executor:
            result = register_many(files, align=align, executor=executor)
        np.testing.assert_array_equal(result.T_world_scan, register_many(clouds, align=align).T_world_scan)
        assert register_many([str(file) for file in files], align=align).status is Status.CONVERGED

    def test_what_a_task_raises_is_raised(self, tmp_path):
        with Sent() as executor, pytest.raises(FileFormatError, match=r"nowhere\.npy"):
            register_many([tmp_path / "nowhere.npy"] * 2, executor=executor)
        with Sent() as executor, pytest.raises(InvalidInputError, match="scan 1: expected points in 3-D, got 2-D"):
            register_many([np.zeros((20, 3)), np.zeros((20, 2))], executor=executor)
