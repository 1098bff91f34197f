"""A recording and a run behind URLs, in fragments: nothing but URLs goes between the tasks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import scanweld as sw
from rendered import rendered, write_tum_folder
from scanweld.cli import app as command_line
from scanweld.runs.fragments import making
from scanweld.runs.fragments.exchange import ENDING, Exchange
from scanweld.runs.fragments.making import Workplace, left_unfit
from scanweld.runs.fragments.run import run_fragments
from scanweld.runs.input import RunInput
from scanweld.runs.reopen import reopen_input
from scanweld.runs.repeat import repeat_run
from scanweld.runs.storage.recordings import HELD, local_place
from scanweld.slam.parts import FragmentConfig, Part

CONFIG = sw.SlamConfig(fragments=FragmentConfig(overlap=12))
FILES = ("map.ply", "trajectory.txt", "keyframes.csv", "groundtruth.txt")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A half of the way around the room, in the layout of TUM RGB-D."""
    return write_tum_folder(
        tmp_path_factory.mktemp("lab") / "room", rendered("room", "kinect", 96, "sweep").part(0, 60)
    )


@pytest.fixture(scope="module")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of two fragments on a disk."""
    folder = tmp_path_factory.mktemp("fragments") / "run"
    run_fragments(RunInput(str(room)).open, 2, CONFIG, out=folder)
    return folder


def test_same_bytes_behind_urls(
    room: Path, run: Path, bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The storage breaks down after the first fragment; the same call with `resume` makes the second one alone."""
    bucket.put(str(room), "/lab/room", recursive=True)
    recording, out = RunInput("memory://lab/room"), "memory://lab/runs/room"
    usual, made = making.process_all, []

    def process_all(slam: sw.Slam, sequence: sw.RgbdSequence, *arguments: object, **options: object) -> None:
        made.append(float(sequence.timestamps_s[0]))
        if len(made) == 2:
            raise sw.DatasetError("the storage is gone")
        usual(slam, sequence, *arguments, **options)

    monkeypatch.setattr(making, "process_all", process_all)
    with pytest.raises(sw.DatasetError, match="the storage is gone"):
        run_fragments(recording.open, 2, CONFIG, out=out)
    assert not bucket.exists("/lab/runs/room")
    with pytest.raises(sw.OutputError, match="holds 1 finished fragment of a run that was interrupted; --resume"):
        run_fragments(recording.open, 2, CONFIG, out=out)
    summary = run_fragments(recording.open, 2, CONFIG, out=out, resume=True, description=recording.described())
    assert made[1:] == [made[1]] * 2
    assert summary.folder is None
    for name in FILES:
        assert bucket.cat_file(f"/lab/runs/room/{name}") == (run / name).read_bytes()
    assert json.loads(bucket.cat_file("/lab/runs/room/run.json"))["input"] == "memory://lab/room"
    assert not bucket.exists(f"/lab/runs/room{ENDING}")
    with pytest.raises(sw.OutputError, match="runs/room: exists and is not empty; --force"):
        run_fragments(recording.open, 2, CONFIG, out=out)
    bucket.get("/lab/runs/room", str(tmp_path / "fetched"), recursive=True)
    assert repeat_run(tmp_path / "fetched", tmp_path / "again").identical  # from the recording behind its URL


def test_workers_that_share_nothing_but_urls(
    room: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = (tmp_path / "runs/room").as_uri()
    given = ["--fragments", "2", "--workers", "2", "--set", "fragments.overlap=12"]
    assert command_line.run(["slam", room.as_uri(), "--out", out, *given]) == 0
    assert f"written  {out}" in capsys.readouterr().out
    for name in FILES:
        assert (tmp_path / "runs/room" / name).read_bytes() == (run / name).read_bytes()
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["room"]


def test_a_recording_behind_a_url_in_one_piece(
    room: Path, bucket: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bucket.put(str(room), "/lab/room", recursive=True)
    given = ["slam", "memory://lab/room", "--frames", "0:6"]
    assert command_line.run([*given, "--out", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run/run.json").read_text())["input"] == "memory://lab/room"
    assert command_line.run(["repeat", str(tmp_path / "run"), "--out", str(tmp_path / "again")]) == 0
    with pytest.raises(sw.DatasetError, match="is not on this machine: memory://lab/room"):
        reopen_input(json.loads((tmp_path / "run/run.json").read_text()))  # nobody asked for it to be fetched
    assert command_line.run([*given, "--out", "memory://lab/run"]) == 2
    assert "--out: a URL is for --fragments" in capsys.readouterr().err
    assert command_line.run(["slam", "memory://lab/nothing"]) == 1
    assert "memory://lab/nothing: no such folder" in capsys.readouterr().err


def test_what_somebody_else_has_behind_a_url_is_left_alone(room: Path, bucket: Any) -> None:
    bucket.pipe_file(f"/lab/run{ENDING}/thesis.txt", b"years of work")
    with pytest.raises(sw.OutputError, match="something else than fragments"):
        run_fragments(RunInput(str(room)).open, 2, CONFIG, out="memory://lab/run", force=True)
    assert bucket.cat_file(f"/lab/run{ENDING}/thesis.txt") == b"years of work"


def test_what_is_left_of_something_else_is_looked_at_and_not_kept(bucket: Any) -> None:
    """A fragment that is made in its place has the same name."""
    place, name = Workplace(Exchange("memory://lab/run.fragments"), CONFIG), "fragment-0000/fragment.swc"
    bucket.pipe_file(f"/lab/run.fragments/{name}", b"of something else")
    assert left_unfit(place, rendered(count=40), [Part(0, 0, 5, 0)]) == [0]
    bucket.pipe_file(f"/lab/run.fragments/{name}", b"made anew")
    assert place.exchange.read(name).read_bytes() == b"made anew"


def test_copies_of_recordings_do_not_pile_up(room: Path, bucket: Any) -> None:
    places = []
    for k in range(HELD + 2):
        bucket.put(str(room / "camera.json"), f"/lab/{k}/camera.json")
        places.append(Path(local_place(f"memory://lab/{k}")))
    assert local_place(f"memory://lab/{HELD + 1}") == str(places[-1])
    assert [place.exists() for place in places[-HELD:]] == [True] * HELD
    assert not places[0].exists()


def test_files_of_another_run_are_not_taken_for_those_of_this_one(bucket: Any) -> None:
    """Two runs one after the other with the same names, in one process."""
    for content in ("one", "two"):
        exchange = Exchange("memory://lab/run")
        with exchange.written("fragment-0000/fragment.swc") as path:
            path.write_text(content)
        elsewhere = Exchange(exchange.place)  # another process has other copies
        assert elsewhere.read("fragment-0000/fragment.swc").read_text() == content
    with pytest.raises(sw.FileFormatError, match="no such file"):
        exchange.read("fragment-0001/fragment.swc")
