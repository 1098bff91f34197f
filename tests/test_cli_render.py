"""`scanweld render`: what is typed, what is written, and what wrong input gets."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from scanweld.cli.render import render
from scanweld.datasets.synthetic import PATHS, RenderConfig
from scanweld.errors import ScanweldError

app = typer.Typer()
app.command()(render)


def _run(*arguments: str) -> tuple[int, str]:
    """Exit code and standard output; a known error is raised, as the command table expects."""
    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    return result.exit_code, result.stdout


def test_a_sequence_is_written(tmp_path: Path) -> None:
    out = tmp_path / "new" / "sequence"
    code, text = _run("--out", str(out), "--frames", "2", "--size", "64x48", "--noise", "kinect", "--seed", "3")
    assert code == 0
    assert "2 frames of room-orbit-kinect, 64x48" in text
    assert len(list((out / "depth").glob("*.png"))) == 2
    with pytest.raises(ScanweldError, match="--force"):
        _run("--out", str(out), "--frames", "1", "--size", "64x48")
    code, _ = _run("--out", str(out), "--frames", "1", "--size", "64x48", "--force")
    assert code == 0
    assert len(list((out / "depth").glob("*.png"))) == 1


def test_a_path_file_is_followed(tmp_path: Path) -> None:
    path = tmp_path / "path.txt"
    path.write_text("\n".join(f"{t / 10} {t / 50} -1.3 0.5 0 0 0 1" for t in range(4)))
    _, text = _run("--out", str(tmp_path / "s"), "--path", str(path), "--fps", "10", "--size", "64x48")
    assert "4 frames of room-path, 64x48, 0.06 m of path" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--scene", "castle"), "expected one of room, corridor"),
        (("--path", "figure"), "orbit, sweep"),
        (("--path", "missing.txt"), "no such file"),
        (("--path-frame", "up"), "expected one of cv, icl"),
        (("--noise", "lidar"), "expected one of none, kinect, realsense"),
        (("--size", "0x480"), "width = 0"),
        (("--frames", "-1"), "frames = -1"),
    ],
)
def test_wrong_input_is_one_line_that_names_the_choices(
    tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ScanweldError) as caught:
        _run("--out", str(tmp_path / "s"), *arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "s").exists()


def test_the_help_names_the_defaults_and_choices_of_the_configuration() -> None:
    text = " ".join(CliRunner().invoke(app, ["--help"], env={"COLUMNS": "400", "TERM": "dumb"}).stdout.split())
    defaults = {f.name: f.default for f in dataclasses.fields(RenderConfig)}
    assert f"Default: {defaults['width']}x{defaults['height']}." in text
    assert f"Default: {defaults['fps']:g}." in text
    for key in ("scene", "noise", "path_frame", "seed"):
        assert f"Default: {defaults[key]}." in text
    for name in PATHS:
        assert name in text
    assert defaults["frames"] == 0
    assert "Default, or 0: one round" in text
