"""Recordings that are played at their own speed: which frames are dropped, and that every one of them is told."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import MemorySequence, rendered, write_tum_folder
from scanweld.cli import app as command_line
from scanweld.cli.progress import FrameProgress
from scanweld.cli.slam import summary_text
from scanweld.datasets.playback import play
from scanweld.datasets.stream import FrameRecord
from scanweld.errors import DatasetError, InvalidInputError
from scanweld.report.run_files import read_run_files
from scanweld.report.verdict import judge
from scanweld.trajectory import FrameState

PERIOD_S = 1 / 30
"""Of the rendered sequences."""


class FakeClock:
    """Time passes when somebody sleeps, or says that work took so long."""

    def __init__(self) -> None:
        self.time_s = 1000.0
        self.slept_s = 0.0

    def now(self) -> float:
        return self.time_s

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.slept_s += seconds
        self.time_s += seconds

    def work(self, frames: float) -> None:
        self.time_s += frames * PERIOD_S


def played(
    sequence: MemorySequence, clock: FakeClock, work: dict[int, float], usual: float = 0.0
) -> list[tuple[FrameRecord, float]]:
    """Records, and when each came in periods after the first; frame k takes work[k] periods, others the usual time."""
    seen = []
    for record in play(sequence, clock=clock):
        seen.append((record, (clock.time_s - 1000.0) / PERIOD_S))
        if not record.dropped:
            clock.work(work.get(record.index, usual))
    return seen


def taken(records: list[tuple[FrameRecord, float]]) -> list[int]:
    return [record.index for record, _ in records if not record.dropped]


class TestPlay:
    def test_quick_consumer_gets_every_frame_at_its_time(self) -> None:
        sequence, clock = rendered().part(0, 6), FakeClock()
        seen = played(sequence, clock, {}, usual=0.4)
        assert taken(seen) == [0, 1, 2, 3, 4, 5]
        np.testing.assert_allclose([at for _, at in seen], range(6), atol=1e-4)  # stamps are in microseconds
        assert clock.slept_s == pytest.approx(5 * 0.6 * PERIOD_S, rel=1e-3)
        assert all(record.frame is sequence.frames[record.index] for record, _ in seen)

    def test_slow_consumer_drops_what_came_meanwhile(self) -> None:
        """Each frame takes 1.6 periods. 0 is taken at 0. 1 waits from 1 on and is taken at 1.6; 2 comes at 2. 2 is
        taken at 3.2, when 3 has come: dropped. 4 waits and is taken at 4.8, 5 at 6.4, when 6 has come: dropped; 7 at
        8.0."""
        seen = played(rendered().part(0, 8), FakeClock(), {}, usual=1.6)
        assert taken(seen) == [0, 1, 2, 4, 5, 7]
        assert [record.index for record, _ in seen] == list(range(8))

    def test_a_long_pause_is_not_caught_up_with(self) -> None:
        """Frame 1 takes 5.5 periods, until 6.5. 2 has waited since; 3 to 6 have come and are dropped, 7 is in time."""
        seen = played(rendered().part(0, 10), FakeClock(), {1: 5.5}, usual=0.1)
        assert taken(seen) == [0, 1, 2, 7, 8, 9]
        assert {record.index: round(at, 3) for record, at in seen if not record.dropped}[7] == 7.0

    def test_dropped_frames_say_so_and_were_not_read(self) -> None:
        sequence = rendered().part(0, 6).with_frames({3: None})  # whoever reads it finds it damaged
        dropped = [record for record, _ in played(sequence, FakeClock(), {1: 3.5}) if record.dropped]
        assert [record.index for record in dropped] == [3, 4]
        assert all(record.frame is None and "dropped to keep pace" in record.error for record in dropped)
        assert [record.timestamp_s for record in dropped] == sequence.timestamps_s[3:5].tolist()

    def test_the_end_may_be_dropped(self) -> None:
        seen = played(rendered().part(0, 5), FakeClock(), {0: 100.0})
        assert taken(seen) == [0, 1]
        assert [record.index for record, _ in seen] == [0, 1, 2, 3, 4]

    def test_unreadable_frames_are_unreadable_not_dropped(self) -> None:
        seen = played(rendered().part(0, 4).with_frames({2: None}), FakeClock(), {})
        assert [(record.dropped, record.error) for record, _ in seen][2] == (False, "frame 2 is damaged")

    def test_nothing_readable(self) -> None:
        sequence = rendered().part(0, 2).with_frames({0: None, 1: None})
        with pytest.raises(DatasetError, match="none of the 2 frames"):
            played(sequence, FakeClock(), {})

    def test_what_is_prepared_comes_along(self) -> None:
        sequence = rendered().part(0, 3)
        prepared = [record.prepared for record in play(sequence, prepare=lambda f: f.timestamp_s, clock=FakeClock())]
        assert prepared == sequence.timestamps_s[:3].tolist()


def run(clock: FakeClock, work: dict[int, float], out: Path | None = None) -> sw.RunSummary:
    def progress(result: sw.FrameResult) -> None:
        if result.state is not FrameState.DROPPED:
            clock.work(work.get(result.index, 0.0))

    return sw.run_sequence(rendered().part(0, 14), out=out, realtime=True, clock=clock, progress=progress)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> sw.RunSummary:
    """A run in which frame 3 takes 4.5 periods, until 7.5: 5, 6 and 7 come while 4 waits."""
    return run(FakeClock(), {3: 4.5}, tmp_path_factory.mktemp("realtime") / "run")


class TestRun:
    def test_dropped_frames_are_told_everywhere(self, told: sw.RunSummary) -> None:
        states = ["dropped" if k in (5, 6, 7) else "tracking" for k in range(14)]
        assert [result.state.value for result in told.results] == states
        assert told.metrics["frames_dropped"] == 3
        assert told.trustworthy
        assert told.folder is not None
        with (told.folder / "frames.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["status"] for row in rows] == states
        assert "keep pace" in rows[5]["note"]
        assert json.loads((told.folder / "run.json").read_text())["realtime"] is True
        assert json.loads((told.folder / "metrics.json").read_text())["frames_dropped"] == 3
        files = read_run_files(told.folder)
        assert judge(files.frames, files.metrics, files.run).reasons[0].startswith("3 frames of 14 were dropped")
        assert "3 frames of 14 were dropped" in (told.folder / "report.html").read_text()
        assert "11 of 14 tracked, 3 dropped to keep pace" in summary_text(told)

    def test_poses_of_dropped_frames_are_interpolated(self, told: sw.RunSummary) -> None:
        T = sw.read_trajectory(told.folder / "trajectory.txt").T_world_camera
        middle = sw.se3.interpolate(T[4], T[8], np.array([0.25, 0.5, 0.75]))
        np.testing.assert_allclose(T[5:8], middle, atol=1e-6)
        assert told.metrics["ate_max_m"] < 0.01

    def test_frames_that_were_taken_are_answered_as_if_the_others_were_not_there(self, told: sw.RunSummary) -> None:
        """Frames 0 to 4 and 8 to 13 alone give the same poses, byte for byte."""
        sequence, kept = rendered(), [*range(5), *range(8, 14)]
        slam = sw.build_slam(sequence.camera)
        for k in kept:
            slam.process(sequence.frames[k])
        for k, result in zip(kept, slam.results, strict=True):
            assert told.results[k].T_world_camera.tobytes() == result.T_world_camera.tobytes()

    def test_dropping_is_no_loss(self) -> None:
        """Eight frames are dropped at once: the next is tracked from the motion, and not looked for as a lost one."""
        summary = run(FakeClock(), {2: 9.5})
        states = [result.state.value for result in summary.results]
        assert states == ["tracking"] * 4 + ["dropped"] * 8 + ["tracking"] * 2

    def test_calibration_is_not_real_time(self) -> None:
        with pytest.raises(InvalidInputError, match="not real time"):
            sw.run_sequence(rendered().part(0, 3), realtime=True, calibrate=True)

    def test_by_default_every_frame_is_taken_however_long_it_takes(self) -> None:
        summary = sw.run_sequence(rendered().part(0, 4), clock=FakeClock())
        assert summary.metrics["frames_tracked"] == 4
        assert summary.metrics["frames_dropped"] == 0


def test_progress_counts_dropped_frames(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scanweld.cli.progress.QUIET_INTERVAL_S", -1.0)
    with FrameProgress(3, "slam") as progress:
        for k, state in enumerate((FrameState.TRACKING, FrameState.DROPPED, FrameState.TRACKING)):
            progress.update(sw.FrameResult(index=k, timestamp_s=float(k), state=state, T_world_camera=np.eye(4)))
    lines = capsys.readouterr().err.splitlines()
    assert "dropped" not in lines[0]
    assert lines[2].endswith("1 dropped")


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the clock of the machine: how many frames are dropped is not known, only that all are told."""
    folder = write_tum_folder(tmp_path / "room", rendered().part(0, 5))
    code = command_line.run(["slam", str(folder), "--realtime", "--json", "--out", str(tmp_path / "run")])
    metrics = json.loads(capsys.readouterr().out)
    assert code == 0
    assert (metrics["frames"], metrics["frames_tracked"] + metrics["frames_dropped"]) == (5, 5)
    assert json.loads((tmp_path / "run/run.json").read_text())["realtime"] is True
