"""The depth cameras: what their noise does on surfaces whose answer is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanweld.arrays import Float32
from scanweld.datasets.synthetic.noise import NOISE_MODELS, NoiseModel, degrade_color, degrade_depth
from scanweld.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)


def _model(name: str, **changes: object) -> NoiseModel:
    model = NOISE_MODELS[name]
    assert model is not None
    return dataclasses.replace(model, **changes)  # type: ignore[arg-type]


def _wall(depth_m: float) -> Float32:
    return np.full(CAMERA.shape, depth_m, np.float32)


def _rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_kinect_depths_are_eighths_of_a_pixel_of_disparity() -> None:
    """8 f b / z is whole: 8 * 525 * 0.075 = 315; next to 2 m lie 315/157 = 2.00637 and 315/158 = 1.99367."""
    noisy = degrade_depth(_wall(2.0), CAMERA, _model("kinect"), _rng())
    steps = 315 / noisy[noisy > 0].astype(np.float64)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    assert len(np.unique(noisy)) < 15
    assert np.float32(315 / 158) in noisy
    assert np.float32(315 / 157) in noisy


def test_the_sensor_has_the_same_steps_at_any_image_size() -> None:
    half = CAMERA.scaled(0.5)
    noisy = degrade_depth(np.full(half.shape, 2.0, np.float32), half, _model("kinect"), _rng())
    steps = 315 / noisy[noisy > 0].astype(np.float64)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


@pytest.mark.parametrize("depth_m", [0.8, 1.5, 3.0])
def test_kinect_noise_grows_with_the_square_of_depth(depth_m: float) -> None:
    """Nguyen et al. 2012: sigma_z = 0.0012 + 0.0019 (z - 0.4)^2; the steps are made fine to see it alone."""
    noisy = degrade_depth(_wall(depth_m), CAMERA, _model("kinect", disparity_step_px=1e-4), _rng())
    seen = noisy[noisy > 0]
    assert seen.std() == pytest.approx(0.0012 + 0.0019 * (depth_m - 0.4) ** 2, rel=0.02)
    assert seen.mean() == pytest.approx(depth_m, abs=1e-4)


def test_realsense_noise_is_stronger_and_shared_by_neighbours() -> None:
    deviation = {}
    for name in ("kinect", "realsense"):
        noisy = degrade_depth(_wall(2.5), CAMERA, _model(name), _rng()).astype(np.float64)
        both = (noisy[:, 1:] > 0) & (noisy[:, :-1] > 0)
        error = noisy - 2.5
        product = (error[:, 1:] * error[:, :-1])[both].mean()
        deviation[name] = error[noisy > 0].std(), product / error[noisy > 0].var()
    assert deviation["realsense"][0] > 1.5 * deviation["kinect"][0]
    assert deviation["realsense"][1] > 0.6
    assert abs(deviation["kinect"][1]) < 0.05
    # sigma_z = 0.0008 + 0.0032 z^2 = 0.0208 m at 2.5 m
    assert deviation["realsense"][0] == pytest.approx(0.0208, rel=0.06)


@pytest.mark.parametrize("name", ["kinect", "realsense"])
def test_edges_are_lost_more_often_than_surfaces_and_shadows_lie_to_the_left(name: str) -> None:
    """A board at 1 m before a wall at 2 m; its shadow is f b (1/1 - 1/2) pixels wide, 19.7 with b = 75 mm."""
    depth = _wall(2.0)
    depth[120:360, 250:400] = 1.0
    lost = degrade_depth(depth, CAMERA, _model(name), _rng()) == 0
    edge = lost[160:320, [398, 399, 400, 401]].mean()
    inside = lost[160:320, 300:380].mean()
    assert edge > 0.25
    assert edge > inside + 0.2
    baseline = _model(name).baseline_m
    width = round(525 * baseline * 0.5)
    assert lost[160:320, 250 - width + 2 : 248].mean() == 1.0
    assert lost[160:320, 250 - width - 30 : 250 - width - 5].mean() < 0.1
    assert lost[160:320, 405:440].mean() < 0.1


def test_grazing_surfaces_are_lost() -> None:
    """A floor 1 m below a level camera is seen at atan(z / 1 m) from its normal: 45 deg at 1 m, 83 at 8 m."""
    v = np.arange(480, dtype=np.float64)[:, None]
    down = (v - 239.5) / 525
    z = np.where(down > 0, 1 / np.maximum(down, 1e-3), 0) * np.ones((1, 640))
    depth = np.where(z < 12, z, 0).astype(np.float32)
    model = _model("kinect", range_m=(0.4, 20.0), edge_dropout=0.0)
    lost = degrade_depth(depth, CAMERA, model, _rng()) == 0
    near, far = (depth > 2.2) & (depth < 3), (depth > 7) & (depth < 8)
    assert lost[near].mean() < 0.02  # 66 to 72 degrees
    assert lost[far].mean() > 0.7  # 82 to 83 degrees


@pytest.mark.parametrize(("name", "low", "high"), [("kinect", 0.4, 8.0), ("realsense", 0.2, 6.0)])
def test_range_limits(name: str, low: float, high: float) -> None:
    assert (degrade_depth(_wall(low * 0.8), CAMERA, _model(name), _rng()) == 0).all()
    assert (degrade_depth(_wall(high * 1.2), CAMERA, _model(name), _rng()) == 0).mean() > 0.99
    assert (degrade_depth(_wall(1.5), CAMERA, _model(name), _rng()) > 0).mean() > 0.95


def test_invalid_stays_invalid_and_the_input_is_kept() -> None:
    depth = _wall(1.5)
    depth[:, :100] = 0
    before = depth.copy()
    noisy = degrade_depth(depth, CAMERA, _model("realsense"), _rng())
    assert (noisy[:, :100] == 0).all()
    np.testing.assert_array_equal(depth, before)
    np.testing.assert_array_equal(noisy, degrade_depth(depth, CAMERA, _model("realsense"), _rng()))


def test_color_noise_has_its_deviation() -> None:
    grey = np.full((*CAMERA.shape, 3), 128, np.uint8)
    noisy = degrade_color(grey, _model("kinect"), _rng())
    # Rounding adds a variance of 1/12.
    assert noisy.astype(float).std() == pytest.approx(np.sqrt(2.5**2 + 1 / 12), rel=0.01)
    assert noisy.mean() == pytest.approx(128, abs=0.02)
