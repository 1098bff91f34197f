"""Frame-to-model tracking and the alignment of two frames: frames of reference, selection, and honest answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, blind, frame_of, plane_depth, pose_error, rendered
from scanweld.datasets.synthetic import NOISE_MODELS, degrade_depth
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.registration.projective import align_projective


def map_of(sequence: object, stop: int) -> sw.SurfelMapper:
    mapper = sw.SurfelMapper()
    for k in range(stop):
        mapper.fuse(sw.build_pyramid(sequence.frames[k]), sequence.ground_truth.T_world_camera[k])
    return mapper


def of_confidence(view: sw.ModelView, confidences: np.ndarray) -> sw.ModelView:
    """Return the same view with other confidences (N,)."""
    return sw.ModelView(
        view.T_world_camera, view.camera, view.positions_m, view.normals, confidences, view.index_map,
        view.stable_confidence, view.intensities,
    )  # fmt: skip


def random_start(rng: np.random.Generator, shift_m: float, turn_deg: float) -> np.ndarray:
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    start = se3.exp([0, 0, 0, *np.radians(turn_deg) * axes[0]])
    start[:3, 3] = shift_m * axes[1]
    return start


class TestTracker:
    @pytest.mark.parametrize(("noise", "bound_m"), [("none", 1e-3), ("kinect", 4e-3)])
    def test_finds_the_camera_in_the_world(self, noise: str, bound_m: float) -> None:
        sequence = rendered(noise=noise, count=40)
        mapper, true = map_of(sequence, 10), sequence.ground_truth.T_world_camera[10]
        guess = true @ se3.exp([0.02, -0.02, 0.01, 0.01, 0.02, -0.01])
        result = sw.FrameToModelTracker().track(
            sw.build_pyramid(sequence.frames[10]), mapper.view(guess, CAMERA), guess
        )
        assert result.status is sw.Status.CONVERGED
        shift, turn = pose_error(result.T_target_source, true)
        assert shift < bound_m
        assert turn < 0.1

    def test_information_is_that_of_the_camera_in_the_world(self) -> None:
        """T_cw <- exp(xi) T_cw is T_wc <- exp(eta) T_wc with xi = -Ad(T_cw) eta, so H_eta = Ad^T H_xi Ad; the sign
        drops out. Checked on the definition: exp(-Ad eta) T_cw is the inverse of exp(eta) T_wc."""
        sequence = rendered(count=40)
        mapper, guess = map_of(sequence, 5), sequence.ground_truth.T_world_camera[5]
        view, pyramid = mapper.view(guess, CAMERA), sw.build_pyramid(sequence.frames[5])
        tracker = sw.FrameToModelTracker(sw.TrackingConfig(photometry="off"))
        tracked = tracker.track(pyramid, view, guess)
        positions_m, normals = (side[:, tracker._select(view)] for side in (view.positions_m, view.normals))
        config = tracker.config.projective
        aligned = align_projective(positions_m, normals, pyramid.levels, se3.inverse(guess), config)
        T_wc, T_cw = tracked.T_target_source, aligned.T_target_source
        np.testing.assert_allclose(T_wc @ T_cw, np.eye(4), atol=1e-12)
        for eta in 1e-4 * np.eye(6):
            xi = se3.log(np.linalg.inv(se3.exp(eta) @ T_wc) @ np.linalg.inv(T_cw))
            assert eta @ tracked.information @ eta == pytest.approx(xi @ aligned.information @ xi, rel=1e-3)

    def test_does_not_depend_on_the_world_frame(self) -> None:
        sequence, T = rendered(count=40), se3.exp([0.4, -0.8, 0.3, 0.5, -1.0, 2.0])
        poses, pyramid = sequence.ground_truth.T_world_camera, sw.build_pyramid(sequence.frames[12])
        answers = []
        for world in (np.eye(4), T):
            mapper = sw.SurfelMapper()
            for k in range(10):
                mapper.fuse(sw.build_pyramid(sequence.frames[k]), world @ poses[k])
            guess = world @ poses[11]
            answers.append(sw.FrameToModelTracker().track(pyramid, mapper.view(guess, CAMERA), guess).T_target_source)
        shift, turn = pose_error(answers[1], T @ answers[0])
        assert shift < 3e-4
        assert turn < 0.02

    @pytest.mark.parametrize(
        "offsets",
        [
            ((0.05, 3), (0.1, 0), (0.2, 0), (0, 5)),
            pytest.param(
                ((0, 15), (0.5, 0), (1.0, 0), (0.3, 20)),
                marks=pytest.mark.xfail(
                    strict=True, reason="the tracker's loose free-space check lets answers far from the prediction pass"
                ),
            ),
        ],
        ids=["near", "far"],
    )
    def test_wrong_prediction_never_ends_in_a_wrong_converged(self, offsets: tuple[tuple[float, float], ...]) -> None:
        rng = np.random.default_rng(1)
        right = 0
        for scene in ("room", "corridor"):
            sequence = rendered(scene, count=40)
            mapper, true = map_of(sequence, 10), sequence.ground_truth.T_world_camera[10]
            pyramid = sw.build_pyramid(sequence.frames[10])
            for shift_m, turn_deg in offsets:
                for _ in range(4):
                    guess = true @ random_start(rng, shift_m, turn_deg)
                    result = sw.FrameToModelTracker().track(pyramid, mapper.view(guess, CAMERA), guess)
                    assert np.isfinite(result.T_target_source).all()
                    if result.status is sw.Status.CONVERGED:
                        shift, turn = pose_error(result.T_target_source, true)
                        assert max(shift / 0.01, turn / 0.5) < 1, (scene, shift_m, turn_deg, result)
                        right += 1
        assert right >= 16

    def test_nothing_to_track(self) -> None:
        sequence = rendered(count=40)
        mapper, true = map_of(sequence, 2), sequence.ground_truth.T_world_camera[2]
        tracker, pyramid = sw.FrameToModelTracker(), sw.build_pyramid(sequence.frames[2])
        away = true @ se3.exp([0, 0, 0, 0, np.pi, 0])
        for view, seen in (
            (sw.SurfelMapper().view(true, CAMERA), pyramid),
            (mapper.view(true, CAMERA), sw.build_pyramid(blind(sequence.frames[2]))),
            (mapper.view(away, CAMERA), pyramid),
        ):
            result = tracker.track(seen, view, true)
            assert result.status in (sw.Status.TOO_FEW_CORRESPONDENCES, sw.Status.NO_OVERLAP)
            assert result.note

    def test_stable_fraction_tracks_against_the_most_stable(self) -> None:
        sequence = rendered(noise="kinect", count=40)
        mapper, true = map_of(sequence, 20), sequence.ground_truth.T_world_camera[20]
        view = mapper.view(true, CAMERA)
        stable = view.confidences >= view.stable_confidence
        assert stable.mean() > 0.5  # so the others are left out
        tracker = sw.FrameToModelTracker(sw.TrackingConfig(stable_fraction=0.1))
        positions = view.positions_m[:, tracker._select(view)]
        assert positions.shape == (3, round(0.1 * stable.sum()))
        taken = self.taken(positions, view)
        limit = np.sort(view.confidences)[-positions.shape[1]]
        assert taken[view.confidences > limit].all()
        assert not taken[view.confidences < limit].any()
        result = tracker.track(sw.build_pyramid(sequence.frames[20]), view, true)
        assert result.status.has_pose
        assert pose_error(result.T_target_source, true)[0] < 1e-2  # 1400 points of 11 mm of noise

    def test_unstable_surfels_are_left_out_where_half_of_the_view_is_stable(self) -> None:
        mapper = map_of(rendered(count=40), 1)
        view = mapper.view(rendered(count=40).ground_truth.T_world_camera[0], CAMERA)
        for share, expected in ((0.3, 1.0), (0.7, 0.7)):
            confidences = np.where(np.random.default_rng(1).random(len(view)) < share, 9, 1).astype(np.float32)
            rows = sw.FrameToModelTracker()._select(of_confidence(view, confidences))
            positions = view.positions_m[:, rows]
            assert positions.shape[1] / len(view) == pytest.approx(expected, abs=0.02)

    @pytest.mark.parametrize("confidence", [1.0, 100.0])
    def test_equally_stable_surfels_are_taken_from_the_whole_image(self, confidence: float) -> None:
        """Confidence stops growing at a limit, so ties are the rule in a long run; they must not favour a corner."""
        mapper = map_of(rendered(count=40), 1)
        view = mapper.view(rendered(count=40).ground_truth.T_world_camera[0], CAMERA)
        view = of_confidence(view, np.full(len(view), confidence, np.float32))
        tracker = sw.FrameToModelTracker(sw.TrackingConfig(stable_fraction=0.1))
        positions = view.positions_m[:, tracker._select(view)]
        places = np.flatnonzero(self.taken(positions, view)) / len(view)
        assert len(places) == positions.shape[1] == round(0.1 * len(view))
        np.testing.assert_allclose(np.percentile(places, [5, 25, 50, 75, 95]), [0.05, 0.25, 0.5, 0.75, 0.95], atol=0.02)

    def test_fraction_leaves_at_least_the_points_that_an_answer_needs(self) -> None:
        mapper = map_of(rendered(count=40), 1)
        view = mapper.view(rendered(count=40).ground_truth.T_world_camera[0], CAMERA)
        config = sw.TrackingConfig(stable_fraction=0.001)
        positions = view.positions_m[:, sw.FrameToModelTracker(config)._select(view)]
        assert positions.shape[1] == config.projective.min_points

    @staticmethod
    def taken(positions: np.ndarray, view: sw.ModelView) -> np.ndarray:
        """Which rows of the view were selected."""
        chosen = {tuple(column) for column in positions.T}
        return np.array([tuple(column) in chosen for column in view.positions_m.T])

    @pytest.mark.parametrize("fraction", [0.0, 1.1, float("nan")])
    def test_fraction_out_of_range(self, fraction: float) -> None:
        with pytest.raises(ConfigError, match="stable_fraction"):
            sw.TrackingConfig(stable_fraction=fraction)


class TestTwoFrames:
    @pytest.mark.parametrize(("noise", "shift_bound", "turn_bound"), [("none", 1e-3, 0.05), ("kinect", 1e-2, 0.5)])
    def test_maps_points_of_a_to_b(self, noise: str, shift_bound: float, turn_bound: float) -> None:
        sequence = rendered(noise=noise, count=40)
        G = sequence.ground_truth.T_world_camera
        for a, b in ((0, 5), (20, 8), (39, 20)):
            result = sw.align_frames(sequence.frames[a], sequence.frames[b])
            assert result.status is sw.Status.CONVERGED
            shift, turn = pose_error(result.T_target_source, se3.inverse(G[b]) @ G[a])
            assert shift < shift_bound
            assert turn < turn_bound

    @pytest.mark.parametrize(
        ("a", "b"),
        [
            (("room", "", 0), ("corridor", "", 0)), (("corridor", "", 30), ("room", "", 39)),
            (("room", "", 0), ("room", "sweep", 0)), (("room", "sweep", 0), ("corridor", "", 39)),
            (("room", "sweep", 20), ("room", "", 30)), (("corridor", "", 10), ("room", "sweep", 13)),
            # Two corners of rooms that fit each other in depth; their walls do not look alike.
            (("room", "sweep", 39), ("corridor", "", 39)),
        ],
    )  # fmt: skip
    def test_unrelated_views_never_converge(self, a: tuple[str, str, int], b: tuple[str, str, int]) -> None:
        """Two scenes, or two sides of one room that look away from each other."""
        first, second = (rendered(scene, path=path, count=40).frames[k] for scene, path, k in (a, b))
        result = sw.align_frames(first, second)
        assert result.status is not sw.Status.CONVERGED
        assert not result.status.success
        assert result.note

    @pytest.mark.xfail(strict=True, reason="two corners of rooms fit each other; depth alone cannot tell")
    def test_corners_that_fit_never_converge_without_colour(self) -> None:
        frames = rendered("room", path="sweep", count=40).frames[39], rendered("corridor", count=40).frames[39]
        first, second = (replace(frame, color=None) for frame in frames)
        assert sw.align_frames(first, second).status is not sw.Status.CONVERGED

    def test_random_depth_never_converges(self) -> None:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            a, b = (frame_of(rng.uniform(0.5, 4, CAMERA.shape)) for _ in range(2))
            smooth = [frame_of(cv2.GaussianBlur(f.depth_m, (0, 0), 6)) for f in (a, b)]
            assert sw.align_frames(a, b).status is not sw.Status.CONVERGED
            assert sw.align_frames(*smooth).status is not sw.Status.CONVERGED

    def test_blind_frames_have_no_answer(self) -> None:
        frame = rendered(count=40).frames[0]
        for a, b in ((frame, blind(frame)), (blind(frame), frame), (blind(frame), blind(frame))):
            result = sw.align_frames(a, b)
            assert result.status is sw.Status.TOO_FEW_CORRESPONDENCES
            assert np.isfinite(result.T_target_source).all()

    @pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.1, 1)])
    def test_wall_is_degenerate_and_stays_at_the_guess(self, normal: tuple[float, ...]) -> None:
        frame = frame_of(plane_depth(normal, 1.5))
        along = np.cross(normal, [0, 1, 0])
        guess = np.eye(4)
        guess[:3, 3] = 0.15 * along / np.linalg.norm(along)
        result = sw.align_frames(frame, frame, T_init=guess)
        assert result.status is sw.Status.DEGENERATE
        assert len(result.unobservable) == 3
        np.testing.assert_allclose(result.T_target_source, guess, atol=1e-3)

    @pytest.mark.parametrize("noise", ["kinect", "realsense"])
    def test_noisy_wall_is_degenerate(self, noise: str) -> None:
        depth = plane_depth((0.3, 0.1, 1), 1.5)
        a, b = (frame_of(degrade_depth(depth, CAMERA, NOISE_MODELS[noise], np.random.default_rng(k))) for k in (1, 2))
        for guess in (np.eye(4), se3.exp([0, 0.1, 0, 0, 0, 0])):
            assert sw.align_frames(a, b, T_init=guess).status is sw.Status.DEGENERATE

    def test_wrong_guess_never_ends_in_a_wrong_converged(self) -> None:
        rng = np.random.default_rng(2)
        right = 0
        for scene, noise in (("room", "none"), ("room", "kinect"), ("corridor", "none")):
            sequence = rendered(scene, noise, 40)
            G = sequence.ground_truth.T_world_camera
            true = se3.inverse(G[22]) @ G[20]
            for shift_m, turn_deg in ((0.3, 0), (0.6, 0), (1.0, 0), (0, 15), (0, 45), (0.3, 20)):
                for _ in range(2):
                    guess = random_start(rng, shift_m, turn_deg) @ true
                    result = sw.align_frames(sequence.frames[20], sequence.frames[22], T_init=guess)
                    if result.status is sw.Status.CONVERGED:
                        shift, turn = pose_error(result.T_target_source, true)
                        assert max(shift / 0.01, turn / 0.5) < 1, (scene, noise, shift_m, turn_deg, result)
                        right += 1
        assert right >= 15

    def test_frames_of_different_cameras(self) -> None:
        sequence = rendered(count=40)
        small = sw.PinholeCamera(CAMERA.fx, CAMERA.fy, CAMERA.cx - 20, CAMERA.cy - 10, 120, 100)
        cut = sequence.frames[3]
        cut = sw.Frame(cut.timestamp_s, cut.depth_m[10:110, 20:140], cut.color[10:110, 20:140], small)
        result = sw.align_frames(sequence.frames[0], cut)
        G = sequence.ground_truth.T_world_camera
        assert result.status is sw.Status.CONVERGED
        assert pose_error(result.T_target_source, se3.inverse(G[3]) @ G[0])[0] < 1e-3

    def test_guess_that_is_no_rigid_motion_is_refused(self) -> None:
        frame = rendered(count=40).frames[0]
        for bad in (np.eye(3), np.diag([2.0, 2, 2, 1]), np.full((4, 4), np.nan)):
            with pytest.raises(sw.InvalidInputError, match="T_init"):
                sw.align_frames(frame, frame, T_init=bad)


class TestRecordedPairs:
    """Recorded data: plain projective alignment from the identity."""

    @pytest.mark.parametrize(("a", "b"), [(10, 40), (100, 130)])
    def test_living_room_pairs_within_a_millimetre(self, shared_data: Path, a: int, b: int) -> None:
        result, true = self.living_room(shared_data, a, b)
        shift, turn = pose_error(result.T_target_source, true)
        assert result.status is sw.Status.CONVERGED
        assert shift < 1e-3
        assert turn < 0.1

    @pytest.mark.parametrize(("a", "b"), [(10, 50), (10, 100), (100, 200), (200, 100), (206, 66), (0, 80)])
    @pytest.mark.parametrize("colour", [True, False])
    def test_far_apart_pairs(self, shared_data: Path, a: int, b: int, colour: bool) -> None:
        """0.5 to 1.4 m, 15 to 62 degrees; asked for are 1 cm and 0.5 degrees, with colour. Measured 0.1 to 0.3 mm."""
        sequence = sw.open_sequence(shared_data / "livingroom1")
        G = sequence.ground_truth.T_world_camera
        frames = [sequence.read(k) if colour else replace(sequence.read(k), color=None) for k in (a, b)]
        result = sw.align_frames(*frames)
        assert result.status is sw.Status.CONVERGED
        assert not result.note
        shift, turn = pose_error(result.T_target_source, se3.inverse(G[b]) @ G[a])
        assert shift < 1e-3
        assert turn < 0.05

    @pytest.mark.parametrize(("a", "b"), [(7, 27), (12, 32), (6, 21), (29, 49)])
    def test_shelf_from_far_apart(self, shared_data: Path, a: int, b: int) -> None:
        """25 to 34 degrees about the shelf, two thirds of the pixels invalid. The poses are good to some millimetres at
        the shelf, and hardly to a degree: what counts is where the points come to lie."""
        sequence = sw.open_sequence(shared_data / "shelf_realsense")
        G, frame = sequence.ground_truth.T_world_camera, sequence.read(a)
        true = se3.inverse(G[b]) @ G[a]
        points = sequence.camera.back_project(frame.depth_m)[frame.depth_m > 0]

        def error_m(T: np.ndarray) -> float:
            gaps = se3.transform_points(T, points) - se3.transform_points(true, points)
            return float(np.sqrt((gaps**2).sum(axis=1).mean()))

        result = sw.align_frames(frame, sequence.read(b))
        assert result.status is sw.Status.CONVERGED
        assert error_m(result.T_target_source) < 0.01
        assert error_m(np.eye(4)) > 0.02

    def test_frames_of_different_places_never_converge(self, shared_data: Path) -> None:
        room, shelf = (sw.open_sequence(shared_data / name) for name in ("livingroom1", "shelf_realsense"))
        for a, b in ((room.read(0), shelf.read(0)), (shelf.read(25), room.read(130)), (room.read(205), shelf.read(49))):
            for first, second in ((a, b), (replace(a, color=None), replace(b, color=None))):
                result = sw.align_frames(first, second)
                assert result.status is not sw.Status.CONVERGED
                assert result.note

    @pytest.mark.parametrize(("a", "b"), [(10, 50), (10, 100)])
    def test_wide_pairs_are_right_or_say_that_they_are_not(self, shared_data: Path, a: int, b: int) -> None:
        result, true = self.living_room(shared_data, a, b)
        if result.status is sw.Status.CONVERGED:
            shift, turn = pose_error(result.T_target_source, true)
            assert shift < 1e-3
            assert turn < 0.1
        else:
            assert result.note

    @pytest.mark.parametrize("case", ["case_1", "case_2"])
    def test_tum_pairs(self, shared_data: Path, case: str) -> None:
        folder = shared_data / "tum_pairs" / case
        camera = sw.PinholeCamera(525, 525, 319.5, 239.5, 640, 480)
        frames, poses = [], []
        for time, which in enumerate(("prev", "curr")):
            depth = cv2.imread(str(folder / f"dep_{which}.png"), cv2.IMREAD_UNCHANGED) / np.float32(5000)
            frames.append(sw.Frame(float(time), depth.astype(np.float32), None, camera))
            values = np.array((folder / f"pose_{which}.txt").read_text().split()[-7:], dtype=np.float64)
            poses.append(se3.from_quaternion_xyzw(values[3:], values[:3]))
        true = se3.inverse(poses[1]) @ poses[0]
        result = sw.align_frames(*frames)
        shift, turn = pose_error(result.T_target_source, true)
        assert result.status is sw.Status.CONVERGED
        assert shift < 5e-3
        assert turn < 0.7
        assert pose_error(np.eye(4), true)[0] > 0.02  # there was something to find

    @staticmethod
    def living_room(shared_data: Path, a: int, b: int) -> tuple[sw.RegistrationResult, np.ndarray]:
        sequence = sw.open_sequence(shared_data / "livingroom1")
        G = sequence.ground_truth.T_world_camera
        return sw.align_frames(sequence.read(a), sequence.read(b)), se3.inverse(G[b]) @ G[a]
