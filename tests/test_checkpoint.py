"""Checkpoints: what is read back is what was written, a resumed run is the run, and what is damaged is refused."""

from __future__ import annotations

import csv
import errno
import json
import os
import random
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import scanweld as sw
from rendered import MemorySequence, blind, write_tum_folder
from scanweld.arrays import Array, Bool, Float32, Float64
from scanweld.cli.app import run
from scanweld.cli.progress import FrameProgress
from scanweld.cli.slam import summary_text
from scanweld.config import from_mapping
from scanweld.datasets.synthetic.paths import built_in_path
from scanweld.errors import DatasetError, FileFormatError, InvalidInputError, OutputError, ScanweldError
from scanweld.geometry import se3
from scanweld.geometry.views import MapCorrection
from scanweld.io.leftovers import put_back
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser
from scanweld.mapping.storage.pages import MapConfig
from scanweld.runs.checkpoint import encoding, file, keeper
from scanweld.runs.checkpoint.file import CHUNK, MAGIC, CheckpointFile
from scanweld.runs.folder import CHECKPOINT
from scanweld.slam.system import Slam
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult, FrameState

WIDTH, HEIGHT = 96, 72


@lru_cache(maxsize=1)
def walk() -> tuple[tuple[sw.Frame, ...], np.ndarray]:
    """Half of a room, a covered lens, the other half, and back on seen ground; the frames and true rotations."""
    config = sw.RenderConfig(width=WIDTH, height=HEIGHT, noise="none")
    sequence = sw.SyntheticSequence(config, trajectory=built_in_path("sweep", 450, 30.0))
    steps = [*range(0, 100, 5), *[-1] * 4, *range(290, 425, 5)]
    frames = [replace(sequence.read(max(step, 0)), timestamp_s=k / 10) for k, step in enumerate(steps)]
    frames = [blind(frame) if step < 0 else frame for frame, step in zip(frames, steps, strict=True)]
    assert sequence.ground_truth is not None
    return tuple(frames), sequence.ground_truth.T_world_camera[np.maximum(steps, 0), :3, :3]


@lru_cache(maxsize=1)
def short() -> MemorySequence:
    """Sixteen frames, of which one is dark and one cannot be decoded."""
    sequence = sw.SyntheticSequence(sw.RenderConfig(width=WIDTH, height=HEIGHT, noise="kinect", frames=16))
    frames: list[sw.Frame | None] = [sequence.read(k) for k in range(16)]
    frames[6], frames[9] = blind(frames[6]), None
    return MemorySequence("short", sequence.camera, tuple(frames), sequence.timestamps_s, sequence.ground_truth)


class Bending(KeyframeLoopCloser):
    """Corrects the map after frame 10, as a loop that closes there does."""

    def process(self, pyramid: sw.SurfacePyramid, result: FrameResult) -> object:
        found = super().process(pyramid, result)
        if result.index != 10:
            return found
        count = len(self.database)
        moved = se3.exp(np.linspace(0, 1, count)[:, None] * np.array([0.004, 0, 0.003, 0, 0.002, 0]))
        self.database.move(moved @ np.stack([k.T_world_camera for k in self.database.keyframes]))
        self.num_closures += 1
        return MapCorrection(np.arange(count, dtype=np.int32), moved)


def stored(slam: Slam) -> bytes:
    return b"".join(encoding.encode(slam, Stateful))


def without_timings(slam: Slam) -> bytes:
    log = slam._results
    kept, log._stage_ms = log._stage_ms, np.zeros_like(log._stage_ms)
    try:
        return stored(slam)
    finally:
        log._stage_ms = kept


class Bytes:
    """A source in memory."""

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 0

    @property
    def left(self) -> int:
        return len(self.content) - self.at

    def read(self, size: int) -> bytes:
        if size > self.left:
            raise ValueError("too few")
        self.at += size
        return self.content[self.at - size : self.at]


class TestState:
    """The state of the system, by itself."""

    STOPS = (1, 6, 11, 20, 22, 27, 35, 44)
    """In a young map; tracking; after a closure; before, in and after darkness; where a submap has begun; within it."""

    def build(self) -> Slam:
        camera = walk()[0][0].camera
        return sw.build_slam(camera, loop_closer=Bending())

    def on(self, slam: Slam, start: int, stop: int) -> None:
        frames, rotations = walk()
        for k in range(start, stop):
            slam.process(frames[k], orientation=rotations[k])

    def test_goes_on_as_if_nothing_had_happened(self) -> None:
        """From each stop to the next, all of the state is the same to the byte, so it is from any stop to the end."""
        frames, _ = walk()
        stops = (*self.STOPS, len(frames))
        slam = self.build()
        self.on(slam, 0, stops[0])
        for start, stop in pairwise(stops):
            saved = stored(slam)
            again = self.build()
            source = Bytes(saved)
            encoding.restore(source, again)
            assert source.left == 0
            assert stored(again) == saved
            self.on(slam, start, stop)
            self.on(again, start, stop)
            assert without_timings(again) == without_timings(slam)
            slam = again if start % 2 else slam
        states = [result.state for result in slam.results]
        assert slam.loop_closer.num_closures == 1
        assert states[20:34] == [FrameState.LOST] * 14
        assert {result.submap for result in slam.results} == {0, 1} if slam.atlas.num_joins == 0 else {0}

    def test_every_attribute_is_stored_or_follows_from_how_the_object_was_made(self) -> None:
        """What is added to a class has to be named, or resumed runs would forget it."""
        slam = self.build()
        self.on(slam, 0, 12)
        seen: dict[type, set[str]] = {}

        def look(one: object) -> None:
            if isinstance(one, Stateful) and type(one) not in seen:
                names = set(vars(one))
                seen[type(one)] = names - set(one.STATE) - one.MADE
                assert not set(one.STATE) & one.MADE
                for name in one.STATE:
                    look(getattr(one, name))
            elif isinstance(one, dict):
                for item in one.values():
                    look(item)

        look(slam)
        assert len(seen) >= 14
        assert {kind.__name__: sorted(names) for kind, names in seen.items() if names} == {}

    @pytest.mark.parametrize("budget_mb", [0.0, 1.0])
    def test_pages_come_back_where_they_were(self, budget_mb: float, tmp_path: Path) -> None:
        slam = self.build()
        self.on(slam, 0, 6)
        config = sw.SlamConfig(map=MapConfig(memory_budget_mb=budget_mb, folder=str(tmp_path)))
        again = sw.build_slam(walk()[0][0].camera, config, loop_closer=Bending())
        encoding.restore(Bytes(stored(slam)), again)
        mine, theirs = again.map.pages, slam.map.pages
        np.testing.assert_array_equal(mine.live, theirs.live)
        for slot in mine.live.tolist():
            np.testing.assert_array_equal(mine.page(slot), theirs.page(slot))

    @pytest.mark.parametrize(
        ("name", "spoil"),
        [
            ("counts", lambda pages: pages.counts.__setitem__(pages.live[0], 257)),
            ("total", lambda pages: setattr(pages, "total", pages.total + 1)),
            ("tails", lambda pages: pages._tails.__setitem__(0, 1 << 20)),
            ("room", lambda pages: setattr(pages, "_room", 10**6)),
            ("calendar", lambda pages: pages._waiting.__setitem__(3, [np.array([-5], np.int32)])),
            ("free", lambda pages: pages.regions.left.__setitem__(0, 1)),
            ("used", lambda pages: pages.regions.used.__setitem__(0, 1)),
            ("chain", lambda pages: pages.regions.following.__setitem__(0, 0)),
            ("regions", lambda pages: pages.regions.heads.__setitem__(pages.regions.heads >= 0, -1)),
            ("boxes", lambda pages: setattr(pages, "boxes", pages.boxes[:-1])),
        ],
    )
    def test_pages_that_kernels_would_stumble_over_are_refused(self, name: str, spoil: Callable[..., None]) -> None:
        slam = self.build()
        self.on(slam, 0, 2)
        spoil(slam.map.pages)
        with pytest.raises((ValueError, IndexError)):
            encoding.restore(Bytes(stored(slam)), self.build())


class Colour(Enum):
    RED = "red"


@dataclass(frozen=True)
class Record:
    number: int
    share: float | None
    matrix: Float64
    colour: Colour
    words: dict[str, list[int]]


class Holder(Stateful):
    STATE: ClassVar = {"queue": deque[tuple[float, bool]], "records": list[Record], "mask": Bool | None, "any": Array}

    def __init__(self) -> None:
        self.queue: deque[tuple[float, bool]] = deque(maxlen=2)
        self.records: list[Record] = []
        self.mask: np.ndarray | None = None
        self.any: np.ndarray = np.zeros(0, np.uint16)


class TestEncoding:
    def filled(self) -> Holder:
        holder = Holder()
        holder.queue.extend([(-0.0, True), (5e-324, False)])
        matrix = np.arange(6.0).reshape(2, 3)
        holder.records = [
            Record(-(2**62), None, matrix, Colour.RED, {"ä": [1, 2], "": []}),
            Record(7, float("inf"), matrix.T, Colour.RED, {}),
        ]
        holder.mask = np.array([[True, False]])
        holder.any = np.arange(5, dtype=np.uint16)
        return holder

    def test_all_kinds_of_values_come_back(self) -> None:
        source, holder = Bytes(b"".join(encoding.encode(self.filled(), Stateful))), Holder()
        encoding.restore(source, holder)
        assert source.left == 0
        assert list(holder.queue) == [(0.0, True), (5e-324, False)]
        assert np.signbit(holder.queue[0][0])
        assert holder.queue.maxlen == 2
        first, second = holder.records
        assert (first.number, first.share, first.colour, first.words) == (
            -(2**62),
            None,
            Colour.RED,
            {"ä": [1, 2], "": []},
        )
        np.testing.assert_array_equal(first.matrix, [[0, 1, 2], [3, 4, 5]])
        assert second.share == float("inf")
        np.testing.assert_array_equal(second.matrix, [[0, 3], [1, 4], [2, 5]])
        assert second.matrix.flags.f_contiguous  # sums of products depend on the order in memory
        assert second.matrix.flags.writeable
        np.testing.assert_array_equal(holder.mask, [[True, False]])
        assert holder.any.tolist() == [0, 1, 2, 3, 4]
        assert holder.any.dtype == np.uint16

    def test_any_truncation_is_told(self) -> None:
        content = b"".join(encoding.encode(self.filled(), Stateful))
        for size in range(len(content)):
            with pytest.raises(ValueError, match=r"follow|few"):
                encoding.restore(Bytes(content[:size]), Holder())

    def test_any_changed_byte_is_told_or_gives_values_of_the_right_types(self) -> None:
        content = b"".join(encoding.encode(self.filled(), Stateful))
        refused = 0
        for at in range(len(content)):
            holder = Holder()
            try:
                encoding.restore(Bytes(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]), holder)
            except (ValueError, OverflowError):
                refused += 1
            else:
                assert all(isinstance(r, Record) and r.matrix.dtype == np.float64 for r in holder.records)
        assert refused > 20

    def test_sizes_are_checked_before_anything_is_allocated(self) -> None:
        head = struct.pack("<BcB2Q", 5, b"C", 2, 2**40, 2**20)
        with pytest.raises(ValueError, match="follow"):
            encoding.decode(Bytes(head), Float32)
        with pytest.raises(ValueError, match="follow"):
            encoding.decode(Bytes(struct.pack("<Q", 2**50) + bytes(100)), list[str])

    def test_an_array_of_another_type_is_refused(self) -> None:
        content = b"".join(encoding.encode(np.zeros(3, np.float32), Float32))
        with pytest.raises(ValueError, match="another type"):
            encoding.decode(Bytes(content), Float64)


class Stop:
    """Sends the signal of Ctrl-C when a frame is done."""

    def __init__(self, at: int) -> None:
        self.at = at

    def __call__(self, result: FrameResult) -> None:
        if result.index == self.at:
            os.kill(os.getpid(), signal.SIGINT)


def rows_of(folder: Path) -> list[dict[str, str]]:
    """What frames.csv holds, but for the times that frames took."""
    with (folder / "frames.csv").open(encoding="utf-8") as content:
        return [{k: v for k, v in row.items() if not k.startswith("ms_")} for row in csv.DictReader(content)]


def assert_same_run(folder: Path, other: Path) -> None:
    for name in ("trajectory.txt", "map.ply", "keyframes.csv", "config.toml"):
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name
    assert rows_of(folder) == rows_of(other)
    metrics = [json.loads((place / "metrics.json").read_text()) for place in (folder, other)]
    for name in ("num_points_input", "ate_rmse_m", "frames_tracked"):
        assert metrics[0][name] == metrics[1][name]


@pytest.fixture(scope="module", autouse=True)
def without_pictures() -> Iterator[None]:
    """Pictures and pages take most of the time of a short run."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("write_renders", "write_report", "plot_tracking", "plot_trajectory_error"):
            patch.setattr(f"scanweld.runs.output.{name}", lambda *_, **__: None)
        yield


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    sw.run_sequence(short(), out=out)
    assert not (out / CHECKPOINT).exists()
    return out


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that Ctrl-C ended after frame 4."""
    out = tmp_path_factory.mktemp("part") / "run"
    assert sw.run_sequence(short(), out=out, progress=Stop(4)).resumable
    return out


@pytest.fixture
def partial(interrupted: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    out = tmp_path / "run"
    out.mkdir()
    for name in (CHECKPOINT, "run.json"):
        (out / name).write_bytes((interrupted / name).read_bytes())
    return out


class TestInterrupted:
    @pytest.mark.parametrize("at", [0, 6, 9, 15])
    def test_resumed_run_is_the_uninterrupted_one(self, at: int, uninterrupted: Path, tmp_path: Path) -> None:
        """After the first frame, in darkness (lost), after a frame that cannot be decoded, after the last."""
        out = tmp_path / "run"
        summary = sw.run_sequence(short(), out=out, progress=Stop(at))
        assert summary.interrupted
        assert summary.resumable
        assert {CHECKPOINT, "map.ply", "trajectory.txt", "metrics.json"} <= {path.name for path in out.iterdir()}
        assert len(rows_of(out)) == at + 1  # what is there is a complete run of what was seen
        seen: list[int] = []
        summary = sw.run_sequence(short(), out=out, resume=True, progress=lambda result: seen.append(result.index))
        assert seen == list(range(at + 1, 16))
        assert not summary.interrupted
        assert not summary.resumable
        assert_same_run(out, uninterrupted)
        assert not (out / CHECKPOINT).exists()
        assert json.loads((out / "run.json").read_text())["resumed_at"] == [at + 1]
        assert [path.name for path in tmp_path.iterdir()] == ["run"]

    def test_twice_and_with_another_memory_budget(self, partial: Path, uninterrupted: Path) -> None:
        sw.run_sequence(short(), out=partial, resume=True, progress=Stop(10))
        budget = sw.SlamConfig(map=MapConfig(memory_budget_mb=1.0))
        sw.run_sequence(short(), budget, out=partial, resume=True)
        assert json.loads((partial / "run.json").read_text())["resumed_at"] == [5, 11]
        for name in ("trajectory.txt", "map.ply"):
            assert (partial / name).read_bytes() == (uninterrupted / name).read_bytes()

    def test_given_poses(self, tmp_path: Path) -> None:
        truth = short().ground_truth
        sw.run_sequence(short(), out=tmp_path / "whole", poses=truth)
        sw.run_sequence(short(), out=tmp_path / "run", poses=truth, progress=Stop(3))
        with pytest.raises(InvalidInputError, match="another sequence: given poses"):
            sw.run_sequence(short(), out=tmp_path / "run", resume=True)
        sw.run_sequence(short(), out=tmp_path / "run", poses=truth, resume=True)
        assert_same_run(tmp_path / "run", tmp_path / "whole")


class TestRefused:
    def resume(self, out: Path, sequence: object = None, config: sw.SlamConfig | None = None, **options: object) -> str:
        """Try it; return the message, which is one line, and see that nothing has changed."""
        before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
        with pytest.raises(ScanweldError) as caught:
            sw.run_sequence(sequence or short(), config, out=out, resume=True, **options)
        assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
        assert "\n" not in str(caught.value)
        return f"{type(caught.value).__name__}: {caught.value}"

    def test_another_sequence(self, partial: Path) -> None:
        camera = replace(short().camera, fx=90.0)
        frames = tuple(None if f is None else replace(f, camera=camera) for f in short().frames)
        message = self.resume(partial, replace(short(), camera=camera, frames=frames))
        assert "InvalidInputError" in message
        assert "another sequence: camera.fx" in message
        assert "number of frames 16, here 15" in self.resume(partial, short().part(0, 15))
        assert "timestamps" in self.resume(partial, replace(short(), timestamps_s=short().timestamps_s + 1))

    def test_other_images(self, partial: Path) -> None:
        first, last = short().frames[0], short().frames[4]
        assert first is not None
        assert last is not None
        other = replace(last, depth_m=last.depth_m + np.float32(0.01))
        assert "frame 4 shows something else" in self.resume(partial, short().with_frames({4: other}))
        assert "frame 0 of the run cannot be read any more" in self.resume(partial, short().with_frames({0: None}))

    def test_another_configuration(self, partial: Path) -> None:
        config = from_mapping(sw.SlamConfig, {"tracking": {"stable_fraction": 0.5}})
        message = self.resume(partial, config=config)
        assert "ConfigError" in message
        assert "tracking.stable_fraction = 1.0, here it is 0.5" in message

    def test_in_real_time(self, partial: Path) -> None:
        assert "real time cannot be continued" in self.resume(partial, realtime=True)

    def test_another_version(self, partial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        content = (partial / CHECKPOINT).read_bytes()
        (partial / CHECKPOINT).write_bytes(MAGIC + struct.pack("<I", 99) + content[len(MAGIC) + 4 :])
        assert "a checkpoint of format 99, this version of scanweld reads 1" in self.resume(partial)
        (partial / CHECKPOINT).write_bytes(content)
        monkeypatch.setattr("scanweld.runs.checkpoint.identity.version", lambda _: "99.0")
        assert "written by scanweld '0." in self.resume(partial)

    def test_a_class_that_has_changed(self, partial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(Slam, "STATE", {**Slam.STATE, "_new": int})
        assert "not the Slam of this version" in self.resume(partial)

    def test_any_damage(self, partial: Path) -> None:
        """Cut anywhere, or with any byte changed: told before anything is taken from it."""
        path = partial / CHECKPOINT
        content = path.read_bytes()
        choose = random.Random(0)
        sizes = [
            0,
            1,
            len(MAGIC),
            len(MAGIC) + 5,
            len(content) - 12,
            len(content) - 1,
            *choose.sample(range(len(content)), 20),
        ]
        damaged = [content[:size] for size in sizes] + [content + b"\0"]
        places = [*range(len(MAGIC) + 12), len(content) - 1, *choose.sample(range(len(content)), 60)]
        damaged += [content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :] for at in places]
        for spoilt in damaged:
            path.write_bytes(spoilt)
            with pytest.raises(FileFormatError) as caught:
                CheckpointFile(path)
            assert str(path) in str(caught.value)
        assert "FileFormatError" in self.resume(partial)

    def test_chunks_in_another_order(self, tmp_path: Path) -> None:
        path = tmp_path / CHECKPOINT
        noise = np.random.default_rng(0).bytes(CHUNK)
        file.write(path, {}, [noise, noise[::-1]])
        content = path.read_bytes()
        first = len(MAGIC) + 12 + 2
        length = 12 + struct.unpack_from("<I", content, first)[0]
        swapped = content[:first] + content[first + length : first + 2 * length] + content[first : first + length]
        path.write_bytes(swapped + content[first + 2 * length :])
        with pytest.raises(FileFormatError, match="damaged"):
            CheckpointFile(path)

    def test_a_chunk_that_claims_to_be_large(self, tmp_path: Path) -> None:
        """With the right checksums: what is claimed is compared with what is there."""
        head = MAGIC + struct.pack("<III", 1, 2, zlib.crc32(b"{}")) + b"{}"
        packed = zlib.compress(bytes(10))
        for size in (11, 9, 0, 10**6, 2**32 - 1):
            check = zlib.crc32(packed, zlib.crc32(b"{}"))
            end = struct.pack("<III", 0, 0, check)
            (tmp_path / CHECKPOINT).write_bytes(head + struct.pack("<III", len(packed), size, check) + packed + end)
            with pytest.raises((FileFormatError, ValueError)), CheckpointFile(tmp_path / CHECKPOINT) as content:
                content.read(max(1, content.left))

    def test_a_state_that_is_none(self, partial: Path) -> None:
        """A sound file, of this run by its header, with other bytes in it."""
        with CheckpointFile(partial / CHECKPOINT) as content:
            header, state = content.header, content.read(content.left)
        for bad in (state[:-1], state + b"\0", b"", state[:4] + b"\xff" * 2000, bytes(len(state))):
            file.write(partial / CHECKPOINT, header, [bad])
            assert "FileFormatError" in self.resume(partial)
        file.write(partial / CHECKPOINT, {**header, "shown": "nothing", "seconds": None}, [state])
        assert "holds no state of a run" in self.resume(partial)


class TestFolder:
    def test_neither_lost_nor_taken_for_another(self, partial: Path, tmp_path: Path) -> None:
        (partial / "run.json").unlink()  # as after a kill
        with pytest.raises(OutputError, match="--resume continues it, --force begins anew"):
            sw.run_sequence(short(), out=partial)
        assert len(sw.run_sequence(short().part(0, 4), out=partial, force=True).results) == 4
        assert not (partial / CHECKPOINT).exists()
        with pytest.raises(InvalidInputError, match="is finished, there is nothing to resume"):
            sw.run_sequence(short(), out=partial, resume=True)
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "letter.txt").write_text("dear")
        with pytest.raises(OutputError, match="not a run folder"):
            sw.run_sequence(short(), out=tmp_path / "other", resume=True)

    def test_interrupted_run_whose_checkpoint_is_gone(self, partial: Path) -> None:
        (partial / CHECKPOINT).unlink()
        with pytest.raises(InvalidInputError, match=r"was interrupted and has no checkpoint.*--force .* begins anew"):
            sw.run_sequence(short(), out=partial, resume=True)

    def test_without_a_checkpoint_the_run_begins(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        summary = sw.run_sequence(short().part(0, 3), out=tmp_path / "run", resume=True)
        assert len(summary.results) == 3
        assert "no checkpoint to resume from" in caplog.text

    def test_killed_between_the_two_renames(self, partial: Path) -> None:
        """The old folder had been moved aside, the new one was not yet in its place."""
        partial.rename(partial.with_name(".run.part-k3j4_x00.old"))
        partial.with_name(".run.part-k3j4_x00").mkdir()
        put_back(partial, [CHECKPOINT])
        assert (partial / CHECKPOINT).is_file()
        assert len(sw.run_sequence(short(), out=partial, resume=True).results) == 16
        assert [path.name for path in partial.parent.iterdir()] == ["run"]


class TestCommandLine:
    def test_progress_goes_on_from_the_first_new_frame(self) -> None:
        result = FrameResult(index=5, timestamp_s=1.0, state=FrameState.TRACKING, T_world_camera=np.eye(4))
        with FrameProgress(16, "slam") as progress:
            progress.update(result)
            progress.update(replace(result, index=6))
            assert progress._done == 7

    def test_which_run_has_to_be_said(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        recorded = write_tum_folder(tmp_path / "recorded", short().part(0, 2))
        assert run(["slam", str(recorded), "--resume"]) == 1
        assert "--out RUN has to say which run" in capsys.readouterr().err

    def test_summary_says_how_to_go_on(self, tmp_path: Path) -> None:
        summary = sw.run_sequence(short(), out=tmp_path / "run", progress=Stop(3))
        assert "--resume goes on from here" in summary_text(summary)
        assert "--resume" not in summary_text(replace(summary, resumable=False))


class TestWriting:
    def test_half_written_ones_are_removed_and_the_last_stays(self, partial: Path) -> None:
        stray = partial / f".{CHECKPOINT}.part-a1b2c3d4"
        stray.write_bytes(b"half")
        sw.run_sequence(short(), out=partial, resume=True, progress=Stop(7))
        assert not stray.exists()

    def test_full_disk(
        self, partial: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        """The last checkpoint stays good, the run warns once, goes on, and is complete."""
        before, tried = (partial / CHECKPOINT).read_bytes(), []

        def full(_: int) -> None:
            tried.append((partial / CHECKPOINT).read_bytes() == before)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr("scanweld.io.atomic.os.fsync", full)
        sw.run_sequence(short(), out=partial, resume=True, checkpoint_every_s=1e-9)
        assert tried == [True] * 11
        assert caplog.text.count("No space left on device") == 1
        assert_same_run(partial, uninterrupted)
        assert any("no checkpoint" in line for line in json.loads((partial / "run.json").read_text())["warnings"])

    @pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
    def test_folder_that_cannot_be_written_in_the_end(
        self, code: int, partial: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The disk is full, or was mounted read-only, once the run is done: it goes on when there is room again."""

        def fail(*_: object) -> None:
            raise OSError(code, os.strerror(code))

        with monkeypatch.context() as patch:
            patch.setattr("scanweld.runs.output.write_frames", fail)
            with pytest.raises(OutputError) as caught:
                sw.run_sequence(short(), out=partial, resume=True, checkpoint_every_s=1e-9)
        assert os.strerror(code) in str(caught.value)
        assert "the last checkpoint is whole, and --resume goes on from there" in str(caught.value)
        assert [path.name for path in partial.parent.iterdir()] == ["run"]
        sw.run_sequence(short(), out=partial, resume=True)
        assert json.loads((partial / "run.json").read_text())["resumed_at"] == [5, 16]
        assert_same_run(partial, uninterrupted)

    def test_vanished_input(self, tmp_path: Path) -> None:
        """The disk with the recording is unplugged after frame 7: that is no frame that cannot be decoded."""
        recorded = write_tum_folder(tmp_path / "recorded", short().with_frames({9: short().frames[8]}))
        sw.run_sequence(sw.open_sequence(recorded), out=tmp_path / "whole")
        gone, out = tmp_path / "gone", tmp_path / "run"

        def unplug(result: FrameResult) -> None:
            if result.index == 7:
                recorded.rename(gone)

        with pytest.raises(DatasetError, match=r"is the recording still there\?; the last checkpoint is whole"):
            sw.run_sequence(sw.open_sequence(recorded), out=out, progress=unplug)
        assert [path.name for path in out.iterdir()] == [CHECKPOINT]
        gone.rename(recorded)
        summary = sw.run_sequence(sw.open_sequence(recorded), out=out, resume=True)
        assert summary.metrics["frames_unreadable"] == 0
        assert_same_run(out, tmp_path / "whole")

    def test_as_often_as_it_costs_little(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """With one that takes 3 s, the next is after 150 s: 2 %."""
        now = [0.0]
        monkeypatch.setattr(keeper.time, "perf_counter", lambda: now[0])
        monkeypatch.setattr(keeper.file, "write", lambda *_: now.__setitem__(0, now[0] + 3.0))
        kept = keeper.Checkpoints(tmp_path / "run", short(), sw.SlamConfig())
        frame, written = short().frames[0], []
        while now[0] < 500:
            before = now[0]
            assert kept.keep(Holder(), 0, frame) == ""
            if now[0] > before:
                written.append(before)
            now[0] += 1.0
        assert written == [60.0, 213.0, 366.0]

    def test_wrong_interval(self, tmp_path: Path) -> None:
        with pytest.raises(InvalidInputError, match="checkpoint_every_s"):
            sw.run_sequence(short(), out=tmp_path / "run", checkpoint_every_s=-1.0)


@pytest.fixture
def process() -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    running: list[subprocess.Popen[bytes]] = []

    def start(*arguments: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "scanweld", "slam", *map(str, arguments)]
        running.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return running[-1]

    yield start
    for one in running:
        one.kill()
        one.wait()


DYING = """
import os, sys
from pathlib import Path
import scanweld as sw
from scanweld.io import atomic
from scanweld.runs import output
recorded, out, moment = sys.argv[1:]
calls = []

def dying(call):
    def counted(*arguments, **options):
        calls.append(call)
        if len(calls) == 3:
            os._exit(9)
        return call(*arguments, **options)
    return counted

if moment == "half written":
    atomic.os.fsync = dying(os.fsync)
elif moment == "not renamed":
    Path.replace = dying(Path.replace)
else:
    calls += [None, None]
    output.write_frames = dying(output.write_frames)
sw.run_sequence(sw.open_sequence(recorded), out=Path(out), checkpoint_every_s=1e-9)
"""


@pytest.mark.parametrize(("moment", "kept"), [("half written", 1), ("not renamed", 2), ("in the run folder", 6)])
def test_killed_while_writing(moment: str, kept: int, tmp_path: Path) -> None:
    """A process ends while it writes the second checkpoint, before the third has its name, and in the run folder.

    A checkpoint is brought to the disk by two calls, for the file and for its name: the third call is for the second.
    """
    recorded = write_tum_folder(tmp_path / "recorded", short().part(0, 6))
    sw.run_sequence(sw.open_sequence(recorded), out=tmp_path / "whole")
    out = tmp_path / "run"
    command = [sys.executable, "-c", DYING, str(recorded), str(out), moment]
    assert subprocess.run(command, check=False).returncode == 9
    half = [*out.glob(".*.part-*"), *tmp_path.glob(".run.part-*")]
    assert len(half) == 1
    sw.run_sequence(sw.open_sequence(recorded), out=out, resume=True)
    assert json.loads((out / "run.json").read_text())["resumed_at"] == [kept]
    assert_same_run(out, tmp_path / "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"recorded", "run", "whole"}
    assert not any(path.name.startswith(".") for path in out.iterdir())


def test_killed_at_random_moments(process: Callable[..., subprocess.Popen[bytes]], tmp_path: Path) -> None:
    """SIGKILL, three times, while a checkpoint is written after every frame; resumed, it is the uninterrupted run."""
    sequence = short().with_frames({9: short().frames[8]})
    recorded = write_tum_folder(tmp_path / "recorded", sequence)
    sw.run_sequence(sw.open_sequence(recorded), out=tmp_path / "whole")
    out, choose = tmp_path / "run", random.Random(7)
    options = (recorded, "--out", out, "--resume", "--checkpoint-every", 1e-9)
    for _ in range(3):
        running = process(*options)
        waited = time.monotonic() + 60
        before = (out / CHECKPOINT).stat().st_ino if (out / CHECKPOINT).exists() else None
        while running.poll() is None and time.monotonic() < waited:
            if (out / CHECKPOINT).exists() and (out / CHECKPOINT).stat().st_ino != before:
                break
            time.sleep(0.002)
        time.sleep(choose.uniform(0, 0.15))
        running.kill()
        running.wait()
        put_back(out, [CHECKPOINT])
        if (out / CHECKPOINT).exists():
            CheckpointFile(out / CHECKPOINT).__exit__()  # whole, whatever was being written
    if not (out / "run.json").exists():
        assert process(*options).wait(timeout=60) == 0
    assert_same_run(out, tmp_path / "whole")
    assert not (out / CHECKPOINT).exists()
