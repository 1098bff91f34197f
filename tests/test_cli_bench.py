"""The benchmark a user runs: floors, stages, sizes, peers, the command line; and the warm-up."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, rendered
from scanweld.benchmarking.machine import Machine, measure_machine
from scanweld.benchmarking.sizes import SpeedResult, plot_sizes, run_sizes
from scanweld.benchmarking.stages import STAGES, profile_stages
from scanweld.cli.app import run
from scanweld.errors import DatasetError, InvalidInputError, OutputError
from scanweld.slam import warmup

MACHINE = Machine("a processor", 2, 2, read_gb_s=20.0, copy_gb_s=10.0)


class TestMachine:
    def test_floor_by_hand(self) -> None:
        """5 MB read and 5 MB written at 10 GB/s take 1 ms."""
        assert MACHINE.floor_ms(10e6) == pytest.approx(1.0)

    def test_floors_are_measured(self) -> None:
        machine = measure_machine(1 << 22)
        assert 0.1 < machine.copy_gb_s < 10_000
        assert 0.1 < machine.read_gb_s < 10_000
        assert machine.processor
        assert machine.cores >= 1


class TestStages:
    def test_costs_of_a_run(self) -> None:
        sequence = rendered(noise="kinect").part(0, 12).with_frames({8: None})
        seen: list[tuple[int, int]] = []
        costs = profile_stages(sequence, MACHINE, progress=lambda done, total: seen.append((done, total)))
        assert tuple(cost.name for cost in costs) == STAGES
        by_name = {cost.name: cost for cost in costs}
        assert by_name["view"].over_floor is None  # the view is what fusion saw: nothing moves for it
        for name in ("surfaces", "track", "fuse"):
            assert by_name[name].wall_ms > 0
            assert by_name[name].over_floor == pytest.approx(
                by_name[name].wall_ms / MACHINE.floor_ms(by_name[name].bytes_moved)
            )
        assert by_name["other"].over_floor is None
        assert seen[-1] == (12, 12)
        assert len(seen) == 11  # one cannot be decoded

    def test_bytes_by_hand(self) -> None:
        """160x120: decoding writes 4 + 3 bytes a pixel. Surfaces read the colour and write 4 bytes of brightness; the
        levels have 19200 + 4800 + 1200 pixels of 8 floats, and of depth."""
        costs = {cost.name: cost for cost in profile_stages(rendered(noise="kinect").part(0, 8), MACHINE)}
        assert costs["decode"].bytes_moved == 19200 * 7
        assert costs["surfaces"].bytes_moved == 19200 * 7 + 25200 * 36

    def test_too_few_frames(self) -> None:
        with pytest.raises(DatasetError, match="4 of 5 frames can be decoded, a profile needs more than 5"):
            profile_stages(rendered(noise="kinect").part(0, 5).with_frames({1: None}), MACHINE)


def stand_in(folder: Path, lines: str) -> str:
    """An interpreter that has no Open3D but says what it would."""
    path = folder / "peer"
    path.write_text(f"#!{sys.executable}\nimport json, sys\n{lines}\n")
    path.chmod(0o755)
    return str(path)


class TestSizes:
    def test_ours_and_a_peer(self, tmp_path: Path) -> None:
        """The peer's centres are the true ones but for 3 mm along an axis, up and down in turn: an ATE of 3 mm."""
        said: list[str] = []
        peer = stand_in(
            tmp_path,
            "rows = [line.split() for line in open(sys.argv[2] + '/groundtruth.txt') if line[0] != '#']\n"
            "c = [[float(r[1]), float(r[2]), float(r[3]) + 0.003 * (-1) ** k] for k, r in enumerate(rows)]\n"
            "print('chatter'); print(json.dumps({'ms': [900] * 5 + [7, 9, 8], 'centres_m': c}))",
        )
        ours, theirs = run_sizes(tmp_path / "sizes", [(160, 120)], frames=8, peer_python=peer, say=said.append)
        assert (ours.program, ours.width, ours.height, ours.frames) == ("scanweld", 160, 120, 8)
        assert ours.ms_per_frame > 0
        assert 0 < ours.ate_rmse_m < 0.02
        assert (theirs.program, theirs.frames, theirs.ms_per_frame) == ("open3d", 8, 8)
        assert theirs.ate_rmse_m == pytest.approx(0.003, rel=0.05)
        assert said == ["160x120: rendering 8 frames", "160x120: scanweld", "160x120: open3d"]

    @pytest.mark.parametrize("lines", ["sys.exit('no such module')", "print('no figures')", ""])
    def test_a_peer_that_fails_is_left_out(
        self, tmp_path: Path, lines: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ours = SpeedResult("scanweld", 160, 120, 8, 5.0, 9.0, 0.001)
        monkeypatch.setattr("scanweld.benchmarking.sizes._run_ours", lambda sequence, progress: ours)
        peer = stand_in(tmp_path, lines)
        assert run_sizes(tmp_path / "sizes", [(64, 48)], frames=7, peer_python=peer) == [ours]
        assert "Open3D is left out" in caplog.text

    def test_too_few_frames(self, tmp_path: Path) -> None:
        with pytest.raises(InvalidInputError, match="more than 6"):
            run_sizes(tmp_path, [(64, 48)], frames=6)

    def test_plot(self, tmp_path: Path) -> None:
        rows = [
            SpeedResult(name, w, 3 * w // 4, 60, w / 10, None, 0.001)
            for name in ("scanweld", "open3d")
            for w in (160, 320)
        ]
        plot_sizes(rows, tmp_path / "speed.png")
        assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")
        with pytest.raises(OutputError, match="cannot be written"):
            plot_sizes(rows, tmp_path / "absent" / "speed.png")


class TestCommand:
    def test_stages_as_json(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        config = sw.RenderConfig(scene="room", noise="kinect", frames=7, width=CAMERA.width, height=CAMERA.height)
        sw.render_sequence(tmp_path / "room", config)
        assert run(["bench", "stages", str(tmp_path / "room"), "--frames", "7", "--json"]) == 0
        printed = capsys.readouterr()
        found = json.loads(printed.out)
        assert [stage["name"] for stage in found["stages"]] == list(STAGES)
        assert (found["frames"], found["width"], found["height"]) == (7, 160, 120)
        assert "profiling" in printed.err
        assert run(["bench", "stages", str(tmp_path / "room"), "--frames", "7"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines[2:10]] == [*STAGES, "sum"]

    def test_sizes_as_a_table(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        asked: list[object] = []

        def fake(folder: Path, sizes: object, **options: object) -> list[SpeedResult]:
            asked.extend([sizes, options["frames"]])
            return [SpeedResult("scanweld", 64, 48, 9, 4.0, 7.5, 0.00125)]

        monkeypatch.setattr("scanweld.benchmarking.sizes.run_sizes", fake)
        picture = tmp_path / "speed.png"
        assert run(["bench", "--sizes", "64x48,80x60", "--frames", "9", "--plot", str(picture)]) == 0
        assert asked == [[(64, 48), (80, 60)], 9]
        out = capsys.readouterr().out
        assert "64x48       scanweld         4.0     250.0      7.5     1.25" in out
        assert "nothing to compare with" in out
        assert picture.exists()

    @pytest.mark.parametrize(
        "arguments",
        [["stages", "--plot", "x.png"], ["sizes", "somewhere"], ["speed"], ["--frames", "3"], ["--sizes", "640"]],
    )
    def test_wrong_usage(self, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["bench", *arguments]) in (1, 2)
        assert capsys.readouterr().err

    def test_a_plot_that_cannot_be_is_told_before_anything_is_measured(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr("scanweld.benchmarking.machine.measure_machine", lambda: pytest.fail("it was measured"))
        assert run(["bench", "--plot", str(tmp_path / "speed")]) == 1
        assert "must end in .png or .pdf or .svg, got a name without ending" in capsys.readouterr().err


class TestWarmup:
    def test_says_whether_anything_was_compiled(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(warmup, "kernels_are_cached", lambda group, now=False: True)
        assert run(["warmup", "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["compiled"] is False
        assert found["cache"]
        monkeypatch.setattr(warmup, "compile_kernels", lambda report: report("a part (1 of 1)") or True)
        assert run(["warmup"]) == 0
        printed = capsys.readouterr()
        assert "compiled in" in printed.out
        assert "compiling: a part (1 of 1)" in printed.err

    def test_a_process_beside(self, tmp_path: Path) -> None:
        with warmup._beside(f"open({str(tmp_path / 'done')!r}, 'w').close()") as wait:
            wait()
        assert (tmp_path / "done").exists()

    def test_no_process_beside(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Where there is no interpreter to start, the kernels are compiled when they are needed."""
        for absent in (None, "/no/such/interpreter"):
            monkeypatch.setattr(sys, "executable", absent)
            with warmup._beside("pass") as wait:
                wait()

    def test_what_only_a_long_run_calls_is_compiled_too(self) -> None:
        """In a process of its own, as nothing else may have called these kernels."""
        code = """
from scanweld.slam import warmup
warmup.compile_pairs()
warmup._compile_frames(print, print)
from scanweld.loop_closure import kernels as places
from scanweld.mapping import kernels as mapping
from scanweld.mapping.merging import kernels as merging
from scanweld.mapping.storage import kernels as storage
from scanweld.registration.consistency import kernels as cliques
called = [mapping.show_pages, merging.merge_layers, storage.move_pages, storage.cull_pages, storage.fit_boxes,
          storage.settle_pages, storage.clean_pages, places.count_shared_words, cliques.branch_and_bound,
          cliques.induced]
print([kernel.__name__ for kernel in called if not kernel.signatures])
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "[]"

    def test_pairs_compile_by_themselves(self) -> None:
        """What the process beside runs is right: it finds a motion, and so goes through every kernel."""
        points = np.random.default_rng(2).random((40, 3))
        fit = warmup.align_pairs_robustly(points, points + 1.0, np.full(40, 0.01))
        assert fit.result.status.success
        warmup.compile_pairs()
