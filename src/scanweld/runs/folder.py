"""Where a run is written."""

from __future__ import annotations

import contextlib
from pathlib import Path

from scanweld.io import atomic

KIND, MARK = "run folder", "run.json"


def next_run_folder(name: str, root: Path = Path("runs")) -> Path:
    """Return the first of `root`/`name`-1, -2, .. that does not exist."""
    number = 1
    while (root / f"{name}-{number}").exists():
        number += 1
    return root / f"{name}-{number}"


def check_writable(folder: Path, *, force: bool) -> None:
    """Raise OutputError before any work is done when a run could not be written to `folder` at the end."""
    atomic.check_writable(folder, force=force, kind=KIND, mark=MARK)


def write_folder(folder: Path, *, force: bool) -> contextlib.AbstractContextManager[Path]:
    """Yield an empty folder that becomes the run folder; see :func:`scanweld.io.atomic.write_folder`."""
    return atomic.write_folder(folder, force=force, kind=KIND, mark=MARK)
