"""`scanweld evaluate` as a person types it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from scanweld.cli.app import run
from scanweld.geometry import se3
from scanweld.io.trajectory_files import write_redwood_log, write_tum
from scanweld.trajectory import Trajectory


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    """A truth along a curve, and an estimate in another world frame whose odd poses are 2 mm too high."""
    s = np.arange(20) / 10
    xi = np.column_stack([s, 0.5 * np.sin(3 * s), 0.1 * s, 0 * s, 0.2 * s, 0 * s])
    truth = Trajectory(np.arange(20) / 30, se3.exp(xi))
    T = truth.T_world_camera.copy()
    T[1::2, 2, 3] += 0.002
    moved = se3.exp(np.array([5, 1, 0, 0.3, 0.2, 0.1])) @ T
    write_tum(tmp_path / "estimate.txt", Trajectory(truth.timestamps_s + 0.001, moved))
    write_tum(tmp_path / "truth.txt", truth)
    return str(tmp_path / "estimate.txt"), str(tmp_path / "truth.txt")


def test_table(files: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    """Half of the poses 2 mm off, seen from their mean: 1 mm each (the rotation takes a little of it)."""
    assert run(["evaluate", *files]) == 0
    out, err = capsys.readouterr()
    assert "matched poses    20 of 20" in out
    assert "ATE rmse         0.99" in out or "ATE rmse         1.000 mm" in out
    assert "RPE translation  2.000 mm a frame" in out
    assert "RPE rotation     0.0000 degrees" in out
    assert err == ""


def test_json(files: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", *files, "--json"]) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out)
    assert err == ""
    assert {"ate_rmse_m", "ate_max_m", "rpe_trans_m", "rpe_rot_deg", "scale", "num_pairs"} <= set(figures)
    assert 0.0009 < figures["ate_rmse_m"] <= 0.001
    assert figures["rpe_trans_m"] == pytest.approx(0.002)
    assert figures["rpe_rot_deg"] == pytest.approx(0, abs=1e-5)
    assert figures["num_pairs"] == figures["num_poses"] == 20
    assert figures["scale"] == 1


@pytest.mark.parametrize("align", ["se3", "sim3", "none"])
def test_alignments(files: tuple[str, str], align: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", *files, "--align", align, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["ate_rmse_m"] > 1) == (align == "none"), "the world frames are metres apart"
    assert (figures["scale"] == 1) == (align != "sim3")


def test_plot_shows_both_panels(files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", *files, "--plot", str(tmp_path / "plot.png")]) == 0
    image = cv2.imread(str(tmp_path / "plot.png"))
    assert image.shape[1] > 1000
    for half in (image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]):
        assert (half.reshape(-1, 3) != 255).any(axis=1).mean() > 0.01, "a panel is empty"
    assert "plot.png" in capsys.readouterr().out


def test_one_pose_has_an_ate_but_no_rpe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = Trajectory(np.zeros(1), np.eye(4)[None])
    write_tum(tmp_path / "one.txt", one)
    path = str(tmp_path / "one.txt")
    assert run(["evaluate", path, path, "--json", "--plot", str(tmp_path / "p.png")]) == 0
    assert json.loads(capsys.readouterr().out)["rpe_trans_m"] is None
    assert run(["evaluate", path, path]) == 0
    out = capsys.readouterr().out
    assert "matched poses    1 of 1" in out
    assert "RPE translation  -\n" in out
    assert out.endswith("RPE rotation     -\n")


def test_formats_mix(files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from scanweld.io.trajectory_files import read_trajectory

    write_redwood_log(tmp_path / "truth.log.gz", read_trajectory(files[1]))
    assert run(["evaluate", files[0], str(tmp_path / "truth.log.gz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_pairs"] == 20


def test_errors_are_one_line(files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    late = tmp_path / "late.txt"
    late.write_text("9999 0 0 0 0 0 0 1\n")
    cases = [
        ([files[0], str(tmp_path / "none.txt")], "none.txt: no such file"),
        ([files[0], str(late)], "no timestamp of the estimate"),
        ([*files, "--plot", str(tmp_path / "no/folder.png")], "cannot be written"),
    ]
    for arguments, words in cases:
        assert run(["evaluate", *arguments]) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("error: ")
        assert words in err
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("plot.docx", "the name must end in .png or .pdf or .svg, got '.docx'"),
        ("plot.raw", "the name must end in .png or .pdf or .svg, got '.raw'"),
        ("plot", "the name must end in .png or .pdf or .svg, got a name without ending"),
        ("folder", "is a folder; the name of a file must end in .png or .pdf or .svg"),
        ("folder.png", "is a folder"),
    ],
)
def test_a_plot_that_cannot_be_is_told_before_any_work(
    tmp_path: Path, name: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither trajectory is there: had one been opened, that would be told instead."""
    for folder in ("folder", "folder.png"):
        (tmp_path / folder).mkdir()
    assert run(["evaluate", str(tmp_path / "a.txt"), str(tmp_path / "b.txt"), "--plot", str(tmp_path / name)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: --plot {tmp_path / name}: ")
    assert words in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "folder.png"]


def test_the_library_draws_the_documented_kinds_alone(files: tuple[str, str], tmp_path: Path) -> None:
    from scanweld.errors import OutputError
    from scanweld.evaluation.trajectory_metrics import ate
    from scanweld.evaluation.trajectory_plot import plot_trajectory_error
    from scanweld.io.trajectory_files import read_trajectory

    result = ate(read_trajectory(files[0]), read_trajectory(files[1]))
    for name in ("plot", "plot.raw"):
        with pytest.raises(OutputError, match=r"must end in \.png or \.pdf or \.svg"):
            plot_trajectory_error(result, tmp_path / name)
        assert list(tmp_path.glob("plot*")) == []


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", "--help"]) == 0
    out = capsys.readouterr().out
    for word in ("estimate", "--align", "--json", "--plot", "ATE"):
        assert word in out
