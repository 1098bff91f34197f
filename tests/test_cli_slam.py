"""`scanweld slam` and `demo` as a person types them: output, exit codes, configuration, and bad input."""

from __future__ import annotations

import inspect
import json
import logging
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer

import scanweld as sw
from rendered import blind, pose_error, rendered, write_tum_folder
from scanweld.cli import app as command_line
from scanweld.cli import progress
from scanweld.cli.slam import load_config, slam, summary_text
from scanweld.config import load_toml
from scanweld.errors import ConfigError
from scanweld.parallel import get_num_threads, set_num_threads
from scanweld.runs.run import run_sequence
from test_runs import EXTRAS, FILES, METRICS, files_of

Answer = tuple[int, str, str]
COUNT = 8


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames of the room on disk, TUM layout; tests copy it before they damage it."""
    return write_tum_folder(tmp_path_factory.mktemp("recorded") / "room", rendered(count=40).part(0, COUNT))


@pytest.fixture
def room(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "input/room"))


@pytest.fixture
def scanweld(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[..., Answer]]:
    """Run a command line in an empty folder; returns exit code, stdout and stderr."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    root, threads = logging.getLogger(), get_num_threads()
    handlers, level = root.handlers[:], root.level

    def call(*arguments: object) -> Answer:
        capsys.readouterr()
        code = command_line.run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    yield call
    root.handlers[:] = handlers
    root.setLevel(level)
    set_num_threads(threads)


class TestRun:
    def test_writes_a_run_and_says_what_came_of_it(self, scanweld: Callable[..., Answer], room: Path) -> None:
        code, out, err = scanweld("slam", room)
        assert code == 0
        assert files_of(Path("runs/room-1")) == FILES
        assert f"{COUNT} of {COUNT} tracked" in out
        assert "ATE" in out
        assert "runs/room-1" in out
        assert "error" not in err
        run = json.loads(Path("runs/room-1/run.json").read_text())
        assert Path(run["input"]) == room.resolve()
        assert scanweld("slam", room, "--frames", "0:2")[0] == 0
        assert sorted(path.name for path in Path("runs").iterdir()) == ["room-1", "room-2"]

    def test_json_is_the_only_thing_on_stdout(self, scanweld: Callable[..., Answer], room: Path) -> None:
        code, out, _ = scanweld("slam", room, "--out", "run", "--json")
        assert code == 0
        metrics = json.loads(out)
        assert set(metrics) == METRICS | EXTRAS
        assert metrics == json.loads(Path("run/metrics.json").read_text())

    def test_options_reach_the_run(self, scanweld: Callable[..., Answer], room: Path) -> None:
        code, out, _ = scanweld(
            "slam", room, "--out", "run", "--frames", "1:7:2", "--scale", 0.5, "--camera", "131.25,131.25,79.5,59.5",
            "--depth-scale", 5000, "--threads", 1, "--set", "tracking.projective.iterations=7", "--json",
        )  # fmt: skip
        assert code == 0
        assert json.loads(out)["frames"] == 3
        times = sw.read_trajectory("run/trajectory.txt").timestamps_s
        np.testing.assert_allclose(times, rendered(count=40).timestamps_s[1:7:2], atol=1e-6)
        run = json.loads(Path("run/run.json").read_text())
        assert run["threads"] == 1
        assert run["frames"] == "1:7:2"
        assert run["set"] == ["tracking.projective.iterations=7"]
        config = sw.from_mapping(sw.SlamConfig, load_toml(Path("run/config.toml")))
        assert config.tracking.projective.iterations == 7
        points = sum(np.count_nonzero(f.depth_m) for f in rendered(count=40).frames[1:7:2])
        assert json.loads(out)["num_points_input"] == pytest.approx(points / 4, rel=0.02)

    def test_force(self, scanweld: Callable[..., Answer], room: Path) -> None:
        assert scanweld("slam", room, "--out", "run", "--frames", "0:2")[0] == 0
        before = Path("run/metrics.json").read_bytes()
        code, out, err = scanweld("slam", room, "--out", "run", "--frames", "0:3")
        assert (code, out) == (1, "")
        assert err.startswith("error: ")
        assert "--force" in err
        assert len(err.splitlines()) == 1
        assert Path("run/metrics.json").read_bytes() == before
        assert scanweld("slam", room, "--out", "run", "--frames", "0:3", "--force")[0] == 0
        assert json.loads(Path("run/metrics.json").read_text())["frames"] == 3

    def test_mostly_blank_sequence_ends_with_3_and_a_complete_run(
        self, scanweld: Callable[..., Answer], tmp_path: Path
    ) -> None:
        sequence = rendered(count=40).part(0, 7)
        blank = sequence.with_frames({k: blind(sequence.frames[k]) for k in range(3, 7)})
        folder = write_tum_folder(tmp_path / "blank", blank)
        code, out, err = scanweld("slam", folder, "--out", "run")
        assert code == 3
        assert files_of(Path("run")) == FILES
        assert "3 of 7 tracked, 4 lost" in out
        assert "frames.csv says why" in err
        code, out, err = scanweld("slam", folder, "--out", "run", "--force", "--json")
        assert code == 3
        assert json.loads(out)["frames_lost"] == 4

    def test_interrupt_keeps_the_run_and_says_so(
        self, scanweld: Callable[..., Answer], room: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        update = progress.FrameProgress.update

        def stop(self: progress.FrameProgress, result: sw.FrameResult) -> None:
            update(self, result)
            if result.index == 3:
                raise KeyboardInterrupt

        monkeypatch.setattr(progress.FrameProgress, "update", stop)
        code, out, err = scanweld("slam", room, "--out", "run")
        assert code == 130
        assert "interrupted after 4 of 8 frames" in err
        assert "4 of 4 tracked" in out
        assert files_of(Path("run")) == FILES

    def test_interrupt_while_writing_leaves_nothing(
        self, scanweld: Callable[..., Answer], room: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def stop(*arguments: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("scanweld.runs.output.write_ply", stop)
        code, out, err = scanweld("slam", room, "--out", "run")
        assert (code, out) == (130, "")
        assert err.splitlines()[-1] == "interrupted"
        assert list(Path().iterdir()) == []

    def test_second_ctrl_c_leaves_the_checkpoint_and_says_so(
        self, scanweld: Callable[..., Answer], room: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The first one is waiting for the end of the frame; the second one comes while the run is written."""
        update = progress.FrameProgress.update

        def ask(self: progress.FrameProgress, result: sw.FrameResult) -> None:
            update(self, result)
            if result.index == 3:
                signal.raise_signal(signal.SIGINT)

        with monkeypatch.context() as patch:
            patch.setattr(progress.FrameProgress, "update", ask)
            patch.setattr("scanweld.runs.output.write_ply", lambda *_: signal.raise_signal(signal.SIGINT))
            code, out, err = scanweld("slam", room, "--out", "run")
        assert (code, out) == (130, "")
        assert files_of(Path("run")) == {"checkpoint.swc"}
        assert err.splitlines()[-1] == (
            "interrupted; the last checkpoint is kept: the same command with --out run --resume goes on from there"
        )
        assert scanweld("slam", room, "--out", "run", "--resume")[0] == 0
        assert files_of(Path("run")) == FILES

    def test_tracked_only(self, scanweld: Callable[..., Answer], tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 6)
        folder = write_tum_folder(tmp_path / "gap", sequence.with_frames({2: blind(sequence.frames[2])}))
        assert scanweld("slam", folder, "--out", "all")[0] == 0
        assert scanweld("slam", folder, "--out", "tracked", "--tracked-only")[0] == 0
        assert len(sw.read_trajectory("all/trajectory.txt")) == 6
        assert len(sw.read_trajectory("tracked/trajectory.txt")) == 5


class TestPoses:
    def test_truth(self, scanweld: Callable[..., Answer], room: Path) -> None:
        code, out, _ = scanweld("slam", room, "--poses", "truth", "--out", "run", "--json")
        assert code == 0
        assert json.loads(out)["ate_rmse_m"] < 1e-9
        read, true = sw.read_trajectory("run/trajectory.txt"), rendered(count=40).ground_truth
        for estimate, pose in zip(read.T_world_camera, true.T_world_camera, strict=False):
            assert pose_error(estimate, pose)[0] < 1e-8

    def test_file(self, scanweld: Callable[..., Answer], room: Path) -> None:
        true = rendered(count=40).ground_truth
        shifted = true.T_world_camera.copy()
        shifted[:, 0, 3] += 5
        sw.write_tum("given.txt", sw.Trajectory(true.timestamps_s, shifted))
        assert scanweld("slam", room, "--poses", "given.txt", "--out", "run")[0] == 0
        positions = sw.read_trajectory("run/trajectory.txt").positions_m
        np.testing.assert_allclose(positions, shifted[:COUNT, :3, 3], atol=1e-8)

    def test_truth_that_is_not_there(self, scanweld: Callable[..., Answer], room: Path) -> None:
        (room / "groundtruth.txt").unlink()
        code, _, err = scanweld("slam", room, "--poses", "truth")
        assert code == 1
        assert "has no ground truth" in err
        assert "--poses FILE" in err

    def test_file_that_is_not_there(self, scanweld: Callable[..., Answer], room: Path) -> None:
        code, _, err = scanweld("slam", room, "--poses", "nowhere.txt")
        assert code == 1
        assert "nowhere.txt" in err
        assert list(Path().iterdir()) == []


class TestConfiguration:
    def test_misspelt_nested_key_names_the_nearest(self, scanweld: Callable[..., Answer], room: Path) -> None:
        """Golden 5, from the command line and from a file."""
        code, _, err = scanweld("slam", room, "--set", "tracking.stable_fracton=0.1")
        assert code == 1
        assert "unknown key 'tracking.stable_fracton'; did you mean 'tracking.stable_fraction'?" in err
        Path("c.toml").write_text("[tracking.projective]\niteration = 5\n")
        code, _, err = scanweld("slam", room, "--config", "c.toml")
        assert code == 1
        assert "c.toml: unknown key 'tracking.projective.iteration'" in err
        assert "'tracking.projective.iterations'" in err
        assert len(err.splitlines()) == 1
        assert not Path("runs").exists()

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("tracking.stable_fraction=2", "0.001 to 1.0"), ("tracking.stable_fraction=lots", "expected float"),
            ("tracking=3", "is a section"), ("fusion.clean_interval=1.5", "expected int"),
        ],
    )  # fmt: skip
    def test_wrong_value_is_told_in_a_line(
        self, scanweld: Callable[..., Answer], room: Path, text: str, told: str
    ) -> None:
        code, _, err = scanweld("slam", room, "--set", text)
        assert code == 1
        assert told in err
        assert len(err.splitlines()) == 1

    def test_flag_beats_file_beats_default(self, tmp_path: Path) -> None:
        """Golden 7."""
        path = tmp_path / "c.toml"
        path.write_text("seed = 3\n[tracking]\nstable_fraction = 0.5\n[fusion]\nmax_confidence = 9\n")
        assert load_config(None, []) == sw.SlamConfig()
        from_file = load_config(path, [])
        assert (from_file.seed, from_file.tracking.stable_fraction, from_file.fusion.max_confidence) == (3, 0.5, 9)
        assert from_file.tracking.projective == sw.SlamConfig().tracking.projective
        both = load_config(path, ["tracking.stable_fraction=0.25", "seed=4", "seed=5"])
        assert (both.seed, both.tracking.stable_fraction, both.fusion.max_confidence) == (5, 0.25, 9)

    def test_fault_of_the_file_is_told_with_its_name_even_when_a_flag_would_mend_it(self, tmp_path: Path) -> None:
        path = tmp_path / "c.toml"
        path.write_text("[tracking]\nstable_fraction = 7\n")
        with pytest.raises(ConfigError, match=r"c\.toml.*stable_fraction"):
            load_config(path, ["tracking.stable_fraction=0.5"])

    def test_run_repeats_from_its_own_config(self, scanweld: Callable[..., Answer], room: Path) -> None:
        assert scanweld("slam", room, "--out", "a", "--set", "fusion.max_confidence=9")[0] == 0
        assert scanweld("slam", room, "--out", "b", "--config", "a/config.toml")[0] == 0
        assert Path("a/map.ply").read_bytes() == Path("b/map.ply").read_bytes()
        assert Path("a/config.toml").read_bytes() == Path("b/config.toml").read_bytes()

    def test_defaults_are_those_of_the_api(self) -> None:
        """Golden 7: every default of the command line is the default of the function that it reaches."""
        options = inspect.signature(slam).parameters
        opened = inspect.signature(sw.open_sequence).parameters
        ran = inspect.signature(run_sequence).parameters
        for option, api in (("format_name", "format"), ("camera", "camera"), ("depth_scale", "depth_scale"),
                            ("frames", "frames"), ("scale", "scale")):  # fmt: skip
            assert options[option].default == opened[api].default, option
        for name in ("poses", "tracked_only", "force"):
            assert options[name].default == ran[name].default, name
        assert load_config(options["config"].default, options["overrides"].default or []) == sw.SlamConfig()


class TestBadInput:
    """One line that names the file and the likely fix, exit code 1, nothing half-written."""

    @staticmethod
    def told(answer: Answer, *words: str) -> None:
        code, out, err = answer
        assert (code, out) == (1, "")
        assert len(err.splitlines()) == 1, err
        assert err.startswith("error: ")
        for word in words:
            assert word in err
        assert list(Path().iterdir()) == []

    def test_missing_folder(self, scanweld: Callable[..., Answer]) -> None:
        self.told(scanweld("slam", "/nowhere/at/all"), "/nowhere/at/all", "no such folder")

    def test_empty_folder(self, scanweld: Callable[..., Answer], tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        self.told(scanweld("slam", tmp_path / "empty"), "empty", "nothing")

    def test_lists_without_frames(self, scanweld: Callable[..., Answer], room: Path) -> None:
        (room / "depth.txt").write_text("# no frame\n")
        code, out, err = scanweld("slam", room)
        assert (code, out) == (1, "")
        assert err.splitlines()[-1] == f"error: {room}: the sequence is empty, no frame was found"

    def test_colour_without_depth(self, scanweld: Callable[..., Answer], room: Path) -> None:
        shutil.rmtree(room / "depth")
        (room / "depth.txt").unlink()
        self.told(scanweld("slam", room), "depth")

    def test_unknown_format(self, scanweld: Callable[..., Answer], room: Path) -> None:
        self.told(scanweld("slam", room, "--format", "kitti"), "kitti", "redwood")

    @pytest.mark.parametrize("frames", ["9:3", "100:"])
    def test_frames_that_are_none(self, scanweld: Callable[..., Answer], room: Path, frames: str) -> None:
        self.told(scanweld("slam", room, "--frames", frames), frames.rstrip(":"))

    @pytest.mark.parametrize("option", [("--scale", "0"), ("--camera", "1,2,3"), ("--depth-scale", "-5")])
    def test_numbers_that_make_no_sense(
        self, scanweld: Callable[..., Answer], room: Path, option: tuple[str, str]
    ) -> None:
        code, out, err = scanweld("slam", room, *option)
        assert code in (1, 2)
        assert out == ""
        assert "Traceback" not in err
        assert list(Path().iterdir()) == []

    def test_timestamps_out_of_order(self, scanweld: Callable[..., Answer], room: Path) -> None:
        """Sorted, or told; never a run whose time goes backwards."""
        for kind in ("depth", "rgb"):
            lines = (room / f"{kind}.txt").read_text().splitlines()
            lines[3], lines[4] = lines[4], lines[3]
            (room / f"{kind}.txt").write_text("\n".join(lines) + "\n")
        code, _, err = scanweld("slam", room, "--out", "run")
        if code == 0:
            times = sw.read_trajectory("run/trajectory.txt").timestamps_s
            assert (np.diff(times) > 0).all()
            assert len(times) == COUNT
        else:
            assert (code, len(err.splitlines())) == (1, 1)

    def test_output_in_the_place_of_a_file(self, scanweld: Callable[..., Answer], room: Path, tmp_path: Path) -> None:
        place = tmp_path / "place"
        place.write_text("a file")
        self.told(scanweld("slam", room, "--out", place), "place", "--out")
        self.told(scanweld("slam", room, "--out", place / "run"), "place", "--out")
        assert place.read_text() == "a file"

    def test_force_spares_what_is_no_run(self, scanweld: Callable[..., Answer], room: Path) -> None:
        code, _, err = scanweld("slam", room, "--out", room, "--force")
        assert code == 1
        assert "not a run folder" in err
        assert (room / "depth.txt").exists()

    def test_truncated_png_is_skipped_and_counted(self, scanweld: Callable[..., Answer], room: Path) -> None:
        for name in ("depth/003.png", "rgb/005.png"):
            data = (room / name).read_bytes()
            (room / name).write_bytes(data[: len(data) // 2])
        code, out, err = scanweld("slam", room, "--out", "run", "--json")
        assert code == 0
        metrics = json.loads(out)
        assert (metrics["frames"], metrics["frames_tracked"], metrics["frames_unreadable"]) == (COUNT, COUNT - 2, 2)
        assert "003.png" in err
        assert "truncated" in err
        read, true = sw.read_trajectory("run/trajectory.txt"), rendered(count=40).ground_truth.T_world_camera
        assert len(read) == COUNT
        first = np.linalg.inv(true[0])
        for k in (3, 5):
            assert pose_error(read.T_world_camera[k], first @ true[k])[0] < 3e-3

    def test_every_frame_damaged(self, scanweld: Callable[..., Answer], room: Path) -> None:
        for path in (room / "depth").iterdir():
            path.write_bytes(path.read_bytes()[:100])
        code, _, err = scanweld("slam", room, "--out", "run")
        assert code == 1
        assert err.splitlines()[-1].startswith("error: ")
        assert "none of the 8 frames" in err
        assert list(Path().iterdir()) == []

    def test_wrong_depth_unit_is_named(self, scanweld: Callable[..., Answer], room: Path) -> None:
        """Read as millimetres, the room is five times too large: beyond the range, so there is no run either."""
        code, _, err = scanweld("slam", room, "--depth-scale", 1000, "--out", "run")
        assert "pass --depth-scale 5000" in err
        assert code == 1
        assert list(Path().iterdir()) == []

    def test_parents_that_were_made_for_a_failed_run_are_gone(
        self, scanweld: Callable[..., Answer], room: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(*arguments: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("scanweld.runs.output.write_ply", fail)
        self.told(scanweld("slam", room, "--out", "deep/er/run"), "No space left")


def result_of(index: int, state: sw.FrameState) -> sw.FrameResult:
    return sw.FrameResult(index=index, timestamp_s=0, state=state, T_world_camera=np.eye(4), num_surfels=1_234_567)


class TestProgress:
    def test_quiet_lines_without_a_terminal(
        self, scanweld: Callable[..., Answer], room: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(progress, "QUIET_INTERVAL_S", 0.0)
        _, _, err = scanweld("slam", room, "--out", "run")
        lines = [line for line in err.splitlines() if line.startswith("slam: frame ")]
        assert len(lines) == COUNT
        assert "frame 8/8" in lines[-1]
        assert "TRACKING" in lines[-1]
        assert "surfels" in lines[-1]
        assert "\r" not in err
        assert "\x1b" not in err

    @pytest.mark.parametrize("columns", [40, 100])
    def test_a_line_on_a_terminal(
        self, columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """One line at any width, since one that wraps is not overwritten; the second pass says that it is one."""
        for name, value in {"FORCE_COLOR": "1", "COLUMNS": str(columns), "TERM": "xterm"}.items():
            monkeypatch.setenv(name, value)
        with progress.FrameProgress(1500, "slam", then="calibrating") as shown:
            for index in (*range(1500), *range(1300)):
                shown.update(result_of(index, sw.FrameState.RELOCALISED))
            shown._bar.refresh()
        err = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
        lines = [line.rstrip() for line in re.split(r"[\r\n]+", err)]
        assert max(map(len, lines)) <= columns
        assert lines.count("calibrating") == 1
        assert any(line.startswith("slam ag") for line in lines)
        assert not any(line and not line.startswith(("slam", "calibrating")) for line in lines)

    def test_count_of_passes_without_a_terminal(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(progress, "QUIET_INTERVAL_S", 0.0)
        with progress.FrameProgress(2, "slam", then="calibrating") as shown:
            for index in (0, 1, 0, 1):
                shown.update(result_of(index, sw.FrameState.TRACKING))
        heads = [" ".join(line.split()[:4]) for line in capsys.readouterr().err.splitlines()]
        assert [head.partition("/2")[0] for head in heads] == [
            "slam: frame 1", "slam: frame 2", "calibrating", "slam again: frame 1", "slam again: frame 2",
        ]  # fmt: skip

    def test_log_handlers_are_put_back(self, monkeypatch: pytest.MonkeyPatch) -> None:
        before = logging.getLogger().handlers[:]
        for terminal in ("1", ""):
            monkeypatch.setenv("FORCE_COLOR", terminal)
            with progress.FrameProgress(2, "x") as shown:
                shown.say("compiling")
                shown.update(result_of(0, sw.FrameState.LOST))
            assert logging.getLogger().handlers == before


class TestDemo:
    def test_small_demo(self, scanweld: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch) -> None:
        """The rendering is swapped for a small one; everything else is what a person gets."""
        asked: list[sw.RenderConfig] = []

        def small(folder: Path, config: sw.RenderConfig, **options: object) -> None:
            asked.append(config)
            write_tum_folder(folder, rendered(noise="kinect", count=40).part(0, config.frames))

        monkeypatch.setattr("scanweld.datasets.synthetic.render_sequence", small)
        code, out, _ = scanweld("demo", "--frames", 4)
        assert code == 0
        assert files_of(Path("scanweld-demo")) == FILES
        assert (asked[0].scene, asked[0].noise, asked[0].frames) == ("room", "kinect", 4)
        for name in ("report.html", "renders/overview-rgb.png"):
            assert f"scanweld-demo/{name}" in out
        code, out, _ = scanweld("demo", "--frames", 5, "--json")  # replaces its own folder
        assert code == 0
        assert json.loads(out)["frames"] == 5
        code, _, err = scanweld("demo", "--frames", 4, "--out", "mine")
        assert code == 0
        code, _, err = scanweld("demo", "--frames", 4, "--out", "mine")
        assert code == 1
        assert "--force" in err
        assert scanweld("demo", "--frames", 4, "--out", "mine", "--force")[0] == 0

    def test_demo_does_not_replace_what_is_not_its_own(self, scanweld: Callable[..., Answer]) -> None:
        Path("scanweld-demo").mkdir()
        Path("scanweld-demo/precious.txt").write_text("mine")
        code, _, err = scanweld("demo", "--frames", 2)
        assert code == 1
        assert "not a run folder" in err
        assert Path("scanweld-demo/precious.txt").exists()


class TestUsage:
    @pytest.mark.parametrize(
        "arguments",
        [
            ("slam",),
            ("slam", "x", "--no-such-option"),
            ("slam", "x", "--threads", "0"),
            ("nonsense",),
            ("demo", "--frames", "1"),
        ],
    )
    def test_usage_errors_exit_with_2(self, scanweld: Callable[..., Answer], arguments: tuple[str, ...]) -> None:
        code, out, err = scanweld(*arguments)
        assert (code, out) == (2, "")
        assert "Traceback" not in err
        assert err

    @pytest.mark.parametrize("command", [(), ("slam",), ("demo",), ("register",), ("evaluate",), ("render",)])
    def test_help(self, scanweld: Callable[..., Answer], command: tuple[str, ...]) -> None:
        code, out, err = scanweld(*command, "--help")
        assert (code, err) == (0, "")
        assert "Usage" in out

    def test_every_option_has_help(self) -> None:
        commands = typer.main.get_command(command_line.app).commands
        assert {"slam", "demo", "register", "evaluate", "render"} <= set(commands)
        for name, command in commands.items():
            assert command.help, name
            for parameter in command.params:
                assert getattr(parameter, "help", None) or parameter.name == "help", (name, parameter.name)

    def test_version(self, scanweld: Callable[..., Answer]) -> None:
        from importlib.metadata import version

        assert scanweld("--version")[:2] == (0, version("scanweld") + "\n")

    def test_module_is_the_command(self) -> None:
        command = [sys.executable, "-m", "scanweld", "slam", "/nowhere"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr == "error: /nowhere: no such folder\n"

    def test_reader_that_goes_away(self, room: Path, tmp_path: Path) -> None:
        """`scanweld slam ... --json | head -c 1`: no traceback."""
        arguments = ["slam", str(room), "--frames", "0:2", "--out", str(tmp_path / "run"), "--json"]
        command = [sys.executable, "-m", "scanweld", *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        err = process.stderr.read()
        process.stderr.close()
        process.wait(60)
        assert "Traceback" not in err
        assert "Exception" not in err


def test_colour_that_is_missing_is_no_error(scanweld: Callable[..., Answer], tmp_path: Path) -> None:
    sequence = rendered(count=40).part(0, 3)
    frames = {k: replace(f, color=np.zeros_like(f.color)) for k, f in enumerate(sequence.frames)}
    folder = write_tum_folder(tmp_path / "dark", sequence.with_frames(frames))
    shutil.rmtree(folder / "rgb")
    (folder / "rgb.txt").unlink()
    code, _, err = scanweld("slam", folder, "--format", "tum", "--out", "run")
    assert code in (0, 1)
    assert "Traceback" not in err
    if code == 0:
        assert files_of(Path("run")) == FILES


def test_summary_of_a_run_that_is_one_in_every_way() -> None:
    """What was not joined, and the words of refinement and calibration; no line where there are no truth and time."""
    metrics: dict[str, object] = dict.fromkeys(METRICS) | {
        "frames": 90, "frames_tracked": 80, "frames_lost": 9, "frames_unreadable": 1, "num_surfels": 12_345,
        "num_points_input": 67_890, "path_length_m": 1.234, "submaps_unjoined": 2, "frames_in_unjoined_submaps": 7,
    }  # fmt: skip
    camera = sw.PinholeCamera(500.0, 501.0, 320.0, 240.0, 640, 480)
    poses = SimpleNamespace(sigmas={}, held=(), note="keyframes moved by 3 mm")
    found = SimpleNamespace(sigmas={"fx": 0.1}, held=(), recalibrated=True, camera=camera, note="0.1 px")
    same = SimpleNamespace(sigmas={}, held=("fx",), recalibrated=False, camera=camera, note="not determined")
    summary = SimpleNamespace(metrics=metrics, refinements=[poses, found, same], folder=None, resumable=False)
    assert summary_text(summary).splitlines() == [  # type: ignore[arg-type]
        "frames   80 of 90 tracked, 9 lost, 1 unreadable",
        "map      12,345 surfels from 67,890 points",
        "path     1.23 m",
        "apart    2 submaps with 7 frames, counted as lost: no place in common with the map was found",
        "refined  keyframes moved by 3 mm",
        "camera   fx 500.00 fy 501.00 cx 320.00 cy 240.00; 0.1 px",
        "camera   as given; not determined",
    ]
