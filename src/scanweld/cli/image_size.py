"""Image sizes as they are typed."""

from __future__ import annotations

import re

from scanweld.errors import ConfigError


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of "640x480"; raises ConfigError."""
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None:
        raise ConfigError(f"size {text!r}: expected WIDTHxHEIGHT, for example 640x480")
    return int(match[1]), int(match[2])
