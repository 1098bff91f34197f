"""Bad input for every reader of recordings: one line, nothing written, nothing absurd allocated."""

from __future__ import annotations

import gc
import json
import os
import shutil
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.lzfse import decompress_lzfse
from scanweld.datasets.open import open_sequence
from scanweld.datasets.ros_messages import CAMERA_INFO, IMAGE, parse_camera_info, parse_image
from scanweld.errors import DatasetError, FileFormatError, UnreadableFrameError
from written_captures import (
    BagWriter,
    record3d_files,
    sens_bytes,
    write_bag,
    write_bundle_fusion,
    write_eth3d,
    write_record3d,
    write_replica,
    write_sens,
    write_stray,
    write_video_pair,
)
from written_sequences import HEIGHT, WIDTH, color_rgb, depth_units

EXAMPLES = settings(max_examples=25)


def read_all(path: Path) -> bool:
    """Open and read everything; whether that worked. Any failure must be ours, in one line."""
    opened: list[RgbdSequence] = []
    if not succeeds(lambda: opened.append(open_sequence(path))):
        return False
    # All of them are read, whatever becomes of the first.
    read = [succeeds(lambda index=index: opened[0].read(index)) for index in range(len(opened[0]))]
    return all(read)


def succeeds(action: Callable[[], object]) -> bool:
    """Whether it ends without an error; an error must be one of a data set or a file, in one line."""
    try:
        action()
    except (DatasetError, FileFormatError) as error:
        message = str(error)
    else:
        return True
    assert message
    assert "\n" not in message
    return False


def fails(path: Path, words: str, error: type[Exception] = DatasetError, **options: object) -> None:
    with pytest.raises(error, match=words) as caught:
        open_sequence(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a good recording of each kind that is one file, by its name."""
    folder = tmp_path_factory.mktemp("good")
    files = {"a.sens": sens_bytes()}
    files["a.r3d"] = write_record3d(folder / "a.r3d", record3d_files(compress=False)).read_bytes()
    if find_spec("rosbags") is None:
        return files
    files["a.bag"] = write_bag(folder / "a.bag").read_bytes()
    for storage, suffix in (("sqlite3", ".db3"), ("mcap", ".mcap")):
        write_bag(folder / storage, 2, storage=storage)
        files[f"a{suffix}"] = next((folder / storage).glob(f"*{suffix}")).read_bytes()
    return files


KINDS = ["a.sens", "a.r3d", "a.bag", "a.db3", "a.mcap"]


@pytest.mark.parametrize("name", KINDS)
@EXAMPLES
@given(fraction=st.floats(0, 1, exclude_max=True))
def test_a_truncated_recording(
    recordings: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory, name: str, fraction: float
) -> None:
    if name not in recordings:
        pytest.skip("rosbags is not installed: pip install 'scanweld[ros]'")
    folder = tmp_path_factory.mktemp("cut")
    data = recordings[name]
    (folder / name).write_bytes(data[: int(fraction * len(data))])
    intact = read_all(folder / name)
    assert not intact or name in ("a.db3", "a.mcap", "a.sens"), "what is missing may be an index that is not needed"
    assert [path.name for path in folder.iterdir() if not path.name.startswith(f"{name}-")] == [name]


@pytest.mark.parametrize("name", KINDS)
@EXAMPLES
@given(place=st.floats(0, 1, exclude_max=True), values=st.binary(min_size=1, max_size=8))
def test_a_damaged_recording(
    recordings: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory, name: str, place: float, values: bytes
) -> None:
    if name not in recordings:
        pytest.skip("rosbags is not installed: pip install 'scanweld[ros]'")
    folder = tmp_path_factory.mktemp("damaged")
    data = bytearray(recordings[name])
    start = int(place * len(data))
    data[start : start + len(values)] = values
    (folder / name).write_bytes(data)
    read_all(folder / name)


FOLDERS: dict[str, Callable[[Path], Path]] = {
    "replica": write_replica,
    "eth3d": write_eth3d,
    "bundlefusion": write_bundle_fusion,
    "stray": write_stray,
    "video": write_video_pair,
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("folders")
    for name, write in FOLDERS.items():
        (home / name / name).mkdir(parents=True)
        write(home / name / name)
    return home


@pytest.mark.parametrize("name", sorted(FOLDERS))
@settings(max_examples=12)
@given(choice=st.integers(0, 10_000), fraction=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_of_a_folder(
    folders: Path, tmp_path_factory: pytest.TempPathFactory, name: str, choice: int, fraction: float
) -> None:
    folder = tmp_path_factory.mktemp("cut") / name
    shutil.copytree(folders / name, folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # Descriptions are few among many images: every other time one of them is cut.
    texts = [path for path in files if path.suffix not in (".png", ".jpg")]
    chosen = (files if choice % 2 else texts)[(choice // 2) % len(files if choice % 2 else texts)]
    data = chosen.read_bytes()
    chosen.write_bytes(data[: int(fraction * len(data))])
    read_all(folder / name)
    assert sorted(path for path in folder.rglob("*") if path.is_file()) == files


# --- .sens ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"version": 3}, r"no [.]sens file of version 4 \(it begins with 3\)"),
        ({"num_frames": 2**60}, "frames do not fit into"),
        ({"num_frames": 5}, r"truncated within frame 4 of 5|do not fit"),
        ({"count": 0}, "the sequence is empty"),
        ({"depth_size": (70_000, 70_000)}, "claims images of 32x24 .* and 70000x70000"),
        ({"depth_size": (0, 12)}, "claims images"),
        ({"depth_size": (WIDTH + 1, HEIGHT)}, "none of the 4 frames can be decoded.*expected 17x12 depth values"),
        ({"extrinsics": np.full((4, 4), 3.0)}, "no rigid transforms"),
    ],
)
def test_sens_headers(tmp_path: Path, options: dict[str, object], words: str) -> None:
    fails(write_sens(tmp_path / "a.sens", **options), words)  # type: ignore[arg-type]


def test_sens_sizes_that_exceed_the_file(tmp_path: Path) -> None:
    data = bytearray(sens_bytes())
    start = 4 + 8 + 5 + 4 * 64 + 8 + 16 + 4 + 8  # of the first frame
    for place, value in ((start + 80, 2**63), (start + 88, 2**40)):
        (tmp_path / "a.sens").write_bytes(data[:place] + struct.pack("<Q", value) + data[place + 8 :])
        fails(tmp_path / "a.sens", "truncated within frame 0 of 4")
    (tmp_path / "a.sens").write_bytes(data[:4] + struct.pack("<Q", 2**50) + data[12:])
    fails(tmp_path / "a.sens", "claims a sensor name of 1125899906842624 bytes")
    (tmp_path / "a.sens").write_bytes(b"")
    fails(tmp_path / "a.sens", "no .sens file, it has 0 bytes")


def test_sens_depth_that_unpacks_to_gigabytes_stops_at_an_image(tmp_path: Path) -> None:
    import zlib

    good = sens_bytes(1, depth_compression=0)
    depth = depth_units(0, 1000).astype("<u2").tobytes()
    bomb = zlib.compress(bytes(64 << 20), 9)
    data = good.replace(depth, bomb).replace(struct.pack("<Q", len(depth)), struct.pack("<Q", len(bomb)))
    kinds = 4 + 8 + 5 + 4 * 64
    data = data[: kinds + 4] + struct.pack("<i", 1) + data[kinds + 8 :]
    (tmp_path / "a.sens").write_bytes(data)
    tracemalloc.start()
    fails(tmp_path / "a.sens", "expected 16x12 depth values")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 << 20


def test_reading_a_long_sens_file_keeps_memory_constant(tmp_path: Path) -> None:
    """300 frames of which each is 12 kB: reading them takes no more than a few."""
    path = write_sens(tmp_path / "a.sens", 300, color_compression=0)
    assert path.stat().st_size > 800_000
    sequence = open_sequence(path)
    sequence.read(0)
    tracemalloc.start()
    for frame in sequence:
        assert frame.depth_m[0, 0] > 0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000


# --- Record3D -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"K": [1, 2, 3]}, "'K' must be 9 numbers"),
        ({"K": None}, "'K' is missing"),
        ({"w": 1e9}, "says that images have 1e"),
        ({"dw": "wide"}, "'dw' must be a number"),
        ({"dh": 13}, "none of the 4 frames can be decoded"),
        ({"fps": 0}, "positive number of frames a second"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]] * 3}, "'poses' has 3 entries, but there is a frame 3"),
        ({"poses": [[0, 0, 0, 0, 0, 0, 0]] * 4}, "unit quaternions"),
        ({"poses": [[0, 0, 0, 1]] * 4}, "'poses' must be N x 7 numbers"),
        ({"frameTimestamps": [1, 2]}, "'frameTimestamps' has 2 entries"),
        ({"frameTimestamps": {"a": 1}}, "'frameTimestamps' must be N numbers"),
    ],
)
def test_record3d_metadata(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    files = record3d_files(compress=False, **changes)
    fails(write_record3d(tmp_path / "a.r3d", files), words)


def test_record3d_archives(tmp_path: Path) -> None:
    path = tmp_path / "a.r3d"
    path.write_bytes(b"PK\x03\x04 this is no archive")
    fails(path, "no readable .r3d file")
    files = record3d_files(compress=False)
    fails(write_record3d(path, {k: v for k, v in files.items() if k != "metadata"}), "has no metadata")
    fails(write_record3d(path, files | {"metadata": b"\x80\x04pickle"}), "metadata")
    fails(write_record3d(path, files | {"metadata": b"[1]"}), "expected a JSON object")
    fails(write_record3d(path, {"metadata": files["metadata"]}), "the sequence is empty")


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../../escaped", "rgbd/../../escaped", "C:\\escaped", "rgbd/..\\0.jpg"]
)
def test_record3d_names_that_lead_elsewhere_are_passed_over(tmp_path: Path, name: str) -> None:
    """Nothing of an archive is written to disk, and only names of frames are looked up."""
    folder = tmp_path / "in"
    path = write_record3d(folder / "a.r3d", record3d_files(compress=False) | {name: b"evil"})
    before = sorted(tmp_path.rglob("*"))
    assert read_all(path)
    assert sorted(tmp_path.rglob("*")) == before


def test_record3d_entry_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    files = record3d_files(compress=False) | {"rgbd/0.depth": bytes(64 << 20)}
    path = write_record3d(tmp_path / "a.r3d", files, zipfile.ZIP_DEFLATED)
    tracemalloc.start()
    sequence = open_sequence(path)
    with pytest.raises(UnreadableFrameError, match=r"rgbd/0.depth claims 67108864 bytes, at most 5632 fit"):
        sequence.read(0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 << 20


def test_lzfse_streams_that_promise_too_much() -> None:
    """The library would grow its output for ever; the headers are added up before it is called."""
    block = b"bvxn" + struct.pack("<II", 1 << 31, 4) + bytes(4)
    for data, words in (
        (block + b"bvx$", "becomes 2147483648 bytes, expected 100"),
        (b"bvx-" + struct.pack("<I", 100) + bytes(100), "truncated LZFSE stream"),
        (b"bvx-" + struct.pack("<I", 60) + bytes(60) + b"bvx$", "becomes 60 bytes"),
        (b"bvx?" + bytes(8), "damaged LZFSE stream"),
        (b"bvx", "truncated LZFSE stream"),
        (b"\x80\x04\x95", "no LZFSE stream"),
        (b"", "no LZFSE stream"),
    ):
        with pytest.raises(UnreadableFrameError, match=words):
            decompress_lzfse(data, 100, "x")


def test_lzfse_stream_that_is_damaged() -> None:
    liblzfse = pytest.importorskip("liblzfse", reason="pyliblzfse is not installed")
    good = liblzfse.compress((1.5 + 0.01 * np.arange(4096)).astype("<f4").tobytes())
    assert len(decompress_lzfse(good, 16384, "x")) == 16384
    rng = np.random.default_rng(0)
    for _ in range(200):
        data = bytearray(good)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        succeeds(lambda data=bytes(data): decompress_lzfse(data, 16384, "x"))


# --- folders ------------------------------------------------------------------------------------------


def test_replica_parameters(tmp_path: Path) -> None:
    scene = write_replica(tmp_path / "r/office0")
    parameters = tmp_path / "r/cam_params.json"
    for text, words in (
        ("{}", "expected an object 'camera'"),
        ('{"camera": {"w": 16}}', "'fx' must be a number"),
        ("[" * 100_000, "not a readable JSON file"),
        ('{"camera": {"fx": 1, "fy": 1, "cx": 1, "cy": 1, "scale": 0}}', "depth_scale must be positive"),
    ):
        parameters.write_text(text)
        fails(scene, words)


@pytest.mark.parametrize("text", ["", "1 2 3", "a b c d", "1 2 3 4 5"])
def test_eth3d_calibration(tmp_path: Path, text: str) -> None:
    folder = write_eth3d(tmp_path)
    (folder / "calibration.txt").write_text(text)
    fails(folder, "expected four numbers, fx fy cx cy")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("m_depthShift = 0", "depth_scale must be positive"),
        ("m_depthShift = many", "'m_depthShift' must be 1 number"),
        ("m_depthWidth = 1e12", "says that depth has 1e"),
        ("m_calibrationDepthIntrinsic = 1 2 3", "must be 16 numbers"),
        ("m_calibrationDepthExtrinsic = 2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "not a rotation"),
        ("m_depthHeight = 13", "none of the 4 frames can be decoded"),
    ],
)
def test_bundle_fusion_info(tmp_path: Path, line: str, words: str) -> None:
    folder = write_bundle_fusion(tmp_path)
    with (folder / "info.txt").open("a") as stream:
        stream.write(line + "\n")  # the last line with a key is taken
    fails(folder, words)


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("odometry.csv", "", "expected a header line"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n1, 0, 2\n", "line 2: expected 9 numbers"),
        ("odometry.csv", "timestamp,frame,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,0,0\n", "has not the norm 1"),
        ("odometry.csv", "timestamp,frame,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,0,1\n2,0,0,0,0,0,0,0,1\n", "whole and diff"),
        ("odometry.csv", "timestamp,frame,x,y,z,qx,qy,qz,qw\n1,77,0,0,0,0,0,0,1\n", "no depth image has the number"),
        ("odometry.csv", "timestamp,frame,x,y,z,qx,qy,qz,qw\n2,0,0,0,0,0,0,0,1\n1,1,0,0,0,0,0,0,1\n", "time must"),
        ("camera_matrix.csv", "1,2\n", "expected the 3x3 matrix"),
        ("rgb.mp4", "no video", "cannot be opened as a video"),
    ],
    ids=["empty", "short", "quaternion", "repeated", "unpaired", "backwards", "matrix", "video"],
)
def test_stray_scanner_files(tmp_path: Path, file: str, content: str, words: str) -> None:
    folder = write_stray(tmp_path)
    (folder / file).write_text(content)
    fails(folder, words)


def test_video_descriptions(tmp_path: Path) -> None:
    folder = write_video_pair(tmp_path)
    good = json.loads((folder / "camera.json").read_text())
    for changes, words in (
        ({"color": "../color.mkv"}, "leaves the sequence folder"),
        ({"depth": "/etc"}, "leaves the sequence folder"),
        ({"color": "other.mkv"}, "no such file; camera.json names it as 'color'"),
        ({"color": 7}, "must be the name of a file"),
        ({"fps": -1}, "positive number of frames"),
        ({"width": 99}, "says 99x12"),
    ):
        (folder / "camera.json").write_text(json.dumps(good | changes))
        fails(folder, words)
    (folder / "camera.json").write_text(json.dumps(good))
    (folder / "timestamps.txt").write_text("1\n2\n")
    fails(folder, "has 2 times for 6 frames")


def test_color_video_that_is_shorter_leaves_frames_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    from written_captures import large_color, write_video

    folder = write_video_pair(tmp_path, depth="depth")
    write_video(folder / "color.mkv", [large_color(i) for i in range(4)], "FFV1")
    assert len(open_sequence(folder)) == 4
    assert "4 colour and 6 depth images" in caplog.text


# --- ROS ------------------------------------------------------------------------------------------------


def image_message(**changes: int) -> bytes:
    """An Image of ROS 1, packed by hand."""
    values = {"height": 2, "width": 3, "step": 6, "count": 12} | changes
    return (
        struct.pack("<III", 1, 10, 500_000_000) + struct.pack("<I", 3) + b"cam"
        + struct.pack("<II", values["height"], values["width"]) + struct.pack("<I", 5) + b"16UC1"
        + struct.pack("<BII", 0, values["step"], values["count"]) + bytes(12)
    )  # fmt: skip


def test_ros_message_fields() -> None:
    image = parse_image(image_message(), IMAGE, is_cdr=False, where="x")
    assert (image.stamp_s, image.frame_id, image.encoding) == (10.5, "cam", "16UC1")
    assert (image.width, image.height, image.step, len(image.data)) == (3, 2, 6, 12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"count": 2**32 - 1}, "4294967295 bytes announced, 12 left"),
        ({"width": 2**31, "height": 2**31}, "claims an image"),
    ],
)
def test_ros_message_sizes(changes: dict[str, int], words: str) -> None:
    with pytest.raises(UnreadableFrameError, match=words):
        parse_image(image_message(**changes), IMAGE, is_cdr=False, where="x")


@EXAMPLES
@given(data=st.binary(max_size=200), is_cdr=st.booleans(), msgtype=st.sampled_from([IMAGE, CAMERA_INFO]))
def test_ros_messages_of_anything(data: bytes, is_cdr: bool, msgtype: str) -> None:
    if msgtype == CAMERA_INFO:
        succeeds(lambda: parse_camera_info(data, is_cdr=is_cdr, where="x"))
    else:
        succeeds(lambda: parse_image(data, msgtype, is_cdr=is_cdr, where="x"))


def test_ros_image_that_contradicts_itself_is_left_out(tmp_path: Path) -> None:
    """A step that is too small, a size that is not the topic's, an encoding that is none of depth."""
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'scanweld[ros]'")
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        bag.info("/d/camera_info", 1, (WIDTH, HEIGHT), (13, 13, 7, 5))
        bag.image("/d/image", 1, "16UC1", depth_units(0, 1000))
        bag.add("/d/image", "Image", 2, height=HEIGHT, width=WIDTH, encoding="16UC1", is_bigendian=0, step=3,
                data=np.zeros(9, np.uint8))  # fmt: skip
        bag.image("/d/image", 3, "16UC1", depth_units(0, 1000)[:4])
        bag.image("/d/image", 4, "rgb8", color_rgb(0))
    sequence = open_sequence(tmp_path / "a.bag")
    for index, words in ((1, "needs 32 bytes a row"), (2, "the image is 16x4"), (3, "'rgb8' is none of depth")):
        with pytest.raises(UnreadableFrameError, match=words):
            sequence.read(index)
    assert len(list(sequence)) == 1


def test_no_file_stays_open(tmp_path: Path) -> None:
    """Readers that are given up leave no descriptor behind."""
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'scanweld[ros]'")
    paths = [write_bag(tmp_path / "a.bag"), write_sens(tmp_path / "b.sens"), write_video_pair(tmp_path / "v"),
             write_record3d(tmp_path / "c.r3d", record3d_files(compress=False))]  # fmt: skip
    for path in paths:
        read_all(path)
    gc.collect()
    descriptors = Path("/proc/self/fd")
    if not descriptors.is_dir():
        pytest.skip("open files are listed on Linux only")
    links = [os.readlink(entry) for entry in descriptors.iterdir() if entry.exists()]
    assert [link for link in links if link.startswith(str(tmp_path))] == []


@pytest.mark.parametrize("compression", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_record3d_compressed_by_what_takes_any_memory(tmp_path: Path, compression: int) -> None:
    """The head of LZMA says how large its dictionary is, up to 4 GiB; recordings are stored or deflated."""
    path = write_record3d(tmp_path / "a.r3d", record3d_files(compress=False), compression)
    fails(path, "neither stored nor deflated")
