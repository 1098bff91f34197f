"""What a killed process left: taken away or put back by the next one, unless somebody is still at work on it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from scanweld.io import leftovers
from scanweld.io.atomic import check_writable, write_file, write_folder
from scanweld.runs import folder as runs

KIND = {"force": True, "kind": "thing", "mark": "mark"}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def make(folder: Path, *files: str) -> Path:
    folder.mkdir()
    for name in files:
        (folder / name).write_text(name)
    return folder


class TestCleared:
    def test_files_and_folders(self, tmp_path: Path) -> None:
        make(tmp_path / ".run.part-a1b2c3_8", "map.ply")
        make(tmp_path / ".run.part-a1b2c3_8.old", "map.ply")
        (tmp_path / ".run.part-00000000").write_text("")
        leftovers.clear(tmp_path / "run")
        assert names(tmp_path) == set()

    def test_nothing_else(self, tmp_path: Path) -> None:
        kept = {
            ".run.settings",
            ".run.part-notes",
            ".run.part-a1b2c3d4.txt",
            ".runs.part-a1b2c3d4",
            "run.part-a1b2c3d4",
        }
        for name in kept:
            make(tmp_path / name)
        leftovers.clear(tmp_path / "run")
        assert names(tmp_path) == kept

    def test_a_link_is_not_followed(self, tmp_path: Path) -> None:
        elsewhere = make(tmp_path / "elsewhere", "precious")
        (tmp_path / ".run.part-a1b2c3d4").symlink_to(elsewhere)
        leftovers.clear(tmp_path / "run")
        assert names(elsewhere) == {"precious"}

    def test_what_is_being_written_stays(self, tmp_path: Path) -> None:
        part = make(tmp_path / ".run.part-a1b2c3d4")
        with leftovers.held(part):
            leftovers.clear(tmp_path / "run")
            assert part.exists()
        leftovers.clear(tmp_path / "run")
        assert not part.exists()

    def test_before_a_file_is_written(self, tmp_path: Path) -> None:
        (tmp_path / ".map.ply.part-a1b2c3d4").write_text("half")
        write_file(tmp_path / "map.ply", b"whole")
        assert names(tmp_path) == {"map.ply"}

    def test_before_a_folder_is_written(self, tmp_path: Path) -> None:
        make(tmp_path / ".run.part-a1b2c3d4", "map.ply")
        check_writable(tmp_path / "run", **KIND)
        assert names(tmp_path) == set()

    def test_two_writers_leave_each_other_alone(self, tmp_path: Path) -> None:
        with write_folder(tmp_path / "run", **KIND) as aside:
            (aside / "mark").write_text("first")
            with write_folder(tmp_path / "run", **KIND) as other:
                (other / "mark").write_text("second")
        assert (tmp_path / "run" / "mark").read_text() == "first"
        assert names(tmp_path) == {"run"}


class TestPutBack:
    def test_between_the_two_renames(self, tmp_path: Path) -> None:
        make(tmp_path / ".run.part-a1b2c3d4", "mark")
        make(tmp_path / ".run.part-a1b2c3d4.old", "mark", "old")
        check_writable(tmp_path / "run", **KIND)
        assert names(tmp_path) == {"run"}
        assert (tmp_path / "run" / "old").exists()

    def test_not_what_is_none_of_ours(self, tmp_path: Path) -> None:
        make(tmp_path / ".run.part-a1b2c3d4.old", "letter")
        leftovers.put_back(tmp_path / "run", ["mark"])
        assert not (tmp_path / "run").exists()

    def test_not_over_something(self, tmp_path: Path) -> None:
        make(tmp_path / "run", "mark", "new")
        make(tmp_path / ".run.part-a1b2c3d4.old", "mark")
        check_writable(tmp_path / "run", **KIND)
        assert (tmp_path / "run" / "new").exists()
        assert names(tmp_path) == {"run"}

    def test_a_run_killed_before_its_first_checkpoint_begins_again(self, tmp_path: Path) -> None:
        make(tmp_path / "run", f".{runs.CHECKPOINT}.part-a1b2c3d4")
        runs.check_writable(tmp_path / "run", force=False, resume=True)
        assert names(tmp_path / "run") == set()


KILLED_AT = """
import os, pathlib, shutil, sys
from pathlib import Path
from scanweld.io import atomic
folder, step, calls = Path(sys.argv[1]), int(sys.argv[2]), []

def dying(call):
    def counted(*arguments, **options):
        if len(calls) == step:
            os._exit(9)
        calls.append(call)
        return call(*arguments, **options)
    return counted

with atomic.write_folder(folder, force=True, kind="thing", mark="mark") as aside:
    (aside / "mark").write_text("")
    (aside / "new").write_text("")
    Path.rename, shutil.rmtree = dying(Path.rename), dying(shutil.rmtree)
"""


@pytest.mark.parametrize("step", range(5))
def test_killed_at_every_step_of_taking_its_place(step: int, tmp_path: Path) -> None:
    """The old one moves away, the new one in, the old one out of the way of being put back, and is deleted.

    Killed before the first, second, .. of these steps and after the last: there is the old folder or the new one, and
    after the next look nothing else.
    """
    make(tmp_path / "run", "mark", "old")
    command = [sys.executable, "-c", KILLED_AT, str(tmp_path / "run"), str(step)]
    assert subprocess.run(command, check=False).returncode == 9
    check_writable(tmp_path / "run", **KIND)
    assert names(tmp_path) == {"run"}
    assert names(tmp_path / "run") == {"mark", "old" if step < 2 else "new"}


def test_places_that_cannot_be_looked_at(tmp_path: Path) -> None:
    leftovers.clear(tmp_path / "absent" / "run")
    leftovers.put_back(tmp_path / "absent" / "run", ["mark"])
    with leftovers.held(tmp_path / "absent"):
        assert os.listdir(tmp_path) == []
