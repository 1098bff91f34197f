"""Pages follow corrections when they are next used, and come to where they would have been moved at once."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scanweld as sw
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.mapping.mapper import PAGES_A_FRAME, SurfelMapper
from scanweld.mapping.rendering import find_candidates
from scanweld.mapping.storage.corrections import Meetings, farthest_moves
from scanweld.mapping.surfel_map import SurfelMap

CAMERA = PinholeCamera(60.0, 60.0, 39.5, 29.5, 80, 60)


def scattered(count: int, seed: int = 0, extent_m: float = 4.0) -> SurfelMap:
    """Surfels of ten keyframes, each keyframe's in a corner of its own with some of all others."""
    rng, surfels = np.random.default_rng(seed), SurfelMap()
    for anchor in range(10):
        positions = rng.uniform(-extent_m, extent_m, (3, count)).astype(np.float32)
        normals = rng.normal(size=(3, count))
        normals = (normals / np.linalg.norm(normals, axis=0)).astype(np.float32)
        ones = np.ones(count, np.float32)
        surfels.append(positions, normals, np.tile(100 * ones, (3, 1)), 0.01 * ones, 9 * ones, anchor, anchor)
    return surfels


def motion(seed: int, size: float = 0.3) -> sw.MapCorrection:
    """Move seven of the ten keyframes, each in its own way."""
    rng = np.random.default_rng(seed)
    ids = np.sort(rng.choice(10, 7, replace=False)).astype(np.int32)
    return sw.MapCorrection(ids, np.stack([se3.exp(rng.normal(0, size, 6)) for _ in ids]))


def expected(surfels: SurfelMap, corrections: list[sw.MapCorrection]) -> np.ndarray:
    """Rows of anchor, position, normal after the corrections, one at a time in float64, sorted."""
    positions, normals, anchors = surfels.positions_m.astype(float), surfels.normals.astype(float), surfels.anchors
    for correction in corrections:
        for anchor, T in zip(correction.keyframe_ids, correction.T_new_old, strict=True):
            mine = anchors == anchor
            positions[:, mine] = T[:3, :3] @ positions[:, mine] + T[:3, 3:]
            normals[:, mine] = T[:3, :3] @ normals[:, mine]
    return in_order(positions, normals, anchors)


def in_order(positions: np.ndarray, normals: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    rows = np.concatenate([anchors[None], positions, normals]).T
    return rows[np.lexsort((np.round(rows[:, 1], 3), rows[:, 0]))]


class TestFollowing:
    def test_all_at_once(self) -> None:
        surfels, correction = scattered(300), motion(1)
        wanted = expected(surfels, [correction])
        surfels.apply_correction(correction)
        found = in_order(surfels.positions_m, surfels.normals, surfels.anchors)
        np.testing.assert_allclose(found, wanted, atol=2e-6)

    def test_some_pages_after_each_correction_and_all_in_the_end(self) -> None:
        """The third correction finds pages that have followed two, one and none."""
        surfels, corrections = scattered(300), [motion(k) for k in range(3)]
        wanted = expected(surfels, corrections)
        for k, correction in enumerate(corrections):
            surfels.apply_correction(correction)
            live = surfels.pages.live
            surfels.pages.use(live[k :: 3 + k])
        assert len(set(surfels.pages.epochs[surfels.pages.live].tolist())) > 2
        found = in_order(surfels.positions_m, surfels.normals, surfels.anchors)
        np.testing.assert_allclose(found, wanted, atol=4e-6)
        assert (surfels.pages.epochs[surfels.pages.live] == len(surfels.pages.corrections)).all()

    def test_noting_touches_no_surfel(self) -> None:
        surfels = scattered(300)
        before = surfels.pages.pool.copy()
        surfels.apply_correction(motion(0))
        np.testing.assert_array_equal(surfels.pages.pool, before)

    def test_corrections_that_all_have_followed_are_forgotten(self) -> None:
        surfels = scattered(100)
        for k in range(20):
            surfels.apply_correction(motion(k, 0.01))
            surfels.pages.follow(surfels.capacity)
        assert len(surfels.pages.corrections) == 1

    def test_with_each_frame_some_more(self) -> None:
        """A mapper that fuses frames elsewhere has moved all of a map of 800 pages after as many frames as it takes."""
        mapper = SurfelMapper()
        mapper.map = scattered(400, extent_m=6.0)
        correction = motion(5, 0.01)
        wanted = expected(mapper.map, [correction])
        mapper.apply(correction)
        behind = []
        for k in range(-(-mapper.map.pages.capacity // PAGES_A_FRAME)):
            frame = sw.Frame(float(k), np.zeros(CAMERA.shape, np.float32), None, CAMERA)
            mapper.fuse(sw.build_pyramid(frame), se3.exp([0, 0, 100, 0, 0, 0]))
            pages = mapper.map.pages
            behind.append(np.count_nonzero(pages.epochs[pages.live] < len(pages.corrections)))
        assert behind[0] > 1000
        assert all(a >= b for a, b in pairwise(behind))
        assert behind[-1] == 0
        assert len(mapper.map) == len(wanted)
        found = in_order(mapper.map.positions_m, mapper.map.normals, mapper.map.anchors)
        np.testing.assert_allclose(found, wanted, atol=2e-6)

    def test_what_is_new_is_not_moved(self) -> None:
        """Surfels that are added between a correction and the first look at a place stay where they were put."""
        surfels = SurfelMap()
        ones = np.ones((3, 50), np.float32)
        old = np.random.default_rng(0).uniform(0, 0.2, (3, 50)).astype(np.float32)
        surfels.append(old, ones, ones, ones[0], ones[0], 0, 0)
        T = se3.exp([0.05, 0, 0, 0, 0, 0])
        surfels.apply_correction(sw.MapCorrection(np.array([0], np.int32), T[None]))
        surfels.append(old, ones, ones, ones[0], ones[0], 1, 0)
        x = np.sort(surfels.positions_m[0])
        np.testing.assert_allclose(x, np.sort(np.concatenate([old[0], old[0] + np.float32(0.05)])), atol=1e-6)


@given(st.integers(0, 2**31), st.floats(0.0, 1.0))
@settings(max_examples=30)
def test_no_page_is_missed_that_a_correction_brings_into_view(seed: int, size: float) -> None:
    """Whoever looks before pages have moved gets all that are in view afterwards."""
    rng = np.random.default_rng(seed)
    surfels, pose = scattered(60, seed), se3.exp(rng.normal(0, 1, 6))
    for k in range(2):
        surfels.apply_correction(motion(seed + k, size))
    found = find_candidates(surfels, pose, CAMERA)
    surfels.pages.follow(surfels.capacity)
    assert np.isin(find_candidates(surfels, pose, CAMERA), found).all()


@given(st.integers(0, 2**31), st.floats(0.0, 2.0))
@settings(max_examples=50)
def test_no_point_of_a_box_moves_further_than_is_said(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    motions = np.stack([se3.exp(rng.normal(0, size, 6)) for _ in range(4)])
    low = rng.uniform(-20, 20, (5, 3))
    boxes = np.concatenate([low, low + rng.uniform(0, 3, (5, 3))], axis=1).astype(np.float32)
    farthest = farthest_moves(motions, boxes)
    for box, most in zip(boxes.astype(float), farthest, strict=True):
        points = box[:3] + rng.uniform(0, 1, (100, 3)) * (box[3:] - box[:3])
        moved = np.einsum("aij,nj->ani", motions[:, :3, :3], points) + motions[:, None, :3, 3] - points
        assert np.linalg.norm(moved, axis=-1).max() <= most + 1e-9


class TestMeetings:
    def test_ranges_of_several_times(self) -> None:
        met = Meetings()
        met.add(np.array([7, 3]), np.zeros((4, 2)), np.zeros((4, 2)))
        assert met.among(5, 0.002).tolist() == []
        met.add(np.array([3]), np.array([[9.0], [0], [0.01], [0]]), np.array([[9.0], [0], [0.01], [0]]))
        assert met.cells.tolist() == [3, 7]
        assert met.among(5, 0.002).tolist() == [3]
        assert met.among(10, 0.002).tolist() == []

    @pytest.mark.parametrize(("gap", "moved_m"), [(0.0, 0.01), (9.0, 0.001)], ids=["one pass", "moved alike"])
    def test_what_is_none(self, gap: float, moved_m: float) -> None:
        met = Meetings()
        met.add(np.array([3]), np.zeros((4, 1)), np.array([[gap], [moved_m], [0], [0]]))
        assert met.among(5, 0.002).tolist() == []

    def test_dealt_with_until_something_comes_again(self) -> None:
        met, ranges = Meetings(), np.array([[9.0], [0.01], [0], [0]])
        met.add(np.array([3]), np.zeros((4, 1)), ranges)
        met.dealt_with(3)
        assert met.among(5, 0.002).tolist() == []
        met.add(np.array([3]), ranges, ranges)
        assert met.among(5, 0.002).tolist() == [3]

    def test_a_new_correction_keeps_what_waits(self) -> None:
        met, ranges = Meetings(), np.array([[9.0, 9.0], [0.01, 0.01], [0, 0], [0, 0]])
        met.add(np.array([3, 4]), np.zeros((4, 2)), ranges)
        met.dealt_with(3)
        met.begin()
        assert met.cells.tolist() == met.among(5, 0.002).tolist() == [4]
