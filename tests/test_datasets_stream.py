"""Reading ahead: order, bounds, damaged frames, and an end that leaves no thread behind."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA as RENDERED_CAMERA
from rendered import MemorySequence, blind, rendered
from scanweld.arrays import Float64
from scanweld.datasets.base import readable_frames
from scanweld.datasets.open import open_sequence
from scanweld.datasets.stream import stream
from scanweld.errors import DatasetError, InvalidInputError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from written_sequences import write_redwood

CAMERA = PinholeCamera(10, 10, 3.5, 2.5, 8, 6)


class Recorded:
    """A sequence in memory that notes which frames were read, and fails where it is told to."""

    name = "recorded"
    camera = CAMERA
    depth_scale = 1.0
    ground_truth = None

    def __init__(self, count: int, unreadable: tuple[int, ...] = (), broken: int = -1, seconds: float = 0) -> None:
        self.count, self.unreadable, self.broken, self.seconds = count, unreadable, broken, seconds
        self.read_indices: list[int] = []

    @property
    def timestamps_s(self) -> Float64:
        return np.arange(self.count) / 10

    def __len__(self) -> int:
        return self.count

    def read(self, index: int) -> Frame:
        self.read_indices.append(index)
        time.sleep(self.seconds * (1 + index % 3))
        if index in self.unreadable:
            raise UnreadableFrameError(f"frame {index} is damaged")
        if index == self.broken:
            raise RuntimeError("a bug in the decoder")
        return Frame(index / 10, np.full((6, 8), index, np.float32), None, CAMERA)

    def __iter__(self) -> Iterator[Frame]:
        return readable_frames(self)


def decode_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("scanweld-decode")]


@pytest.mark.parametrize("num_threads", [1, 3])
@pytest.mark.parametrize("lookahead", [1, 4, 100])
def test_records_come_in_order(lookahead: int, num_threads: int) -> None:
    records = list(stream(Recorded(12, seconds=0.001), lookahead, num_threads=num_threads))
    assert [record.index for record in records] == list(range(12))
    assert [record.timestamp_s for record in records] == [i / 10 for i in range(12)]
    assert all(record.frame is not None and record.frame.depth_m[0, 0] == record.index for record in records)
    assert not decode_threads()


def test_each_frame_is_read_once() -> None:
    sequence = Recorded(20)
    list(stream(sequence, 3))
    assert sequence.read_indices == list(range(20))


def test_unreadable_frames_are_delivered_and_the_run_goes_on() -> None:
    records = list(stream(Recorded(5, unreadable=(0, 3))))
    assert [record.frame is None for record in records] == [True, False, False, True, False]
    assert [record.error for record in records] == ["frame 0 is damaged", "", "", "frame 3 is damaged", ""]
    assert records[3].timestamp_s == 0.3


def test_decoding_runs_ahead_but_not_further_than_asked() -> None:
    sequence = Recorded(20)
    records = stream(sequence, 4)
    next(records)
    deadline = time.monotonic() + 5
    while len(sequence.read_indices) < 5 and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(0.02)
    assert sequence.read_indices == [0, 1, 2, 3, 4], "one delivered, four ahead"
    records.close()  # type: ignore[attr-defined]


def test_closing_ends_the_thread() -> None:
    sequence = Recorded(1000, seconds=0.001)
    records = stream(sequence)
    next(records)
    assert decode_threads()
    records.close()  # type: ignore[attr-defined]
    assert not decode_threads()
    assert len(sequence.read_indices) <= 6


def test_an_exception_of_the_consumer_ends_the_thread() -> None:
    def consume() -> None:
        for _ in stream(Recorded(1000)):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        consume()
    gc.collect()  # the traceback is gone, and with it the last reference to the generator
    assert not decode_threads()


def test_a_bug_in_the_decoder_reaches_the_consumer_at_its_frame() -> None:
    records = stream(Recorded(10, broken=2))
    assert [next(records).index, next(records).index] == [0, 1]
    with pytest.raises(RuntimeError, match="a bug in the decoder"):
        next(records)
    assert not decode_threads()


def test_frames_are_prepared_ahead_on_the_decoding_thread() -> None:
    names: list[str] = []

    def prepare(frame: Frame) -> float:
        names.append(threading.current_thread().name)
        return frame.timestamp_s * 2

    records = list(stream(Recorded(6, unreadable=(2,), seconds=0.001), 3, num_threads=2, prepare=prepare))
    assert [record.prepared for record in records] == [0, 0.2, None, 0.6, 0.8, 1.0]
    assert len(names) == 5
    assert all(name.startswith("scanweld-decode") for name in names)


def test_no_more_is_prepared_than_asked() -> None:
    """What is prepared waits in memory: the bound holds for it, too."""
    prepared: list[float] = []
    records = stream(Recorded(20), 2, prepare=lambda frame: prepared.append(frame.timestamp_s))
    next(records)
    deadline = time.monotonic() + 5
    while len(prepared) < 3 and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(0.02)
    assert prepared == [0, 0.1, 0.2], "one delivered, two ahead"
    records.close()


def test_an_error_while_preparing_reaches_the_consumer_at_its_frame() -> None:
    def prepare(frame: Frame) -> None:
        if frame.timestamp_s == 0.2:
            raise InvalidInputError("not to be prepared")

    records = stream(Recorded(10), prepare=prepare)
    assert [next(records).index, next(records).index] == [0, 1]
    with pytest.raises(InvalidInputError, match="not to be prepared"):
        next(records)
    assert not decode_threads()


def test_no_readable_frame_at_all() -> None:
    records = stream(Recorded(3, unreadable=(0, 1, 2)))
    assert [record.frame for record in (next(records), next(records), next(records))] == [None, None, None]
    with pytest.raises(DatasetError, match="none of the 3 frames can be decoded; the first: frame 0 is damaged"):
        next(records)
    with pytest.raises(DatasetError, match="none of the 3"):
        list(Recorded(3, unreadable=(0, 1, 2)))


def test_iteration_leaves_unreadable_frames_out(caplog: pytest.LogCaptureFixture) -> None:
    frames = list(Recorded(4, unreadable=(1,)))
    assert [frame.timestamp_s for frame in frames] == [0, 0.2, 0.3]
    assert "frame 1 is left out: frame 1 is damaged" in caplog.text


def test_arguments_are_checked_at_once() -> None:
    for lookahead, num_threads in ((0, 1), (1, 0)):
        with pytest.raises(InvalidInputError, match="at least one"):
            stream(Recorded(3), lookahead, num_threads=num_threads)


def test_files_with_a_truncated_image(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    damaged = tmp_path / "color/00002.jpg"
    damaged.write_bytes(damaged.read_bytes()[:-10])
    records = list(stream(open_sequence(tmp_path)))
    assert [record.frame is None for record in records] == [False, False, True, False]
    assert "00002.jpg: truncated JPEG" in records[2].error


class TestSurfacesMadeAhead:
    """Slam.prepare on the decoding thread: when a frame is prepared changes nothing."""

    def sequence(self) -> MemorySequence:
        part = rendered(noise="kinect").part(0, 12)
        return part.with_frames({4: None, 7: blind(part.read(7))})

    def run(self, lookahead: int, num_threads: int, prepared: bool) -> tuple[bytes, list[str]]:
        slam = sw.build_slam(RENDERED_CAMERA)
        records = stream(
            self.sequence(), lookahead, num_threads=num_threads, prepare=slam.prepare if prepared else None
        )
        for record in records:
            assert (record.prepared is not None) == (prepared and record.frame is not None)
            if record.frame is None:
                slam.skip(record.timestamp_s, record.error)
            else:
                slam.process(record.frame, pyramid=record.prepared)
        poses = b"".join(result.T_world_camera.tobytes() for result in slam.results)
        surfels = b"".join(np.array(getattr(slam.map, name)).tobytes() for name in ("positions_m", "normals", "colors"))
        return poses + surfels, [result.state.name for result in slam.results]

    def test_same_bytes(self) -> None:
        expected, states = self.run(1, 1, prepared=False)
        assert states.count("TRACKING") >= 8
        for lookahead, num_threads in ((1, 1), (4, 3)):
            assert self.run(lookahead, num_threads, prepared=True) == (expected, states)

    def test_surfaces_of_another_frame_are_refused(self) -> None:
        one, other = rendered(noise="kinect").frames[:2]
        slam = sw.build_slam(RENDERED_CAMERA)
        with pytest.raises(InvalidInputError, match=r"that of the frame at 0\.03"):
            slam.process(one, pyramid=slam.prepare(other))
        assert not slam.results
