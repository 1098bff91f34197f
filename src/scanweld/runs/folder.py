"""Where a run is written."""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

from scanweld.errors import OutputError
from scanweld.io import atomic, leftovers

logger = logging.getLogger(__name__)

KIND, MARK = "run folder", "run.json"

CHECKPOINT = "checkpoint.swc"
"""What a run that is not finished can be continued from."""


def next_run_folder(name: str, root: Path = Path("runs")) -> Path:
    """Return the first of `root`/`name`-1, -2, .. that does not exist."""
    number = 1
    while (root / f"{name}-{number}").exists():
        number += 1
    return root / f"{name}-{number}"


def check_writable(folder: Path, *, force: bool, resume: bool = False) -> None:
    """Raise OutputError before any work is done when a run could not be written to `folder` at the end.

    What a killed run left half done is put back or taken away.
    """
    leftovers.put_back(folder.resolve(), [CHECKPOINT, MARK])
    leftovers.clear(folder / CHECKPOINT)  # a folder that holds nothing else is empty
    if (folder / CHECKPOINT).is_file() and not (force or resume):
        raise OutputError(f"{folder}: holds a run that was interrupted; --resume continues it, --force begins anew")
    atomic.check_writable(folder, force=force or resume, kind=KIND, mark=_mark(folder))


def still_free(folder: Path, *, force: bool) -> Path:
    """Return the folder, or one beside it where another run was written to it since it was checked: none is lost."""
    if force or not (folder / MARK).is_file():
        return folder
    other = next_run_folder(folder.name, folder.parent)
    logger.warning("%s: another run was written there meanwhile; this one is in %s", folder, other)
    return other


def write_folder(folder: Path, *, force: bool) -> contextlib.AbstractContextManager[Path]:
    """Yield an empty folder that becomes the run folder; see :func:`scanweld.io.atomic.write_folder`.

    A checkpoint of the run that is in its place goes when the run is there.
    """
    mark = _mark(folder)
    return atomic.write_folder(folder, force=force or mark == CHECKPOINT, kind=KIND, mark=mark)


def _mark(folder: Path) -> str:
    """Return the file that tells a run folder: one of a run that was killed holds nothing but its checkpoint."""
    unfinished = (folder / CHECKPOINT).is_file() and not (folder / MARK).is_file()
    return CHECKPOINT if unfinished else MARK
