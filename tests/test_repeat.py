"""A run made again from its folder: the same to the byte, or what differs is named, and what may be why."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

import scanweld as sw
from rendered import rendered, write_tum_folder
from scanweld.backends import get_backend
from scanweld.cli.app import run
from scanweld.cli.progress import FrameProgress
from scanweld.cli.repeat import comparison_text
from scanweld.errors import DatasetError, FileFormatError, InvalidInputError, OutputError
from scanweld.runs.comparison import Comparison, compare_runs
from scanweld.runs.repeat import repeat_run

RESULTS = {"trajectory.txt", "map.ply", "keyframes.csv", "frames.csv", "metrics.json"}


@pytest.fixture(scope="module", autouse=True)
def without_pictures():
    """Pictures and pages take most of the time of a short run."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("write_renders", "write_report", "plot_tracking", "plot_trajectory_error"):
            patch.setattr(f"scanweld.runs.output.{name}", lambda *_, **__: None)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording and a run of it, made with all options that say where frames come from."""
    folder = tmp_path_factory.mktemp("made")
    recorded = write_tum_folder(folder / "recorded", rendered(noise="kinect", count=40).part(0, 12))
    options = ["--frames", "1:11", "--scale", "0.75", "--set", "tracking.stable_fraction=0.9", "--tracked-only"]
    assert run(["slam", str(recorded), "--out", str(folder / "run"), *options, "--camera", "131,131,79.5,59.5"]) == 0
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be spoilt."""
    shutil.copytree(made / "run", tmp_path / "run")
    return tmp_path / "run"


def change(path: Path, spoil: Callable[[dict[str, object]], object]) -> None:
    content = json.loads(path.read_text())
    spoil(content)
    path.write_text(json.dumps(content))


class TestRepeat:
    def test_same_to_the_byte(self, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["repeat", str(made / "run"), "--out", str(tmp_path / "again"), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["identical"], set(told["same"]), told["different"], told["causes"]) == (True, RESULTS, {}, [])
        again, first = (json.loads((place / "run.json").read_text()) for place in (tmp_path / "again", made / "run"))
        assert again["fingerprint"] == first["fingerprint"]
        assert again["repeats"] == str((made / "run").resolve())
        assert (tmp_path / "again" / "config.toml").read_bytes() == (made / "run" / "config.toml").read_bytes()

    def test_a_repetition_can_be_repeated(self, made: Path, tmp_path: Path) -> None:
        repeat_run(made / "run", tmp_path / "again")
        assert repeat_run(tmp_path / "again").identical

    def test_given_poses(self, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The file is found from any folder, and is noticed when it changes."""
        poses = tmp_path / "poses.txt"
        poses.write_bytes((made / "recorded" / "groundtruth.txt").read_bytes())
        monkeypatch.chdir(tmp_path)
        assert run(["slam", str(made / "recorded"), "--poses", "poses.txt", "--out", "run"]) == 0
        monkeypatch.chdir(made)
        assert repeat_run(tmp_path / "run").identical
        poses.write_text("\n".join(poses.read_text().splitlines()[:5]))
        with pytest.raises(DatasetError, match="input: given poses"):
            repeat_run(tmp_path / "run")

    def test_demo(self, tmp_path: Path) -> None:
        """Its sequence is rendered again."""
        assert run(["demo", "--frames", "2", "--out", str(tmp_path / "demo")]) == 0
        assert repeat_run(tmp_path / "demo").identical

    def test_what_the_frames_show_is_compared(self, made: Path, copy: Path) -> None:
        """One pixel of one frame by a millimetre."""
        shutil.copytree(made / "recorded", copy.parent / "recorded")
        change(copy / "run.json", lambda content: content.update(input=str(copy.parent / "recorded")))
        assert repeat_run(copy).identical  # it may lie elsewhere
        image = copy.parent / "recorded" / "depth" / "004.png"
        depth = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        depth[60, 80] += 5
        assert cv2.imwrite(str(image), depth)
        told = repeat_run(copy)
        assert len(told.causes) == 1
        assert told.causes[0].startswith("input: content ")

    def test_a_sequence_that_is_another_one_is_refused_before_it_is_run(self, made: Path, copy: Path) -> None:
        change(copy / "run.json", lambda content: content.update(frames="1:10"))
        with pytest.raises(DatasetError, match="input: number of frames 9, was 10; input: timestamps"):
            repeat_run(copy)
        for nowhere in (str(made / "nowhere"), "(" * 5000, ""):  # the second is longer than any name may be
            change(copy / "run.json", lambda content, place=nowhere: content.update(input=place))
            with pytest.raises(DatasetError, match="not there any more"):
                repeat_run(copy)

    @pytest.mark.parametrize(
        ("key", "message"), [("realtime", "real time"), ("interrupted", "has no checkpoint, .* --force` begins anew")]
    )
    def test_runs_without_a_second_time(self, copy: Path, key: str, message: str) -> None:
        change(copy / "run.json", lambda content: content.update({key: True}))
        with pytest.raises(InvalidInputError, match=message):
            repeat_run(copy)
        (copy / "checkpoint.swc").touch()
        with pytest.raises(InvalidInputError, match="real time" if key == "realtime" else "--resume` ends it first"):
            repeat_run(copy)

    def test_interruption_leaves_what_was_there(
        self, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Nothing where there was nothing, and with --force the run that was to be replaced."""
        update, command = FrameProgress.update, ["repeat", str(made / "run"), "--out", str(tmp_path / "again")]

        def ask(self: FrameProgress, result: sw.FrameResult) -> None:
            update(self, result)
            if result.index == 3:
                signal.raise_signal(signal.SIGINT)

        with monkeypatch.context() as patch:
            patch.setattr(FrameProgress, "update", ask)
            assert run(command) == 130
            assert list(tmp_path.iterdir()) == []
            assert capsys.readouterr().err.splitlines()[-1] == "interrupted"
        assert run(command) == 0
        with monkeypatch.context() as patch:
            patch.setattr(FrameProgress, "update", ask)
            assert run([*command, "--force"]) == 130
        assert compare_runs(tmp_path / "again", made / "run").identical
        assert [path.name for path in tmp_path.iterdir()] == ["again"]

    def test_interrupted_run_is_not_replaced_unasked(self, made: Path, tmp_path: Path) -> None:
        (tmp_path / "checkpoint.swc").touch()
        with pytest.raises(OutputError, match=r"was interrupted; --force replaces it, --out writes elsewhere"):
            repeat_run(made / "run", tmp_path)

    def test_not_over_itself(self, copy: Path) -> None:
        with pytest.raises(InvalidInputError, match="is the run that is to be repeated"):
            repeat_run(copy, copy, force=True)

    def test_backend_is_that_of_the_run(self, copy: Path) -> None:
        change(copy / "run.json", lambda content: content.update(backend="abacus"))
        with pytest.raises(InvalidInputError, match="abacus"):
            repeat_run(copy)
        assert get_backend() == "numba"


class TestComparison:
    def test_what_differs_is_named_and_what_may_be_why(
        self, made: Path, copy: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        lines = (copy / "trajectory.txt").read_text().splitlines()
        lines[3] = lines[3].replace(".", ".1", 1)
        (copy / "trajectory.txt").write_text("\n".join(lines) + "\n")
        change(copy / "metrics.json", lambda content: content.update(num_surfels=7, fps=1e9))
        change(copy / "run.json", lambda content: content["packages"].update(numba="0.1"))  # type: ignore[attr-defined]
        assert run(["repeat", str(copy)]) == 3
        told = capsys.readouterr().out
        assert "differs  trajectory.txt: from line 4\n" in told
        assert "differs  metrics.json: num_surfels " in told
        assert ", was 7\n" in told
        assert "fps" not in told
        assert "changed  numba " in told
        assert "was 0.1\n" in told
        assert told.endswith("verdict  not the same; what has changed since the run may be why\n")

    def test_maps_and_tables(self, made: Path, copy: Path) -> None:
        content = bytearray((copy / "map.ply").read_bytes())
        content[-1] ^= 1
        (copy / "map.ply").write_bytes(content)
        (copy / "map-1.ply").write_bytes(b"a submap")
        rows = (copy / "frames.csv").read_text().splitlines()
        (copy / "frames.csv").write_text("\n".join(rows[:-1]) + "\n")
        (copy / "groundtruth.txt").unlink()
        told = compare_runs(made / "run", copy)
        size = len(content)
        assert told.different == {
            "map.ply": f"from byte {size - 1} of {size}, was {size} bytes",
            "map-1.ply": f"there is none in {made / 'run'}",
            "frames.csv": "more than 9 frames",
        }
        assert told.causes == (f"input: the true poses differ there is none in {copy}",)

    def test_long_files(self, made: Path, copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The place is that of the file, also beyond the first part that is compared."""
        monkeypatch.setattr("scanweld.runs.comparison._PART", 1000)
        (copy / "map.ply").write_bytes((copy / "map.ply").read_bytes()[:2500])
        assert compare_runs(copy, made / "run").different["map.ply"].startswith("from byte 2500 of 2500, was ")

    def test_runs_of_earlier_versions(self, copy: Path) -> None:
        """They have no fingerprint: nothing is said of their input."""
        change(copy / "run.json", lambda content: [content.pop(key) for key in ("fingerprint", "processor")])
        told = repeat_run(copy)
        assert (told.identical, told.causes) == (True, ())

    def test_no_run(self, made: Path, tmp_path: Path) -> None:
        with pytest.raises(FileFormatError, match="not a run folder"):
            repeat_run(tmp_path)
        (tmp_path / "run.json").write_text("[]")
        with pytest.raises(FileFormatError, match="expected a JSON object"):
            repeat_run(tmp_path)

    def test_verdict_without_a_cause(self) -> None:
        told = comparison_text(Comparison((), {"map.ply": "from byte 1 of 2, was 2 bytes"}, ()))
        assert told.endswith("verdict  not the same, although input and program are")


def test_fingerprint_follows_a_resumed_run(tmp_path: Path) -> None:
    """The checksum goes on where the checkpoint is."""
    sequence, seen = rendered(noise="kinect", count=40).part(0, 6), []

    def stop(result: sw.FrameResult) -> None:
        if result.index == 2 and not seen:
            seen.append(result)
            signal.raise_signal(signal.SIGINT)

    sw.run_sequence(sequence, out=tmp_path / "part", progress=stop)
    sw.run_sequence(sequence, out=tmp_path / "part", resume=True)
    sw.run_sequence(sequence, out=tmp_path / "whole")
    prints = [json.loads((tmp_path / name / "run.json").read_text())["fingerprint"] for name in ("part", "whole")]
    assert prints[0] == prints[1]
    assert prints[0]["number of frames"] == 6
