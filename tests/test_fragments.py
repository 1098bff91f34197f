"""A recording in fragments: cut, made, tied together, and put together as one run."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import MemorySequence, blind, rendered, write_tum_folder
from scanweld.cli import app as command_line
from scanweld.cluster import executors
from scanweld.geometry import se3
from scanweld.loop_closure.linking import common_motion
from scanweld.loop_closure.search import Edge, tracked_edge
from scanweld.runs.fragments import making
from scanweld.runs.fragments.assembling import assemble
from scanweld.runs.fragments.exchange import ENDING
from scanweld.runs.fragments.making import Fragment
from scanweld.runs.fragments.outcome import joined_results
from scanweld.runs.fragments.run import run_fragments
from scanweld.runs.input import RunInput
from scanweld.runs.repeat import repeat_run
from scanweld.slam.motion import POSED
from scanweld.slam.parts import FragmentConfig, Part, parts_of
from scanweld.trajectory import FrameResult, FrameState

COUNT, OVERLAP = 96, 12
CONFIG = sw.SlamConfig(fragments=FragmentConfig(overlap=OVERLAP))


def walk() -> MemorySequence:
    """Once around the room, with Kinect noise."""
    return rendered("room", "kinect", COUNT, "sweep")


@lru_cache
def there_and_back() -> MemorySequence:
    """A half of that way and back again: the last fragment comes to the places of the first one."""
    sequence = walk()
    steps = [*range(COUNT // 2), *reversed(range(COUNT // 2))]
    times = np.arange(COUNT) / 30
    frames = tuple(replace(sequence.frames[k], timestamp_s=float(t)) for k, t in zip(steps, times, strict=True))
    truth = sw.Trajectory(times, sequence.ground_truth.T_world_camera[steps])
    return replace(sequence, frames=frames, timestamps_s=times, ground_truth=truth)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> sw.RunSummary:
    """There and back in three fragments, one task after the other."""
    return run_fragments(there_and_back, 3, CONFIG, out=tmp_path_factory.mktemp("fragments") / "run")


def shifted(x_m: float) -> np.ndarray:
    return se3.exp([x_m, 0, 0, 0, 0, 0])


class TestParts:
    def test_neighbours_share_frames_and_nobody_else(self) -> None:
        """100 frames in 3 parts that share 10: each has (100 - 10) / 3 = 30 before it shares the next 10."""
        assert parts_of(100, 3, 10) == [Part(0, 0, 40, 0), Part(1, 30, 70, 10), Part(2, 60, 100, 10)]

    def test_one_part_is_all(self) -> None:
        assert parts_of(7, 1, 60) == [Part(0, 0, 7, 0)]

    def test_every_frame_is_in_a_part(self) -> None:
        parts = parts_of(1000, 7, 21)
        assert {frame for part in parts for frame in range(part.start, part.stop)} == set(range(1000))
        assert [before.stop - after.start for before, after in pairwise(parts)] == [21] * 6

    def test_too_many(self) -> None:
        """(100 - 10) / (2 * 10) = 4 with as many frames of their own as they share with each neighbour."""
        with pytest.raises(sw.InvalidInputError, match="make at most 4 fragments"):
            parts_of(100, 5, 10)
        with pytest.raises(sw.InvalidInputError, match="at least 1"):
            parts_of(100, 0, 10)

    @pytest.mark.parametrize(("number", "needed", "most"), [(2, 180, "1 fragment;"), (3, 420, "2 fragments;")])
    def test_two_parts_have_one_neighbour_each(self, number: int, needed: int, most: str) -> None:
        """60 are shared. Two parts: 60 alone, 60 shared, 60 alone. One between two others has 60 + 60 + 60, so that
        parts begin 120 apart, and the last ends 60 later: 3 * 120 + 60. The ends then have 120 alone."""
        parts = parts_of(needed, number, 60)
        own = [len(part) - 60 * (2 if 0 < part.index < number - 1 else 1) for part in parts]
        assert own == {2: [60, 60], 3: [120, 60, 120]}[number]
        with pytest.raises(
            sw.InvalidInputError, match=f"need {needed} frames; {needed - 1} frames make at most {most}"
        ):
            parts_of(needed - 1, number, 60)


class TestCommonMotion:
    def test_is_the_mean_of_those_that_agree(self) -> None:
        """Three measured 1.00, 1.01 and 1.02 m; the fourth slipped by half a metre."""
        T = common_motion(np.stack([shifted(x) for x in (1.0, 1.01, 1.02, 1.5)]))
        assert T is not None
        np.testing.assert_allclose(T, shifted(1.01), atol=1e-12)

    @pytest.mark.parametrize("shifts", [(1.0, 1.0), (1.0, 1.5, 2.0, 2.5)])
    def test_too_few_or_no_two_agree(self, shifts: tuple[float, ...]) -> None:
        assert common_motion(np.stack([shifted(x) for x in shifts])) is None


def chain(count: int, *, drift_m: float = 0.0) -> Fragment:
    """Keyframes a metre apart along x as a fragment has them whose every step is too long by so much."""
    fragment = Fragment()
    fragment.T_world_keyframe = np.stack([shifted(k * (1 + drift_m)) for k in range(count)])
    fragment.keyframe_frames, fragment.submaps = np.arange(count), np.zeros(count, np.int64)
    fragment.edges = [tracked_edge(k, k + 1, shifted(1 + drift_m), 0.01) for k in range(count - 1)]
    for k in range(count):
        result = FrameResult(
            index=k, timestamp_s=float(k), state=FrameState.TRACKING, T_world_camera=fragment.T_world_keyframe[k]
        )
        fragment.frames.append(result, k)
    return fragment


def link(i: int, j: int, x_m: float, *, loop: bool = True) -> Edge:
    return tracked_edge(i, j, shifted(x_m), 0.01, loop=loop)


class TestAssembly:
    """Keyframes are a metre apart; the second fragment begins where keyframe 3 of the first one is."""

    def test_later_fragments_come_into_the_world_of_the_first(self) -> None:
        fragments = [chain(5), chain(5)]
        assembly = assemble(fragments, {(0, 1): [link(3, 0, 0.0, loop=False), link(4, 1, 0.0), link(4, 2, 1.0)]})
        assert [piece.component for piece in assembly.pieces] == [0, 0]
        np.testing.assert_allclose(assembly.pieces[0].correction.T_new_old, np.tile(np.eye(4), (5, 1, 1)), atol=1e-9)
        np.testing.assert_allclose(assembly.pieces[1].correction.T_new_old, np.tile(shifted(3), (5, 1, 1)), atol=1e-9)
        assert assembly.kept == {(0, 1): (3, 3)}
        assert assembly.loops == ((4, 6), (4, 7))  # the keyframes of the second are numbered on from 5

    def test_wrong_link_is_dropped(self) -> None:
        links = [link(3, 0, 0.0, loop=False), link(4, 1, 0.0), link(4, 2, 1.0), link(0, 4, 1.0)]
        assembly = assemble([chain(5), chain(5)], {(0, 1): links})
        assert assembly.kept == {(0, 1): (3, 4)}
        np.testing.assert_allclose(assembly.pieces[1].correction.T_new_old[0], shifted(3), atol=1e-6)

    def test_loop_takes_drift_out_of_both(self) -> None:
        """Both go 1 % too far, 7 cm in all; the last keyframe of the second is known to be 7 m from the first of all.

        A step of 1.01 m has the standard deviation 1 mm + 1 %, the variance 11.1^2 = 123.21 mm^2; seven of them and the
        seam have 863.47 mm^2, the loop of 7 m has 71^2 = 5041 mm^2. So the chain gives way by 70 mm * 863.47 / 5904.47
        = 10.237 mm, of which three steps before the seam take 3 * 123.21 / 863.47, 4.382 mm.
        """
        fragments = [chain(5, drift_m=0.01), chain(5, drift_m=0.01)]
        assembly = assemble(fragments, {(0, 1): [link(3, 0, 0.0, loop=False), link(0, 4, 7.0)]})
        first, second = (piece.correction.T_new_old for piece in assembly.pieces)
        assert first[3, 0, 3] == pytest.approx(-4.382e-3, abs=1e-6)
        assert (second[4] @ fragments[1].T_world_keyframe[4])[0, 3] == pytest.approx(7.07 - 10.237e-3, abs=1e-6)

    def test_without_a_link_each_stays_in_its_own_world(self) -> None:
        assembly = assemble([chain(3), chain(4)], {(0, 1): []})
        assert [piece.component for piece in assembly.pieces] == [0, 1]
        for piece in assembly.pieces:
            np.testing.assert_allclose(piece.correction.T_new_old - np.eye(4), 0, atol=1e-12)

    def test_fragment_without_keyframes_is_no_piece(self) -> None:
        assembly = assemble([chain(3), Fragment(), chain(3)], {(0, 2): [link(2, 0, 0.0, loop=False)]})
        assert [(piece.fragment, piece.component) for piece in assembly.pieces] == [(0, 0), (2, 0)]

    def test_frames_go_over_from_one_fragment_to_the_next(self) -> None:
        """Frames 3 and 4 are in both; the second has them 6 cm further on. A third and two thirds of that are taken."""
        fragments = [chain(5), chain(5)]
        links = {(0, 1): [link(3, 0, 0.06, loop=False)]}
        results = joined_results([Part(0, 0, 5, 0), Part(1, 3, 8, 2)], fragments, assemble(fragments, links))
        assert [result.index for result in results] == list(range(8))
        x_m = [result.T_world_camera[0, 3] for result in results]
        np.testing.assert_allclose(x_m, [0, 1, 2, 3.02, 4.04, 5.06, 6.06, 7.06], atol=1e-9)


class TestRun:
    def test_is_a_run_like_any_other(self, run: sw.RunSummary) -> None:
        assert run.folder is not None
        assert len(run.results) == COUNT
        assert all(result.state in POSED for result in run.results)
        assert run.metrics["frames_tracked"] == COUNT
        assert run.metrics["submaps_joined"] == 2
        assert run.metrics["ate_rmse_m"] < 0.002
        assert run.metrics["num_points_input"] == sum(
            np.count_nonzero(frame.depth_m) for frame in there_and_back().frames
        )
        assert len(sw.read_ply(run.folder / "map.ply")) == len(run.map)
        files = {path.name for path in run.folder.iterdir()}
        assert {"trajectory.txt", "map.ply", "frames.csv", "metrics.json", "report.html", "config.toml"} <= files
        assert not run.folder.with_name(run.folder.name + ENDING).exists()

    def test_tells_of_its_fragments(self, run: sw.RunSummary) -> None:
        assert run.folder is not None
        told = json.loads((run.folder / "run.json").read_text())
        parts = told["fragments"]["parts"]
        assert [part["frames"] for part in parts] == [[0, 40], [28, 68], [56, 96]]
        assert all(part["components"] == [0] for part in parts)
        pairs = {tuple(link["fragments"]): link["kept"] for link in told["fragments"]["links"]}
        assert pairs[0, 1] > 2
        assert pairs[1, 2] > 2
        assert pairs[0, 2] > 2  # they share no frames, but places
        assert told["warnings"] == []

    def test_surfaces_are_not_doubled(self, run: sw.RunSummary) -> None:
        """What two fragments have seen is kept once: there are no more surfels than in a run of one piece."""
        assert len(run.map) < 1.05 * len(sw.run_sequence(there_and_back(), CONFIG).map)

    def test_same_bytes_whatever_the_order_and_the_threads(self, run: sw.RunSummary, tmp_path: Path) -> None:
        class Backwards(ThreadPoolExecutor):
            """Begins with the tasks that are handed in last, as far as it can."""

            def submit(self, call: Callable[..., object], /, *arguments: object, **options: object) -> object:  # type: ignore[override]
                future = super().submit(call, *arguments, **options)
                items = [self._work_queue.get_nowait() for _ in range(self._work_queue.qsize())]
                for item in reversed(items):
                    self._work_queue.put(item)
                return future

        with Backwards(max_workers=2) as executor:
            other = run_fragments(there_and_back, 3, CONFIG, out=tmp_path / "run", executor=executor, threads=2)
        assert run.folder is not None
        assert other.folder is not None
        for name in ("trajectory.txt", "map.ply", "keyframes.csv"):
            assert (run.folder / name).read_bytes() == (other.folder / name).read_bytes()

    def test_goes_on_with_the_fragments_that_are_there(
        self, run: sw.RunSummary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The recording vanishes during the last fragment; with `resume` that one alone is made."""
        made: list[float] = []

        def process_all(slam: sw.Slam, sequence: sw.RgbdSequence, *arguments: object, **options: object) -> None:
            made.append(float(sequence.timestamps_s[0]))
            if len(made) == 3:
                raise sw.DatasetError("the disk is gone")
            usual(slam, sequence, *arguments, **options)

        usual = making.process_all
        monkeypatch.setattr(making, "process_all", process_all)
        with pytest.raises(sw.DatasetError, match="the disk is gone"):
            run_fragments(there_and_back, 3, CONFIG, out=tmp_path / "run")
        assert not (tmp_path / "run").exists()
        with pytest.raises(sw.OutputError, match=r"run.fragments: holds 2 finished fragments .* --resume continues it"):
            run_fragments(there_and_back, 3, CONFIG, out=tmp_path / "run")
        again = run_fragments(there_and_back, 3, CONFIG, out=tmp_path / "run", resume=True)
        assert len(made) == 4
        assert made[3] == made[2]
        assert run.folder is not None
        assert (run.folder / "map.ply").read_bytes() == (tmp_path / "run/map.ply").read_bytes()
        assert len(again.results) == COUNT

    def test_fragments_of_other_frames_or_settings_are_named(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Of two fragments, 0 to 41 and 30 to 71 of 72 frames, the first is that of a run of frames 0 to 41 in one."""

        def stopped(*_: object) -> None:
            raise sw.DatasetError("stopped")

        def make(count: int, number: int, config: sw.SlamConfig = CONFIG) -> str:
            caplog.clear()
            with pytest.raises(sw.DatasetError, match="stopped"):
                run_fragments(lambda: walk().part(0, count), number, config, out=tmp_path / "run", resume=True)
            return caplog.text

        monkeypatch.setattr("scanweld.runs.fragments.run.assemble", stopped)
        assert make(72, 2) == ""
        assert make(72, 2) == ""
        assert ": fragment 1 left there is of other frames" in make(42, 1)
        assert ": fragments 0, 1 left there are of other frames" in make(72, 2, replace(CONFIG, seed=1))

    def test_folder_of_somebody_else_is_left_alone(self, tmp_path: Path) -> None:
        mine = tmp_path / f"run{ENDING}" / "thesis.txt"
        mine.parent.mkdir()
        mine.write_text("years of work")
        with pytest.raises(sw.OutputError, match="something else than fragments"):
            run_fragments(walk, 3, CONFIG, out=tmp_path / "run", force=True)
        assert mine.read_text() == "years of work"

    def test_blind_fragment_is_named_and_nothing_is_made_up(self, tmp_path: Path) -> None:
        """Frames 30 to 71 of 72 show no depth: the first of two fragments has 30, the second none."""
        sequence = walk().part(0, 72)
        dark: dict[int, sw.Frame | None] = {
            k: blind(frame) for k, frame in enumerate(sequence.frames) if k >= 30 and frame
        }
        dim = sequence.with_frames(dark)
        summary = run_fragments(lambda: dim, 2, CONFIG, out=tmp_path / "run")
        assert [result.state in POSED for result in summary.results] == [True] * 30 + [False] * 42
        warnings = json.loads((tmp_path / "run/run.json").read_text())["warnings"]
        assert any("fragment 1 (frames 30 to 71): was lost, 0 of 42 frames" in warning for warning in warnings)

    def test_fragment_that_cannot_be_connected_has_a_map_of_its_own(self, tmp_path: Path) -> None:
        """Both see nothing of what they share, and look at opposite walls."""
        sequence, times = walk(), np.arange(72) / 30
        seen = [sequence.frames[k] for k in (*range(36), *range(60, 96))]
        frames = [
            replace(blind(frame) if 26 <= k < 47 else frame, timestamp_s=float(times[k]))
            for k, frame in enumerate(seen)
        ]
        parted = replace(sequence, frames=tuple(frames), timestamps_s=times, ground_truth=None)
        summary = run_fragments(lambda: parted, 2, CONFIG, out=tmp_path / "run")
        assert summary.metrics["submaps_unjoined"] == 1
        assert [result.state in POSED for result in summary.results] == [True] * 26 + [False] * 46
        assert summary.metrics["frames_in_unjoined_submaps"] == 25
        assert (tmp_path / "run/map-1.ply").is_file()
        warnings = json.loads((tmp_path / "run/run.json").read_text())["warnings"]
        assert any("fragment 1 (frames 30 to 71): connects to no fragment" in warning for warning in warnings)

    def test_is_repeated_in_fragments(self, tmp_path: Path) -> None:
        place = write_tum_folder(tmp_path / "room", walk().part(0, 60))
        recording = RunInput(str(place))
        run_fragments(recording.open, 2, CONFIG, out=tmp_path / "run", description=recording.described())
        repeated = repeat_run(tmp_path / "run", tmp_path / "again")
        assert repeated.identical
        assert len(json.loads((tmp_path / "again/run.json").read_text())["fragments"]["parts"]) == 2

    def test_what_cannot_be_run_in_fragments(self) -> None:
        with pytest.raises(sw.InvalidInputError, match="tied together by their keyframes"):
            run_fragments(walk, 3, replace(CONFIG, loop_closer="none"))
        with pytest.raises(sw.InvalidInputError, match="make at most 3 fragments"):
            run_fragments(walk, 5, CONFIG)
        nothing = walk().part(0, 40)
        dark = nothing.with_frames({k: blind(frame) for k, frame in enumerate(nothing.frames) if frame is not None})
        with pytest.raises(sw.DatasetError, match="no fragment has a frame with usable depth"):
            run_fragments(lambda: dark, 1, CONFIG)


@pytest.mark.parametrize("finished", [0, 1])
def test_interruption_says_what_is_kept(
    finished: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C before the first fragment is finished, and in the second one."""
    place = write_tum_folder(tmp_path / "room", walk().part(0, 60))

    @contextlib.contextmanager
    def in_this_process(*_: object, **__: object) -> Iterator[ThreadPoolExecutor]:
        with ThreadPoolExecutor(1) as executor:
            yield executor

    def process_all(*arguments: object, **options: object) -> None:
        if len(made) == finished:
            raise KeyboardInterrupt
        made.append(usual(*arguments, **options))

    usual, made = making.process_all, []
    monkeypatch.setattr(making, "process_all", process_all)
    monkeypatch.setattr(executors, "opened_executor", in_this_process)
    command = ["slam", str(place), "--out", str(tmp_path / "run"), "--fragments", "2", "--set", "fragments.overlap=12"]
    assert command_line.run(command) == 130
    resumed = f"the same command with --out {tmp_path / 'run'} --resume goes on from there"
    kept = f"interrupted; 1 finished fragment is kept: {resumed}"
    assert capsys.readouterr().err.splitlines()[-1] == (kept if finished else "interrupted")


@pytest.mark.parametrize(
    "arguments",
    [
        ("--workers", "2"),
        ("--scheduler", "tcp://127.0.0.1:8786"),
        ("--fragments", "2", "--realtime"),
        ("--fragments", "2", "--poses", "truth"),
        ("--fragments", "2", "--refine"),
    ],
)
def test_options_that_do_not_go_together(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.run(["slam", "nowhere", *arguments]) == 2
    assert "fragments" in capsys.readouterr().err
