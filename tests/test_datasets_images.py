"""Decoding: every invalid value becomes 0 once, damage is found; resizing never mixes surfaces."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanweld.datasets.images import (
    SURFACE_BAND,
    _on_surface,
    check_depth_unit,
    compare_depth_units,
    explain_unusable_depth,
    read_color,
    read_depth_png,
    read_header,
    read_ray_distance_text,
    require_depth_scale,
    require_scale,
    resize_color,
    resize_depth,
    valid_depth,
)
from scanweld.datasets.png import decode_png
from scanweld.errors import DatasetError, InvalidInputError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from written_sequences import color_rgb, depth_units, write_image

SHAPE = (12, 16)
CAMERA = PinholeCamera(525, 520, 318, 241, 640, 480)


def png_bytes(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def jpeg_bytes(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


# --- values
# ---------------------------------------------------------------------------------------------------


def test_depth_png_maps_both_invalid_values_to_zero(tmp_path: Path) -> None:
    raw = np.array([[0, 65535, 1000, 1, 65534]], dtype=np.uint16)
    depth = read_depth_png(write_image(tmp_path / "d.png", raw), (1, 5), 1000)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, np.array([[0, 0, 1, 0.001, 65.534]], np.float32))


def test_depth_scale_is_units_per_metre(tmp_path: Path) -> None:
    path = write_image(tmp_path / "d.png", np.full((2, 3), 5000, np.uint16))
    assert (read_depth_png(path, (2, 3), 5000) == 1).all()


def test_valid_depth_maps_what_is_no_distance_to_zero() -> None:
    depth = valid_depth(np.array([[np.nan, np.inf, -np.inf, -1, 0, 65535, 1e30, 2.5]]))
    np.testing.assert_array_equal(depth, np.array([[0, 0, 0, 0, 0, 0, 0, 2.5]], np.float32))


def test_color_is_rgb(tmp_path: Path) -> None:
    red = np.zeros((12, 16, 3), np.uint8)
    red[..., 0] = 255
    for name in ("c.png", "c.jpg"):
        color = read_color(write_image(tmp_path / name, red), SHAPE)
        assert color.shape == (12, 16, 3)
        assert color.dtype == np.uint8
        assert np.abs(color.reshape(-1, 3).mean(axis=0) - [255, 0, 0]).max() < 3


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_and_16_bit_color_become_8_bit_rgb(tmp_path: Path, dtype: type) -> None:
    grey = np.full(SHAPE, 128 if dtype is np.uint8 else 128 * 257, dtype)
    color = read_color(write_image(tmp_path / "grey.png", grey), SHAPE)
    assert (color == 128).all()


def test_exif_orientation_does_not_turn_the_image(tmp_path: Path) -> None:
    """Orientation 6 (turn by 90 degrees) in a hand-made EXIF segment: the size stays 16x12."""
    tiff = b"II*\x00" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    exif = b"Exif\x00\x00" + tiff
    data = jpeg_bytes(np.zeros((12, 16, 3), np.uint8))
    path = tmp_path / "turned.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    assert cv2.imread(str(path)).shape[:2] == (16, 12), "the segment is not understood, the test proves nothing"
    assert read_color(path, SHAPE).shape == (12, 16, 3)


def test_ray_distance_text(tmp_path: Path) -> None:
    path = tmp_path / "f.depth"
    path.write_text("1.5 2\nnan -1 inf 250\n")
    np.testing.assert_array_equal(
        read_ray_distance_text(path, (2, 3), 1), np.array([[1.5, 2, 0], [0, 0, 250]], np.float32)
    )
    np.testing.assert_array_equal(read_ray_distance_text(path, (2, 3), 100)[1], np.array([0, 0, 2.5], np.float32))


@pytest.mark.parametrize(("text", "words"), [("1 2 3 4 5", "got 5"), ("1 2 x 4 5 6", "numbers"), ("", "got 0")])
def test_ray_distance_text_that_is_wrong(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "f.depth"
    path.write_text(text)
    with pytest.raises(UnreadableFrameError, match=words) as caught:
        read_ray_distance_text(path, (2, 3), 1)
    assert "f.depth" in str(caught.value)


# --- damage
# ---------------------------------------------------------------------------------------------------

PNG = png_bytes(depth_units(0, 1000))
JPEG = jpeg_bytes(np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, len(PNG) - 1))
def test_every_truncated_png_is_found(tmp_path: Path, length: int) -> None:
    path = tmp_path / "cut.png"
    path.write_bytes(PNG[:length])
    with pytest.raises(UnreadableFrameError, match=r"cut[.]png"):
        read_depth_png(path, SHAPE, 1000)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(8, len(PNG) - 1), st.integers(1, 255))
def test_every_changed_byte_of_a_png_is_found(tmp_path: Path, at: int, change: int) -> None:
    data = bytearray(PNG)
    data[at] ^= change
    path = tmp_path / "flipped.png"
    path.write_bytes(bytes(data))
    with pytest.raises(UnreadableFrameError, match=r"flipped[.]png"):
        read_depth_png(path, SHAPE, 1000)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, len(JPEG) - 1))
def test_every_truncated_jpeg_is_found(tmp_path: Path, length: int) -> None:
    path = tmp_path / "cut.jpg"
    path.write_bytes(JPEG[:length])
    with pytest.raises(UnreadableFrameError, match=r"cut[.]jpg"):
        read_color(path, SHAPE)


def test_damage_is_silent_on_stderr(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Decoders complain on the process's own stderr; a damaged file is found before it gets there."""
    for name, data in (("a.png", PNG[:-20]), ("b.jpg", JPEG[:-20])):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UnreadableFrameError):
            read_color(tmp_path / name, SHAPE)
    assert capfd.readouterr().err == ""


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_absurd_size_in_an_intact_header(tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 2**31 - 1, 2**31 - 1, 16, 0, 0, 0, 0)
    path = tmp_path / "huge.png"
    path.write_bytes(PNG[:8] + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    with pytest.raises(UnreadableFrameError, match="2147483647x2147483647"):
        read_header(path)


def test_intact_chunks_around_rubbish(tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 16, 12, 16, 0, 0, 0, 0)
    path = tmp_path / "rubbish.png"
    path.write_bytes(PNG[:8] + chunk(b"IHDR", header) + chunk(b"IDAT", b"rubbish") + chunk(b"IEND", b""))
    with pytest.raises(UnreadableFrameError, match="cannot be decoded"):
        read_depth_png(path, SHAPE, 1000)


def written_png(image: np.ndarray, filters: list[int]) -> bytes:
    """A PNG file of (H, W) uint16 or (H, W, 3) uint8 whose rows have the given filters, after the specification."""
    size = 2 if image.ndim == 2 else 3
    rows = image.astype(">u2").view(np.uint8) if size == 2 else image.reshape(len(image), -1)
    rows = rows.astype(int)
    lines = b""
    for v, kind in enumerate(filters):
        x, above = rows[v], rows[v - 1] if v else np.zeros_like(rows[v])
        left = np.concatenate([np.zeros(size, int), x[:-size]])
        corner = np.concatenate([np.zeros(size, int), above[:-size]])
        p = left + above - corner
        near = [np.abs(p - left), np.abs(p - above), np.abs(p - corner)]
        paeth = np.choose(np.argmin(near, axis=0), [left, above, corner])  # of equals the first
        guess = [0, left, above, (left + above) // 2, paeth][kind] if kind < 5 else 0
        lines += bytes([kind]) + ((x - guess) % 256).astype(np.uint8).tobytes()
    height, width = image.shape[:2]
    header = bytes([16 if size == 2 else 8, 0 if size == 2 else 2, 0, 0, 0])
    stream = zlib.compress(lines)
    parts = [stream[k : k + 500] for k in range(0, len(stream), 500)]
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", width.to_bytes(4, "big") + height.to_bytes(4, "big") + header)
        + b"".join(chunk(b"IDAT", part) for part in parts)
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("kind", ["depth", "rgb"])
@pytest.mark.parametrize("filters", ["01234432104", "44444444444", "00000000000"])
def test_every_filter_of_png_rows(tmp_path: Path, kind: str, filters: str) -> None:
    """The decoder for these two kinds of PNG gives what was written, as does OpenCV."""
    rng = np.random.default_rng(len(filters))
    image = (
        rng.integers(1, 65535, (11, 37), np.uint16) if kind == "depth" else rng.integers(0, 256, (11, 37, 3), np.uint8)
    )
    path = tmp_path / "written.png"
    path.write_bytes(written_png(image, [int(c) for c in filters]))
    decoded = decode_png(path.read_bytes())
    assert decoded is not None
    assert decoded.dtype == image.dtype
    np.testing.assert_array_equal(decoded, image)
    by_opencv = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded, by_opencv if kind == "depth" else by_opencv[..., ::-1])
    read = read_depth_png(path, (11, 37), 1.0) if kind == "depth" else read_color(path, (11, 37))
    np.testing.assert_array_equal(read, image)


def test_without_libdeflate_pixels_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(0).integers(0, 65535, (20, 30), np.uint16)
    data = written_png(image, [4] * 20)
    for absent in (False, True):
        if absent:
            monkeypatch.setattr("scanweld.datasets.png.deflate", None)
        np.testing.assert_array_equal(decode_png(data), image)


@pytest.mark.parametrize("fault", ["unknown filter", "too short", "too long", "rubbish", "cut"])
def test_damage_within_intact_chunks(tmp_path: Path, fault: str) -> None:
    """Whatever the chunks' checksums say, the stream must hold exactly the image."""
    image = np.random.default_rng(1).integers(1, 65535, (8, 12), np.uint16)
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in image)
    stream = {
        "unknown filter": zlib.compress(b"\7" + lines[1:]), "too short": zlib.compress(lines[:-1]),
        "too long": zlib.compress(lines + b"\0"), "rubbish": b"\x78\x9c" + lines[:50], "cut": zlib.compress(lines)[:-6],
    }[fault]  # fmt: skip
    path = tmp_path / "damaged.png"
    header = (12).to_bytes(4, "big") + (8).to_bytes(4, "big") + bytes([16, 0, 0, 0, 0])
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", stream) + chunk(b"IEND", b""))
    with pytest.raises(UnreadableFrameError, match=r"damaged\.png: cannot be decoded"):
        read_depth_png(path, (8, 12), 1000.0)


def test_other_kinds_of_png_are_left_to_opencv(tmp_path: Path) -> None:
    grey = np.random.default_rng(2).integers(0, 256, (9, 14), np.uint8)
    assert decode_png(png_bytes(grey)) is None
    assert decode_png(png_bytes(np.dstack([grey] * 4))) is None
    plain = written_png(np.dstack([grey] * 3), [1] * 9)
    transparent = plain[:33] + chunk(b"tRNS", bytes(6)) + plain[33:]
    assert decode_png(plain) is not None
    assert decode_png(transparent) is None
    path = tmp_path / "transparent.png"
    path.write_bytes(transparent)
    np.testing.assert_array_equal(read_color(path, (9, 14)), np.dstack([grey] * 3))


def test_missing_empty_and_foreign_files(tmp_path: Path) -> None:
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("hello")
    for name, words in (
        ("missing.png", "No such file"),
        ("empty.png", "empty"),
        ("text.png", "neither PNG nor"),
    ):
        with pytest.raises(UnreadableFrameError, match=words):
            read_header(tmp_path / name)


def test_a_size_that_is_not_the_sequence_s(tmp_path: Path) -> None:
    path = write_image(tmp_path / "d.png", depth_units(0, 1000))
    with pytest.raises(UnreadableFrameError, match="16x12, the sequence 20x10"):
        read_depth_png(path, (10, 20), 1000)


def test_a_preview_is_no_depth_image(tmp_path: Path) -> None:
    preview = write_image(tmp_path / "preview.png", np.zeros(SHAPE, np.uint8))
    with pytest.raises(UnreadableFrameError, match=r"8 bits, 1 channel.*raw depth"):
        read_depth_png(preview, SHAPE, 1000)
    with pytest.raises(UnreadableFrameError, match="swapped"):
        read_depth_png(write_image(tmp_path / "c.png", color_rgb(0)), SHAPE, 1000)


# --- resizing
# -------------------------------------------------------------------------------------------------


def plane_depth(camera: PinholeCamera, normal: tuple[float, float, float], distance: float) -> np.ndarray:
    """Depth of the plane n . x = d: z = d / (n . ray)."""
    return (distance / (camera.rays() @ np.array(normal))).astype(np.float32)


@pytest.mark.parametrize("scale", [0.5, 0.25, 0.125])
def test_a_plane_resizes_to_what_the_scaled_camera_sees(scale: float) -> None:
    """Golden 9 for depth: the resized image of a tilted plane is that plane at the scaled pixel centres.

    1/z = n . ray / d is linear in the pixel, so its mean over a block is its value at the block's centre.
    """
    small = CAMERA.scaled(scale)
    resized = resize_depth(plane_depth(CAMERA, (0.3, -0.2, 1), 2), small.shape)
    np.testing.assert_allclose(resized, plane_depth(small, (0.3, -0.2, 1), 2), rtol=1e-6)


@pytest.mark.parametrize("scale", [0.7, 1 / 3, 0.9])
def test_a_plane_at_other_scales_is_within_a_pixel_s_slope(scale: float) -> None:
    """Samples are whole pixels, so they lie within half a pixel of where they should be.

    The plane's inverse depth changes by |n| / (d f) per pixel: |dz| <= z^2 * 0.5 * (0.3 + 0.2) / (2 * 520).
    """
    small = CAMERA.scaled(scale)
    expected = plane_depth(small, (0.3, -0.2, 1), 2)
    resized = resize_depth(plane_depth(CAMERA, (0.3, -0.2, 1), 2), small.shape)
    assert (np.abs(resized - expected) <= 1.01 * expected**2 * 0.5 * 0.5 / (2 * 520)).all()


@settings(max_examples=30)
@given(st.sampled_from([0.25, 0.4, 0.5, 0.75, 1.5, 2.0]), st.integers(0, 2**32 - 1))
def test_no_depth_is_invented(scale: float, seed: int) -> None:
    """Every output is 0 or one of the input depths; all-invalid blocks stay invalid."""
    rng = np.random.default_rng(seed)
    depth = rng.choice(np.array([0, 1, 1.5, 3, 8], np.float32), size=(24, 32))
    camera = PinholeCamera(20, 20, 15.5, 11.5, 32, 24).scaled(scale)
    resized = resize_depth(depth, camera.shape)
    # The mean of equal numbers by way of their inverses is exact to the last digit or two of float32.
    assert np.abs(resized[..., None] - np.unique(depth)).min(axis=-1).max() < 1e-6
    assert (resize_depth(np.zeros_like(depth), camera.shape) == 0).all()


def test_a_block_takes_the_majority_and_of_equals_the_nearer() -> None:
    blocks = np.array(
        [
            [1, 3, 1, 1, 0, 0, 0, 2],
            [3, 3, 3, 3, 0, 5, 0, 0],
        ],
        np.float32,
    )
    np.testing.assert_array_equal(resize_depth(blocks, (1, 4)), np.array([[3, 1, 5, 2]], np.float32))


def test_a_much_smaller_image_costs_a_bounded_number_of_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """16 x 16 pixels an output pixel, of which 8 x 8 are looked at: all of them would make 65536 comparisons."""
    compared = 0

    def counted(samples: list[np.ndarray], surface: np.ndarray) -> Iterator[np.ndarray]:
        nonlocal compared
        for same in _on_surface(samples, surface):
            compared += 1
            yield same

    monkeypatch.setattr("scanweld.datasets.images._on_surface", counted)
    small = CAMERA.scaled(1 / 16)
    plane = plane_depth(CAMERA, (0.3, -0.2, 1), 2)
    resized = resize_depth(plane, small.shape)
    assert compared == 64 * 64 + 64
    # The samples are the odd pixels of the 16, half a pixel off the centre on either axis at most.
    expected = plane_depth(small, (0.3, -0.2, 1), 2)
    assert (np.abs(resized - expected) <= 1.01 * expected**2 * 0.5 * 0.5 / (2 * 520)).all()


def test_within_the_band_inverse_depth_is_averaged() -> None:
    """1 and 1.01 are one surface (band 2 %), 1.1 is not: 2 / (1 / 1 + 1 / 1.01) = 1.004975."""
    assert SURFACE_BAND == 0.02
    block = np.array([[1, 1.01], [1.1, 0]], np.float32)
    np.testing.assert_allclose(resize_depth(block, (1, 1)), 2 / (1 + 1 / 1.01), rtol=1e-6)


def test_color_is_averaged_over_the_area() -> None:
    color = np.zeros((2, 4, 3), np.uint8)
    color[:, 1] = 100
    np.testing.assert_array_equal(resize_color(color, (1, 2))[0, :, 0], [50, 0])


def test_resizing_leaves_its_input_alone() -> None:
    depth = plane_depth(CAMERA, (0.3, -0.2, 1), 2)
    before = depth.copy()
    resize_depth(depth, (240, 320))
    np.testing.assert_array_equal(depth, before)


# --- unit
# -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("median_m", "scale"), [(1.845, 1000), (0.41, 1000), (1.2, 5000), (4.9, 1000)])
def test_plausible_depth_is_not_doubted(median_m: float, scale: float) -> None:
    assert check_depth_unit(median_m, scale) is None


@pytest.mark.parametrize(
    ("true_m", "wrong_scale", "right"),
    [(1.5, 1, "1000"), (1.5, 100000, "1000"), (1.2, 1000 / 5, "1000")],
)
def test_a_wrong_unit_is_named(true_m: float, wrong_scale: float, right: str) -> None:
    """The file holds millimetres: raw = 1000 true, read with the wrong scale."""
    message = check_depth_unit(true_m * 1000 / wrong_scale, wrong_scale)
    assert message is not None
    assert f"--depth-scale {right}" in message


def test_tum_depth_read_as_millimetres_is_doubted() -> None:
    """1.4 m at 5000 per metre is 7000 units; as millimetres 7 m, further than such cameras see."""
    message = check_depth_unit(7.0, 1000)
    assert message is not None
    assert "--depth-scale 5000" in message


@pytest.mark.parametrize(
    ("median_m", "scale", "words"),
    [
        (1500, 1, "the unit is likely 1 mm .* --depth-scale 1000"),
        (5.2, 1000, "5.2 m with 1000 .* 0.3 to 3 m are used; widen the range, or, if .* --depth-scale 5000"),
        (0.2, 1e-6, "widen the range$"),
        (1.5, 1000, "the unit looks right"),
        (0, 1000, "no valid depth"),
    ],
)
def test_depth_that_gave_no_surface_is_explained(median_m: float, scale: float, words: str) -> None:
    """5.2 m is 5200 units, 1.04 m at 5000 per metre; 0.2 m at 1e-6 is 2e-7 units, no distance in any unit."""
    assert re.search(words, explain_unusable_depth(median_m, scale, (0.3, 3.0)))


def test_units_that_a_picture_does_not_betray_are_compared() -> None:
    """TUM and Redwood differ by 5; a factor of 1000 shows in the depth itself."""
    assert "5 times smaller" in (compare_depth_units(1000, 5000, "the format") or "")
    assert "5 times larger" in (compare_depth_units(5000, 1000, "the format") or "")
    for passed in (1000, 1400, 1, 1e6):
        assert compare_depth_units(1000, passed, "the format") is None


def test_no_valid_depth_and_hopeless_units_say_so() -> None:
    assert "no valid depth" in (check_depth_unit(0, 1000) or "")
    assert "no valid depth" in (check_depth_unit(float("nan"), 1000) or "")
    assert "implausible" in (check_depth_unit(1e-9, 1000) or "")


@pytest.mark.parametrize("bad", [0, -1, float("nan"), float("inf"), 5])
def test_scale_is_checked(bad: float) -> None:
    with pytest.raises(InvalidInputError, match="scale"):
        require_scale(bad)


@pytest.mark.parametrize("bad", [0, -1000, float("nan")])
def test_depth_scale_is_checked(bad: float) -> None:
    with pytest.raises(DatasetError, match="depth_scale must be positive"):
        require_depth_scale(bad, "here")
