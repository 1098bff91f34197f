"""The pinhole camera: projection and its inverse, scaling, and the borders of the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.errors import InvalidInputError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame

CAMERA = PinholeCamera(525, 520, 319.5, 239.5, 640, 480)

cameras = st.builds(
    PinholeCamera,
    st.floats(10, 2000),
    st.floats(10, 2000),
    st.floats(-5, 50),
    st.floats(-5, 50),
    st.integers(2, 48),
    st.integers(2, 48),
)


def test_projection_by_hand() -> None:
    """(1, -0.5, 2): u = 525 / 2 + 319.5 = 582, v = -520 / 4 + 239.5 = 109.5."""
    pixel, inside = CAMERA.project(np.array([1, -0.5, 2.0]))
    assert inside
    np.testing.assert_allclose(pixel, [582, 109.5])
    np.testing.assert_array_equal(CAMERA.matrix, [[525, 0, 319.5], [0, 520, 239.5], [0, 0, 1]])
    assert CAMERA.shape == (480, 640)


@given(cameras, st.integers(0, 2**32 - 1))
def test_back_projection_and_projection_are_inverse(camera: PinholeCamera, seed: int) -> None:
    """Every pixel's point projects to the pixel, to the precision of float32 vertices."""
    depth = np.random.default_rng(seed).uniform(0.1, 10, camera.shape).astype(np.float32)
    pixels, inside = camera.project(camera.back_project(depth))
    v, u = np.indices(camera.shape)
    assert inside.all()
    scale = max(camera.fx, camera.fy, 50)
    np.testing.assert_allclose(pixels[..., 0], u, atol=1e-6 * scale)
    np.testing.assert_allclose(pixels[..., 1], v, atol=1e-6 * scale)


@given(cameras, st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 10))
def test_projection_solves_the_pinhole_equation(camera: PinholeCamera, x: float, y: float, z: float) -> None:
    pixel, inside = camera.project(np.array([x, y, z]))
    if inside:
        ray = np.linalg.inv(camera.matrix) @ [*pixel, 1]
        np.testing.assert_allclose(ray * z, [x, y, z], atol=1e-9)


def test_the_image_spans_half_a_pixel_beyond_the_centres() -> None:
    camera = PinholeCamera(1, 1, 0, 0, 4, 3)
    u = np.array([-0.51, -0.5, 3.49, 3.5])
    points = np.column_stack([u, np.zeros(4), np.ones(4)])
    np.testing.assert_array_equal(camera.project(points)[1], [False, True, True, False])
    np.testing.assert_array_equal(
        camera.project(np.column_stack([np.zeros(4), u - [0, 0, 1, 1], np.ones(4)]))[1],
        [False, True, True, False],
    )


def test_points_behind_are_not_in_the_image() -> None:
    pixels, inside = CAMERA.project(np.array([[0, 0, -1.0], [0, 0, 0]]))
    assert not inside.any()
    assert (pixels == -1).all()


def test_invalid_depth_stays_zero() -> None:
    depth = np.zeros((480, 640), np.float32)
    depth[3, 5] = 2
    vertices = CAMERA.back_project(depth)
    assert vertices.dtype == np.float32
    assert (vertices[depth == 0] == 0).all()
    assert vertices[3, 5, 2] == 2


@pytest.mark.parametrize("scale", [0.5, 0.25, 0.125, 2.0])
def test_a_scaled_camera_sees_the_same_rays(scale: float) -> None:
    """Golden 9: the centre of an output pixel is the centre of the input block that it covers.

    At half size output pixel 0 covers input pixels 0 and 1, whose common centre is 0.5:
    u_in = (u_out + 0.5) / s - 0.5.
    """
    small = CAMERA.scaled(scale)
    assert small.shape == (480 * scale, 640 * scale)
    u_in = (np.arange(small.width) + 0.5) / scale - 0.5
    v_in = (np.arange(small.height) + 0.5) / scale - 0.5
    rays = small.rays()
    np.testing.assert_allclose(rays[0, :, 0], (u_in - CAMERA.cx) / CAMERA.fx, atol=1e-12)
    np.testing.assert_allclose(rays[:, 0, 1], (v_in - CAMERA.cy) / CAMERA.fy, atol=1e-12)


def test_half_size_by_hand() -> None:
    """cx' = 320 / 2 - 0.5 = 159.5, cy' = 240 / 2 - 0.5 = 119.5; scaling back is exact."""
    half = CAMERA.scaled(0.5)
    assert half == PinholeCamera(262.5, 260, 159.5, 119.5, 320, 240)
    assert half.scaled(2) == CAMERA


@given(cameras, st.floats(0.2, 3))
def test_the_image_keeps_its_field_of_view(camera: PinholeCamera, scale: float) -> None:
    """The borders -0.5 and W - 0.5 look the same way, also when the size is rounded."""
    scaled = camera.scaled(scale) if min(camera.shape) * scale >= 1 else camera
    for border, other in ((-0.5, -0.5), (camera.width - 0.5, scaled.width - 0.5)):
        assert (other - scaled.cx) / scaled.fx == pytest.approx((border - camera.cx) / camera.fx, abs=1e-9)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((np.nan, 1, 1, 1, 4, 4), "finite"),
        ((1, 1, np.inf, 1, 4, 4), "finite"),
        ((0, 1, 1, 1, 4, 4), "positive"),
        ((481.2, -480, 319.5, 239.5, 640, 480), "ICL-NUIM"),
        ((1, 1, 1, 1, 0, 4), "at least 1x1"),
    ],
)
def test_what_is_no_camera(values: tuple[float, ...], words: str) -> None:
    with pytest.raises(InvalidInputError, match=words):
        PinholeCamera(*values)  # type: ignore[arg-type]


def test_what_does_not_fit() -> None:
    with pytest.raises(InvalidInputError, match="is empty"):
        CAMERA.scaled(0.0001)
    with pytest.raises(InvalidInputError, match="depth has shape"):
        CAMERA.back_project(np.zeros((3, 4), np.float32))


class TestFrame:
    @pytest.mark.parametrize(
        ("depth_m", "color", "words"),
        [
            (np.ones((4, 6)), None, "depth_m must be float32"),
            (np.ones((6, 4), np.float32), None, r"depth has shape \(6, 4\), the camera \(4, 6\)"),
            (np.full((4, 6), -1, np.float32), None, "finite and not negative, got -1"),
            (np.full((4, 6), np.nan, np.float32), None, "finite and not negative, got nan"),
            (np.full((4, 6), np.inf, np.float32), None, "set invalid pixels to 0"),
            (np.ones((4, 6), np.float32), np.zeros((4, 6), np.uint8), r"color must be \(H, W, 3\) uint8"),
            (np.ones((4, 6), np.float32), np.zeros((4, 6, 3), np.float32), "float32"),
        ],
    )
    def test_what_is_no_frame_is_refused(self, depth_m: np.ndarray, color: np.ndarray | None, words: str) -> None:
        with pytest.raises(InvalidInputError, match=words):
            Frame(0.0, depth_m, color, PinholeCamera(5.0, 5.0, 2.5, 1.5, 6, 4))
