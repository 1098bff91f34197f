"""Pyramid, vertices, normals and their noise against plain NumPy and against planes known by their equation."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

import scanweld as sw
from rendered import CAMERA, frame_of, plane_depth
from scanweld.geometry import kernels
from scanweld.geometry.depth import (
    bilateral_filter,
    half_size,
    intrinsics_array,
    luminance,
    noise_scale,
    surface_image,
    window_radius,
)

SMALL = sw.PinholeCamera(60.0, 62.0, 30.2, 22.9, 61, 47)


def random_depth(seed: int, shape: tuple[int, int] = (47, 61), invalid: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 4, shape).astype(np.float32)
    depth[rng.random(shape) < invalid] = 0
    return depth


def halved(depth: np.ndarray, band: float) -> np.ndarray:
    """The mean of the pixels of each 2x2 block within the band of the nearest valid one."""
    out = np.zeros((depth.shape[0] // 2, depth.shape[1] // 2))
    for v, u in np.ndindex(*out.shape):
        block = depth[2 * v : 2 * v + 2, 2 * u : 2 * u + 2].astype(np.float64)
        block = block[block > 0]
        if block.size:
            out[v, u] = block[block <= block.min() * (1 + band)].mean()
    return out


def slanted_steps(seed: int, camera: sw.PinholeCamera) -> np.ndarray:
    """Depth of tilted planes behind each other, with noise and holes: all that the window has to tell apart."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    planes = [plane_depth((0.5, 0.1, 1), 1.0, camera), plane_depth((-0.2, 0.4, 1), 2.0, camera)]
    depth = np.where((u // 17 + v // 11) % 2 == 0, *planes)
    depth = depth * (1 + 0.0005 * rng.standard_normal(depth.shape))
    depth[rng.random(depth.shape) < 0.05] = 0
    return depth.astype(np.float32)


def plain_surface(depth_m: np.ndarray, camera: sw.PinholeCamera, config: sw.SurfaceConfig) -> np.ndarray:
    """The surface image (H, W, 8) by its definition, in double precision: sums over the pairs of the window."""
    depth, r = depth_m.astype(np.float64), window_radius(camera, config)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    sigma = config.noise_floor_m + config.noise_growth * (depth - config.noise_nearest_m) ** 2
    padded = np.pad(inverse, r)
    height, width = depth.shape
    sxx, sxy, syy, sx, sy = np.zeros((5, height, width))
    for dv in range(r + 1):
        for du in range(-r if dv else 1, r + 1):
            a = padded[r - dv : r - dv + height, r - du : r - du + width]
            b = padded[r + dv : r + dv + height, r + du : r + du + width]
            use = (depth > 0) & (a > 0) & (b > 0) & (np.abs(a + b - 2 * inverse) < 8 * sigma * inverse**2)
            slope = np.where(use, b - a, 0)
            sxx, sxy, syy = sxx + use * du * du, sxy + use * du * dv, syy + use * dv * dv
            sx, sy = sx + slope * du, sy + slope * dv
    determinant = sxx * syy - sxy**2
    good = determinant > 0.5
    good[:, :r] = good[:, max(width - r, 0) :] = False
    scale = 0.5 / np.where(good, determinant, 1)
    rays = camera.rays()
    a, b = camera.fx * scale * (syy * sx - sxy * sy), camera.fy * scale * (sxx * sy - sxy * sx)
    n = np.stack([a, b, inverse - a * rays[..., 0] - b * rays[..., 1]], axis=-1)
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-30)
    cosine = (n * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    good &= cosine > config.min_cosine
    radius = depth * 0.70711 / camera.fx / np.maximum(cosine, 0.26)
    rest = np.concatenate([-n, (1 / sigma)[..., None], radius[..., None]], axis=-1)
    return np.concatenate([rays * depth[..., None], np.where(good[..., None], rest, 0)], axis=-1)


class TestHalfSize:
    @pytest.mark.parametrize("shape", [(47, 61), (48, 60), (2, 9), (2, 2), (3, 3)])
    def test_matches_numpy(self, shape: tuple[int, int]) -> None:
        depth = random_depth(1, shape)
        camera = sw.PinholeCamera(50, 50, 3, 3, shape[1], shape[0])
        half, smaller = half_size(depth, camera, 0.2)
        assert half.shape == smaller.shape
        np.testing.assert_allclose(half, halved(depth, 0.2), rtol=1e-6)

    def test_every_combination_of_invalid_pixels(self) -> None:
        for pattern in range(16):
            block = np.array([1.0, 1.01, 1.02, 1.03], np.float32) * [bool(pattern & 1 << k) for k in range(4)]
            half, _ = half_size(block.reshape(2, 2).astype(np.float32), sw.PinholeCamera(1, 1, 0, 0, 2, 2))
            valid = block[block > 0]
            assert half[0, 0] == pytest.approx(valid.mean() if valid.size else 0.0)

    def test_no_average_across_an_edge(self) -> None:
        rng = np.random.default_rng(2)
        depth = np.where(rng.random((60, 80)) < 0.5, 1.0, 1.5).astype(np.float32)
        half, _ = half_size(depth, sw.PinholeCamera(50, 50, 40, 30, 80, 60))
        assert set(np.unique(half.round(6))) <= {np.float32(1.0), np.float32(1.5)}
        # The nearer surface wins, so a thin object in front does not vanish.
        assert (half < 1.25).mean() == pytest.approx(15 / 16, abs=0.03)

    def test_all_invalid_stays_invalid(self) -> None:
        half, _ = half_size(np.zeros((10, 10), np.float32), sw.PinholeCamera(9, 9, 4, 4, 10, 10))
        assert not half.any()

    def test_block_of_four_and_its_camera_see_the_same_plane(self) -> None:
        """Pixel centres of the half image lie between four old ones (golden 9): a plane stays that plane."""
        depth = plane_depth((0.2, -0.3, 1), 1.5)
        half, camera = half_size(depth, CAMERA)
        assert camera.scaled(2) == CAMERA
        # The mean of 1/z would be exact; the mean of z is off by the variance of z within a block.
        np.testing.assert_allclose(half, plane_depth((0.2, -0.3, 1), 1.5, camera), rtol=2e-5)


class TestSurfaces:
    @pytest.mark.parametrize("radius", [1, 2, 3])
    @pytest.mark.parametrize("size", [(61, 47), (1100, 13)])
    def test_matches_numpy(self, size: tuple[int, int], radius: int) -> None:
        """Also where a row is longer than a block of the kernel.

        An inverse depth near 1 / m is rounded to 2^-24, a slope in units of the focal length by fx times that.
        """
        camera = sw.PinholeCamera(60.0 * size[0] / 61, 62.0 * size[1] / 47, size[0] / 2, size[1] / 2, *size)
        depth, config = slanted_steps(radius, camera), sw.SurfaceConfig(normal_radius=radius)
        surface, expected = surface_image(depth, camera, config), plain_surface(depth, camera, config)
        has = expected[..., 6] > 0
        assert has.mean() > 0.3
        np.testing.assert_array_equal(surface[..., 6] > 0, has)
        np.testing.assert_allclose(surface[..., :3], expected[..., :3], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(surface[..., 3:6], expected[..., 3:6], atol=2e-5 + camera.fx * 2**-23)
        np.testing.assert_allclose(surface[..., 6:], expected[..., 6:], rtol=1e-4)

    @given(
        tilt=st.floats(0, 1.1), turn=st.floats(0, 2 * np.pi), distance_m=st.floats(0.3, 4),
        radius=st.integers(1, 4),
    )  # fmt: skip
    def test_plane_is_exact_in_any_direction(self, tilt: float, turn: float, distance_m: float, radius: int) -> None:
        n = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        cosine = (SMALL.rays() @ n) / np.linalg.norm(SMALL.rays(), axis=-1)
        with np.errstate(divide="ignore"):
            depth = distance_m / (SMALL.rays() @ n)
        seen = (cosine > 0.2) & (depth < 60)
        depth = np.where(seen, depth, 0).astype(np.float32)
        config = sw.SurfaceConfig(normal_radius=radius)
        surface = surface_image(depth, SMALL, config)
        np.testing.assert_allclose(surface[..., 0:3], SMALL.rays() * depth[..., None], rtol=1e-5, atol=1e-6)
        # Where the whole window is seen there is a normal, it is unit, and it is the plane's.
        inner = np.zeros_like(seen)
        inner[radius:-radius, radius:-radius] = seen[radius:-radius, radius:-radius]
        for dv in range(-radius, radius + 1):
            for du in range(-radius, radius + 1):
                inner &= np.roll(seen, (dv, du), (0, 1))
        assert (surface[inner, 6] > 0).all()
        has = surface[..., 6] > 0
        assert np.abs(surface[has, 3:6] + n).max(initial=0) < 1e-3
        assert not has[depth == 0].any()
        sigma = 0.0012 + 0.0019 * (depth[has] - 0.4) ** 2
        np.testing.assert_allclose(surface[has, 6], 1 / sigma, rtol=1e-5)
        expected = depth[has] * np.sqrt(0.5) / SMALL.fx / np.maximum(cosine[has], 0.26)
        np.testing.assert_allclose(surface[has, 7], expected, rtol=2e-3)

    def test_noise_of_normals_is_that_of_the_whole_window(self) -> None:
        """Least squares over the 24 neighbours of a 5x5 window: the slope of 1/z has the standard deviation
        sigma / z^2 / sqrt(50) per pixel (the sum of du^2 is 50), the normal's tilt is f z times that."""
        rng = np.random.default_rng(3)
        depth = (1.0 + 0.0005 * rng.standard_normal(CAMERA.shape)).astype(np.float32)
        surface = surface_image(depth, CAMERA, sw.SurfaceConfig())
        normals = surface[5:-5, 5:-5, 3:6]
        expected = CAMERA.fx * 0.0005 / np.sqrt(50)
        assert normals[..., 0].std() == pytest.approx(expected, rel=0.1)
        assert normals[..., 1].std() == pytest.approx(expected, rel=0.1)
        assert np.abs(normals[..., :2].mean(axis=(0, 1))).max() < expected / 20

    @pytest.mark.parametrize("radius", [1, 2, 4])
    @pytest.mark.parametrize("kind", ["vertical", "horizontal", "diagonal", "blobs", "speckles"])
    def test_no_normal_leans_across_a_step(self, kind: str, radius: int) -> None:
        v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
        rng = np.random.default_rng(4)
        near = {
            "vertical": u < 70,
            "horizontal": v < 50,
            "diagonal": u + 2 * v < 190,
            "blobs": np.sin(u / 7) * np.sin(v / 5) > 0.2,
            "speckles": rng.random(CAMERA.shape) < 0.2,
        }[kind]
        depth = np.where(near, plane_depth((0.1, 0, 1), 1.0), plane_depth((0, 0.2, 1), 1.4))
        surface = surface_image(depth.astype(np.float32), CAMERA, sw.SurfaceConfig(normal_radius=radius))
        true = np.where(near[..., None], np.array([-0.1, 0, -1]) / 1.01**0.5, np.array([0, -0.2, -1]) / 1.04**0.5)
        has = surface[..., 6] > 0
        assert np.abs(surface[has, 3:6] - true[has]).max() < 2e-3
        if kind != "speckles":
            assert has.mean() > 0.6

    def test_grazing_surfaces_have_no_normal(self) -> None:
        """A floor 1 m below: the cosine at a pixel is y / |ray|, so the limit runs along a known curve."""
        rays = CAMERA.rays()
        cosine = rays[..., 1] / np.linalg.norm(rays, axis=-1)
        depth = np.where(cosine > 0.02, 1.0 / np.maximum(rays[..., 1], 1e-6), 0).astype(np.float32)
        surface = surface_image(depth, CAMERA, sw.SurfaceConfig(min_cosine=0.15, max_depth_m=100))
        inner = np.zeros(CAMERA.shape, bool)
        inner[2:-2, 2:-2] = True
        assert (surface[inner & (cosine > 0.151), 6] > 0).all()
        assert not (surface[cosine < 0.149, 3:] != 0).any()

    def test_invalid_pixels_are_all_zero(self) -> None:
        depth = random_depth(5, SMALL.shape)
        surface = surface_image(depth, SMALL, sw.SurfaceConfig())
        assert not surface[depth == 0].any()
        without = surface[..., 6] == 0
        assert not surface[without, 3:].any()
        np.testing.assert_array_equal(surface[..., 2], depth)

    @pytest.mark.parametrize(("focal_px", "expected"), [(150, 2), (525, 2), (640, 2), (920, 4), (1050, 4), (2100, 8)])
    def test_window_of_fine_images_is_as_wide_on_the_surface(self, focal_px: float, expected: int) -> None:
        camera = sw.PinholeCamera(focal_px, focal_px, 10, 10, 21, 21)
        assert window_radius(camera, sw.SurfaceConfig()) == expected

    @pytest.mark.parametrize("shape", [(1, 1), (3, 2), (4, 5), (5, 4), (16, 3)])
    def test_images_smaller_than_the_window(self, shape: tuple[int, int]) -> None:
        camera = sw.PinholeCamera(5, 5, 1, 1, shape[1], shape[0])
        surface = surface_image(np.ones(shape, np.float32), camera, sw.SurfaceConfig(normal_radius=8))
        assert np.isfinite(surface).all()
        np.testing.assert_array_equal(surface[..., 2], 1)

    def test_rows_do_not_depend_on_how_they_are_shared_out(self) -> None:
        depth = random_depth(6, SMALL.shape, invalid=0.05) * np.float32(0.01) + np.float32(1)
        config = sw.SurfaceConfig(normal_radius=3)
        arguments = (depth, intrinsics_array(SMALL), 3, config.noise, np.float32(0.15))
        whole, pieces = (np.full((47, 61 * 8), 7, np.float32) for _ in range(2))
        kernels.surface_rows(0, 47, *arguments, whole)
        for start, stop in ((20, 21), (0, 1), (21, 47), (1, 20)):
            kernels.surface_rows(start, stop, *arguments, pieces)
        assert whole.tobytes() == pieces.tobytes()

    def test_wrong_shape_is_refused(self) -> None:
        with pytest.raises(sw.InvalidInputError, match=r"\(47, 60\)"):
            surface_image(np.ones((47, 60), np.float32), SMALL, sw.SurfaceConfig())


class TestNoiseScale:
    def test_matches_numpy(self) -> None:
        rng = np.random.default_rng(11)
        depth = (plane_depth((0.2, 0.1, 1), 1.5) * (1 + 0.01 * rng.standard_normal(CAMERA.shape))).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0
        config, ratios = sw.SurfaceConfig(), []
        for image in (depth[::8].astype(np.float64), depth.T[::8].astype(np.float64)):
            before, centre, behind = image[:, :-6:4], image[:, 3:-3:4], image[:, 6::4]
            valid = (before > 0) & (centre > 0) & (behind > 0)
            a, z, b = before[valid], centre[valid], behind[valid]
            sigma = config.noise_floor_m + config.noise_growth * (z - config.noise_nearest_m) ** 2
            ratios.append(np.abs(1 / a + 1 / b - 2 / z) * z * z / np.sqrt(6) / sigma)
        expected = 1.4826 * np.median(np.concatenate(ratios))
        assert 1 < expected < config.max_noise_scale
        assert noise_scale(depth, config) == pytest.approx(expected, rel=1e-5)

    def test_finds_the_noise_that_was_added(self) -> None:
        """At 2 m the model has 0.0012 + 0.0019 * 1.6^2 m; three times that is seen as three."""
        rng, sigma = np.random.default_rng(12), 0.0012 + 0.0019 * 1.6**2
        depth = 2 + 3 * sigma * rng.standard_normal(CAMERA.shape)
        assert noise_scale(depth.astype(np.float32), sw.SurfaceConfig()) == pytest.approx(3, rel=0.1)

    @pytest.mark.parametrize("shape", [(1, 1), (5, 200), (200, 5), (480, 640)])
    def test_too_little_to_see_trusts_the_model(self, shape: tuple[int, int]) -> None:
        assert noise_scale(np.zeros(shape, np.float32), sw.SurfaceConfig()) == 1.0
        assert noise_scale(np.ones(shape, np.float32), sw.SurfaceConfig()) == 1.0


class TestBilateral:
    def test_matches_numpy(self) -> None:
        depth = random_depth(7, (19, 23)) * np.float32(0.02) + np.float32(1.5)
        depth[random_depth(8, (19, 23)) == 0] = 0
        config = sw.SurfaceConfig()
        smooth = bilateral_filter(depth, config, radius=3, space_sigma=2.0)
        expected = np.zeros(depth.shape)
        for v, u in np.ndindex(*depth.shape):
            z = float(depth[v, u])
            if z == 0:
                continue
            sigma = 3 * (0.0012 + 0.0019 * (z - 0.4) ** 2)
            total = weights = 0.0
            for y in range(max(0, v - 3), min(19, v + 4)):
                for x in range(max(0, u - 3), min(23, u + 4)):
                    other = float(depth[y, x])
                    if other > 0:
                        w = np.exp(-0.5 * (((y - v) ** 2 + (x - u) ** 2) / 4 + ((other - z) / sigma) ** 2))
                        total, weights = total + w * other, weights + w
            expected[v, u] = total / weights
        np.testing.assert_allclose(smooth, expected, rtol=1e-5)

    def test_smooths_noise_and_keeps_an_edge(self) -> None:
        rng = np.random.default_rng(9)
        noise = 0.0015 * rng.standard_normal(CAMERA.shape)
        step = np.where(np.arange(CAMERA.width) < 80, 1.0, 1.3)
        smooth = bilateral_filter((step + noise).astype(np.float32))
        error = (smooth - step)[4:-4, 4:-4]
        assert error.std() < 0.4 * noise.std()
        assert np.abs(error[:, 70:90]).max() < 0.01


class TestPyramid:
    def test_levels_and_cameras(self) -> None:
        pyramid = sw.build_pyramid(frame_of(plane_depth((0, 0, 1), 1.0)))
        assert [level.depth_m.shape for level in pyramid.levels] == [(120, 160), (60, 80), (30, 40)]
        for finer, coarser in zip(pyramid.levels, pyramid.levels[1:], strict=False):
            # Pixel (u, v) of the coarser level lies between (2u, 2v) and (2u + 1, 2v + 1).
            middle = (finer.camera.rays()[0::2, 0::2] + finer.camera.rays()[1::2, 1::2]) / 2
            np.testing.assert_allclose(coarser.camera.rays(), middle, atol=1e-12)

    def test_stops_before_it_is_too_small(self) -> None:
        camera = sw.PinholeCamera(20, 20, 9, 8, 19, 17)
        pyramid = sw.build_pyramid(frame_of(np.ones((17, 19)), camera=camera), sw.SurfaceConfig(levels=6))
        assert [level.depth_m.shape for level in pyramid.levels] == [(17, 19), (8, 9)]

    def test_far_depth_is_invalid_and_the_frame_is_not_touched(self) -> None:
        depth = plane_depth((0, 0, 1), 2.0)
        depth[:, 80:] = 9.0
        frame = frame_of(depth)
        level = sw.build_pyramid(frame, sw.SurfaceConfig(max_depth_m=8.0)).levels[0]
        assert not level.surface[:, 80:].any()
        assert (frame.depth_m[:, 80:] == 9.0).all()

    def test_brightness_of_the_finest_level(self) -> None:
        depth = plane_depth((0, 0, 1), 1.0)
        color = np.random.default_rng(13).integers(0, 256, (*CAMERA.shape, 3), np.uint8)
        grey = sw.build_pyramid(sw.Frame(0.0, depth.astype(np.float32), color, CAMERA)).grey
        assert grey is not None
        np.testing.assert_allclose(grey, color @ np.array([0.299, 0.587, 0.114]), rtol=1e-6)
        np.testing.assert_array_equal(luminance(color[::-1, ::-1]), grey[::-1, ::-1])
        assert sw.build_pyramid(sw.Frame(0.0, depth.astype(np.float32), None, CAMERA)).grey is None

    def test_bilateral_smooths_the_finest_level(self) -> None:
        rng = np.random.default_rng(10)
        frame = frame_of(1.5 + 0.003 * rng.standard_normal(CAMERA.shape))
        plain = sw.build_pyramid(frame).levels[0].normals[10:-10, 10:-10]
        smooth = sw.build_pyramid(frame, sw.SurfaceConfig(bilateral=True)).levels[0].normals[10:-10, 10:-10]
        assert smooth[..., :2].std() < 0.5 * plain[..., :2].std()

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
    def test_depth_that_is_no_measurement_is_refused(self, bad: float) -> None:
        """Kernels test masks, never NaN: what reaches them must be 0 or a depth."""
        depth = plane_depth((0, 0, 1), 1.0)
        depth[7, 9] = bad
        with pytest.raises(sw.InvalidInputError, match="set invalid pixels to 0"):
            frame_of(depth)
