"""Completion in the shell, and the examples that the help of every command shows."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from scanweld.cli.app import app
from scanweld.cli.completion import formats, noises, scenes, slam_settings
from scanweld.cli.examples import EXAMPLES

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def scanweld(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "scanweld", *arguments],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
        env={**os.environ, "COLUMNS": "100", "TERM": "dumb", **environment},
    )  # fmt: skip


def completed(line: str) -> list[str]:
    """Return what the script of bash gets for a line whose last word is to be completed."""
    last = str(len(line.split(" ")) - 1)
    done = scanweld(_SCANWELD_COMPLETE="complete_bash", COMP_WORDS=line, COMP_CWORD=last)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_a_script(shell: str) -> None:
    done = scanweld("completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"_SCANWELD_COMPLETE=complete_{shell}" in done.stdout
    assert "scanweld" in done.stdout.splitlines()[-1]


def test_a_command_is_completed() -> None:
    assert set(completed("scanweld re")) == {"register", "render", "repeat", "report"}


def test_options_and_their_values_are_completed() -> None:
    assert "--format" in completed("scanweld slam --fo")
    assert completed("scanweld slam --format sca") == ["scannet"]
    assert completed("scanweld register --method g") == ["gicp"]
    assert completed("scanweld slam --set tracking.stable") == ["tracking.stable_fraction=1.0"]


def test_values_are_those_that_the_commands_take() -> None:
    """Formats begin with auto, settings are KEY=DEFAULT as `--set` takes them, each with a word on what it is."""
    from scanweld.cli.slam import load_config
    from scanweld.slam.config import SlamConfig

    assert next(name for name, _ in formats("")) == "auto"
    assert scenes("twin") == ["twin-rooms"]
    assert noises("k") == ["kinect"]
    settings = slam_settings("")
    assert len(settings) > 50
    assert all(doc for _, doc in settings)
    assert load_config(None, [text for text, _ in settings]) == SlamConfig()


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_with_the_script(tmp_path: Path) -> None:
    """The script is read by a real bash, and its function fills in what was begun."""
    program = tmp_path / "scanweld"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m scanweld "$@"\n')
    program.chmod(0o755)
    script = """
        eval "$(scanweld completion bash)"
        COMP_WORDS=(scanweld eval) COMP_CWORD=1
        $(complete -p scanweld | sed 's/.*-F \\([^ ]*\\) .*/\\1/') scanweld
        echo "${COMPREPLY[@]}"
    """
    done = subprocess.run(
        ["bash", "--norc", "-c", script], capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )  # fmt: skip
    assert (done.stdout.strip(), done.stderr) == ("evaluate", "")


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_it_is_installed_for_the_shell_that_asks(tmp_path: Path) -> None:
    """The shell is found among the parents; its script lands in the home folder, and its start-up file reads it."""
    done = subprocess.run(
        ["bash", "--norc", "-c", f'"{sys.executable}" -m scanweld --install-completion && echo installed'],
        capture_output=True, text=True, check=False, env={**os.environ, "HOME": str(tmp_path)},
    )  # fmt: skip
    assert "installed" in done.stdout, done.stderr
    (script,) = [path for path in tmp_path.rglob("*") if path.is_file() and path.name.startswith("scanweld")]
    assert "_SCANWELD_COMPLETE=complete_bash" in script.read_text()
    assert script.name in (tmp_path / ".bashrc").read_text()


def test_every_command_has_examples() -> None:
    assert set(COMMANDS) == set(EXAMPLES)


@pytest.mark.parametrize("command", EXAMPLES)
def test_examples_are_shown_and_sound(command: str) -> None:
    """Each is one line of the help, and the parser takes it: options are spelt right, and values are of their kind."""
    lines = [line.strip() for line in scanweld(command, "--help", COLUMNS="80").stdout.splitlines()]
    for typed, what in EXAMPLES[command]:
        assert f"{typed}  # {what}" in lines
        words = shlex.split(typed.removeprefix('eval "$(').removesuffix(')"'))
        end = next((k for k, word in enumerate(words) if word in (">", "|")), len(words))
        assert words[0] == "scanweld"
        COMMANDS[words[1]].make_context(words[1], words[2:end])
