"""A batch without a cluster: what it is to do, single tasks, URLs, the table and the page."""

from __future__ import annotations

import errno
import json
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import fsspec
import pyarrow.parquet as pq
import pytest

import scanweld as sw
from scanweld.cli.app import run
from scanweld.cli.progress import BatchProgress
from scanweld.cluster.batch import largest_first
from scanweld.cluster.outcome import Outcome, State
from scanweld.cluster.plan import names_of, parse_sweep, plan_batch
from scanweld.cluster.table import rows_of, table_lines, write_table
from scanweld.cluster.task import RunTask, run_task
from scanweld.config import from_mapping, merge, parse_override
from scanweld.datasets.synthetic import RenderConfig, render_sequence
from scanweld.errors import ConfigError, DatasetError, InvalidInputError, OutputError
from scanweld.report.batch_page import make_batch_page
from scanweld.runs.input import RunInput
from scanweld.runs.storage import run_folders
from scanweld.runs.storage.recordings import Copies, list_files
from scanweld.slam.config import SlamConfig

FRAMES = 6
SMALL = {"width": 160, "height": 120}


def configure(overrides: list[str]) -> SlamConfig:
    """Return the configuration with overrides, as the command line does."""
    values: dict[str, Any] = {}
    for text in overrides:
        values = merge(values, parse_override(text))
    return from_mapping(SlamConfig, values)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered sequence of a few frames, with files beside it that no reader opens."""
    folder = tmp_path_factory.mktemp("recordings") / "desk"
    render_sequence(folder, RenderConfig(scene="room", noise="none", frames=FRAMES, **SMALL))
    (folder / "model.ply").write_bytes(b"not of the recording")
    (folder / ".hidden").write_bytes(b"nor this")
    return folder


def task_of(place: str | Path, out: str | Path, *overrides: str, **changes: Any) -> RunTask:
    (task,) = plan_batch([str(place)], str(out), RunInput(""), lambda swept: configure([*overrides, *swept]))
    return replace(task, **changes)


class TestPlan:
    def test_every_sequence_has_every_combination(self, tmp_path: Path) -> None:
        sweeps = ["tracking.stable_fraction=0.1,1.0", "loop_closer=none,keyframes"]
        tasks = plan_batch(["a/x", "a/y"], str(tmp_path), RunInput("", frames="0:9"), configure, sweeps=sweeps)
        assert [task.name for task in tasks[:2]] == [
            "x/tracking.stable_fraction=0.1,loop_closer=none",
            "x/tracking.stable_fraction=0.1,loop_closer=keyframes",
        ]
        assert [task.number for task in tasks] == list(range(8))
        assert tasks[3].swept == {"tracking.stable_fraction": 1.0, "loop_closer": "keyframes"}
        assert tasks[4].source == RunInput(str(Path("a/y").resolve()), frames="0:9")
        assert {task.config.loop_closer for task in tasks} == {"none", "keyframes"}
        assert tasks[0].folder == str(tmp_path / tasks[0].name)

    def test_urls_stay_as_they_are(self) -> None:
        (task,) = plan_batch(["s3://lab/desk/"], "gs://lab/runs", RunInput(""), configure)
        assert (task.source.input, task.folder) == ("s3://lab/desk/", "gs://lab/runs/desk")

    def test_equal_names_are_told_apart_by_the_folders_above(self) -> None:
        """The first keeps its name: sequences that are added later do not change it."""
        places = ["/lab/a/desk", "/lab/b/desk", "s3://lab/b/desk", "/lab/a/café (1)"]
        assert names_of(places) == ["desk", "b-desk", "lab-b-desk", "café__1_"]
        assert names_of(places[:1]) == ["desk"]

    def test_the_largest_is_run_first(self, desk: Path, tmp_path: Path) -> None:
        """All settings of a sequence stay together; what is not there is known soon."""
        small = tmp_path / "small"
        small.mkdir()
        (small / "rgb.txt").write_text("little")
        places = [str(small), str(desk), str(tmp_path / "nowhere")]
        tasks = plan_batch(places, str(tmp_path), RunInput(""), configure, sweeps=["seed=1,2"])
        assert [task.number for task in largest_first(tasks)] == [4, 5, 2, 3, 0, 1]

    def test_twice_is_refused(self) -> None:
        with pytest.raises(InvalidInputError, match="given twice"):
            names_of(["desk", "./desk"])

    @pytest.mark.parametrize("text", ["tracking.stable_fraction", "=1,2", "a=1,,2", "a="])
    def test_what_is_no_sweep(self, text: str) -> None:
        with pytest.raises(ConfigError, match="expected key=value,value"):
            parse_sweep(text)

    @pytest.mark.parametrize(
        ("sweeps", "told"),
        [
            (["seed=1,1"], "twice"),
            (["seed=1,2", "seed=3"], "seed"),
            (["tracking.stable_fractoin=1"], "stable_fraction"),
            (["tracking.stable_fraction=0.1,-3"], "stable_fraction"),
        ],
    )
    def test_a_wrong_sweep_is_told_before_anything_runs(self, sweeps: list[str], told: str) -> None:
        with pytest.raises(ConfigError, match=told):
            plan_batch(["desk"], "runs", RunInput(""), configure, sweeps=sweeps)


class TestTask:
    def test_runs_once(self, desk: Path, tmp_path: Path) -> None:
        task = task_of(desk, tmp_path)
        first = run_task(task, "b")
        assert (first.state, first.verdict, first.metrics["frames_tracked"]) == (State.DONE, "trustworthy", FRAMES)
        assert first.good
        written = (tmp_path / "desk" / "run.json").stat().st_mtime_ns
        again = run_task(task, "b")
        assert (again.state, again.metrics) == (State.KEPT, first.metrics)
        assert (tmp_path / "desk" / "run.json").stat().st_mtime_ns == written
        forced = run_task(replace(task, force=True), "b")
        assert forced.state is State.DONE
        assert (tmp_path / "desk" / "run.json").stat().st_mtime_ns > written

    def test_where_the_map_is_kept_makes_no_other_run(self, desk: Path, tmp_path: Path) -> None:
        run_task(task_of(desk, tmp_path), "b")
        assert run_task(task_of(desk, tmp_path, "map.memory_budget_mb=500"), "b").state is State.KEPT

    @pytest.mark.parametrize("what", ["config", "frames", "files"])
    def test_another_run_is_not_replaced(self, desk: Path, tmp_path: Path, what: str) -> None:
        task = task_of(desk, tmp_path)
        run_task(task, "b")
        if what == "config":
            other, told = task_of(desk, tmp_path, "seed=7"), "seed 0, here 7"
        elif what == "frames":
            other, told = replace(task, source=replace(task.source, frames="0:3")), "frames None, here 0:3"
        else:
            other, told = task_of(desk, tmp_path), "files.number"
            (desk / "added.txt").write_text("a file more")
        outcome = run_task(other, "b")
        (desk / "added.txt").unlink(missing_ok=True)
        assert (outcome.state, outcome.good) == (State.FAILED, False)
        assert told in outcome.reason
        assert "--force replaces it" in outcome.reason

    def test_links_to_folders_are_followed_but_not_round(self, desk: Path, tmp_path: Path) -> None:
        linked = tmp_path / "linked"
        linked.mkdir()
        for path in desk.iterdir():
            (linked / path.name).symlink_to(path)
        (linked / "round").symlink_to(linked)
        assert list_files(str(linked)).described() == list_files(str(desk)).described()

    def test_what_is_wrong_with_a_sequence_is_an_outcome(self, desk: Path, tmp_path: Path) -> None:
        missing = run_task(task_of(tmp_path / "nowhere", tmp_path), "b")
        assert missing.reason == f"{tmp_path / 'nowhere'}: no such folder, or an empty one"
        corrupt = tmp_path / "corrupt"
        corrupt.mkdir()
        for name, size in list_files(str(desk)).sizes.items():
            (corrupt / name).parent.mkdir(parents=True, exist_ok=True)
            (corrupt / name).write_bytes(b"\xff" * size if name.endswith(".png") else (desk / name).read_bytes())
        outcome = run_task(task_of(corrupt, tmp_path / "runs"), "b")
        assert (outcome.state, outcome.verdict) == (State.FAILED, "")
        assert "corrupt" in outcome.reason
        assert "\n" not in outcome.reason

    def test_a_fault_of_the_program_is_one_too(self, desk: Path, tmp_path: Path, monkeypatch: Any) -> None:
        monkeypatch.setattr("scanweld.cluster.task.run_sequence", lambda *_, **__: 1 / 0)
        assert run_task(task_of(desk, tmp_path), "b").reason == "ZeroDivisionError: division by zero"


class TestUrls:
    @pytest.mark.parametrize("kind", ["memory", "file"])
    def test_a_run_between_urls(self, desk: Path, tmp_path: Path, bucket: Any, kind: str) -> None:
        """The same as between paths: the run folder is whole, and is not made again."""
        if kind == "memory":
            bucket.put(str(desk), "/lab/desk", recursive=True)
            source, out = "memory://lab/desk", "memory://lab/runs"
        else:
            source, out = desk.as_uri(), (tmp_path / "uploaded").as_uri()
        outcome = run_task(task_of(source, out), "b")
        assert (outcome.state, outcome.reason) == (State.DONE, run_task(task_of(desk, tmp_path / "here"), "b").reason)
        listing = list_files(f"{out}/desk")
        local = {
            path.relative_to(tmp_path / "here/desk").as_posix() for path in (tmp_path / "here/desk").rglob("*.txt")
        }
        assert {name for name in listing.sizes if name.endswith(".txt")} == local
        files, root = fsspec.core.url_to_fs(f"{out}/desk")
        noted = json.loads(files.cat_file(f"{root}/run.json"))
        assert noted["input"] == source
        assert noted["files"]["number"] == len(list_files(str(desk)).sizes)
        assert files.exists(f"{root}/map.ply")
        assert not files.exists(f"{root}/{run_folders.UPLOADING}")
        assert run_task(task_of(source, out), "b").state is State.KEPT
        assert run_task(task_of(source, out, force=True), "b").state is State.DONE

    def test_what_no_reader_opens_is_not_fetched(self, desk: Path, bucket: Any, tmp_path: Path) -> None:
        bucket.put(str(desk), "/lab/desk", recursive=True)
        bucket.pipe_file("/lab/desk/recording.bag", b"beside its images")
        with Copies(tmp_path).local(list_files("memory://lab/desk")) as place:
            names = {path.name for path in place.rglob("*")}
        assert place.name == "desk"
        assert names >= {"camera.json", "groundtruth.txt"}
        assert not names & {"model.ply", ".hidden", "recording.bag"}

    def test_copies_of_a_sweep_are_made_once(self, desk: Path, bucket: Any, tmp_path: Path) -> None:
        """A copy stays for the next task of the same sequence, and goes when another sequence is fetched."""
        for name in ("one", "two"):
            bucket.put(str(desk), f"/lab/{name}", recursive=True)
        copies, one, two = Copies(tmp_path), list_files("memory://lab/one"), list_files("memory://lab/two")
        with copies.local(one) as first:
            marker = first / "marker"
            marker.touch()
            with copies.local(two) as other:
                assert first.exists()
                assert other.exists()
        with copies.local(one) as again:
            assert (again, marker.exists()) == (first, True)
            assert not other.exists()

    def test_a_file_that_arrives_short_is_told(self, desk: Path, bucket: Any, tmp_path: Path) -> None:
        bucket.put(str(desk), "/lab/desk", recursive=True)
        listing = list_files("memory://lab/desk")
        bucket.pipe_file("/lab/desk/camera.json", b"{}")  # it was replaced meanwhile
        expected = f"camera.json: 2 bytes arrived of {listing.sizes['camera.json']}"
        with pytest.raises(DatasetError, match=expected), Copies(tmp_path).local(listing):
            pass
        assert [path for path in tmp_path.rglob("*") if path.is_file()] == []

    def test_names_stay_within_the_folder(self, bucket: Any, tmp_path: Path) -> None:
        bucket.store["/lab/desk/../../evil"] = bucket.open("/x", "wb")
        with pytest.raises(DatasetError, match="leaves the sequence folder"):
            list_files("memory://lab/desk")

    @pytest.mark.parametrize("place", ["memory://lab/nothing", "nowhere", "file:///no/such/folder"])
    def test_nothing_there(self, place: str, bucket: Any) -> None:
        with pytest.raises(DatasetError, match="no such"):
            list_files(place)

    def test_a_storage_that_nobody_knows(self) -> None:
        with pytest.raises(InvalidInputError, match=r"nosuch://x: no storage that fsspec knows"):
            list_files("nosuch://x")

    def test_half_an_upload_is_no_run(self, desk: Path, bucket: Any, tmp_path: Path, monkeypatch: Any) -> None:
        """An upload that fails in the middle, over a finished run, leaves no run.json; the next one mends it."""
        out = "memory://lab/runs"
        run_task(task_of(desk, out), "b")
        real = type(bucket).put_file

        def put_file(self: Any, source: str, target: str, **options: Any) -> None:
            if target.endswith("map.ply"):
                raise ConnectionResetError("connection reset")
            real(self, source, target, **options)

        monkeypatch.setattr(type(bucket), "put_file", put_file)
        failed = run_task(task_of(desk, out, force=True), "b")
        assert (failed.state, failed.reason) == (State.FAILED, f"{out}/desk: connection reset")
        assert not bucket.exists("/lab/runs/desk/run.json")
        monkeypatch.undo()
        assert run_task(task_of(desk, out), "b").state is State.DONE
        assert bucket.exists("/lab/runs/desk/run.json")

    def test_folders_of_others_are_left_alone(self, desk: Path, bucket: Any) -> None:
        bucket.pipe_file("/lab/runs/desk/thesis.tex", b"years of work")
        outcome = run_task(task_of(desk, "memory://lab/runs"), "b")
        assert "no run folder" in outcome.reason
        assert bucket.cat_file("/lab/runs/desk/thesis.tex") == b"years of work"
        assert bucket.ls("/lab/runs/desk", detail=False) == ["/lab/runs/desk/thesis.tex"]

    def test_without_fsspec_the_extra_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "fsspec.core", None)
        with pytest.raises(sw.errors.MissingDependencyError, match=r"fsspec.*pip install 'scanweld\[cluster\]'"):
            list_files("memory://lab")


METRICS = {
    "frames": 1508, "frames_tracked": 1500, "loop_closures": 12, "ate_rmse_m": 0.0123, "fps": 31.4,
    "seconds_total": 61.2,
}  # fmt: skip


@pytest.fixture
def ended(tmp_path: Path) -> tuple[list[RunTask], list[Outcome]]:
    """Tasks with long names and evil ones, and an outcome of each kind."""
    places = [f"a/{'corridor_' * 6}kinect", "a/desk", "a/<script>alert(1)</script>", "a/room", "a/stairs"]
    tasks = plan_batch(places, str(tmp_path), RunInput(""), configure, sweeps=["seed=3"])
    return tasks, [
        Outcome(0, State.DONE, "trustworthy", "All frames were aligned.", METRICS, 0, 70.0, "host", "0.1.0"),
        Outcome(
            1, State.KEPT, "doubtful", "Lost for a while.", METRICS | {"ate_rmse_m": None}, 1, 0.1, "host", "0.1.0"
        ),
        Outcome(2, State.FAILED, reason="<b>no</b> such folder"),
        Outcome(3, State.INTERRUPTED),
        Outcome(4, State.DONE, "untrustworthy", "The camera was lost.", METRICS, 0, 70.0, "host", "0.1.0"),
    ]


class TestTable:
    @pytest.mark.parametrize("columns", [40, 60, 80, 120])
    def test_fits(self, ended: tuple[list[RunTask], list[Outcome]], columns: int) -> None:
        head, *rows = table_lines(*ended, columns)
        assert max(map(len, [head, *rows])) <= columns
        assert [row.split()[1] for row in rows] == ["good", "doubtful*", "failed", "interrupted", "bad"]
        assert "ATE" in head
        assert rows[0].startswith("corridor")
        assert ("time" in head) == (columns >= 80)

    def test_parquet_has_all_of_it(self, ended: tuple[list[RunTask], list[Outcome]], tmp_path: Path) -> None:
        rows = rows_of(*ended)
        write_table(rows, str(tmp_path / "batch.parquet"))
        table = pq.read_table(tmp_path / "batch.parquet")
        assert table.column("run").to_pylist() == [task.name for task in ended[0]]
        assert table.column("seed").to_pylist() == [3] * 5
        assert table.column("ate_rmse_m").to_pylist() == [0.0123, None, None, None, 0.0123]
        assert table.column("reason").to_pylist()[2] == "<b>no</b> such folder"

    def test_parquet_of_failures_alone(self, ended: tuple[list[RunTask], list[Outcome]], tmp_path: Path) -> None:
        write_table(rows_of(ended[0][2:3], ended[1][2:3]), str(tmp_path / "new" / "batch.parquet"))
        assert pq.read_table(tmp_path / "new" / "batch.parquet").num_rows == 1

    def test_a_place_that_cannot_be_written(self, ended: tuple[list[RunTask], list[Outcome]], tmp_path: Path) -> None:
        (tmp_path / "batch.parquet").mkdir()
        with pytest.raises(OutputError, match=r"batch\.parquet"):
            write_table(rows_of(*ended), str(tmp_path / "batch.parquet"))
        (tmp_path / "file").touch()
        with pytest.raises(OutputError, match=r"batch\.parquet: cannot be written: File exists"):
            write_table(rows_of(*ended), str(tmp_path / "file" / "batch.parquet"))


class TestPage:
    def test_tells_what_is_to_be_known(self, ended: tuple[list[RunTask], list[Outcome]]) -> None:
        page = make_batch_page("runs", rows_of(*ended), ["seed"], 3700.0)
        assert "Interrupted: 4 of 5 runs ended, 2 of them can be trusted" in page
        assert "The same command goes on from here." in page
        assert unescape(page).count("<b>no</b> such folder") == 2  # at the top, and in the table
        for text in ("Settings compared", "12.3 mm", "1,500 of 1,508", "62 min", "not run again"):
            assert text in page

    @pytest.mark.parametrize(
        ("kinds", "headline", "level"),
        [
            ([0, 1], "All of 2 runs can be trusted", "trustworthy"),
            ([0, 2], "1 of 2 runs can be trusted", "doubtful"),
            ([2, 4], "None of 2 runs can be trusted", "untrustworthy"),
            ([1], "The run can be trusted", "trustworthy"),
            ([4], "The run cannot be trusted", "untrustworthy"),
            ([3], "Interrupted before the run ended", "doubtful"),
            ([3, 3], "Interrupted before any of 2 runs ended", "doubtful"),
            ([2, 3], "Interrupted: 1 of 2 runs ended, none of them can be trusted", "doubtful"),
        ],
    )
    def test_headline(
        self, kinds: list[int], headline: str, level: str, ended: tuple[list[RunTask], list[Outcome]]
    ) -> None:
        rows = rows_of(*ended)
        page = make_batch_page("runs", [rows[kind] for kind in kinds], [], 1.0)
        assert f"</span>{headline}</h2>" in page
        assert f'<section class="verdict {level}"' in page
        assert ("The same command goes on from here." in page) == (3 in kinds)
        assert '<span class="why">interrupted</span>' not in page

    def test_texts_of_runs_are_only_texts(self, ended: tuple[list[RunTask], list[Outcome]]) -> None:
        rows = [dict(row, run="<script>alert(1)</script>", input="<i>") for row in rows_of(*ended)]
        page = make_batch_page("<img src=x>", rows, [], 1.0)
        assert "<script>alert" not in page
        assert "<b>no</b>" not in page
        assert "<img src=x>" not in page
        assert "<b>no</b> such folder" in unescape(page)

    def test_without_truth_and_without_sweep(self, ended: tuple[list[RunTask], list[Outcome]]) -> None:
        rows = [dict(row, ate_rmse_m=None) for row in rows_of(*ended)]
        page = make_batch_page("runs", rows, [], 1.0)
        assert "ATE" not in page
        assert '<section id="settings" aria-labelledby="settings-title" hidden>' in page


class TestCommand:
    @pytest.mark.parametrize("package", ["distributed", "pyarrow"])
    def test_what_is_not_installed_is_named(
        self, package: str, desk: Path, monkeypatch: Any, capsys: Any, tmp_path: Path
    ) -> None:
        """Before anything is run."""
        monkeypatch.setitem(sys.modules, package, None)
        assert run(["batch", str(desk), "--out", str(tmp_path / "runs")]) == 1
        assert capsys.readouterr().err == (
            f"error: this needs {package}, which is not installed: pip install 'scanweld[cluster]'\n"
        )
        assert not (tmp_path / "runs").exists()

    @pytest.mark.parametrize(
        ("arguments", "told"),
        [
            (["--sweep", "tracking.stable_fractoin=1,2"], "did you mean 'tracking.stable_fraction'"),
            (["--sweep", "seed"], "expected key=value,value"),
            (["--memory", "plenty"], "expected for example 4GB"),
            (["--scheduler", "tcp://127.0.0.1:1", "--workers", "2"], "has workers of its own"),
        ],
    )
    def test_what_is_wrong_is_told_before_anything_runs(
        self, arguments: list[str], told: str, desk: Path, tmp_path: Path, capsys: Any
    ) -> None:
        assert run(["batch", str(desk), "--out", str(tmp_path / "runs"), *arguments]) == 1
        assert told in capsys.readouterr().err.splitlines()[-1]
        assert not (tmp_path / "runs").exists()

    def test_a_place_where_nothing_can_be_written_is_told_before_anything_runs(
        self, desk: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
    ) -> None:
        def refuse(*_: object, **__: object) -> None:
            raise PermissionError(errno.EACCES, "Permission denied")

        def told(place: Path) -> str:
            assert run(["batch", str(desk), "--out", str(place)]) == 1
            return str(capsys.readouterr().err)

        monkeypatch.setattr("scanweld.cluster.batch.run_batch", lambda *_: pytest.fail("begins to work"))
        file = tmp_path / "file"
        file.write_text("mine")
        assert told(file) == f"error: {file}: exists and is a file; choose another --out\n"
        assert (
            told(file / "runs") == f"error: {file / 'runs'}: cannot be written: Not a directory; choose another --out\n"
        )
        monkeypatch.setattr("tempfile.mkdtemp", refuse)
        for name in ("runs", "."):
            assert "cannot be written: Permission denied; choose another --out\n" in told(tmp_path / name)
        assert [path.name for path in tmp_path.iterdir()] == ["file"]

    def test_progress_in_a_pipe(self, capsys: Any) -> None:
        """A line for each that ended; word of what was before, which comes late, is not taken in."""
        with BatchProgress(["desk", "room"]) as progress:
            progress.working(0, {"doing": "opening"})
            progress.ended(Outcome(0, State.DONE, "trustworthy", "All is well."))
            progress.working(0, {"frame": 3, "total": 9})
            progress.ended(Outcome(1, State.FAILED, reason="room: no such folder"))
        assert capsys.readouterr().err.splitlines() == [
            "1/2  desk  trustworthy", "2/2  room  failed: room: no such folder"
        ]  # fmt: skip
