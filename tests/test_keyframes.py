"""Keyframes: what is kept of a frame, its fern code, and when a frame becomes one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import scanweld as sw
from rendered import blind, rendered
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.loop_closure.ferns import FernCode, FernConfig, Ferns, similarities
from scanweld.loop_closure.keyframes import (
    Keyframe,
    KeyframeConfig,
    Sighting,
    keyframe_of,
    keyframe_reason,
    sighting_of,
)


def frames(noise: str = "kinect") -> tuple[sw.Frame, ...]:
    found = rendered("room", noise, count=40).frames
    assert all(frame is not None for frame in found)
    return found  # type: ignore[return-value]


def enlarged(frame: sw.Frame, factor: int) -> sw.Frame:
    """The same view with `factor` times the pixels along each side, each pixel repeated."""
    depth = np.repeat(np.repeat(frame.depth_m, factor, axis=0), factor, axis=1)
    color = np.repeat(np.repeat(frame.color, factor, axis=0), factor, axis=1)
    return sw.Frame(frame.timestamp_s, depth, color, frame.camera.scaled(factor))


def sight(frame: sw.Frame, config: KeyframeConfig | None = None) -> Sighting:
    config = config or KeyframeConfig()
    return sighting_of(sw.build_pyramid(frame, config.surfaces), Ferns(config.ferns), config)


def keep(frame: sw.Frame, T_world_camera: np.ndarray | None = None) -> Keyframe:
    return keyframe_of(sight(frame), np.eye(4) if T_world_camera is None else T_world_camera, index=0, frame_index=7)


def code_similarity(a: FernCode, b: FernCode) -> float:
    return float(similarities(a, b.depth[None], b.grey[None], np.array([b.has_grey]))[0])


class TestStoredFrame:
    def test_depth_and_grey_are_kept_to_half_a_step(self) -> None:
        """65535 steps up to the largest depth: half a step of a room of 5 m is 0.04 mm."""
        frame = frames()[0]
        kept = keep(frame)
        stored = kept.frame()
        assert kept.depth_step_m == pytest.approx(frame.depth_m.max() / 65535)
        np.testing.assert_allclose(stored.depth_m, frame.depth_m, atol=0.51 * kept.depth_step_m)
        np.testing.assert_array_equal(stored.depth_m > 0, frame.depth_m > 0)
        assert stored.camera == frame.camera
        # Y = 0.299 R + 0.587 G + 0.114 B
        np.testing.assert_allclose(stored.color[..., 0], frame.color @ np.array([0.299, 0.587, 0.114]), atol=1)

    def test_large_images_are_halved(self) -> None:
        """640x480 pixels become 320x240, whose centres lie between four of the old: cx' = (cx + 1/2) / 2 - 1/2."""
        large = enlarged(frames()[0], 4)
        kept = keep(large)
        c = large.camera
        assert kept.camera.shape == (240, 320)
        assert kept.camera.fx == pytest.approx(c.fx / 2)
        assert kept.camera.cx == pytest.approx((c.cx + 0.5) / 2 - 0.5)
        # A pixel that was repeated four times along each side is there twice now, unchanged.
        np.testing.assert_array_equal(kept.frame().depth_m[::2, ::2] > 0, frames()[0].depth_m > 0)
        assert kept.grey is not None
        again = keep(frames()[0]).grey
        np.testing.assert_array_equal(kept.grey[::2, ::2], again)

    def test_two_thousand_fit_into_memory(self) -> None:
        """320x240 x (2 + 1) bytes = 230 kB, and features: 2000 keyframes are 0.6 GB at most."""
        kept = keep(enlarged(frames()[0], 4))
        assert 230_400 < kept.num_bytes < 300_000

    @pytest.mark.parametrize("levels", [1, 2, 3])
    @pytest.mark.parametrize("crop", [0, 1, 3])
    def test_any_size_and_any_pyramid(self, levels: int, crop: int) -> None:
        """Odd last rows and columns are dropped with each halving, in depth and grey alike."""
        large = enlarged(frames()[0], 4)
        height, width = large.depth_m.shape
        camera = replace(large.camera, width=width - crop, height=height - crop)
        rest = np.s_[: height - crop, : width - crop]
        cropped = sw.Frame(0.0, np.ascontiguousarray(large.depth_m[rest]), large.color[rest].copy(), camera)
        config = KeyframeConfig(surfaces=sw.SurfaceConfig(levels=levels))
        reduced = sight(cropped, config).pyramid
        assert reduced.frame.camera.shape == ((480 - crop) // 2, (640 - crop) // 2)
        assert reduced.frame.depth_m.shape == reduced.frame.color.shape[:2] == reduced.frame.camera.shape
        assert reduced.levels[0].surface[..., 6].any()
        whole = sight(large).pyramid.frame
        inner = np.s_[:200, :300]
        np.testing.assert_array_equal(reduced.frame.depth_m[inner], whole.depth_m[inner])
        np.testing.assert_array_equal(reduced.frame.color[inner], whole.color[inner])

    def test_surfaces_that_are_there_are_taken_over(self) -> None:
        pyramid = sw.build_pyramid(enlarged(frames()[0], 4))
        reduced = sighting_of(pyramid, Ferns()).pyramid
        assert reduced.levels[0] is pyramid.levels[1]

    def test_without_colour(self) -> None:
        kept = keep(replace(frames()[0], color=None))
        assert kept.grey is None
        assert kept.frame().color is None
        assert len(kept.features) == 0
        assert not kept.code.has_grey

    def test_pose_is_its_own_and_replaceable(self) -> None:
        T = np.eye(4)
        kept = keep(frames()[0], T)
        T[0, 3] = 5.0
        assert kept.T_world_camera[0, 3] == 0.0
        moved = replace(kept, T_world_camera=T)
        assert moved.T_world_camera[0, 3] == 5.0
        assert moved.depth_steps is kept.depth_steps


class TestFerns:
    def test_same_configuration_same_codes(self) -> None:
        pyramid = sw.build_pyramid(frames()[0])
        a, b = Ferns().encode(pyramid), Ferns().encode(pyramid)
        assert a.depth.tobytes() == b.depth.tobytes()
        assert a.grey.tobytes() == b.grey.tobytes()
        other = Ferns(FernConfig(seed=1)).encode(pyramid)
        assert a.depth.tobytes() != other.depth.tobytes()
        assert a.depth.shape == a.grey.shape == (FernConfig().count,)
        assert max(a.depth.max(), a.grey.max()) < 16

    def test_sensor_noise_changes_little(self) -> None:
        """The same views without and with the noise of a sensor, and views of another scene."""
        clean, noisy, elsewhere = frames("none"), frames(), rendered("corridor", "kinect", count=40).frames
        ferns = Ferns()
        for k in (0, 20, 39):
            a, b, c = (ferns.encode(sw.build_pyramid(f)) for f in (clean[k], noisy[k], elsewhere[k]))
            assert code_similarity(a, b) > 0.85
            assert code_similarity(a, c) < KeyframeConfig().max_similarity

    def test_exposure_changes_little(self) -> None:
        frame = frames()[0]
        darker = replace(frame, color=(0.6 * frame.color.astype(np.float64) + 12).astype(np.uint8))
        a, b = (Ferns().encode(sw.build_pyramid(f)) for f in (frame, darker))
        np.testing.assert_array_equal(a.depth, b.depth)
        assert (a.grey == b.grey).mean() > 0.9

    def test_neighbours_in_time_are_more_alike(self) -> None:
        codes = [Ferns().encode(sw.build_pyramid(frames()[k])) for k in (0, 5, 39)]
        assert code_similarity(codes[0], codes[1]) > code_similarity(codes[0], codes[2])

    def test_colour_counts_only_where_both_have_it(self) -> None:
        """By hand: 3 of 4 depth ferns and 1 of 4 grey ferns agree, (3/4 + 1/4) / 2 = 1/2; by depth alone 3/4."""
        a = FernCode(np.array([1, 2, 3, 4], np.uint8), np.array([1, 2, 3, 4], np.uint8), True)
        depth, grey = np.array([[1, 2, 3, 5]] * 2, np.uint8), np.array([[1, 0, 0, 0]] * 2, np.uint8)
        np.testing.assert_allclose(similarities(a, depth, grey, np.array([True, False])), [0.5, 0.75])
        blank = replace(a, has_grey=False)
        np.testing.assert_allclose(similarities(blank, depth, grey, np.array([True, False])), [0.75, 0.75])


class TestReason:
    @staticmethod
    def reason(T: np.ndarray, similarity: float = 1.0, frame: sw.Frame | None = None, first: bool = False) -> str:
        config = KeyframeConfig()
        pyramid = sw.build_pyramid(frame or frames()[0], config.surfaces)
        return keyframe_reason(pyramid, T, None if first else keep(frames()[0]), similarity, config)

    def test_the_first(self) -> None:
        assert self.reason(np.eye(4), first=True)

    def test_nothing_new(self) -> None:
        assert self.reason(np.eye(4)) == ""

    def test_new_content(self) -> None:
        config = KeyframeConfig()
        assert "unlike" in self.reason(np.eye(4), similarity=config.max_similarity - 0.01)
        assert self.reason(np.eye(4), similarity=config.max_similarity + 0.01) == ""

    def test_motion_counts_in_depths(self) -> None:
        depth = frames()[0].depth_m
        limit_m = KeyframeConfig().max_shift * np.median(depth[depth > 0])
        for share, moved in ((0.9, False), (1.1, True)):
            T = np.eye(4)
            T[0, 3] = share * limit_m
            assert ("moved" in self.reason(T)) is moved

    def test_turn(self) -> None:
        limit = KeyframeConfig().max_turn_rad
        for share, turned in ((0.95, False), (1.05, True)):
            T = se3.exp(np.array([0, 0, 0, 0, share * limit, 0]))
            assert ("turned" in self.reason(T)) is turned

    def test_blank_frames_never(self) -> None:
        far = se3.exp(np.array([3.0, 0, 0, 0, 1, 0]))
        for first in (True, False):
            assert self.reason(far, similarity=0.0, frame=blind(frames()[0]), first=first) == ""
        hardly = np.zeros_like(frames()[0].depth_m)
        hardly[:20, :20] = 1.0  # 400 of 19200 pixels
        assert self.reason(far, similarity=0.0, frame=replace(frames()[0], depth_m=hardly)) == ""

    @pytest.mark.parametrize("setting", [{"min_usable": 0.0}, {"max_similarity": 1.5}, {"max_width_px": 10}])
    def test_settings_out_of_range(self, setting: dict[str, float]) -> None:
        with pytest.raises(ConfigError, match=next(iter(setting))):
            KeyframeConfig(**setting)


def test_features_are_those_of_the_reduced_image() -> None:
    """Points lie on the rays of their pixels in the reduced camera."""
    seen = sight(enlarged(frames()[0], 4))
    camera = seen.pyramid.frame.camera
    pixels, inside = camera.project(seen.features.points_m)
    assert inside.all()
    assert len(seen.features) > 100
    np.testing.assert_allclose(pixels, seen.features.pixels, atol=1e-3)
