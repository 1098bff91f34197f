"""Image features with depth and the comparison of textures: places, matches, motions, and what has none."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, blind, frame_of, plane_depth, pose_error, rendered
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.registration.result import Status
from scanweld.tracking.appearance import MIN_CONTRAST, compare_appearance
from scanweld.tracking.image_features import FrameFeatures, ImageFeatureConfig, align_features, detect, match

WALL_M = 1.3125
"""At this distance of a wall a step of 1 cm to the side moves the image by fx / 131.25 = 1 pixel."""


def wall(shift_px: int = 0, *, texture: str = "spots", gain: float = 1.0, offset: float = 0.0) -> sw.Frame:
    """A wall with a texture, seen after a step of `shift_px` centimetres to the right."""
    height, width = CAMERA.height, CAMERA.width + 60
    if texture == "spots":
        noise = np.random.default_rng(4).standard_normal((height, width))
        grey = 128 + 40 * cv2.GaussianBlur(noise, (0, 0), 1.5) / 0.19
    elif texture == "tiles":
        v, u = np.mgrid[:height, :width]
        grey = 128 + 50.0 * (((u // 5) + (v // 5)) % 2 * 2 - 1)
    else:
        grey = np.full((height, width), 128.0)
    seen = np.clip(gain * grey[:, shift_px : shift_px + CAMERA.width] + offset, 0, 255).astype(np.uint8)
    plain = frame_of(plane_depth((0, 0, 1), WALL_M))
    return replace(plain, color=np.repeat(seen[:, :, None], 3, axis=2))


def features_of(frame: sw.Frame, config: ImageFeatureConfig | None = None) -> FrameFeatures:
    return detect(sw.build_pyramid(frame), config)


class TestDetect:
    def test_places_are_those_of_the_depth(self) -> None:
        """A pixel's point projects back onto it, at the depth of the pixel that it rounds to."""
        frame = rendered(count=40).frames[0]
        features = features_of(frame)
        assert len(features) > 300
        pixels, inside = CAMERA.project(features.points_m)
        assert inside.all()
        np.testing.assert_allclose(pixels, features.pixels, atol=1e-4)
        u, v = np.rint(features.pixels).astype(int).T
        np.testing.assert_array_equal(features.points_m[:, 2], frame.depth_m[v, u])

    def test_noise_grows_with_the_size_of_the_corner(self) -> None:
        """sigma^2 = depth noise^2 + (z s / f)^2 with s >= 1 the scale: on a wall at one depth a pixel is 1 cm."""
        sigma = features_of(wall()).sigma_m
        assert sigma.min() > 0.01
        assert sigma.max() <= np.hypot(0.01 * 1.2**7, 0.03)

    def test_spread_over_the_image(self) -> None:
        """The right half has a third of the contrast, so its corners are weaker: by strength alone all come from the
        left half."""
        frame = wall()
        color = frame.color.astype(np.float64)
        color[:, 80:] = 128 + 0.3 * (color[:, 80:] - 128)
        features = features_of(replace(frame, color=color.astype(np.uint8)), ImageFeatureConfig(count=400))
        assert len(features) == 400
        assert 160 < (features.pixels[:, 0] < 80).sum() < 280

    def test_no_feature_on_an_edge_of_the_depth(self) -> None:
        depth = plane_depth((0, 0, 1), WALL_M)
        depth[:, 80:] = 3.0
        features = features_of(replace(wall(), depth_m=depth))
        assert len(features) > 100
        assert (np.abs(features.pixels[:, 0] - 79.5) > 0.6).all()

    def test_nothing_to_see(self) -> None:
        tiny = sw.PinholeCamera(20, 20, 10, 10, 20, 20)
        for frame in (
            replace(wall(), color=None),
            wall(texture="none"),
            blind(wall()),
            sw.Frame(0.0, np.ones((20, 20), np.float32), np.zeros((20, 20, 3), np.uint8), tiny),
        ):
            features = features_of(frame)
            assert len(features) == 0
            assert features.descriptors.shape == (0, 32)
            assert match(features, features_of(wall())).shape == (0, 2)
            result = align_features(features, features_of(wall())).result
            assert result.status is Status.TOO_FEW_CORRESPONDENCES
            assert result.note

    def test_same_bytes_at_any_thread_count(self) -> None:
        frame, before, found = rendered(count=40).frames[7], cv2.getNumThreads(), []
        try:
            for threads in (1, 2, 8):
                cv2.setNumThreads(threads)
                features = features_of(frame)
                pairs = match(features, features_of(rendered(count=40).frames[12]))
                found.append([*(getattr(features, name).tobytes() for name in features.__slots__), pairs.tobytes()])
        finally:
            cv2.setNumThreads(before)
        assert found[0] == found[1] == found[2]

    @pytest.mark.parametrize("setting", [{"count": 0}, {"max_ratio": 1.5}, {"levels": 0}, {"min_agreeing": 1}])
    def test_settings_out_of_range(self, setting: dict[str, float]) -> None:
        with pytest.raises(ConfigError, match=next(iter(setting))):
            ImageFeatureConfig(**setting)


class TestMatch:
    def test_pairs_are_mutual_and_one_to_one(self) -> None:
        a, b = (features_of(rendered(count=40).frames[k]) for k in (0, 20))
        pairs = match(a, b)
        assert len(pairs) > 50
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
        assert (np.diff(pairs[:, 0]) > 0).all()
        differ = np.unpackbits(a.descriptors[pairs[:, 0], None] ^ b.descriptors, axis=2).sum(axis=2)
        least = differ[np.arange(len(pairs)), pairs[:, 1]]
        np.testing.assert_array_equal(least, differ.min(axis=1))
        assert (least < 0.9 * np.sort(differ, axis=1)[:, 1]).all()
        back = np.unpackbits(a.descriptors ^ b.descriptors[pairs[:, 1], None], axis=2).sum(axis=2)
        np.testing.assert_array_equal(least, back.min(axis=1))

    def test_a_frame_matches_itself(self) -> None:
        features = features_of(rendered(count=40).frames[0])
        pairs = match(features, features)
        np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])
        assert len(pairs) > 0.9 * len(features)


class TestAlign:
    @pytest.mark.parametrize("noise", ["none", "kinect"])
    def test_finds_the_motion(self, noise: str) -> None:
        sequence = rendered(noise=noise, count=40)
        G = sequence.ground_truth.T_world_camera
        found = align_features(*(features_of(sequence.frames[k]) for k in (0, 39)))
        true = se3.inverse(G[39]) @ G[0]
        shift, turn = pose_error(found.result.T_target_source, true)
        assert found.result.status is Status.CONVERGED
        assert shift < 0.08  # half of what there is to find; pixels are 20 mm apart
        assert turn < 2
        assert pose_error(np.eye(4), true)[0] > 0.15
        assert found.share_within(true) > 0.9
        assert found.share_within(np.eye(4)) < 0.2

    def test_step_along_a_wall(self) -> None:
        """15 cm to the right: every point is 15 cm further to the left, x_b = x_a - 0.15."""
        found = align_features(features_of(wall()), features_of(wall(15)))
        assert found.result.status is Status.CONVERGED
        np.testing.assert_allclose(found.result.T_target_source[:3, 3], [-0.15, 0, 0], atol=0.005)

    def test_equations_hold_the_pairs(self) -> None:
        """The Gauss-Newton step from a motion nearby leads back to the least-squares motion."""
        found = align_features(features_of(wall()), features_of(wall(15)))
        T = se3.exp([1e-3, -2e-3, 1e-3, 1e-3, 0, -1e-3]) @ found.result.T_target_source
        for _ in range(3):
            equations = found.equations(T)
            T = se3.exp(-np.linalg.solve(equations.information, equations.gradient)) @ T
        moved = se3.transform_points(T, found.source_m)
        weights = found.sigma_m**-2.0
        np.testing.assert_allclose(weights @ (moved - found.target_m) / weights.sum(), 0, atol=1e-9)
        assert equations.total_weight == pytest.approx(weights.sum())

    def test_unrelated_views_agree_on_nothing(self) -> None:
        a = features_of(rendered("room", path="sweep", count=40).frames[39])
        found = align_features(a, features_of(rendered("corridor", count=40).frames[39]))
        assert found.result.status is Status.NO_OVERLAP
        assert found.result.note
        assert len(found.source_m) == len(found.target_m) == len(found.sigma_m) == 0
        assert found.share_within(np.eye(4)) == 0


class TestAppearance:
    STEP = se3.exp([-0.15, 0, 0, 0, 0, 0])

    @staticmethod
    def compare(a: sw.Frame, b: sw.Frame, T: np.ndarray) -> object:
        return compare_appearance(sw.build_pyramid(a), sw.build_pyramid(b), T)

    @pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.5, 60.0), (0.7, -10.0)])
    def test_right_motion_looks_alike_whatever_the_exposure(self, gain: float, offset: float) -> None:
        result = self.compare(wall(), wall(15, gain=gain, offset=offset), self.STEP)
        assert result.telling
        assert result.correlation > 0.98  # 1 but for rounding to grey levels, and highlights that are cut off
        assert result.compared > 0.7 * CAMERA.width * CAMERA.height / 2

    def test_wrong_motion_along_the_wall_does_not(self) -> None:
        """The wall agrees with itself in depth; spots of 1.5 pixels that are 15 pixels off do not."""
        result = self.compare(wall(), wall(15), np.eye(4))
        assert result.telling
        assert abs(result.correlation) < 0.1

    def test_negative_is_the_opposite(self) -> None:
        result = self.compare(wall(), wall(gain=-1, offset=255), np.eye(4))
        assert result.correlation < -0.98

    def test_light_from_above_is_no_evidence(self) -> None:
        """Two textures in the same gradient of light: the plain correlation is high, that of the textures is not."""
        light = np.linspace(-70, 70, CAMERA.height)[:, None, None]
        a, b = (np.clip(f.color * 0.3 + 90 + light, 0, 255).astype(np.uint8) for f in (wall(), wall(37)))
        assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.8
        result = self.compare(replace(wall(), color=a), replace(wall(), color=b), np.eye(4))
        assert abs(result.correlation) < 0.1

    def test_nothing_to_compare_tells_nothing(self) -> None:
        away = se3.exp([0, 0, 0, 0, np.pi, 0])
        for a, b, T in (
            (replace(wall(), color=None), wall(), np.eye(4)),
            (wall(), replace(wall(), color=None), np.eye(4)),
            (wall(), blind(wall()), np.eye(4)),
            (wall(), wall(), away),
        ):
            result = self.compare(a, b, T)
            assert not result.telling
            assert (result.compared, result.correlation) == (0, 0.0)

    def test_plain_walls_tell_nothing(self) -> None:
        rng = np.random.default_rng(1)
        noisy = [
            replace(wall(), color=(128 + rng.standard_normal((*CAMERA.shape, 3))).round().astype(np.uint8))
            for _ in range(2)
        ]
        result = self.compare(*noisy, np.eye(4))
        assert result.contrast < MIN_CONTRAST
        assert not result.telling

    def test_other_surfaces_are_left_out(self) -> None:
        """Half of the wall has moved away by 20 cm: only the other half is compared."""
        depth = plane_depth((0, 0, 1), WALL_M)
        depth[:, 80:] += 0.2
        whole = self.compare(wall(), wall(), np.eye(4)).compared
        half = self.compare(wall(), replace(wall(), depth_m=depth), np.eye(4)).compared
        assert half == pytest.approx(whole / 2, rel=0.05)


class TestTwoFramesWithColour:
    def test_textured_wall_is_held_by_its_features(self) -> None:
        """Depth leaves three directions of a wall free; the features know them to a fraction of a pixel (1 cm)."""
        result = sw.align_frames(wall(), wall(15))
        assert result.status is Status.CONVERGED
        assert result.unobservable == ()
        shift, turn = pose_error(result.T_target_source, TestAppearance.STEP)
        assert shift < 0.005
        assert turn < 0.3
        assert np.linalg.eigvalsh(result.information)[0] > 1e4  # 1 cm at worst

    def test_wall_whose_texture_repeats_has_no_confident_wrong_answer(self) -> None:
        """Tiles of 5 pixels, dark and bright by turns: a step of 10 cm looks like none, one of 13 cm does not."""
        still, other = (sw.align_frames(wall(texture="tiles"), wall(step, texture="tiles")) for step in (10, 13))
        assert still.status is Status.DEGENERATE
        assert len(still.unobservable) == 3
        np.testing.assert_allclose(still.T_target_source, np.eye(4), atol=1e-3)
        assert not other.status.success

    def test_without_texture_depth_decides(self) -> None:
        sequence = rendered(count=40)
        grey = [replace(sequence.frames[k], color=np.full((*CAMERA.shape, 3), 90, np.uint8)) for k in (0, 5)]
        assert sw.align_frames(*grey).status is Status.CONVERGED

    def test_frame_whose_colours_are_another_scenes_is_refused(self) -> None:
        frames = rendered(count=40).frames
        painted = replace(frames[5], color=rendered("corridor", count=40).frames[5].color)
        result = sw.align_frames(frames[0], painted)
        assert result.status is Status.NO_OVERLAP
        assert "look alike" in result.note
        tolerant = sw.TwoFrameConfig(min_correlation=0.0)
        depth_only = sw.align_frames(frames[0], replace(painted, color=None), config=tolerant)
        assert depth_only.status is Status.CONVERGED
