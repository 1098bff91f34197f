"""Shell completion: the script that a shell reads, and what options complete to beyond their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated, Any

import typer

PROGRAM, VARIABLE = "scanweld", "_SCANWELD_COMPLETE"


class Shell(StrEnum):
    """Shells that completion is for."""

    bash = "bash"
    zsh = "zsh"
    fish = "fish"


def completion(shell: Annotated[Shell, typer.Argument(help="The shell that is to complete.")]) -> int:
    """Print the script that lets a shell complete commands, options and values when Tab is pressed.

    scanweld --install-completion installs it for the shell that this is typed in.
    """
    from typer.completion import get_completion_script  # type: ignore[attr-defined]

    typer.echo(get_completion_script(prog_name=PROGRAM, complete_var=VARIABLE, shell=shell.value))
    return 0


def formats(incomplete: str) -> list[tuple[str, str]]:
    """Complete the name of a sequence format, with its layout."""
    from scanweld.datasets.open import FORMATS

    named = [("auto", "recognise it by its files"), *((row.name, row.layout) for row in FORMATS)]
    return [(name, layout) for name, layout in named if name.startswith(incomplete)]


def scenes(incomplete: str) -> list[str]:
    """Complete the name of a scene to render."""
    from scanweld.datasets.synthetic import SCENES

    return [name for name in SCENES if name.startswith(incomplete)]


def noises(incomplete: str) -> list[str]:
    """Complete the name of a noise model."""
    from scanweld.datasets.synthetic import NOISE_MODELS

    return [name for name in NOISE_MODELS if name.startswith(incomplete)]


def slam_settings(incomplete: str) -> list[tuple[str, str]]:
    """Complete KEY=VALUE for `slam --set`: the key with its default, and what it means."""
    from scanweld.slam.config import SlamConfig

    return [(f"{key}={value}", doc) for key, value, doc in _settings(SlamConfig()) if key.startswith(incomplete)]


def _settings(config: Any, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield key, default and meaning of every setting, also of nested ones."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{prefix}{item.name}.")
        elif isinstance(value, (bool, int, float, str)):
            text = str(value).lower() if isinstance(value, bool) else str(value)
            yield f"{prefix}{item.name}", text, item.metadata.get("doc", "")
