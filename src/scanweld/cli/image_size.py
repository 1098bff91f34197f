"""Image sizes as they are typed."""

from __future__ import annotations

import re

import typer


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of "640x480"; anything else is wrong usage."""
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None:
        raise typer.BadParameter(f"expected WIDTHxHEIGHT, for example 640x480, got {text!r}", param_hint="size")
    return int(match[1]), int(match[2])
