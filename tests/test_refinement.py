"""Direct bundle adjustment: what is solved is what the definition says, drift goes, and what is not known is named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, MemorySequence, frame_of, pose_error, rendered
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.loop_closure.ferns import FernConfig, Ferns
from scanweld.loop_closure.keyframes import Keyframe, KeyframeConfig, keyframe_of, sighting_of
from scanweld.loop_closure.loop_closer import LoopClosingConfig
from scanweld.loop_closure.place_recognition import PlaceConfig
from scanweld.refinement.calibration import Calibration, DepthCorrection
from scanweld.refinement.config import RefinementConfig
from scanweld.refinement.held_out import HeldOut, gain
from scanweld.refinement.normal_equations import MotionEdges, assemble, covariance_of, dispersion, solve
from scanweld.refinement.observations import (
    Observations,
    Views,
    fit_surfels,
    fitted_surfels,
    observe,
    sample_surfels,
)
from scanweld.refinement.refine import Refinement, RefinementStatus, refine_keyframes
from scanweld.refinement.surfels import Cameras, Surfels
from scanweld.runs.calibrated import CalibratedSequence

COUNT, STEP = 240, 12
FAST = RefinementConfig(photometry="off", iterations=8)


@lru_cache(maxsize=4)
def ferns() -> Ferns:
    return Ferns(FernConfig(count=16))


def keyframes_of(
    frames: Sequence[sw.Frame], poses: Sequence[np.ndarray], config: KeyframeConfig | None = None
) -> list[Keyframe]:
    """Every frame a keyframe, one second apart."""
    return [
        keyframe_of(sighting_of(sw.build_pyramid(frame), ferns(), config), T, index=k, frame_index=k)
        for k, (frame, T) in enumerate(zip(frames, poses, strict=True))
    ]


def sequence(noise: str, *, focal: float = 1.0, offset_per_m: float = 0.0) -> tuple[list[sw.Frame], np.ndarray]:
    """Frames 0, 12, .. of the room as a camera with a wrong focal length and depth records it, and true poses."""
    whole, read = views_of_the_room(noise)
    camera = replace(CAMERA, fx=CAMERA.fx * focal, fy=CAMERA.fy * focal)
    frames = []
    for k, frame in enumerate(read):
        # What a camera measures whose 1/z must be raised by the offset to be right.
        depth = np.where(frame.depth_m > 0, frame.depth_m / (1 - offset_per_m * frame.depth_m), 0).astype(np.float32)
        frames.append(replace(frame, timestamp_s=float(k), depth_m=depth, camera=camera))
    return frames, whole.ground_truth.T_world_camera[::STEP]


@lru_cache(maxsize=2)
def views_of_the_room(noise: str) -> tuple[sw.SyntheticSequence, list[sw.Frame]]:
    """Rendered every twelfth: the frames between are not looked at."""
    config = sw.RenderConfig(scene="room", noise=noise, frames=COUNT, width=CAMERA.width, height=CAMERA.height)
    whole = sw.SyntheticSequence(config)
    return whole, [whole.read(i) for i in range(0, COUNT, STEP)]


def shaken(poses: np.ndarray, size: float = 1.0) -> list[np.ndarray]:
    """Poses whose every step is off by a few millimetres and a tenth of a degree."""
    rng = np.random.default_rng(0)
    drifted = [poses[0]]
    for before, after in pairwise(poses):
        error = size * rng.normal(size=6) * [0.004, 0.004, 0.004, 0.002, 0.002, 0.002]
        drifted.append(drifted[-1] @ se3.inverse(before) @ after @ se3.exp(error))
    return drifted


def ate_mm(poses: Sequence[np.ndarray], true: np.ndarray) -> float:
    times = np.arange(len(true), dtype=np.float64)
    return 1e3 * sw.ate(sw.Trajectory(times, np.stack(list(poses))), sw.Trajectory(times, true)).rmse_m


class TestResiduals:
    """The kernel against its definition in NumPy, in double precision."""

    @staticmethod
    def texture(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """A brightness whose bilinear interpolation is exact but for its product term's own square."""
        return 100 + 0.3 * u - 0.2 * v + 0.004 * u * v

    def residuals(
        self, surfel: Surfels, calibration: Calibration, raw_depth: tuple[np.ndarray, float], T: np.ndarray
    ) -> np.ndarray:
        """Distance [m] and two differences of brightness of one surfel before a plane n . x = d as it is recorded.

        `raw_depth` : the plane (n, d) in the recording camera CAMERA, whose depth the calibration corrects.
        """
        c = calibration.camera
        p = T[:3, :3] @ surfel.positions_m[0] + T[:3, 3]
        normal = T[:3, :3] @ surfel.normals[0]
        u, v = c.fx * p[0] / p[2] + c.cx, c.fy * p[1] / p[2] + c.cy
        n, d = raw_depth
        measured = d / (n @ [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        z = 1 / (1 / measured + calibration.depth.inverse_depth_offset_per_m)
        q = np.array([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z])
        values = [normal @ (q - p)]
        places = [surfel.positions_m[0], *(surfel.positions_m[0] + surfel.tangents()[0].astype(np.float64))]
        grey = []
        for place in places:
            m = T[:3, :3] @ place + T[:3, 3]
            grey.append(self.texture(c.fx * m[0] / m[2] + c.cx, c.fy * m[1] / m[2] + c.cy))
        return np.array([*values, grey[1] - grey[0], grey[2] - grey[0]])

    def case(self) -> tuple[Views, Cameras, Surfels, tuple[np.ndarray, float]]:
        """One keyframe before a slanted plane, and a surfel 3 mm before it."""
        n, d = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9]), 1.5
        depth = (d / (CAMERA.rays() @ n)).astype(np.float32)
        u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
        color = np.repeat(np.rint(self.texture(u, v))[..., None], 3, axis=2).astype(np.uint8)
        T_world_camera = se3.exp([0.1, -0.2, 0.3, 0.02, 0.03, -0.05])
        keyframe = keyframes_of([replace(frame_of(depth), color=color)], [T_world_camera])[0]
        views = Views([keyframe], RefinementConfig().surfaces)
        # The stored image has 256 values; what is tested is the interpolation and its slopes, not their rounding.
        views.grey = lambda index: self.texture(u, v).astype(np.float32)  # type: ignore[method-assign]
        cameras = Cameras(se3.inverse(T_world_camera)[None], Calibration(CAMERA))
        ray = np.array([(97.3 - CAMERA.cx) / CAMERA.fx, (41.6 - CAMERA.cy) / CAMERA.fy, 1.0])
        p = ray * d / (n @ ray) - 0.003 * n
        R = T_world_camera[:3, :3]
        surfels = Surfels(
            (R @ p + T_world_camera[:3, 3])[None], (R @ -n)[None], np.array([0.02]), np.zeros(1, np.int32),
            np.zeros(1, np.bool_),
        )  # fmt: skip
        return views, cameras, surfels, (n, d)

    def test_the_kernel_is_its_definition(self) -> None:
        views, cameras, surfels, plane = self.case()
        found = observe(views, cameras, surfels, 0.05, 0.7)
        assert len(found) == 1
        assert found.pixel[0] == 42 * CAMERA.width + 97
        expected = self.residuals(surfels, cameras.calibration, plane, cameras.T_camera_world[0])
        # The distance is in units of the noise at the surfel's depth, 0.0012 + 0.0019 (z - 0.4)^2.
        z = (cameras.T_camera_world[0, :3, :3] @ surfels.positions_m[0] + cameras.T_camera_world[0, :3, 3])[2]
        sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
        # Keyframes keep depth in 65535 steps, here of 33 um.
        assert found.rows[0, 0, 12] * sigma == pytest.approx(expected[0], abs=1.7e-5)
        assert expected[0] == pytest.approx(-0.003, abs=1e-4)
        np.testing.assert_allclose(found.rows[0, 1:, 12], expected[1:], atol=2e-3)
        np.testing.assert_allclose(found.seen[0], surfels.normals[0], atol=2e-3)

    def test_slopes_are_finite_differences(self) -> None:
        """Pose, camera and offset; a slope is taken at the surfel, so it is off by the share 3 mm / 1.5 m of itself."""
        views, cameras, surfels, plane = self.case()
        row = observe(views, cameras, surfels, 0.05, 0.7).rows[0].astype(np.float64)
        T = cameras.T_camera_world[0]
        z = (T[:3, :3] @ surfels.positions_m[0] + T[:3, 3])[2]
        row[0, :12] *= 0.0012 + 0.0019 * (z - 0.4) ** 2
        calibration = cameras.calibration

        def at(k: int, step: float) -> np.ndarray:
            x = np.zeros(12)
            x[k] = step
            moved = replace(surfels, positions_m=surfels.positions_m + x[11] * surfels.normals)
            return self.residuals(moved, calibration.stepped(x[6:11]), plane, se3.exp(x[:6]) @ T)

        for k, step in enumerate([1e-5] * 6 + [1e-3] * 4 + [1e-5, 1e-5]):
            slope = (at(k, step) - at(k, -step)) / (2 * step)
            np.testing.assert_allclose(row[0, k], slope[0], rtol=0.02, atol=5e-3 * np.abs(row[0, :12]).max())
            np.testing.assert_allclose(row[1:, k], slope[1:], rtol=0.02, atol=2e-3 * np.abs(row[1:, :12]).max())

    def test_brightness_has_no_weight_without_light(self) -> None:
        views, cameras, surfels, _ = self.case()
        rows = observe(views, cameras, surfels, 0.05, 0.7, lit=False).rows
        assert (rows[:, 1:] == 0).all()

    def test_what_is_behind_another_surface_is_not_seen(self) -> None:
        views, cameras, surfels, _ = self.case()
        hidden = replace(surfels, positions_m=surfels.positions_m - 0.2 * surfels.normals)
        assert len(observe(views, cameras, hidden, 0.05, 0.7)) == 0
        turned = replace(surfels, normals=-surfels.normals)
        assert len(observe(views, cameras, turned, 0.05, 0.7)) == 0


class TestNormalEquations:
    """The reduced system against the whole one."""

    def whole(self) -> tuple[Observations, np.ndarray, MotionEdges, np.ndarray, np.ndarray]:
        """Random rows of 4 keyframes and 30 surfels; H and g of all unknowns: poses, camera, three a surfel."""
        rng = np.random.default_rng(0)
        K, S = 4, 30
        keyframe, surfel = (a.astype(np.int32) for a in np.nonzero(rng.random((K, S)) < 0.7))
        M = len(surfel)
        rows = rng.normal(size=(M, 3, 14)).astype(np.float32)
        rows[:, :, 13] = rng.uniform(0.2, 1, (M, 3))
        rows[::5, 1:] = 0  # without brightness
        zero = np.zeros(M, np.int32)
        observations = Observations(surfel, keyframe, zero, np.zeros((M, 3), np.float32), rows)
        T = np.stack([se3.exp(0.1 * rng.normal(size=6)) for _ in range(K)])
        edges = MotionEdges.between(np.stack([se3.exp(1e-4 * rng.normal(size=6)) @ t for t in T]), 0.005)
        J = np.zeros((M, 3, 6 * K + 5 + 3 * S))
        for a, (k, s) in enumerate(zip(keyframe, surfel, strict=True)):
            J[a, :, 6 * k : 6 * k + 6], J[a, :, 6 * K : 6 * K + 5] = rows[a, :, :6], rows[a, :, 6:11]
            own = 6 * K + 5 + 3 * s
            J[a, :, own] = rows[a, :, 11]
            J[a, 1, own + 1] = J[a, 2, own + 2] = -1
        w, r = rows[:, :, 13].astype(np.float64), rows[:, :, 12].astype(np.float64)
        H, g = np.einsum("aci,ac,acj->ij", J, w, J), np.einsum("aci,ac,ac->i", J, w, r)
        for k in range(K - 1):
            motion = T[k] @ se3.inverse(T[k + 1])
            A = np.zeros((6, len(g)))
            A[:, 6 * k : 6 * k + 6], A[:, 6 * k + 6 : 6 * k + 12] = np.eye(6), -se3.adjoint(motion)
            W = np.diag(np.repeat([edges.sigma_m[k], edges.sigma_rad[k]], 3) ** -2.0)
            H += A.T @ W @ A
            g += A.T @ W @ se3.log(motion @ se3.inverse(edges.T_i_j[k]))
        return observations, T, edges, H[6:, 6:], g[6:]

    @pytest.mark.parametrize("active", [[0, 0, 0, 0, 0], [1, 0, 1, 0, 1], [1, 1, 1, 1, 1]])
    def test_the_step_is_that_of_the_whole_system(self, active: list[int]) -> None:
        observations, T, edges, H, g = self.whole()
        use = np.array(active, np.bool_)
        free = np.concatenate([np.ones(18, np.bool_), use, np.ones(len(g) - 23, np.bool_)])
        x = np.zeros(len(g))
        x[free] = -np.linalg.lstsq(H[np.ix_(free, free)], g[free], rcond=1e-12)[0]
        step = solve(assemble(observations, T, 30, edges), use)
        np.testing.assert_allclose(step.poses[1:].ravel(), x[:18], atol=1e-4 * np.abs(x[:18]).max())
        np.testing.assert_allclose(step.camera, x[18:23], atol=1e-3 * np.abs(x[18:23]).max() + 1e-12)
        assert (step.poses[0] == 0).all()
        left = step.information[np.ix_(use, use)]
        inverse = np.linalg.pinv(H[np.ix_(free, free)])[18 : 18 + use.sum(), 18 : 18 + use.sum()]
        np.testing.assert_allclose(covariance_of(left), inverse, rtol=1e-3, atol=1e-9)

    def test_an_edge_pulls_back_to_the_motion_that_was_tracked(self) -> None:
        """Without surfels one step restores every motion: the residual is linear up to second order."""
        observations, _, _, _, _ = self.whole()
        nothing = observations.only(np.zeros(len(observations), np.bool_))
        rng = np.random.default_rng(1)
        T = np.stack([se3.exp(0.3 * rng.normal(size=6)) for _ in range(4)])
        edges = MotionEdges.between(T, 0.005)
        moved = np.stack([T[0], *(se3.exp(1e-3 * rng.normal(size=6)) @ t for t in T[1:])])
        step = solve(assemble(nothing, moved, 30, edges), np.zeros(5, np.bool_))
        back = np.stack([se3.exp(xi) @ t for xi, t in zip(step.poses, moved, strict=True)])
        assert np.abs(back - T).max() < 2e-5 < np.abs(moved - T).max()

    def test_dispersion_counts_copies(self) -> None:
        """Rows that are there four times know a quarter of what they claim; independent ones know what they claim."""
        rng = np.random.default_rng(2)
        count, height, width = 8000, 120, 160
        rows = np.zeros((count, 3, 14), np.float32)
        rows[:, 0, :6] = rng.normal(size=(count, 6))
        rows[:, 0, 12], rows[:, 0, 13] = rng.normal(size=count), 1
        keyframe = np.sort(rng.integers(0, 20, count)).astype(np.int32)
        pixel = rng.integers(0, height * width, count).astype(np.int32)
        o = Observations(np.arange(count, dtype=np.int32), keyframe, pixel, np.zeros((count, 3), np.float32), rows)
        assert dispersion(o, height, width, slice(0, 1)) == pytest.approx(1, abs=0.2)
        copies = Observations(
            *(np.repeat(getattr(o, n), 4, 0) for n in ("surfel", "keyframe", "pixel", "seen", "rows"))
        )
        assert dispersion(copies, height, width, slice(0, 1)) == pytest.approx(4, rel=0.2)


class TestSurfels:
    def sampled(self) -> tuple[Views, Cameras, Surfels]:
        frames, true = sequence("none")
        views = Views(keyframes_of(frames[:4], true[:4]), RefinementConfig().surfaces)
        cameras = Cameras(np.stack([se3.inverse(T) for T in true[:4]]), Calibration(CAMERA))
        views.begin(cameras.calibration)
        return views, cameras, sample_surfels(views, cameras.T_camera_world, 4, 0.05, 0.7)

    def test_a_cell_has_one_surfel(self) -> None:
        views, cameras, surfels = self.sampled()
        hosts = np.bincount(surfels.hosts)
        assert 600 < hosts[0] <= 30 * 40
        assert hosts[1:].max() < 0.6 * hosts[0]  # most of what a later keyframe sees is there already
        assert 0.15 < surfels.held.mean() < 0.35
        np.testing.assert_allclose(np.linalg.norm(surfels.normals, axis=1), 1, atol=1e-5)
        steps = surfels.tangents()
        np.testing.assert_allclose(np.einsum("sci,si->sc", steps, surfels.normals), 0, atol=1e-6)
        np.testing.assert_allclose(np.einsum("si,si->s", steps[:, 0], steps[:, 1]), 0, atol=1e-6)
        assert len(observe(views, cameras, surfels, 0.05, 0.7)) > 1.5 * len(surfels)

    def test_a_surfel_keeps_its_pixel_and_depth_in_its_host(self) -> None:
        """A camera whose calibration changes sees what it recorded: carried surfels stay on the surfaces."""
        views, cameras, surfels = self.sampled()
        moved = np.stack([se3.exp([0.1, 0.2, -0.1, 0.05, 0.0, 0.1]) @ T for T in cameras.T_camera_world])
        calibration = Calibration(replace(CAMERA, fx=135.0, fy=128.0, cx=78.0, cy=61.0), DepthCorrection(0.02))
        after = Cameras(moved, calibration)
        carried = surfels.carried(cameras, after)
        first = carried.only(carried.hosts == 0)
        seen = observe(views, after, first, 0.05, 0.7)
        seen = seen.only(seen.keyframe == 0)
        before = observe(views, cameras, surfels.only(surfels.hosts == 0), 0.05, 0.7)
        assert len(seen) == pytest.approx(np.count_nonzero(before.keyframe == 0), rel=0.03)
        assert np.median(np.abs(seen.rows[:, 0, 12])) < 1e-3  # of the noise
        back = carried.carried(after, cameras)
        np.testing.assert_allclose(back.positions_m, surfels.positions_m, atol=1e-9)

    def test_fitting_moves_surfels_onto_the_surface(self) -> None:
        """Noise-free views agree: what is put 1 cm behind a surface is brought back."""
        views, cameras, surfels = self.sampled()
        away = replace(surfels, positions_m=surfels.positions_m - 0.01 * surfels.normals)
        fit = fit_surfels(observe(views, cameras, away, 0.05, 0.7), len(surfels), 2.0)
        fitted = fitted_surfels(away, fit)
        shared = np.unique(fit.observations.surfel)
        off = ((fitted.positions_m - surfels.positions_m) * surfels.normals).sum(axis=1)[shared]
        assert np.median(np.abs(off)) < 2e-4
        assert (fit.offsets_m[np.setdiff1d(np.arange(len(surfels)), shared)] == 0).all()


class TestHeldOut:
    def losses(self, shift: float, seed: int) -> HeldOut:
        rng = np.random.default_rng(seed)
        return HeldOut(np.arange(4000), 1 + shift + 0.3 * rng.normal(size=4000), 20)

    def test_a_gain_must_exceed_chance(self) -> None:
        before = self.losses(0.0, 0)
        assert gain(before, self.losses(-0.05, 1)).significant
        assert not gain(before, self.losses(0.05, 2)).significant
        assert sum(gain(before, self.losses(0.0, seed)).significant for seed in range(1, 41)) <= 1

    def test_what_is_seen_no_more_is_a_loss(self) -> None:
        before = self.losses(0.0, 0)
        after = replace(before, sighting=before.sighting[:3900], depth=before.depth[:3900] - 1e-3)
        assert gain(before, after).mean < 0


class TestRefineKeyframes:
    def test_drift_goes(self) -> None:
        frames, true = sequence("kinect")
        keyframes = keyframes_of(frames, shaken(true))
        found = refine_keyframes(keyframes, CAMERA, FAST)
        assert found.status is RefinementStatus.BETTER
        assert found.better
        assert ate_mm(found.T_world_camera, true) < 0.3 * ate_mm([k.T_world_camera for k in keyframes], true)
        np.testing.assert_allclose(found.T_world_camera[0], keyframes[0].T_world_camera, atol=1e-12)
        np.testing.assert_allclose(
            found.T_new_old @ np.stack([k.T_world_camera for k in keyframes]), found.T_world_camera, atol=1e-12
        )
        assert found.camera == CAMERA
        assert not found.recalibrated
        assert found.held_out[1] < found.held_out[0]
        losses = [iteration.loss for iteration in found.iterations]
        assert losses[-1] < 0.7 * losses[0]
        assert "fits better" in found.note

    def test_right_poses_are_left_alone(self) -> None:
        frames, true = sequence("kinect")
        keyframes = keyframes_of(frames, list(true))
        found = refine_keyframes(keyframes, CAMERA, RefinementConfig(iterations=6))
        assert found.status is RefinementStatus.NOT_BETTER
        np.testing.assert_array_equal(found.T_world_camera, np.stack([k.T_world_camera for k in keyframes]))
        np.testing.assert_allclose(found.T_new_old, np.tile(np.eye(4), (len(frames), 1, 1)), atol=1e-12)

    def test_the_same_answer_at_any_number_of_threads(self) -> None:
        frames, true = sequence("kinect")
        keyframes = keyframes_of(frames[:6], shaken(true[:6]))
        answers = []
        for threads in (1, 3):
            sw.set_num_threads(threads)
            try:
                answers.append(refine_keyframes(keyframes, CAMERA, replace(FAST, iterations=3)))
            finally:
                sw.set_num_threads(2)
        assert answers[0].T_world_camera.tobytes() == answers[1].T_world_camera.tobytes()

    def test_a_wrong_focal_length_is_found(self) -> None:
        """2 % wrong; the answer is within 0.3 % and within 4 of its own standard deviations."""
        frames, true = sequence("kinect", focal=1.02)
        wrong = frames[0].camera
        keyframes = keyframes_of(frames, list(true))
        found = refine_keyframes(keyframes, wrong, replace(FAST, calibrate_intrinsics=True))
        assert found.recalibrated
        for name in ("fx", "fy"):
            value, right = getattr(found.camera, name), getattr(CAMERA, name)
            assert value == pytest.approx(right, rel=0.003)
            assert abs(value - right) < 4 * found.sigmas[name]
        assert found.camera.cx == pytest.approx(CAMERA.cx, abs=0.5)
        assert found.camera.cy == pytest.approx(CAMERA.cy, abs=0.5)
        assert found.status is RefinementStatus.BETTER
        assert found.held == ()
        assert ate_mm(found.T_world_camera, true) < 4

    def test_what_is_hardly_known_is_named_and_stays(self) -> None:
        """Three views from nearly the same place: what is held may be wrong, too, and nothing leans on it."""
        frames, true = sequence("kinect", focal=1.02)
        keyframes = keyframes_of(frames[:3], list(true[:3]))
        found = refine_keyframes(keyframes, frames[0].camera, replace(FAST, calibrate_intrinsics=True))
        assert found.status is RefinementStatus.DEGENERATE
        assert "focal length" in found.held
        assert found.camera == frames[0].camera
        assert "focal length" in found.note

    def test_a_wrong_depth_is_found(self) -> None:
        """1 % of the depth a metre: 3 cm at 2 m. Poses are those that tracking with it would end at, so not true."""
        frames, true = sequence("kinect", offset_per_m=0.01)
        keyframes = keyframes_of(frames, shaken(true, 0.5))
        found = refine_keyframes(keyframes, CAMERA, replace(FAST, calibrate_depth=True))
        assert found.recalibrated
        assert found.depth.inverse_depth_offset_per_m == pytest.approx(0.01, abs=0.001)
        assert 0 < found.sigmas["inverse depth offset"] < 0.001
        assert found.camera == CAMERA

    def test_a_right_camera_is_left_alone(self) -> None:
        frames, true = sequence("kinect")
        keyframes = keyframes_of(frames, list(true))
        asked = replace(FAST, calibrate_intrinsics=True, calibrate_depth=True)
        found = refine_keyframes(keyframes, CAMERA, asked)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(found.camera, name) == pytest.approx(getattr(CAMERA, name), abs=0.4)
        assert abs(found.depth.inverse_depth_offset_per_m) < 1e-3

    def test_what_a_plain_wall_does_not_show_is_named(self) -> None:
        """Views of one wall, shifted along it: neither focal length nor depth changes that it is one wall."""
        from rendered import plane_depth

        frames = [replace(frame_of(plane_depth([0, 0, 1], 1.5)), timestamp_s=float(k)) for k in range(5)]
        poses = [se3.exp([0.05 * k, 0.02 * k, 0, 0, 0, 0]) for k in range(5)]
        found = refine_keyframes(
            keyframes_of(frames, poses), CAMERA, replace(FAST, calibrate_intrinsics=True, calibrate_depth=True)
        )
        assert found.status is RefinementStatus.DEGENERATE
        assert set(found.held) == {"focal length", "aspect ratio", "cx", "cy", "inverse depth offset"}
        assert found.camera == CAMERA
        assert "do not determine" in found.note
        for T, right in zip(found.T_world_camera, poses, strict=True):
            assert pose_error(T, right)[0] < 0.005

    def test_too_few_to_adjust(self) -> None:
        frames, true = sequence("none")
        for count in (0, 1):
            found = refine_keyframes(keyframes_of(frames[:count], true[:count]), CAMERA)
            assert found.status is RefinementStatus.TOO_FEW
            assert len(found.T_world_camera) == count
        apart = keyframes_of(frames[:2], [np.eye(4), se3.exp([50.0, 0, 0, 0, 0, 0])])
        found = refine_keyframes(apart, CAMERA)
        assert found.status is RefinementStatus.TOO_FEW
        assert "share" in found.note

    def test_keyframes_of_two_cameras_are_refused(self) -> None:
        frames, true = sequence("none")
        keyframes = keyframes_of(frames[:2], true[:2])
        other = replace(keyframes[1], camera=replace(CAMERA, fx=140.0))
        with pytest.raises(InvalidInputError, match="several cameras"):
            refine_keyframes([keyframes[0], other], CAMERA)


class TestResult:
    def result(self) -> Refinement:
        frames, true = sequence("none")
        found = refine_keyframes(keyframes_of(frames[:1], true[:1]), CAMERA)
        moves = np.stack([np.eye(4), se3.exp([0.1, 0, 0, 0, 0, 0]), se3.exp([0.3, 0, 0, 0, 0, 0])])
        times = np.array([1.0, 2.0, 4.0])
        return replace(found, T_new_old=moves, timestamps_s=times, keyframe_ids=np.array([3, 5, 6], np.int32))

    def test_corrections_go_over_from_keyframe_to_keyframe(self) -> None:
        """0.1 m at 2 s and 0.3 m at 4 s are 0.2 m at 3 s; before the first and after the last it is theirs."""
        moved = self.result().corrections_at(np.array([0.0, 1.0, 1.5, 2.0, 3.0, 9.0]))
        np.testing.assert_allclose(moved[:, 0, 3], [0, 0, 0.05, 0.1, 0.2, 0.3], atol=1e-12)

    def test_a_correction_names_keyframes(self) -> None:
        correction = self.result().correction
        assert correction.keyframe_ids.tolist() == [3, 5, 6]
        assert correction.T_new_old.shape == (3, 4, 4)


class TestCalibration:
    def test_depth_is_corrected_in_its_inverse(self) -> None:
        """b = 0.01: 1 / (1/2 + 0.01) = 1.960784."""
        depth = np.array([[0.0, 2.0]], np.float32)
        np.testing.assert_allclose(DepthCorrection(0.01).apply(depth), [[0, 1.960784]], atol=1e-6)
        assert DepthCorrection().apply(depth) is depth
        assert DepthCorrection(-0.6).apply(depth)[0, 1] == 0  # beyond infinity

    def test_planes_stay_planes(self) -> None:
        n = np.array([0.2, 0.3, 0.9])
        depth = (1.5 / (CAMERA.rays() @ n)).astype(np.float32)
        points = CAMERA.back_project(DepthCorrection(0.05).apply(depth)).reshape(-1, 3).astype(np.float64)
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        assert sizes[2] < 1e-5 * sizes[0]

    def test_sizes_of_images(self) -> None:
        """A keyframe is half as wide as the sequence: focal lengths double, and so do shifts of the centre."""
        small = sw.PinholeCamera(131.25, 131.25, 79.5, 59.5, 160, 120)
        full = sw.PinholeCamera(262.5, 262.5, 159.5, 119.5, 320, 240)
        found = Calibration(replace(small, fx=132.25, cy=60.0)).resized(full, small)
        assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((264.5, 262.5, 159.5, 120.5))

    def test_wrong_values_are_refused(self) -> None:
        with pytest.raises(InvalidInputError):
            DepthCorrection(float("nan"))
        with pytest.raises(ConfigError, match="photometry"):
            RefinementConfig(photometry="on")
        with pytest.raises(ConfigError, match="fine_gate_m"):
            RefinementConfig(fine_gate_m=0.5)


class TestRuns:
    def drifting(self) -> MemorySequence:
        return rendered("room", "kinect", count=30)

    def test_slam_moves_map_and_path_with_its_keyframes(self) -> None:
        """Keyframes that were put wrong come back, and frames and surfels follow."""
        whole = self.drifting()
        often = KeyframeConfig(max_shift=0.01, max_turn_rad=0.01)
        slam = sw.build_slam(CAMERA, sw.SlamConfig(loop_closing=LoopClosingConfig(places=PlaceConfig(keyframes=often))))
        for frame in whole.frames[::3]:
            assert frame is not None
            slam.process(frame)
        database = slam.loop_closer.database  # type: ignore[union-attr]
        assert len(database) > 6
        right = [keyframe.T_world_camera for keyframe in database.keyframes]
        database.move(shaken(np.stack(right), 2.0))
        before, applied = [result.T_world_camera for result in slam.results], []
        move_map = slam.mapper.apply
        slam.mapper.apply = lambda correction: (applied.append(correction), move_map(correction))  # type: ignore
        found = slam.refine(CAMERA, FAST)
        assert found.better
        path = [keyframe.T_world_camera for keyframe in database.keyframes]
        assert ate_mm(path, np.stack(right)) < 0.3 * ate_mm(shaken(np.stack(right), 2.0), np.stack(right))
        last = found.corrections_at(np.array([slam.results[-1].timestamp_s]))[0]
        np.testing.assert_allclose(slam.results[-1].T_world_camera, last @ before[-1], atol=1e-12)
        assert len(applied) == 1
        np.testing.assert_array_equal(applied[0].T_new_old, found.T_new_old)

    def test_without_keyframes_nothing_is_refined(self) -> None:
        slam = sw.build_slam(CAMERA, sw.SlamConfig(loop_closer="none"))
        frame = self.drifting().frames[0]
        assert frame is not None
        slam.process(frame)
        assert slam.refine(CAMERA).status is RefinementStatus.TOO_FEW

    def test_a_run_says_what_came_of_it(self, tmp_path: Path) -> None:
        import json

        config = sw.SlamConfig(refinement=replace(FAST, iterations=3))
        part = self.drifting().part(0, 12)
        summary = sw.run_sequence(part, config, out=tmp_path / "run", calibrate=True, refine=True)
        assert len(summary.refinements) == 2
        written = json.loads((tmp_path / "run/run.json").read_text())["refinements"]
        assert [entry["note"] for entry in written] == [found.note for found in summary.refinements]
        assert summary.metrics["frames"] == 12
        assert summary.metrics["ate_rmse_m"] < 0.01

    def test_given_poses_are_not_refined(self) -> None:
        whole = self.drifting()
        with pytest.raises(InvalidInputError, match="given poses"):
            sw.run_sequence(whole, poses=whole.ground_truth, refine=True)

    def test_a_calibrated_sequence(self) -> None:
        whole = self.drifting()
        camera = replace(CAMERA, fx=130.0)
        other = CalibratedSequence(whole, camera, DepthCorrection(0.01))
        frame, base = other.read(3), whole.read(3)
        assert frame.camera == other.camera == camera
        np.testing.assert_array_equal(frame.depth_m, DepthCorrection(0.01).apply(base.depth_m))
        assert (len(other), other.name, other.depth_scale) == (len(whole), whole.name, whole.depth_scale)
        assert other.ground_truth is whole.ground_truth
        np.testing.assert_array_equal(other.timestamps_s, whole.timestamps_s)
        assert sum(1 for _ in other) == len(whole)
