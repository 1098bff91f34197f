"""The configuration of a run, with what differs from the defaults."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

_ABSENT = object()


@dataclass(frozen=True, slots=True)
class Difference:
    """A setting that is not the default; `default` is None where this version does not know it."""

    key: str
    value: Any
    default: Any


def find_differences(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> list[Difference]:
    """Return the settings of a run that differ from the defaults, by their dotted names."""
    known = dict(_flat(defaults))
    return [Difference(key, value, known.get(key)) for key, value in _flat(values) if known.get(key, _ABSENT) != value]


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def marked_toml(text: str, differences: list[Difference]) -> str:
    """Return TOML as HTML: comments muted, lines that differ from the defaults marked."""
    changed = {difference.key for difference in differences}
    section, lines = "", []
    for line in text.splitlines():
        stripped = line.strip()
        if stripped.startswith("#"):
            lines.append(f'<span class="comment">{escape(line)}</span>')
            continue
        if stripped.startswith("[") and stripped.endswith("]"):
            section = stripped.strip("[]") + "."
        key = section + stripped.partition("=")[0].strip()
        lines.append(f"<mark>{escape(line)}</mark>" if "=" in stripped and key in changed else escape(line))
    return "\n".join(lines)


def default_values(toml: str) -> Mapping[str, Any]:
    """Return the values of a configuration that was written as TOML, in the types that a file gives."""
    return tomllib.loads(toml)
