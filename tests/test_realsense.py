"""Recordings of RealSense cameras, written by the SDK itself, and a camera that is played by it in real time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed: pip install 'scanweld[realsense]'")

import realsense_recording as made
import scanweld as sw
from scanweld.datasets.base import LiveSequence, RgbdSequence
from scanweld.datasets.realsense import RealSenseCamera, is_realsense
from scanweld.datasets.stream import stream
from scanweld.errors import DatasetError, InvalidInputError, UnreadableFrameError

RECORDED = Path(__file__).with_name("recorded") / "realsense.bag"
"""Written by SDK 2.56.5: later ones write no .bag any more."""


@pytest.fixture(scope="module", params=["recorded.bag", "made"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of an earlier SDK, and one by the SDK that is installed."""
    return RECORDED if request.param == "recorded.bag" else made.record(tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def sequence(recording: Path) -> Iterator[RgbdSequence]:
    opened = sw.open_sequence(recording)
    yield opened
    opened.frame_source.close()  # type: ignore[attr-defined]


def test_times_camera_and_unit(sequence: RgbdSequence) -> None:
    """As they were written: six frames from 5 s on, 30 a second, millimetres, the intrinsics of the depth stream."""
    expected_s = (made.FIRST_MS + made.STEP_MS * np.arange(made.COUNT)) / 1000
    np.testing.assert_allclose(sequence.timestamps_s, expected_s, atol=1e-9)
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (made.FX_DEPTH, made.FX_DEPTH, made.CX, made.CY)
    assert camera.shape == (made.HEIGHT, made.WIDTH)
    assert sequence.depth_scale == 1000
    assert isinstance(sequence, RgbdSequence)
    assert not isinstance(sequence, LiveSequence)


@pytest.mark.parametrize("order", [range(made.COUNT), [4, 1, 1, 5, 0]], ids=["forward", "any order"])
def test_depth_is_what_was_written(sequence: RgbdSequence, order: list[int]) -> None:
    for k in order:
        frame = sequence.read(k)
        assert frame.timestamp_s == sequence.timestamps_s[k]
        np.testing.assert_allclose(frame.depth_m, made.depth_of(k) / 1000, rtol=1e-6)


def test_colour_is_seen_from_the_depth_camera(sequence: RgbdSequence) -> None:
    """The border between red and blue is where extrinsics and both intrinsics put it.

    A point (x, z) of the depth camera is at x' = x cos a + z sin a + s of the colour camera, and on the border where
    x' = 0: x / z = -tan a - s / (z cos a). With a = 2 degrees, s = 15 mm, z = 1.5 m that is -0.04493, and with
    fx = 120 and cx = 79.5 the border is at column 74.1: 74 is the last red one.
    """
    color = sequence.read(0).color
    assert color is not None
    row = color[60].astype(int)
    assert np.abs(row[10:73] - made.RED).max() <= 6  # the SDK may keep colour as JPEG
    assert np.abs(row[77:140] - made.BLUE).max() <= 6
    red = np.flatnonzero(row[:, 0] > (made.RED[0] + made.BLUE[0]) / 2)
    assert red[-1] == 74


def test_is_told_from_other_bags(recording: Path, tmp_path: Path) -> None:
    assert is_realsense(recording)
    other = tmp_path / "other.bag"
    other.write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    assert not is_realsense(other)
    assert not is_realsense(tmp_path)


@pytest.mark.parametrize("kept", [5000, 20_000])
def test_truncated(tmp_path: Path, kept: int) -> None:
    """Cut off, it has no index: one line that names the file."""
    cut = tmp_path / "cut.bag"
    cut.write_bytes(RECORDED.read_bytes()[:kept])
    with pytest.raises(DatasetError, match=r"cut\.bag: ") as caught:
        sw.open_sequence(cut)
    assert "\n" not in str(caught.value)


def test_no_recording(tmp_path: Path) -> None:
    fake = tmp_path / "fake.bag"
    fake.write_bytes(b"/device_0/sensor_0" * 400)
    with pytest.raises(DatasetError, match=r"fake\.bag: the RealSense SDK cannot open it"):
        sw.open_sequence(fake, format="realsense")


def test_no_camera() -> None:
    """Nothing is connected under this serial number, on any machine."""
    with pytest.raises(DatasetError, match="realsense:no-such-serial: no such RealSense camera is connected"):
        sw.open_sequence("realsense:no-such-serial")


def test_live_camera_takes_no_part_or_size() -> None:
    with pytest.raises(InvalidInputError, match="a live camera has the size that it is set to"):
        sw.open_sequence("realsense:", scale=0.5)
    with pytest.raises(InvalidInputError, match=":N takes the first N frames"):
        sw.open_sequence("realsense:", frames="10:20")


def test_a_camera_that_is_played() -> None:
    """In real time frames may be dropped, but none comes twice or out of order, and each is what was recorded."""
    camera = RealSenseCamera(file=RECORDED)
    assert isinstance(camera, LiveSequence)
    assert len(camera) == 0
    records = list(stream(camera, prepare=lambda frame: frame.timestamp_s))
    assert 1 <= len(records) == len(camera) <= made.COUNT
    times = [record.timestamp_s for record in records]
    assert times == sorted(set(times)) == camera.timestamps_s.tolist() == [record.prepared for record in records]
    for record in records:
        k = round((record.timestamp_s * 1000 - made.FIRST_MS) / made.STEP_MS)
        assert record.frame is not None
        np.testing.assert_allclose(record.frame.depth_m, made.depth_of(k) / 1000, rtol=1e-6)
    with pytest.raises(UnreadableFrameError, match="was not kept"):
        camera.read(0)


def test_a_camera_ends_after_so_many_frames() -> None:
    camera = RealSenseCamera(file=RECORDED, max_frames=1)
    assert len(list(stream(camera))) == 1
