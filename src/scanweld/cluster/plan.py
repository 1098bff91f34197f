"""What a batch is to do: each sequence with each combination of swept settings, in a run folder of its own."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from scanweld.cluster.task import RunTask
from scanweld.config import parse_override
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.runs.input import RunInput
from scanweld.runs.storage.urls import is_url, join
from scanweld.slam.config import SlamConfig

_UNFIT = re.compile(r"[^\w.,=+-]")  # for the name of a folder, on any system


def parse_sweep(text: str) -> tuple[str, list[str]]:
    """Return the key and the values, as they were written, of "a.b=1,2,3".

    Raises
    ------
    ConfigError
        When it is something else, or has a value twice.
    """
    key, _, values = (part.strip() for part in text.partition("="))
    each = [value.strip() for value in values.split(",")]
    if not key or not all(each):
        raise ConfigError(f"--sweep {text}: expected key=value,value, for example tracking.stable_fraction=0.1,0.3")
    if len(set(each)) < len(each):
        raise ConfigError(f"--sweep {text}: has a value twice")
    return key, each


def plan_batch(
    sequences: Sequence[str],
    out: str,
    source: RunInput,
    configure: Callable[[list[str]], SlamConfig],
    *,
    sweeps: Sequence[str] = (),
    description: Mapping[str, Any] | None = None,
    force: bool = False,
    checkpoint_every_s: float | None = None,
) -> list[RunTask]:
    """Return the tasks of a batch: sequences in their order, for each all combinations of swept values.

    Parameters
    ----------
    sequences : paths or URLs
    out : folder of the batch, path or URL
    source : how each of them is to be opened
    configure : returns the configuration with overrides "key=value"
    sweeps : "key=value,value"
    description, force, checkpoint_every_s : as :class:`~.task.RunTask` has them

    Raises
    ------
    ConfigError
        When a sweep is not of this form, or has a value that its setting does not take.
    InvalidInputError
        When a sequence is given twice, or none is.
    """
    if not sequences:
        raise InvalidInputError("batch: no sequence is given")
    keys, values = zip(*map(parse_sweep, sweeps), strict=True) if sweeps else ((), ())
    if len(set(keys)) < len(keys):
        raise ConfigError(f"--sweep: a setting is swept twice; give all its values at once: {', '.join(keys)}")
    overrides = [[f"{k}={v}" for k, v in zip(keys, each, strict=True)] for each in itertools.product(*values)]
    settings = [(each, configure(each), dict(map(_flat, each))) for each in overrides]
    tasks: list[RunTask] = []
    for place, name in zip(sequences, names_of(sequences), strict=True):
        for each, config, swept in settings:
            folder = "/".join([name, *([_UNFIT.sub("_", ",".join(each))] if each else [])])
            tasks.append(
                RunTask(
                    number=len(tasks), name=folder, config=config, swept=swept, force=force,
                    checkpoint_every_s=checkpoint_every_s,
                    source=replace(source, input=place if is_url(place) else str(Path(place).resolve())),
                    folder=join(out if is_url(out) else str(Path(out).resolve()), folder),
                    description=dict(description or {}),
                )
            )  # fmt: skip
    return tasks


def names_of(sequences: Sequence[str]) -> list[str]:
    """Return a name for each sequence: that of its folder, with those above it as far as others have the same.

    The first keeps the short one, so that a batch to which sequences are added has the same names again.

    Raises
    ------
    InvalidInputError
        When one is given twice.
    """
    taken: dict[str, str] = {}
    for place in sequences:
        whole = place.rstrip("/") if is_url(place) else str(Path(place).resolve())
        name = next((name for name in _candidates(whole) if name not in taken), None)
        if whole in taken.values() or name is None:
            raise InvalidInputError(f"{place}: is given twice")
        taken[name] = whole
    return list(taken)


def _candidates(place: str) -> Iterator[str]:
    """Yield "c", "b-c", "a-b-c" for a place a/b/c; a file is named without its ending."""
    parts = [part for part in re.split(r"[/\\]", place) if part]
    if not is_url(place) and Path(place).is_file():
        parts[-1] = Path(place).stem
    for first in range(len(parts) - 1, -1, -1):
        yield _UNFIT.sub("_", "-".join(parts[first:]))


def _flat(override: str) -> tuple[str, Any]:
    """Return key and value of "a.b=1"."""
    value: Any = parse_override(override)
    while isinstance(value, dict):
        (value,) = value.values()
    return override.partition("=")[0], value
