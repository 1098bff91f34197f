"""Opening: detection, overrides and who wins, selections and sizes, and one line for every bad input."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scanweld.datasets.base import FileSequence, FrameFiles, RgbdSequence
from scanweld.datasets.intrinsics import parse_intrinsics
from scanweld.datasets.open import FORMATS, open_sequence
from scanweld.datasets.selection import parse_frames, select
from scanweld.errors import DatasetError, InvalidInputError, ScanweldError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from written_captures import (
    write_bundle_fusion,
    write_eth3d,
    write_record3d,
    write_replica,
    write_sens,
    write_stray,
    write_video_pair,
)
from written_sequences import (
    HEIGHT,
    WIDTH,
    color_rgb,
    depth_units,
    write_camera,
    write_image,
    write_redwood,
    write_seven_scenes,
    write_tum,
)


def test_every_kind_of_sequence_satisfies_the_protocol(tmp_path: Path) -> None:
    sequence = open_sequence(write_redwood(tmp_path))
    for kind in (sequence, select(sequence, "1:"), open_sequence(tmp_path, scale=2)):
        assert isinstance(kind, RgbdSequence)


def test_each_layout_is_recognised_by_its_own_format_first(tmp_path: Path) -> None:
    (tmp_path / "icl").mkdir()
    (tmp_path / "icl/livingRoom1.gt.freiburg").touch()
    folders = {
        "redwood": write_redwood(tmp_path / "r"),
        "7scenes": write_seven_scenes(tmp_path / "s"),
        "tum": write_tum(tmp_path / "t"),
        "icl": tmp_path / "icl",
        "replica": write_replica(tmp_path / "scenes/office0"),
        "eth3d": write_eth3d(tmp_path / "e"),
        "bonn": write_tum(tmp_path / "rgbd_bonn_balloon"),
        "bundlefusion": write_bundle_fusion(tmp_path / "b"),
        "stray": write_stray(tmp_path / "p"),
        "video": write_video_pair(tmp_path / "v", depth="depth"),
    }
    files = {
        "scannet": write_sens(tmp_path / "a/scene.sens"),
        "record3d": write_record3d(tmp_path / "c/a.r3d", {}),
        "realsense": tmp_path / "q/a.bag",
        "rosbag": tmp_path / "d/a.bag",
    }
    for name, content in (("realsense", b"#ROSBAG V2.0\n/file_version"), ("rosbag", b"")):
        files[name].parent.mkdir()
        files[name].write_bytes(content)
    folders |= {name: file.parent for name, file in files.items()}
    assert set(folders) == {row.name for row in FORMATS}
    for name, folder in folders.items():
        assert next(row.name for row in FORMATS if row.recognises(folder)) == name
    for name, file in files.items():
        fits = [row for row in FORMATS if file.suffix in row.suffixes]
        assert next(row.name for row in fits if row.recognises(file)) == name


def test_a_folder_named_like_icl_with_its_own_truth_is_taken_as_it_is(tmp_path: Path) -> None:
    """A rendered sequence along an ICL-NUIM path must not have its truth turned over."""
    folder = write_tum(tmp_path / "living_room_traj2_frei_png")
    tum = next(row for row in FORMATS if row.recognises(folder))
    assert tum.name == "tum"
    (folder / "groundtruth.txt").unlink()
    assert next(row.name for row in FORMATS if row.recognises(folder)) == "icl"


def test_opening_loads_no_heavy_library() -> None:
    """OpenCV loads with the first image, Numba never; a fresh interpreter shows it."""
    heavy = "('cv2', 'numba', 'matplotlib')"
    code = f"import sys, scanweld.datasets.open; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_sequence_may_be_one_folder_down(tmp_path: Path) -> None:
    write_tum(tmp_path / "download" / "rgbd_dataset_freiburg2_desk")
    sequence = open_sequence(tmp_path / "download")
    assert sequence.name == "rgbd_dataset_freiburg2_desk"
    assert sequence.camera.fx == pytest.approx(520.9 / 40)


@pytest.mark.parametrize("name", ["redwood", "Redwood"])
def test_format_by_name(tmp_path: Path, name: str) -> None:
    assert len(open_sequence(write_redwood(tmp_path), format=name)) == 4


@pytest.mark.parametrize("alias", ["7-scenes", "7Scenes", "seven_scenes"])
def test_format_aliases(tmp_path: Path, alias: str) -> None:
    assert len(open_sequence(write_seven_scenes(tmp_path), format=alias)) == 4


# --- who decides ----------------------------------------------------------------------------------


def test_caller_beats_camera_file_beats_format(tmp_path: Path) -> None:
    for folder in (
        write_redwood(tmp_path / "r"),
        write_seven_scenes(tmp_path / "s"),
        write_tum(tmp_path / "fr1"),
    ):
        write_camera(folder)
        sequence = open_sequence(folder)
        assert sequence.camera == PinholeCamera(13, 13.5, 7.5, 5.5, WIDTH, HEIGHT)
        assert sequence.depth_scale == 2000
        sequence = open_sequence(folder, camera=(12, 12.5, 7, 5), depth_scale=4000)
        assert sequence.camera == PinholeCamera(12, 12.5, 7, 5, WIDTH, HEIGHT)
        assert sequence.depth_scale == 4000
        stored = 1000 if folder.name != "fr1" else 5000
        np.testing.assert_allclose(sequence.read(0).depth_m, depth_units(0, stored) / 4000, rtol=1e-6)


def test_negative_fy_is_taken_as_positive(tmp_path: Path) -> None:
    """ICL-NUIM prints fy = -480; its images are upright, so the pinhole camera has fy = 480."""
    write_redwood(tmp_path)
    write_camera(tmp_path, fy=-13.5)
    assert open_sequence(tmp_path).camera.fy == 13.5
    assert open_sequence(tmp_path, camera=(12, -12, 7, 5)).camera.fy == 12


def test_camera_is_that_of_the_images_on_disk(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    camera = PinholeCamera(12, 12, 7, 5, WIDTH, HEIGHT)
    assert open_sequence(tmp_path, camera=camera, scale=2).camera == camera.scaled(2)
    with pytest.raises(DatasetError, match=r"the images are 16x12, the camera 8x6"):
        open_sequence(tmp_path, camera=camera.scaled(0.5))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": "a"}, "'fx' must be a number"),
        ({"fx": None}, "'fx' must be a number"),
        ({"fx": float("nan")}, "'fx' must be a number"),
        ({"fx": -3}, "must be positive"),
        ({"width": 640}, "says 640x12, the images are 16x12"),
        ({"depth_scale": 0}, "depth_scale must be positive"),
        ({"depth_scale": True}, "'depth_scale' must be a number"),
    ],
)
def test_camera_file_that_is_wrong(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    write_redwood(tmp_path)
    write_camera(tmp_path, **changes)
    with pytest.raises(DatasetError, match=rf"camera[.]json.*{words}"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("text", ["not json", "[1, 2]", "", '{"fx": 1}'])
def test_camera_file_that_is_no_camera(tmp_path: Path, text: str) -> None:
    write_redwood(tmp_path)
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(DatasetError, match=r"camera[.]json"):
        open_sequence(tmp_path)


def test_depth_scale_is_checked(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"^depth_scale must be positive"):
        open_sequence(write_redwood(tmp_path), depth_scale=-1)


@pytest.mark.parametrize(
    ("stated", "passed", "words"),
    [
        (None, 5000, "the unit of the format is 1000 per metre, 5000 was passed: the scene becomes 5 times smaller"),
        (None, 200, "the unit of the format is 1000 per metre, 200 was passed: the scene becomes 5 times larger"),
        (5000, 1000, "the unit of camera.json is 5000 per metre, 1000 was passed: the scene becomes 5 times larger"),
        (5000, 5000, None),
        (None, 1001, None),
    ],
)
def test_a_unit_that_contradicts_the_sequence_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, stated: float | None, passed: float, words: str | None
) -> None:
    write_redwood(tmp_path)
    if stated is not None:
        write_camera(tmp_path, depth_scale=stated)
    assert open_sequence(tmp_path, depth_scale=passed).depth_scale == passed
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert told == ([] if words is None else [f"depth_scale: {words}"])


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ((13, 13, 319.5, 5), "the principal point 319.5, 5 lies outside the image; the images are 16x12"),
        ((13, 13, 7, -9), "the principal point 7, -9 lies outside"),
        ((525, 13, 7, 5), "fx = 525 is 32.8 times the image width"),
        ((13, 1, 7, 5), "fy = 1 is 0.0625 times the image width"),
        ((525, 525, 319.5, 239.5), "principal point 319.5, 239.5 .* and fx = 525 .* and fy = 525"),
    ],
)
def test_a_camera_that_does_not_fit_the_images_is_doubted_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, camera: tuple[float, float, float, float], words: str
) -> None:
    open_sequence(write_redwood(tmp_path), camera=camera)
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(told) == 1
    assert told[0].startswith("camera: ")
    assert re.search(words, told[0])


def test_plausible_cameras_are_not_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """0.2 and 5 times the 16 pixels, and a principal point in the corner pixels."""
    write_redwood(tmp_path)
    for camera in ((3.2, 80, 0, 0), (13, 13, 15, 11)):
        open_sequence(tmp_path, camera=camera)
    open_sequence(tmp_path)
    assert caplog.text == ""


def test_a_bad_camera_is_told_without_stammering(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"^camera: focal lengths must be positive, got -3"):
        open_sequence(write_redwood(tmp_path), camera=(-3, 3, 7, 5))


def test_parse_intrinsics() -> None:
    assert parse_intrinsics("525,526, 319.5,239.5") == (525, 526, 319.5, 239.5)
    for text in ("", "525", "1,2,3", "1,2,3,4,5", "a,b,c,d"):
        with pytest.raises(InvalidInputError, match="FX,FY,CX,CY"):
            parse_intrinsics(text)


# --- selections and sizes -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("1:3", [1, 2]),
        ("2:", [2, 3]),
        (":2", [0, 1]),
        ("::2", [0, 2]),
        ("1:100:2", [1, 3]),
        ("-2:", [2, 3]),
        (":", [0, 1, 2, 3]),
    ],
)
def test_frames(tmp_path: Path, text: str, numbers: list[int]) -> None:
    """Golden 6: frame k of the selection is the frame at that position of the whole, with its own time."""
    whole = open_sequence(write_redwood(tmp_path))
    part = open_sequence(tmp_path, frames=text)
    assert len(part) == len(numbers)
    np.testing.assert_array_equal(part.timestamps_s, whole.timestamps_s[numbers])
    assert part.ground_truth is whole.ground_truth or len(part.ground_truth) == len(whole.ground_truth)  # type: ignore[arg-type]
    for frame, n in zip(part, numbers, strict=True):
        np.testing.assert_array_equal(frame.depth_m, whole.read(n).depth_m)
        np.testing.assert_array_equal(frame.color, whole.read(n).color)


def test_frames_of_frames(tmp_path: Path) -> None:
    whole = open_sequence(write_redwood(tmp_path, count=9))
    part = select(select(whole, "1:8:2"), "1:3")  # 1 3 5 7 -> 3 5
    np.testing.assert_array_equal(part.timestamps_s, whole.timestamps_s[[3, 5]])


@pytest.mark.parametrize("text", ["", "3", "a:b", "1:2:3:4", "1.5:2"])
def test_frames_that_are_no_range(text: str) -> None:
    with pytest.raises(InvalidInputError, match="A:B"):
        parse_frames(text)


@pytest.mark.parametrize(
    ("frames", "words"),
    [("7:9", "selects none of the 4"), ("2:1", "none"), ("::-1", "step"), ("::0", "step")],
)
def test_frames_that_select_nothing(tmp_path: Path, frames: str, words: str) -> None:
    with pytest.raises(InvalidInputError, match=words):
        open_sequence(write_redwood(tmp_path), frames=frames)


def test_half_size(tmp_path: Path) -> None:
    """Golden 9: cx' = (cx + 0.5) / 2 - 0.5; a 2x2 block becomes its mean (inverse) depth and colour."""
    write_large(tmp_path, 96, 64)
    full, half = open_sequence(tmp_path), open_sequence(tmp_path, scale=0.5)
    assert half.camera == full.camera.scaled(0.5)
    assert (half.camera.width, half.camera.height) == (48, 32)
    frame, small = full.read(0), half.read(0)
    assert small.camera == half.camera
    assert small.timestamp_s == frame.timestamp_s
    block = frame.depth_m[:2, :2].astype(np.float64)
    np.testing.assert_allclose(small.depth_m[0, 0], 4 / (1 / block).sum(), rtol=1e-6)
    np.testing.assert_array_equal(small.color, np.full((32, 48, 3), (200, 100, 0)))


@pytest.mark.parametrize("scale", [0.01, 0.49, 0.0001])
def test_a_scale_that_leaves_too_few_pixels_is_refused(tmp_path: Path, scale: float) -> None:
    write_large(tmp_path, 96, 64)
    with pytest.raises(InvalidInputError, match=r"^scale: .*96x64.*less than 32 pixels.*use 0[.]5 or more$"):
        open_sequence(tmp_path, scale=scale)


def test_images_that_are_small_already_cannot_be_made_smaller(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"16x12 images 14x11.*cannot be made smaller"):
        open_sequence(write_redwood(tmp_path), scale=0.9)
    assert open_sequence(tmp_path, scale=1.5).camera.shape == (18, 24)


def write_large(folder: Path, width: int, height: int) -> None:
    """One frame in the Redwood layout: depth 1.5 m and up by a millimetre a pixel, one colour."""
    depth = 1500 + np.add.outer(np.arange(height), np.arange(width))
    write_image(folder / "depth/0.png", depth.astype(np.uint16))
    write_image(folder / "color/0.png", np.full((height, width, 3), (200, 100, 0), np.uint8))


# --- bad input: one line that names the place and the fix -----------------------------------------


def fails(path: Path, words: str, **options: object) -> None:
    with pytest.raises(ScanweldError, match=words) as caught:
        open_sequence(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_missing_folder(tmp_path: Path) -> None:
    fails(tmp_path / "nowhere", "nowhere: no such folder")
    fails(tmp_path / ("n" * 300), "n: no such folder")  # longer than any name may be


def test_a_file_instead_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "seq.zip").touch()
    fails(tmp_path / "seq.zip", r"is a file, expected a sequence folder or one of [.]sens, .*; unpack it")


def test_a_file_named_as_another_format(tmp_path: Path) -> None:
    fails(write_sens(tmp_path / "a.sens"), "not a sequence of format 'tum'; it looks like 'scannet'", format="tum")


def test_unknown_layout_says_what_is_there(tmp_path: Path) -> None:
    fails(tmp_path, "not a sequence of a known format .*datasets list.*; it holds nothing")
    for n in range(7):
        (tmp_path / f"IMG_{n}.dng").touch()
    fails(tmp_path, r"it holds IMG_0[.]dng.* and 2 more")


def test_unknown_format_names_the_known(tmp_path: Path) -> None:
    fails(
        write_redwood(tmp_path),
        "format 'webcam' is not known; known are auto, scannet, .*7scenes, .*icl, .*tum, .*redwood",
        format="webcam",
    )


@pytest.mark.parametrize("name", ["redwood", "7scenes", "tum", "icl"])
def test_a_named_format_says_what_it_misses(tmp_path: Path, name: str) -> None:
    layout = next(row.layout for row in FORMATS if row.name == name)
    fails(tmp_path, f"format '{name}', which needs {re.escape(layout)}; it holds nothing", format=name)


@pytest.mark.parametrize("name", ["redwood", "7scenes", "tum", "icl"])
def test_a_named_format_that_does_not_fit_is_refused_and_the_right_one_named(tmp_path: Path, name: str) -> None:
    """Read as another format a sequence would get that format's intrinsics, unit and truth."""
    write_redwood(tmp_path / "redwood", color="image")
    write_seven_scenes(tmp_path / "7scenes")
    write_tum(tmp_path / "tum")
    (tmp_path / "tum/rgb").rename(tmp_path / "tum/pictures")  # with rgb/ it could be called ICL-NUIM
    for folder in {"redwood", "7scenes", "tum"} - {name}:
        words = f"not a sequence of format '{name}', which needs .*looks like '{folder}'"
        fails(tmp_path / folder, words, format=name)


def test_a_named_format_wins_where_its_files_suffice(tmp_path: Path) -> None:
    """ICL-NUIM's archives without their truth have the files of TUM; numbered rgb/ and depth/ those of Redwood."""
    sequence = open_sequence(write_tum(tmp_path / "t"), format="icl")
    assert sequence.camera.fx == pytest.approx(481.2 / 40)
    numbered = write_redwood(tmp_path / "r", color="rgb", suffix=".png")
    assert open_sequence(numbered, format="icl").depth_scale == 5000
    assert open_sequence(numbered, format="redwood").depth_scale == 1000


def test_empty_sequence(tmp_path: Path) -> None:
    (tmp_path / "color").mkdir()
    (tmp_path / "depth").mkdir()
    fails(tmp_path, "depth/ and color/ hold no images")
    fails(tmp_path, "depth/ and color/ hold no images", format="redwood")
    (tmp_path / "depth").rmdir()
    fails(tmp_path, "color/ holds no images")
    write_image(tmp_path / "color/left.png", color_rgb(0))
    fails(tmp_path, "it holds color/")  # images there are, but none with a number


def test_color_without_depth(tmp_path: Path) -> None:
    write_redwood(tmp_path / "r")
    for path in (tmp_path / "r/depth").iterdir():
        path.unlink()
    fails(tmp_path / "r", "4 colour images, but no depth image")
    write_seven_scenes(tmp_path / "s")
    for path in (tmp_path / "s").glob("*.depth.png"):
        path.unlink()
    fails(tmp_path / "s", "4 colour images, but no depth image")


def test_depth_without_color_is_allowed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_redwood(tmp_path)
    for path in (tmp_path / "color").iterdir():
        path.unlink()
    sequence = open_sequence(tmp_path)
    assert sequence.read(0).color is None
    assert open_sequence(tmp_path, scale=2).read(0).color is None
    assert "no colour" in caplog.text


def test_sizes_that_differ(tmp_path: Path) -> None:
    write_redwood(tmp_path, suffix=".png")
    for path in (tmp_path / "color").iterdir():
        write_image(path, np.zeros((24, 32, 3), np.uint8))
    fails(tmp_path, r"00000[.]png is 32x24, 00000[.]png is 16x12: .* registered")


def test_swapped_folders(tmp_path: Path) -> None:
    write_redwood(tmp_path, suffix=".png")
    (tmp_path / "color").rename(tmp_path / "x")
    (tmp_path / "depth").rename(tmp_path / "color")
    (tmp_path / "x").rename(tmp_path / "depth")
    fails(tmp_path, "not a depth image: it has 8 bits, 3 channels.*swapped")


def test_the_first_frames_may_be_damaged(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    first = tmp_path / "depth/00000.png"
    first.write_bytes(first.read_bytes()[:50])
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 4
    with pytest.raises(UnreadableFrameError, match=r"00000[.]png: truncated PNG"):
        sequence.read(0)
    assert len(list(sequence)) == 3


def test_all_frames_damaged(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    for path in (tmp_path / "depth").iterdir():
        path.write_bytes(b"")
    fails(tmp_path, r"none of the 4 frames can be decoded; the first: .*00000[.]png: the file is empty")


def test_file_sequence_checks_its_frames(tmp_path: Path) -> None:
    camera = PinholeCamera(12, 12, 7, 5, WIDTH, HEIGHT)
    with pytest.raises(DatasetError, match="no frame"):
        FileSequence(name="s", camera=camera, frames=(), depth_scale=1000)
    frames = tuple(FrameFiles(t, Path(f"{t}.png"), None) for t in (1.0, 2.0, 2.0))
    with pytest.raises(DatasetError, match="time must increase"):
        FileSequence(name="s", camera=camera, frames=frames, depth_scale=1000)
