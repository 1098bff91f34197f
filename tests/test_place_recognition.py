"""Places: found among many, verified, refused where they only look alike, and a lost camera's pose from them."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np
import pytest

import scanweld as sw
from rendered import blind, frame_of, plane_depth, pose_error, rendered
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.loop_closure.ferns import FernCode, FernConfig
from scanweld.loop_closure.keyframes import Keyframe, KeyframeConfig, Sighting, keyframe_of
from scanweld.loop_closure.place_recognition import KeyframeDatabase, PlaceConfig, words_of
from scanweld.loop_closure.place_verification import VerificationConfig, relocalise, verify_place
from scanweld.parallel import get_num_threads
from scanweld.registration.result import Status
from scanweld.tracking.image_features import FrameFeatures


def seen(frame: sw.Frame, database: KeyframeDatabase | None = None) -> Sighting:
    return (database or KeyframeDatabase()).sight(sw.build_pyramid(frame))


def kept(frame: sw.Frame) -> Keyframe:
    return keyframe_of(seen(frame), np.eye(4), index=0, frame_index=0)


def database_of(*sequences: tuple[str, int]) -> KeyframeDatabase:
    """Every tenth frame of rendered sequences (scene, number of frames), at their true poses."""
    database = KeyframeDatabase()
    for scene, count in sequences:
        sequence = rendered(scene, "kinect", count=count)
        for k in range(0, count, 10):
            T = sequence.ground_truth.T_world_camera[k]
            database.add(seen(sequence.frames[k], database), T, frame_index=k)
    return database


def without_colour(frame: sw.Frame) -> sw.Frame:
    return replace(frame, color=None)


def random_sighting(rng: np.random.Generator, ferns: int, features: int) -> Sighting:
    """A frame whose code and descriptors are dice."""
    code = FernCode(
        rng.integers(0, 3, ferns, dtype=np.uint8), rng.integers(0, 3, ferns, dtype=np.uint8), bool(rng.integers(2))
    )
    # Few different bytes, so that words are shared now and then.
    descriptors = rng.integers(0, 12, (features, 32), dtype=np.uint8)
    points = np.ones((features, 3))
    found = FrameFeatures(np.zeros((features, 2), np.float32), points, np.ones(features), descriptors)
    frame = frame_of(plane_depth((0, 0.3, 1), 2.0))
    return Sighting(sw.build_pyramid(frame), found, code)


Dice: TypeAlias = tuple[KeyframeDatabase, list[Sighting], Sighting]


@pytest.fixture(scope="module")
def dice() -> Dice:
    """140 keyframes, more than the first room to grow, with 0 to 40 features of which 25 are indexed; and a query."""
    rng = np.random.default_rng(3)
    config = PlaceConfig(keyframes=KeyframeConfig(ferns=FernConfig(count=60)), indexed_features=25)
    database = KeyframeDatabase(config)
    sightings = [random_sighting(rng, 60, int(rng.integers(0, 41))) for _ in range(140)]
    for k, sighting in enumerate(sightings):
        database.add(sighting, np.eye(4), frame_index=10 * k)
    return database, sightings, random_sighting(rng, 60, 35)


class TestDatabase:
    def test_similarity_is_the_share_of_equal_ferns(self, dice: Dice) -> None:
        database, sightings, query = dice
        expected = []
        for other in sightings:
            shares = [np.mean([a == b for a, b in zip(query.code.depth, other.code.depth, strict=True)])]
            if query.code.has_grey and other.code.has_grey:
                shares.append(np.mean([a == b for a, b in zip(query.code.grey, other.code.grey, strict=True)]))
            expected.append(np.mean(shares))
        np.testing.assert_allclose(database.similarities(query.code), expected)
        assert len(set(expected)) > 10

    def test_words_are_shared_as_sets_say(self, dice: Dice) -> None:
        """A word is 16 bits at their place in the descriptor; each of a keyframe's counts once for each feature."""
        database, sightings, query = dice

        def words(descriptors: np.ndarray) -> list[tuple[int, int, int]]:
            return [(w, *d[2 * w : 2 * w + 2]) for d in descriptors.tolist() for w in range(16)]

        present = set(words(query.features.descriptors))
        expected = [sum(word in present for word in words(s.features.descriptors[:25])) for s in sightings]
        np.testing.assert_array_equal(database.shared_words(query.features.descriptors), expected)
        assert 0 < np.median(expected) < 16 * 25

    def test_same_answer_at_any_thread_count(self, dice: Dice) -> None:
        database, _, query = dice
        before, answers = get_num_threads(), []
        try:
            for threads in (1, 2, 5):
                sw.set_num_threads(threads)
                answers.append(database.query(query, 140))
        finally:
            sw.set_num_threads(before)
        assert answers[0] == answers[1] == answers[2]

    def test_most_shared_words_first_then_similarity(self, dice: Dice) -> None:
        database, _, query = dice
        found = database.query(query, 140)
        keys = [(-c.shared_words, -c.similarity, c.index) for c in found]
        assert keys == sorted(keys)
        assert sorted(c.index for c in found) == list(range(140))
        assert database.query(query, 3) == found[:3]
        few = replace(query, features=seen(without_colour(frame_of(plane_depth((0, 0, 1), 2)))).features)
        by_ferns = database.query(few, 140)
        assert all(c.shared_words == 0 for c in by_ferns)
        assert [c.similarity for c in by_ferns] == sorted((c.similarity for c in found), reverse=True)

    def test_only_what_is_allowed(self, dice: Dice) -> None:
        database, _, query = dice
        allowed = np.arange(140) % 7 == 3
        assert {c.index for c in database.query(query, 140, allowed=allowed)} == set(np.flatnonzero(allowed))

    def test_words_of_a_descriptor(self) -> None:
        """Two bytes a word, the low one first: bytes 0, 1, 2, 3 are the words 256 and 3 * 256 + 2."""
        words = words_of(np.arange(32, dtype=np.uint8)[None])
        assert words.shape == (1, 16)
        assert words[0, 0] == 256
        assert words[0, 1] == 3 * 256 + 2

    def test_move(self) -> None:
        database = database_of(("room", 40))
        poses = np.stack([np.eye(4)] * len(database))
        poses[:, 0, 3] = np.arange(len(database))
        database.move(poses)
        assert [k.T_world_camera[0, 3] for k in database.keyframes] == list(range(len(database)))
        with pytest.raises(InvalidInputError, match="poses for"):
            database.move(poses[:1])

    def test_empty(self) -> None:
        database = KeyframeDatabase()
        frame = rendered("room", "kinect", count=40).frames[0]
        assert database.query(seen(frame)) == []
        assert not relocalise(seen(frame), database).found
        assert database.reason(sw.build_pyramid(frame), np.eye(4)) == "the first"

    @pytest.mark.parametrize("setting", [{"indexed_features": 0}, {"min_features": 0}])
    def test_settings_out_of_range(self, setting: dict[str, int]) -> None:
        with pytest.raises(ConfigError, match=next(iter(setting))):
            PlaceConfig(**setting)


class TestRecognition:
    @pytest.mark.parametrize("colour", [True, False])
    def test_the_right_place_comes_first(self, colour: bool) -> None:
        """Two scenes in one memory: the candidate is of the frame's scene, and shares most of the view."""
        scenes = (("room", 40), ("corridor", 40))
        database = KeyframeDatabase()
        for scene, count in scenes:
            for k in range(0, count, 10):
                frame = rendered(scene, "kinect", count=count).frames[k]
                database.add(seen(frame if colour else without_colour(frame)), np.eye(4), frame_index=k)
        for scene, first in (("room", 0), ("corridor", 4)):
            for k in (5, 17, 34):
                frame = rendered(scene, "kinect", count=40).frames[k]
                best = database.query(seen(frame if colour else without_colour(frame)), 1)[0]
                assert 0 <= best.index - first < 4
                assert abs(10 * (best.index - first) - k) <= 20

    def test_reason_sees_all_keyframes(self) -> None:
        """A place that is known needs no keyframe, however old the one that shows it; another scene does."""
        database = database_of(("room", 40))
        last = database[len(database) - 1].T_world_camera
        again = rendered("room", "kinect", count=40).frames[1]
        assert database.reason(sw.build_pyramid(again), last) == ""
        elsewhere = rendered("corridor", "kinect", count=40).frames[0]
        assert "unlike" in database.reason(sw.build_pyramid(elsewhere), last)


class TestVerification:
    @pytest.mark.parametrize("colour", [True, False])
    @pytest.mark.parametrize(("scene", "gap"), [("room", 10), ("room", 25), ("corridor", 10)])
    def test_right_within_a_centimetre(self, scene: str, gap: int, colour: bool) -> None:
        sequence = rendered(scene, "kinect", count=40)
        T = sequence.ground_truth.T_world_camera
        a, b = (f if colour else without_colour(f) for f in (sequence.frames[2 + gap], sequence.frames[2]))
        result = verify_place(seen(a), kept(b))
        assert result.status is Status.CONVERGED
        shift_m, turn_deg = pose_error(result.T_target_source, np.linalg.inv(T[2]) @ T[2 + gap])
        assert shift_m < 0.01
        assert turn_deg < 0.5

    def test_exposure_does_not_matter(self) -> None:
        sequence = rendered("room", "kinect", count=40)
        T = sequence.ground_truth.T_world_camera
        frame = sequence.frames[15]
        darker = replace(frame, color=(0.55 * frame.color.astype(np.float64)).astype(np.uint8))
        result = verify_place(seen(darker), kept(sequence.frames[0]))
        assert result.status is Status.CONVERGED
        assert pose_error(result.T_target_source, np.linalg.inv(T[0]) @ T[15])[0] < 0.01

    def test_covariance_covers_the_error(self) -> None:
        """Squared Mahalanobis distances of six parameters are 6 on average; the claim is made with room to spare."""
        sequence = rendered("room", "kinect", count=40)
        T, distances = sequence.ground_truth.T_world_camera, []
        for k in (4, 8, 12, 16, 20):
            result = verify_place(seen(sequence.frames[k]), kept(sequence.frames[0]))
            error = sw.se3.log(result.T_target_source @ np.linalg.inv(np.linalg.inv(T[0]) @ T[k]))
            distances.append(error @ np.linalg.solve(result.covariance, error))
            np.testing.assert_allclose(
                result.covariance @ result.information, VerificationConfig().variance_scale * np.eye(6), atol=1e-4
            )
        assert 0.05 < np.mean(distances) < 12

    @pytest.mark.parametrize("colour", [True, False])
    def test_another_scene_is_refused(self, colour: bool) -> None:
        room, corridor = (rendered(s, "kinect", count=40).frames for s in ("room", "corridor"))
        for k in (0, 13, 39):
            a, b = (f if colour else without_colour(f) for f in (room[k], corridor[39 - k]))
            for source, target in ((a, b), (b, a)):
                result = verify_place(seen(source), kept(target))
                assert not result.status.success
                assert result.covariance is None
                assert result.note

    def test_the_same_shape_with_other_paint_is_refused(self) -> None:
        """A corner of another room: depth fits exactly, nothing on the walls does."""
        frame = rendered("room", "kinect", count=40).frames[0]
        noise = cv2.GaussianBlur(np.random.default_rng(5).standard_normal(frame.depth_m.shape), (0, 0), 1.5)
        paint = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
        other = replace(frame, color=np.repeat(paint[..., None], 3, axis=2))
        refused = verify_place(seen(other), kept(frame))
        assert refused.status is Status.NO_OVERLAP
        assert "agree on a motion" in refused.note  # hundreds of features speak against it: no dense alignment is tried
        assert verify_place(seen(other), kept(other)).status.success

    @pytest.mark.parametrize("paint", ["none", "spots", "tiles"])
    def test_a_wall_is_a_place_only_by_its_paint(self, paint: str) -> None:
        """Depth leaves three directions of a wall free. Only paint can hold them, if it does not repeat: after a step
        of 12 pixels tiles of 5 pixels look the same in many places.
        """
        rng = np.random.default_rng(6)
        height, width = plane_depth((0, 0, 1), 1.3125).shape
        spots = cv2.GaussianBlur(rng.standard_normal((height, width + 20)), (0, 0), 1.5)
        v, u = np.mgrid[:height, : width + 20]
        tiles = ((u // 5) + (v // 5)) % 2 * 2.0 - 1
        contrast = {"none": 0.0 * spots, "spots": 40 * spots / spots.std(), "tiles": 40 * tiles}[paint]
        grey = np.clip(128 + contrast, 0, 255).astype(np.uint8)
        walls = []
        for shift in (0, 12):
            depth = plane_depth((0, 0, 1), 1.3125) + rng.normal(0, 0.002, (height, width))
            color = np.repeat(grey[:, shift : shift + width, None], 3, axis=2)
            walls.append(replace(frame_of(depth), color=np.ascontiguousarray(color)))
        result = verify_place(seen(walls[1]), kept(walls[0]))
        assert result.status.success is (paint == "spots")
        if paint == "spots":  # 131.25 / 1.3125 m is 100 pixels a metre: 12 pixels are 12 cm to the right
            shift_m, turn_deg = pose_error(result.T_target_source, sw.se3.exp(np.array([0.12, 0, 0, 0, 0, 0])))
            assert shift_m < 0.01
            assert turn_deg < 0.5
        if paint == "none":
            assert result.unobservable

    def test_blank_frames(self) -> None:
        frame = rendered("room", "kinect", count=40).frames[0]
        assert not verify_place(seen(blind(frame)), kept(frame)).status.success
        assert not verify_place(seen(frame), kept(blind(frame))).status.success

    @pytest.mark.parametrize("setting", [{"candidates": 0}, {"variance_scale": 0.0}])
    def test_settings_out_of_range(self, setting: dict[str, float]) -> None:
        with pytest.raises(ConfigError, match=next(iter(setting))):
            VerificationConfig(**setting)


class TestRelocalise:
    def test_a_lost_camera_finds_its_pose(self) -> None:
        database = database_of(("corridor", 40), ("room", 40))
        sequence = rendered("room", "kinect", count=40)
        for k in (4, 15, 36):
            found = relocalise(seen(sequence.frames[k]), database)
            assert found.found
            assert found.keyframe >= 4
            assert found.tried[-1] == found.keyframe
            shift_m, turn_deg = pose_error(found.T_world_camera, sequence.ground_truth.T_world_camera[k])
            assert shift_m < 0.01
            assert turn_deg < 0.5

    def test_a_place_that_is_not_remembered(self) -> None:
        database = database_of(("corridor", 40))
        found = relocalise(seen(rendered("room", "kinect", count=40).frames[0]), database)
        assert not found.found
        assert found.keyframe == -1
        assert found.T_world_camera is None
        assert len(found.tried) == len(database)
        assert found.result.note

    def test_blank_frames_are_never_kept_nor_found(self) -> None:
        database = database_of(("room", 40))
        frame = blind(rendered("room", "kinect", count=40).frames[0])
        found = relocalise(seen(frame), database)
        assert not found.found
        assert found.tried == ()
        assert "0.0%" in found.result.note
        assert database.reason(sw.build_pyramid(frame), np.eye(4)) == ""
        with pytest.raises(InvalidInputError, match="min_usable"):
            database.add(seen(frame), np.eye(4), frame_index=40)
        assert len(database) == 4
