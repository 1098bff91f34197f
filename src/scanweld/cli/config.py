"""`scanweld config`: all settings with their meaning, and whether a file of them is sound."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from scanweld.cli.sequence_options import Overrides
from scanweld.errors import ConfigError


class Action(StrEnum):
    """What to do."""

    show = "show"
    check = "check"


def config(
    action: Annotated[Action, typer.Argument(help="show: print all settings; check: say whether a file is sound.")],
    file: Annotated[Path | None, typer.Argument(help="Settings that differ from the defaults.")] = None,
    overrides: Overrides = None,
) -> int:
    """Show every setting of `slam` as commented TOML, or check a file of settings.

    scanweld config show > my.toml writes a file to change and to pass on: scanweld slam SEQUENCE --config my.toml.
    """
    from scanweld.cli.slam import load_config
    from scanweld.config import to_toml

    if action is Action.check and file is None:
        raise ConfigError("config check: which file? For example: scanweld config check my.toml")
    settings = load_config(file, overrides or [])
    typer.echo(to_toml(settings) if action is Action.show else f"{file}: every setting is known and in range")
    return 0
