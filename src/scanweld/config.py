"""Configuration: frozen dataclasses in code, TOML in files; an unknown key is an error that names the nearest."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from scanweld.errors import ConfigError

T = TypeVar("T")


def setting(default: Any, doc: str, *, low: float | None = None, high: float | None = None) -> Any:
    """Declare a dataclass field with its documentation and allowed range (both ends included)."""
    return dataclasses.field(default=default, metadata={"doc": doc, "low": low, "high": high})


def section(factory: Callable[[], Any], doc: str) -> Any:
    """Declare a nested configuration."""
    return dataclasses.field(default_factory=factory, metadata={"doc": doc})


def check_ranges(config: Any) -> None:
    """Raise ConfigError when a field declared by :func:`setting` is out of its range; for `__post_init__`."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        low, high = item.metadata.get("low"), item.metadata.get("high")
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            bad = math.isnan(value) or (low is not None and value < low) or (high is not None and value > high)
            if bad:
                bounds = f"{'-inf' if low is None else low} to {'inf' if high is None else high}"
                raise ConfigError(f"{item.name} = {value}: expected a value from {bounds} ({item.metadata['doc']})")


def from_mapping(kind: type[T], values: Mapping[str, Any], where: str = "configuration", prefix: str = "") -> T:
    """Build the dataclass `kind` from nested mappings; absent keys keep their defaults.

    Parameters
    ----------
    kind : of the configuration
    values : nested by section
    where : what messages begin with: where the values are from
    prefix : what messages put before every key, where `kind` is itself a section

    Raises
    ------
    ConfigError
        On an unknown key (the message names the nearest one), a wrong type or a value out of range.
    """
    return _build(kind, values, where, prefix, lambda: list(_all_keys(kind, prefix)))


def _build(kind: type[T], values: Mapping[str, Any], where: str, prefix: str, all_keys: Callable[[], list[str]]) -> T:
    hints = get_type_hints(kind)
    known = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            shown = str(key)[:LONGEST_KEY]  # what is no key at all can be of any length
            raise ConfigError(f"{where}: unknown key '{prefix}{shown}'; {_advice(shown, known, prefix, all_keys())}")
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: '{prefix}{key}' is a section, got the value {value!r}")
            arguments[key] = _build(hint, value, where, f"{prefix}{key}.", all_keys)  # type: ignore[arg-type]
        else:
            arguments[key] = _checked(value, hint, f"{where}: '{prefix}{key}'")
    try:
        return kind(**arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}: {prefix}{error}") from None


def _all_keys(kind: Any, prefix: str) -> Iterator[str]:
    """Yield the dotted keys of a configuration and of its sections."""
    hints = get_type_hints(kind)
    for item in dataclasses.fields(kind):
        yield prefix + item.name
        if dataclasses.is_dataclass(hints[item.name]):
            yield from _all_keys(hints[item.name], f"{prefix}{item.name}.")


LONGEST_KEY = 80
"""So many characters of an unknown key are shown, and compared."""

SAME_KEY, SAME_KEY_HERE = 0.75, 0.5
"""A key may be meant that is at least so much like the given one: anywhere, and in the section where that was."""


def _advice(key: str, known: Collection[str], prefix: str, all_keys: Collection[str]) -> str:
    """Say which key may be meant: the nearest of its section, or nearer ones elsewhere; else what there is."""

    def likeness(name: str) -> float:
        return difflib.SequenceMatcher(None, key, name.rpartition(".")[2]).ratio()

    here = max((prefix + name for name in known), key=likeness)
    closest = max(map(likeness, all_keys))
    if likeness(here) < closest and closest >= SAME_KEY:
        names = [name for name in all_keys if likeness(name) == closest]
        least_nested = min(name.count(".") for name in names)
        return f"did you mean {' or '.join(repr(name) for name in names if name.count('.') == least_nested)}?"
    if likeness(here) >= SAME_KEY_HERE:
        return f"did you mean '{here}'?"
    return f"known keys: {', '.join(sorted(known))}"


def _checked(value: Any, hint: Any, where: str) -> Any:
    allowed = {float: (int, float), int: (int,), bool: (bool,), str: (str,)}.get(hint)
    if allowed is None:
        return value
    if not isinstance(value, allowed) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {value!r}")
    if isinstance(value, int) and abs(value) >= 1 << 63:
        raise ConfigError(f"{where}: an integer beyond 64 bits")
    return hint(value)


def load_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file as nested dictionaries."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: not a readable TOML file: {error}") from None


def merge(base: Mapping[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with the values of `extra`, section by section; neither is changed."""
    merged = dict(base)
    for key, value in extra.items():
        mine = merged.get(key)
        merged[key] = merge(mine, value) if isinstance(mine, Mapping) and isinstance(value, Mapping) else value
    return merged


def parse_override(text: str) -> dict[str, Any]:
    """Turn ``a.b=value`` into {"a": {"b": value}}; the value is TOML, or else a plain string."""
    key, separator, raw = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {text}: expected key=value, for example tracking.stable_fraction=0.1")
    try:
        value: Any = tomllib.loads(f"v = {raw}")["v"]
    except tomllib.TOMLDecodeError:
        value = raw.strip()
    for part in reversed(key.strip().split(".")):
        value = {part: value}
    result: dict[str, Any] = value
    return result


def to_toml(config: Any) -> str:
    """Write a configuration as TOML, every key with its documentation; :func:`from_mapping` reads it back."""
    return "\n".join(_toml_lines(config, ())) + "\n"


def _toml_lines(config: Any, path: tuple[str, ...]) -> list[str]:
    lines: list[str] = []
    if path:
        lines += ["", f"[{'.'.join(path)}]"]
    nested = []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            nested.append((item.name, value))
            continue
        if value is None:
            continue
        doc = item.metadata.get("doc")
        if doc:
            lines.append(f"# {doc}")
        lines.append(f"{item.name} = {_toml_value(value)}")
    for name, value in nested:
        lines += _toml_lines(value, (*path, name))
    return lines


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return {math.inf: "inf", -math.inf: "-inf"}.get(value, repr(value))
    if isinstance(value, int):
        return str(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    # A JSON string is a TOML basic string, but for DEL, which TOML wants escaped.
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
