"""Readers of recordings, on files written to the specification: depth, colour, pose and time of every frame."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.color_registration import ColorToDepth
from scanweld.datasets.intrinsics import Overrides
from scanweld.datasets.open import FORMATS, open_sequence
from scanweld.datasets.video_frames import VideoFrames
from scanweld.errors import DatasetError, InvalidInputError, MissingDependencyError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.trajectory_files import read_trajectory
from scanweld.testing import check_sequence
from written_captures import (
    COLOR_K,
    COLOR_SIZE,
    DEPTH_K,
    BagWriter,
    confidence,
    depth_metres,
    large_color,
    record3d_files,
    write_bag,
    write_bundle_fusion,
    write_eth3d,
    write_record3d,
    write_replica,
    write_sens,
    write_stray,
    write_video,
    write_video_pair,
)
from written_sequences import (
    HEIGHT,
    WIDTH,
    color_rgb,
    depth_units,
    poses,
    write_camera,
    write_frame,
    write_image,
    write_tum,
)

CAMERA = PinholeCamera(*DEPTH_K, WIDTH, HEIGHT)
JPEG_ERROR = 3


def needs_rosbags() -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'scanweld[ros]'")


def needs_lzfse() -> None:
    pytest.importorskip("liblzfse", reason="pyliblzfse is not installed: pip install 'scanweld[record3d]'")


def assert_frames(
    sequence: RgbdSequence,
    times_s: np.ndarray,
    depth_scale: float = 1000,
    *,
    color_error: int = 0,
    numbers: list[int] | None = None,
) -> None:
    """The frames hold what the writers made for their numbers, exactly; colour within `color_error` after JPEG."""
    check_sequence(sequence)
    np.testing.assert_allclose(sequence.timestamps_s, times_s, rtol=0, atol=2e-7)
    for index, number in enumerate(numbers or range(len(times_s))):
        frame = sequence.read(index)
        expected = depth_units(number, depth_scale).astype(np.float32) / np.float32(depth_scale)
        np.testing.assert_array_equal(frame.depth_m, expected)
        assert frame.color is not None
        assert np.abs(frame.color.astype(int) - color_rgb(number)).max() <= color_error


def assert_camera(camera: PinholeCamera, expected: PinholeCamera = CAMERA) -> None:
    np.testing.assert_allclose(camera.matrix, expected.matrix, rtol=1e-6)
    assert camera.shape == expected.shape


def assert_truth(sequence: RgbdSequence, T: np.ndarray, times_s: np.ndarray, tolerance: float = 1e-12) -> None:
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, times_s, atol=1e-9)
    np.testing.assert_allclose(sequence.ground_truth.T_world_camera, T, atol=tolerance)


# --- .sens ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("color", [0, 1, 2])
@pytest.mark.parametrize("depth", [0, 1])
def test_sens(tmp_path: Path, color: int, depth: int) -> None:
    path = write_sens(tmp_path / "scene0000_00.sens", color_compression=color, depth_compression=depth)
    sequence = open_sequence(path)
    assert sequence.name == "scene0000_00"
    assert_camera(sequence.camera)
    times = np.arange(4) * 0.033
    assert_frames(sequence, times, color_error=JPEG_ERROR if color == 2 else 0)
    assert_truth(sequence, poses(4), times, 1e-6)


def test_sens_in_its_folder_and_by_name(tmp_path: Path) -> None:
    write_sens(tmp_path / "scene/scene0000_00.sens")
    (tmp_path / "scene/scene0000_00.txt").write_text("axisAlignment = 1 0 0 0\n")
    for path, name in ((tmp_path / "scene", "auto"), (tmp_path / "scene", "sens"), (tmp_path, "ScanNet")):
        assert len(open_sequence(path, format=name)) == 4


def test_sens_lost_poses_have_no_truth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sequence = open_sequence(write_sens(tmp_path / "a.sens", lost=(1, 2)))
    assert len(sequence) == 4
    assert_truth(sequence, poses(4)[[0, 3]], np.array([0, 0.099]), 1e-6)
    assert "2 of 4 true poses" in caplog.text
    assert open_sequence(write_sens(tmp_path / "b.sens", lost=range(4))).ground_truth is None


def test_sens_without_times_is_taken_at_thirty_a_second(tmp_path: Path) -> None:
    sequence = open_sequence(write_sens(tmp_path / "a.sens", with_times=False))
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(4) / 30)


def test_sens_without_color(tmp_path: Path) -> None:
    sequence = open_sequence(write_sens(tmp_path / "a.sens", with_color=False))
    check_sequence(sequence)
    assert sequence.read(0).color is None


def test_sens_depth_scale_and_camera_of_the_caller(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "a.sens")
    sequence = open_sequence(path, depth_scale=2000, camera=(20, 21, 7, 5), frames="1:", scale=2)
    assert sequence.camera.fx == 40
    assert sequence.read(0).depth_m[0, 0] == pytest.approx(depth_units(1, 1000)[0, 0] / 2000)


# --- colour of another camera -------------------------------------------------------------------------


def gradient(width: int, height: int) -> np.ndarray:
    """A colour image whose red is 3 u and green 5 v at pixel (u, v): linear, so between pixels too."""
    v, u = np.mgrid[:height, :width]
    return np.stack([3 * u, 5 * v, np.zeros_like(u)], axis=-1).astype(np.uint8)


def test_color_is_looked_up_by_the_two_intrinsics() -> None:
    """Depth pixel (u, v) looks along ((u - 4) / 10, (v - 3) / 10), colour pixel ((u - 4) + 20, (v - 3) + 15)."""
    depth_camera, color_camera = PinholeCamera(10, 10, 4, 3, 10, 8), PinholeCamera(10, 10, 20, 15, 40, 30)
    seen = ColorToDepth(color_camera, depth_camera)(gradient(40, 30), np.ones((8, 10), np.float32))
    v, u = np.mgrid[:8, :10]
    np.testing.assert_array_equal(seen[..., 0], 3 * (u - 4 + 20))
    np.testing.assert_array_equal(seen[..., 1], 5 * (v - 3 + 15))


def test_color_moves_with_depth_where_the_cameras_stand_apart() -> None:
    """A colour camera 0.1 m to the left (x_color = x + 0.1) sees a point at 1 m one pixel, at 0.5 m two further."""
    camera = PinholeCamera(10, 10, 4.5, 3.5, 10, 8)
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.1
    depth = np.ones((8, 10), np.float32)
    depth[4:] = 0.5
    seen = ColorToDepth(camera, camera, T_color_depth)(gradient(10, 8), depth)
    u = np.arange(10)
    np.testing.assert_array_equal(seen[2, :9, 0], 3 * (u[:9] + 1))
    np.testing.assert_array_equal(seen[6, :8, 0], 3 * (u[:8] + 2))
    assert not seen[2, 9].any(), "outside of the colour image is black"


def test_finer_color_is_averaged() -> None:
    """Stripes of 0 and 200 one pixel wide become 100 at half the size: none of them is skipped."""
    color_camera, depth_camera = PinholeCamera(20, 20, 9.5, 7.5, 20, 16), PinholeCamera(10, 10, 4.5, 3.5, 10, 8)
    stripes = np.zeros((16, 20, 3), np.uint8)
    stripes[:, ::2] = 200
    seen = ColorToDepth(color_camera, depth_camera)(stripes, np.ones((8, 10), np.float32))
    np.testing.assert_array_equal(seen, 100)


def test_sens_extrinsics_move_the_color(tmp_path: Path) -> None:
    extrinsics = np.eye(4)
    extrinsics[0, 3] = 10.0  # metres: nothing of the scene is in the colour image
    sequence = open_sequence(write_sens(tmp_path / "a.sens", extrinsics=extrinsics))
    color = sequence.read(0).color
    assert color is not None
    assert not color.any()


# --- folders of images --------------------------------------------------------------------------------


@pytest.mark.parametrize("inside", [False, True])
def test_replica(tmp_path: Path, inside: bool) -> None:
    scene = tmp_path / "Replica/office0"
    scene.mkdir(parents=True)
    sequence = open_sequence(write_replica(scene, parameters=scene if inside else None))
    assert (sequence.name, sequence.depth_scale) == ("office0", 6553.5)
    assert_camera(sequence.camera)
    assert_frames(sequence, np.arange(4) / 30, 6553.5, color_error=JPEG_ERROR)
    assert_truth(sequence, poses(4), np.arange(4) / 30)


def test_replica_without_parameters_has_the_published_camera(tmp_path: Path) -> None:
    """600 600 599.5 339.5 at 1200x680: at 16x12, fx = 600 / 75 and fy = 600 * 12 / 680."""
    write_replica(tmp_path / "r/office0")
    (tmp_path / "r/cam_params.json").unlink()
    sequence = open_sequence(tmp_path / "r/office0")
    assert_camera(sequence.camera, PinholeCamera(8, 7200 / 680, 600 / 75 - 0.5, 340 * 12 / 680 - 0.5, WIDTH, HEIGHT))
    assert sequence.depth_scale == 6553.5


def test_eth3d(tmp_path: Path) -> None:
    sequence = open_sequence(write_eth3d(tmp_path / "table_3"))
    assert_camera(sequence.camera)
    assert_frames(sequence, sequence_times(4), 5000)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.T_world_camera, poses(16), atol=1e-12)


def test_eth3d_associated_txt_names_color_first(tmp_path: Path) -> None:
    folder = write_eth3d(tmp_path)
    lines = [f"{1000 + i / 30:.6f} rgb/{1000 + i / 30:.6f}.png {1000 + i / 30:.6f} depth/{1000 + i / 30:.6f}.png"
             for i in range(3)]  # fmt: skip
    (folder / "associated.txt").write_text("\n".join(lines) + "\n")
    (folder / "depth.txt").unlink()
    assert_frames(open_sequence(folder), sequence_times(3), 5000)


def sequence_times(count: int) -> np.ndarray:
    return np.array([round(1000 + i / 30, 6) for i in range(count)])


def test_bonn(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_tum(tmp_path / "rgbd_bonn_balloon")
    sequence = open_sequence(folder)
    expected = [(542.822841 + 0) / 40, 542.576870 / 40, (315.593520 + 0.5) / 40 - 0.5, (237.756098 + 0.5) / 40 - 0.5]
    assert_camera(sequence.camera, PinholeCamera(*expected, WIDTH, HEIGHT))
    assert_frames(sequence, sequence_times(4), 5000)
    assert "markers" in caplog.text
    assert open_sequence(write_tum(tmp_path / "other"), format="bonn").camera == sequence.camera


def test_bundle_fusion(tmp_path: Path) -> None:
    sequence = open_sequence(write_bundle_fusion(tmp_path / "apt0", (0, 1, 4), lost=(1,)))
    assert_camera(sequence.camera)
    times = np.array([0, 1, 4]) / 30
    assert_frames(sequence, times, numbers=[0, 1, 4])
    assert_truth(sequence, poses(5)[[0, 4]], times[[0, 2]], 1e-9)
    write_camera(tmp_path / "apt0")
    assert open_sequence(tmp_path / "apt0").depth_scale == 2000, "camera.json wins"


# --- phones -------------------------------------------------------------------------------------------


def assert_record3d(sequence: RgbdSequence) -> None:
    check_sequence(sequence)
    assert_camera(sequence.camera)
    times = 5.5 + 0.02 * np.arange(4)
    np.testing.assert_allclose(sequence.timestamps_s, times)
    assert_truth(sequence, poses(4), times, 1e-12)
    for index, frame in enumerate(sequence):
        expected = depth_metres(index)
        expected[np.isnan(expected)] = 0
        expected[confidence(index) == 0] = 0
        np.testing.assert_array_equal(frame.depth_m, expected)
        assert frame.color is not None
        assert np.abs(frame.color.astype(int) - color_rgb(index)).max() <= JPEG_ERROR


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_record3d(tmp_path: Path, compression: int) -> None:
    needs_lzfse()
    path = write_record3d(tmp_path / "desk.r3d", record3d_files(), compression)
    sequence = open_sequence(path)
    assert sequence.name == "desk"
    assert_record3d(sequence)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "unpacked")
    assert_record3d(open_sequence(tmp_path / "unpacked"))


def test_record3d_planes_that_are_not_compressed_need_no_extra(tmp_path: Path) -> None:
    assert_record3d(open_sequence(write_record3d(tmp_path / "a.r3d", record3d_files(compress=False))))


def test_record3d_without_the_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = record3d_files(compress=False)
    files["rgbd/0.depth"] = b"bvx-" + len(files["rgbd/0.depth"]).to_bytes(4, "little") + files["rgbd/0.depth"] + b"bvx$"
    monkeypatch.setitem(__import__("sys").modules, "liblzfse", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'scanweld\[record3d\]'"):
        open_sequence(write_record3d(tmp_path / "a.r3d", files))


def test_record3d_focal_length_that_changes_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    single = [[26.0, 27, 15.5, 11.5]] * 3 + [[26.65, 27, 15.5, 11.5]]
    files = record3d_files(compress=False, perFrameIntrinsicCoeffs=single)
    open_sequence(write_record3d(tmp_path / "a.r3d", files))
    assert "differ from K by up to 2.5 %" in caplog.text


def test_record3d_without_times_goes_by_its_rate(tmp_path: Path) -> None:
    files = record3d_files(compress=False, frameTimestamps=None)
    sequence = open_sequence(write_record3d(tmp_path / "a.r3d", files))
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(4) / 60)


def test_stray_scanner(tmp_path: Path) -> None:
    sequence = open_sequence(write_stray(tmp_path / "71de12f9"))
    assert sequence.name == "71de12f9"
    check_sequence(sequence)
    assert_camera(sequence.camera)
    times = np.round(100 + np.arange(4) / 60, 6)
    np.testing.assert_allclose(sequence.timestamps_s, times)
    assert_truth(sequence, poses(4), times)
    for index, frame in enumerate(sequence):
        expected = (depth_units(index, 1000) / np.float32(1000)).astype(np.float32)
        expected[confidence(index) == 0] = 0
        np.testing.assert_array_equal(frame.depth_m, expected)
        np.testing.assert_array_equal(frame.color, color_rgb(index))


def test_stray_scanner_frames_without_odometry_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_stray(tmp_path)
    lines = (folder / "odometry.csv").read_text().splitlines()
    (folder / "odometry.csv").write_text("\n".join([lines[0], lines[2], lines[4]]))
    sequence = open_sequence(folder)
    assert len(sequence) == 2
    np.testing.assert_array_equal(sequence.read(1).color, color_rgb(3))
    assert "without a partner" in caplog.text


# --- video ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", ["depth.mkv", "depth.avi", "depth"])
def test_video_pair(tmp_path: Path, depth: str) -> None:
    sequence = open_sequence(write_video_pair(tmp_path / "desk", depth=depth))
    assert_camera(sequence.camera)
    assert_frames(sequence, np.arange(6) / 25)  # 25 a second is what the colour video says
    assert sequence.ground_truth is None


def test_video_pair_with_names_rate_and_times(tmp_path: Path) -> None:
    folder = write_video_pair(tmp_path, depth="range.mkv", fps=10, color="left.mkv", depth_scale=2000)
    (folder / "color.mkv").rename(folder / "left.mkv")
    values = json.loads((folder / "camera.json").read_text()) | {"depth": "range.mkv"}
    (folder / "camera.json").write_text(json.dumps(values))
    sequence = open_sequence(folder, format="video")
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 10)
    assert sequence.depth_scale == 2000
    (folder / "timestamps.txt").write_text("\n".join(str(7 + i * i) for i in range(6)))
    np.testing.assert_allclose(open_sequence(folder, format="video").timestamps_s, 7 + np.arange(6) ** 2)


def test_video_of_eight_bits_is_no_depth(tmp_path: Path) -> None:
    folder = write_video_pair(tmp_path)
    (folder / "depth.mkv").unlink()
    write_video(folder / "depth.mkv", [color_rgb(i) for i in range(6)], "FFV1")
    with pytest.raises(DatasetError, match="expected one channel of 16 bits"):
        open_sequence(folder)


@pytest.mark.parametrize("codec", ["MJPG", "mp4v", "FFV1"])
def test_frames_of_a_video_are_the_same_in_any_order(tmp_path: Path, codec: str) -> None:
    """mp4v has key frames far apart: going back must not end at one."""
    count = 40
    images = [np.full((24, 32, 3), (5 * i, 255 - 5 * i, 100), np.uint8) for i in range(count)]
    path = write_video(tmp_path / ("a.avi" if codec == "MJPG" else "a.mkv"), images, codec)
    first = VideoFrames(path, np.asarray)
    inorder = [first(i) for i in range(count)]
    for i, image in enumerate(inorder):
        assert np.abs(image[..., ::-1].astype(int) - images[i]).max() < 12
    second = VideoFrames(path, np.asarray)
    for i in (17, 3, 39, 0, 1, 25, 24, 23, 5, 38, 2):
        np.testing.assert_array_equal(second(i), inorder[i])
    assert second.count() == count
    with pytest.raises(UnreadableFrameError, match="ends after 40 frames"):
        second(40)
    np.testing.assert_array_equal(second(12), inorder[12])


# --- ROS ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_ros_bag(tmp_path: Path, kind: str) -> None:
    needs_rosbags()
    path = tmp_path / ("desk.bag" if kind == "ros1" else "desk")
    write_bag(path, 1 if kind == "ros1" else 2, storage=kind)
    times = 1000 + np.arange(4) / 30
    sequence = open_sequence(path)
    assert sequence.name == "desk"
    assert_camera(sequence.camera)
    assert_frames(sequence, times)
    assert sequence.ground_truth is None
    if kind != "ros1":
        single = next(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))
        assert_frames(open_sequence(single), times)
    named = {"depth": "/camera/depth/image_raw", "color": "/camera/color/image_raw/compressed"}
    assert_frames(open_sequence(path, topics=named), times, color_error=JPEG_ERROR)
    assert open_sequence(path, topics="color=").read(0).color is None


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "big", "compressed16", "compressed32"])
def test_ros_depth_encodings(tmp_path: Path, version: int, encoding: str) -> None:
    """Compressed floating point is A / z + B in 16 bits: it returns within A / (B' (B' - 1)), B' = A / z."""
    import cv2

    needs_rosbags()
    metres = (depth_units(0, 1000) / 1000).astype(np.float32)
    metres[3, 4] = np.nan
    quant_a, quant_b = 10000.0, -10.0
    expected, tolerance = np.nan_to_num(metres), 0.0
    with BagWriter(tmp_path / "a.bag", version) as bag:
        bag.info("/depth/camera_info", 1, (WIDTH, HEIGHT), DEPTH_K)
        if encoding == "32FC1":
            bag.image("/depth/image", 1, "32FC1", metres)
        elif encoding in ("16UC1", "big", "compressed16"):
            raw = depth_units(0, 1000)
            raw[3, 4], raw[0, 0] = 0, 65535
            expected = np.where(raw == 65535, 0, raw).astype(np.float32) / np.float32(1000)
            if encoding == "compressed16":
                png = cv2.imencode(".png", raw)[1].tobytes()
                config = np.array([0], "<u4").tobytes() + np.array([0, 0], "<f4").tobytes()
                bag.compressed("/depth/image/compressedDepth", 1, "16UC1; compressedDepth png", config + png)
            else:
                bag.image("/depth/image", 1, "16UC1", raw.astype(">u2" if encoding == "big" else "<u2"))
        else:
            inverse = np.where(np.isnan(metres), 0, np.round(quant_a / metres + quant_b)).astype(np.uint16)
            config = np.array([0], "<u4").tobytes() + np.array([quant_a, quant_b], "<f4").tobytes()
            png = cv2.imencode(".png", inverse)[1].tobytes()
            bag.compressed("/depth/image/compressedDepth", 1, "32FC1; compressedDepth png", config + png)
            tolerance = 1.7**2 / quant_a
    sequence = open_sequence(tmp_path / "a.bag")
    frame = sequence.read(0)
    np.testing.assert_allclose(frame.depth_m, expected, rtol=0, atol=tolerance)
    assert frame.depth_m[3, 4] == 0
    assert sequence.depth_scale == (1 if "32" in encoding else 1000)


@pytest.mark.parametrize(
    ("encoding", "pixel"),
    [
        ("bgr8", (10, 100, 200)),
        ("rgba8", (200, 100, 10, 7)),
        ("bgra8", (10, 100, 200, 7)),
        ("mono8", (90,)),
    ],
)
def test_ros_color_encodings(tmp_path: Path, encoding: str, pixel: tuple[int, ...]) -> None:
    needs_rosbags()
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        bag.info("/depth/camera_info", 1, (WIDTH, HEIGHT), DEPTH_K)
        bag.image("/depth/image", 1, "16UC1", depth_units(0, 1000))
        bag.image("/color/image", 1, encoding, np.full((HEIGHT, WIDTH, len(pixel)), pixel, np.uint8))
    color = open_sequence(tmp_path / "a.bag").read(0).color
    assert color is not None
    np.testing.assert_array_equal(color, np.broadcast_to([90] * 3 if len(pixel) == 1 else [200, 100, 10], color.shape))


@pytest.mark.parametrize(
    ("pattern", "tile"),
    [("rggb", "rggb"), ("bggr", "bggr"), ("gbrg", "gbrg"), ("grbg", "grbg")],
)
def test_ros_bayer_patterns(tmp_path: Path, pattern: str, tile: str) -> None:
    """A colour of 200 100 10 behind the filters; the name is that of the first 2x2 pixels, row by row."""
    needs_rosbags()
    value = {"r": 200, "g": 100, "b": 10}
    plane = np.tile(np.array([value[letter] for letter in tile], np.uint8).reshape(2, 2), (HEIGHT // 2, WIDTH // 2))
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        bag.info("/depth/camera_info", 1, (WIDTH, HEIGHT), DEPTH_K)
        bag.image("/depth/image", 1, "16UC1", depth_units(0, 1000))
        bag.image("/color/image", 1, f"bayer_{pattern}8", plane)
    color = open_sequence(tmp_path / "a.bag").read(0).color
    assert color is not None
    np.testing.assert_array_equal(color[3:-3, 3:-3], np.broadcast_to([200, 100, 10], color[3:-3, 3:-3].shape))


def test_ros_color_of_another_size_is_resampled(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    needs_rosbags()
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        for i in range(3):
            bag.info("/depth/camera_info", i, (WIDTH, HEIGHT), DEPTH_K, frame_id="depth_frame")
            bag.image("/depth/image", i, "16UC1", depth_units(i, 1000), frame_id="depth_frame")
            bag.info("/color/camera_info", i, COLOR_SIZE, COLOR_K, frame_id="color_frame")
            bag.image("/color/image", i, "rgb8", large_color(i), frame_id="color_frame")
    assert_frames(open_sequence(tmp_path / "a.bag"), np.arange(3.0))
    assert "the distance between the cameras is ignored" in caplog.text


def test_ros_headers_without_time_go_by_the_recording(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    needs_rosbags()
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        for i in range(3):
            bag.info("/depth/camera_info", 0, (WIDTH, HEIGHT), DEPTH_K, recorded_s=5 + i)
            bag.image("/depth/image", 0, "16UC1", depth_units(i, 1000), recorded_s=5 + i)
    sequence = open_sequence(tmp_path / "a.bag")
    np.testing.assert_allclose(sequence.timestamps_s, [5, 6, 7])
    assert "those of recording" in caplog.text


def test_ros_registered_depth_goes_before_other_depth(tmp_path: Path) -> None:
    needs_rosbags()
    with BagWriter(tmp_path / "a.bag", 2) as bag:
        for topic in ("/cam/depth/image", "/cam/aligned_depth_to_color/image_raw"):
            bag.image(topic, 1, "16UC1", depth_units(len(topic), 1000))
        bag.info("/cam/color/camera_info", 1, (WIDTH, HEIGHT), DEPTH_K, distortion=[0.1, 0, 0, 0, 0])
        bag.image("/cam/color/image_raw", 1, "rgb8", color_rgb(0))
        bag.image("/cam/infra/image_raw", 1, "mono8", color_rgb(0)[..., 0])
    sequence = open_sequence(tmp_path / "a.bag")
    assert_camera(sequence.camera)
    assert sequence.read(0).depth_m[0, 0] == depth_units(len("/cam/aligned_depth_to_color/image_raw"), 1000)[
        0, 0
    ] / np.float32(1000)


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        (
            None,
            r"several topics can be depth; pass topics .*the bag has .*/a/depth \(Image\), /b/depth \(Image\), /color",
        ),
        ("depth=/nowhere", r"depth topic /nowhere is not in the bag; the bag has /a/camera_info"),
        ("depth=/a/camera_info", r"is of type sensor_msgs/msg/CameraInfo"),
        ("depth=/b/depth", "intrinsics are not known; pass --camera"),
    ],
)
def test_ros_topics_that_are_ambiguous_or_missing_are_listed(tmp_path: Path, topics: str | None, words: str) -> None:
    needs_rosbags()
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        for topic in ("/a/depth", "/b/depth"):
            bag.image(topic, 1, "16UC1", depth_units(0, 1000))
        bag.image("/color", 1, "rgb8", color_rgb(0))
        bag.info("/a/camera_info", 1, (WIDTH, HEIGHT), DEPTH_K)
    with pytest.raises(DatasetError, match=words):
        open_sequence(tmp_path / "a.bag", topics=topics)
    assert_camera(open_sequence(tmp_path / "a.bag", topics="depth=/a/depth").camera)


def test_ros_bag_without_images(tmp_path: Path) -> None:
    needs_rosbags()
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        bag.info("/a/camera_info", 1, (WIDTH, HEIGHT), DEPTH_K)
    with pytest.raises(DatasetError, match=r"no topic of depth; .*the bag has /a/camera_info \(CameraInfo\)"):
        open_sequence(tmp_path / "a.bag")


@pytest.mark.parametrize("text", ["depth", "range=/a", "", "=,="])
def test_topics_that_are_none(tmp_path: Path, text: str) -> None:
    if text:
        with pytest.raises(InvalidInputError, match="topics: expected depth=TOPIC"):
            open_sequence(write_sens(tmp_path / "a.sens"), topics=text)
    with pytest.raises(DatasetError, match="only ROS bags have"):
        open_sequence(write_sens(tmp_path / "a.sens"), topics={"depth": "/a"})


def test_ros_without_the_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag1", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'scanweld\[ros\]'"):
        open_sequence(tmp_path / "a.bag")


# --- the contract ---------------------------------------------------------------------------------------


def test_the_contract_notices_what_is_wrong(tmp_path: Path) -> None:
    """Readers that break a promise, each in one way."""
    good = open_sequence(write_sens(tmp_path / "a.sens"))
    check_sequence(good)

    class Broken:
        """The good sequence with one thing changed."""

        def __init__(self, **changes: object) -> None:
            self.changes = changes

        def __getattr__(self, name: str) -> object:
            return self.changes[name] if name in self.changes else getattr(good, name)

        def __len__(self) -> int:
            return len(good)

        def __iter__(self) -> object:
            return iter(self.changes.get("frames", good))  # type: ignore[call-overload]

    last = good.read(3)
    kept = list(good)
    for changes, words in (
        ({"name": ""}, "name"),
        ({"timestamps_s": good.timestamps_s[::-1].copy()}, "not later"),
        ({"timestamps_s": good.timestamps_s.astype(np.float32)}, "float64"),
        ({"depth_scale": 0.0}, "positive"),
        ({"read": lambda index: last}, "frame 2 has time"),
        ({"read": lambda index: kept[index], "frames": kept}, "share memory"),
        ({"frames": kept[:-1]}, "iterating left it out"),
        ({"camera": PinholeCamera(1, 1, 1, 1, WIDTH, HEIGHT)}, "its camera"),
        ({"ground_truth": good.ground_truth.T_world_camera}, "expected a Trajectory"),  # type: ignore[union-attr]
    ):
        with pytest.raises(AssertionError, match=words):
            check_sequence(Broken(**changes))  # type: ignore[arg-type]


def test_the_contract_holds_for_the_formats_of_images(tmp_path: Path) -> None:
    from written_sequences import write_redwood, write_seven_scenes

    numbered = write_redwood(tmp_path / "r", color="rgb", suffix=".png")
    for folder in (numbered, write_seven_scenes(tmp_path / "s"), write_tum(tmp_path / "t")):
        check_sequence(open_sequence(folder))
        check_sequence(open_sequence(folder, frames="1:", scale=3))
    check_sequence(open_sequence(numbered, format="icl"))


def test_true_poses_evaluate_without_error(tmp_path: Path) -> None:
    """What a reader returns as truth is what was recorded: written out, it is the same file again."""
    from scanweld.io.trajectory_files import write_tum as write_trajectory

    sequence = open_sequence(write_stray(tmp_path / "a"))
    assert sequence.ground_truth is not None
    write_trajectory(tmp_path / "truth.txt", sequence.ground_truth)
    np.testing.assert_allclose(read_trajectory(tmp_path / "truth.txt").T_world_camera, poses(4), atol=1e-12)


def test_unreadable_frames_are_left_out(tmp_path: Path) -> None:
    write_image(tmp_path / "x.png", depth_units(0, 1000))
    folder = write_bundle_fusion(tmp_path / "apt0")
    shutil.copy(folder / "frame-000001.color.png", folder / "frame-000001.depth.png")
    sequence = open_sequence(folder)
    check_sequence(sequence)
    assert len(list(sequence)) == 3


def test_the_table_in_the_documentation_lists_every_format_in_order() -> None:
    text = (Path(__file__).parents[1] / "docs/formats.md").read_text(encoding="utf-8")
    table = text.split("| `--format` |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == [row.name for row in FORMATS]


def test_the_page_on_adding_a_format_runs(tmp_path: Path) -> None:
    """Its programs, one after the other; then the reader of images that they define, on images."""
    text = (Path(__file__).parents[1] / "docs/add-a-format.md").read_text(encoding="utf-8")
    variables: dict[str, Any] = {}
    for program in re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        exec(compile(program, "add-a-format.md", "exec"), variables)
    for i in range(3):
        write_frame(tmp_path / f"shot_{i:03d}_z.png", tmp_path / f"shot_{i:03d}_c.png", i, 10000)
    assert variables["row"].recognises(tmp_path)
    check_sequence(variables["row"].open(tmp_path, Overrides()))
