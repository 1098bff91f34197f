"""The command line as it is met first: help, wrong usage, narrow terminals, pipes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer
import typer.main

from scanweld.cli.app import app, run
from scanweld.cli.usage import in_plain_words

OPTIONS = {
    "demo": "--out --frames --threads --force --json",
    "check": "--format --topics --camera --depth-scale --frames --json",
    "slam": "--out --format --camera --depth-scale --frames --scale --poses --config --set --threads --force --json "
    "--tracked-only --topics --refine --calibrate --realtime --resume --checkpoint-every --view --view-host "
    "--view-port --rerun --fragments --scheduler --workers",
    "batch": "--out --scheduler --workers --sweep --set --config --format --topics --camera --depth-scale --frames "
    "--scale --threads --memory --retries --checkpoint-every --force --json",
    "register": "--method --scale --init --global --voxel --max-distance --set --threads --explain --plot --out --json",
    "evaluate": "--align --json --plot",
    "render": "--out --scene --path --path-frame --noise --frames --size --fps --spoil --seed --force",
    "repeat": "--out --threads --force --json",
    "report": "--truth --out",
    "view": "--host --port",
    "mesh": "--out --voxel --frames --depth-max --fill-holes --from-surfels --splat --memory --threads --json",
    "bench": "--frames --sizes --peer-python --plot --threads --json",
    "warmup": "--json",
    "config": "--set",
    "datasets": "--format",
    "completion": "",
}
"""What every command offers."""


def scanweld(*arguments: str, columns: int = 100, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    plain = {key: value for key, value in os.environ.items() if key not in ("FORCE_COLOR", "NO_COLOR", "TERM")}
    return subprocess.run(
        [sys.executable, "-m", "scanweld", *arguments],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
        env={**plain, "COLUMNS": str(columns), "PYTHONIOENCODING": "utf-8", **environment},
    )  # fmt: skip


def test_every_command_is_covered_here() -> None:
    commands = {info.name or info.callback.__name__ for info in app.registered_commands if info.callback}
    assert commands == set(OPTIONS)


@pytest.mark.parametrize("columns", [40, 80, 100])
@pytest.mark.parametrize("command", OPTIONS)
def test_help_names_every_option(command: str, columns: int) -> None:
    """Options are spelt out at any width, since a name that is cut short cannot be typed."""
    done = scanweld(command, "--help", columns=columns)
    assert (done.returncode, done.stderr) == (0, "")
    assert set(OPTIONS[command].split()) <= set(re.findall(r"--[a-z-]+", done.stdout))


@pytest.mark.parametrize("command", OPTIONS)
def test_every_option_is_covered_here(command: str) -> None:
    parser = typer.main.get_command(app).commands[command]  # type: ignore[attr-defined]
    offered = {name for parameter in parser.params for name in parameter.opts if name.startswith("--")}
    assert offered - {"--help"} == set(OPTIONS[command].split())


def test_help_names_every_format() -> None:
    """The command line does not load the readers to show its help."""
    from scanweld.datasets.open import FORMATS

    shown = scanweld("slam", "--help", columns=200).stdout
    assert [row.name for row in FORMATS if row.name not in shown] == []


def test_help_fits_a_narrow_terminal() -> None:
    """Lines are wrapped at 50 columns, below which the parser does not go; panels would be cut at 40."""
    lines = scanweld("slam", "--help", columns=40).stdout.splitlines()
    assert max(len(line) for line in lines) <= 50
    assert not any("…" in line for line in lines)


def test_short_help_option() -> None:
    assert scanweld("slam", "-h").stdout == scanweld("slam", "--help").stdout


def test_alone_it_shows_help() -> None:
    done = scanweld()
    assert done.returncode in (0, 2)  # the parser's versions differ
    assert all(command in done.stdout + done.stderr for command in OPTIONS)
    assert "Traceback" not in done.stderr


def test_version() -> None:
    assert scanweld("--version").stdout == version("scanweld") + "\n"


@pytest.mark.parametrize("command", OPTIONS)
def test_unknown_option_is_usage(command: str) -> None:
    done = scanweld(command, "--no-such-option")
    assert (done.returncode, done.stdout) == (2, "")
    assert "--no-such-option" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "arguments", [["nope"], ["slam"], ["evaluate", "one"], ["demo", "--frames", "many"], ["demo", "--frames", "0"]]
)
def test_wrong_usage_exits_2(arguments: list[str]) -> None:
    done = scanweld(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("slam nowhere --frames a:b", "'--frames': expected A:B or A:B:STEP, for example 0:200 or 100::2, got 'a:b'"),
        ("slam nowhere --frames 5", "got '5'"),
        ("mesh nowhere --frames 0:x", "got '0:x'"),
        ("check nowhere --camera 1,2,3", "'--camera': expected FX,FY,CX,CY, for example"),
        ("batch nowhere --out no --topics /depth", "'--topics': expected depth=TOPIC"),
        ("slam nowhere --set seed=1 --set seed", "--set seed: expected key=value"),
        ("config show --set seed", "--set seed: expected key=value"),
        ("register a b --set kernel", "--set kernel: expected key=value"),
        ("register a b --voxel -1", "--voxel: expected a positive number of metres, got -1"),
        ("render --out no --size 640", "expected WIDTHxHEIGHT, for example 640x480, got '640'"),
        ("bench --sizes 64x48,80", "expected WIDTHxHEIGHT, for example 640x480, got '80'"),
    ],
)
def test_a_value_of_another_form_is_wrong_usage(
    arguments: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the files hold: none of those named is there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    assert run(arguments.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", ["slam nowhere --frames 0:5 --camera 1,2,3,4 --set seed=1", "mesh nowhere"])
def test_values_of_the_right_form_leave_the_error_to_the_files(
    arguments: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments.split()) == 1
    assert capsys.readouterr().err.startswith("error: nowhere: ")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["demo", "--frames", "many"], ["--frames", "many"]),
        (["slam", "room", "--scale", "half"], ["--scale", "half"]),
        (["demo", "--frames", "1"], ["--frames", "2"]),
        (["bench", "speed"], ["speed", "sizes", "stages"]),
    ],
)
def test_a_wrong_value_is_named(arguments: list[str], named: list[str]) -> None:
    told = scanweld(*arguments).stderr
    assert [word for word in named if word not in told] == []
    assert "Input should be" not in told
    assert "Value error" not in told


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"type": "int_parsing", "input": "many", "msg": "?"}, "expected a whole number, got 'many'"),
        ({"type": "float_parsing", "input": "half", "msg": "?"}, "expected a number, got 'half'"),
        ({"type": "greater_than_equal", "input": -1.5, "ctx": {"ge": 2}, "msg": "?"}, "expected 2 or more, got '-1.5'"),
        (
            {"type": "less_than_equal", "input": 70000, "ctx": {"le": 65535}, "msg": "?"},
            "expected 65535 or less, got '70000'",
        ),
        ({"type": "value_error", "input": "x", "msg": "Value error, 'x' is not one of 'a', 'b'"}, "'x' is not one of"),
    ],
)
def test_plain_words(fault: dict[str, object], words: str) -> None:
    class Invalid(Exception):
        """Looks as Pydantic's error does."""

        def errors(self) -> list[dict[str, object]]:
            return [fault]

    error = typer.BadParameter("?")
    error.__cause__ = Invalid()
    assert in_plain_words(error).message.startswith(words)
    assert in_plain_words(typer.BadParameter("as it is")).message == "as it is"


def test_paragraphs_are_broken_by_the_terminal_alone() -> None:
    for info in app.registered_commands:
        assert [part for part in info.help.split("\n\n") if "\n" in part or not part] == []
        assert info.help.split() == info.callback.__doc__.split()


@pytest.mark.parametrize("environment", [{"columns": 40, "NO_COLOR": "1"}, {"columns": 100, "TERM": "xterm-256color"}])
def test_a_pipe_gets_no_escape_codes(environment: dict[str, Any]) -> None:
    for arguments in (["slam", "--help"], ["slam", "--no-such-option"]):
        done = scanweld(*arguments, **environment)
        assert "\x1b" not in done.stdout + done.stderr


@pytest.mark.parametrize("arguments", ["--help", "slam --help", "datasets list"])
def test_a_closed_pipe_is_no_error(arguments: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "scanweld", *arguments.split()],
            stdout=writer, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, check=False,
        )  # fmt: skip
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")
