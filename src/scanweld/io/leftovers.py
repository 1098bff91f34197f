"""What a killed process had not finished writing: told by its name, and taken away by the next one that writes there.

What is to become `NAME` is written as `.NAME.part-xxxxxxxx` beside it, and what it replaces is moved to
`.NAME.part-xxxxxxxx.old` for a moment. Whoever writes holds a lock on it, which the system lets go of with the process:
what another one is at work on is left alone.
"""

from __future__ import annotations

import contextlib
import glob
import os
import re
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows: nobody can tell what is still being written, so it stays
    fcntl = None

OLD = ".old"

_PART = re.compile(r"\.part-[a-z0-9_]{8}(\.old)?")  # as tempfile names things


def prefix_of(path: Path) -> str:
    """Return what names begin with under which `path` is written."""
    return f".{path.name}.part-"


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Tell other processes within the block that a file or folder is being worked on, where the system can."""
    descriptor = None
    with contextlib.suppress(OSError):
        if fcntl is not None:
            descriptor = os.open(path, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def put_back(folder: Path, marks: Collection[str]) -> None:
    """Put a folder back that was moved aside by a process that was killed before the new one took its place.

    Parameters
    ----------
    folder : where it was; nothing is done where there is something
    marks : files of which it has one, or it is none of ours
    """
    if folder.exists():
        return
    for part in _parts_of(folder):
        if part.name.endswith(OLD) and any((part / mark).is_file() for mark in marks) and not _is_held(part):
            with contextlib.suppress(OSError):  # a place where nothing can be written: the caller finds out
                part.rename(folder)
                return


def clear(path: Path) -> None:
    """Take away what killed processes left of `path`, a file or a folder; what another one holds stays."""
    for part in _parts_of(path):
        if fcntl is None or _is_held(part):
            continue
        if part.is_dir() and not part.is_symlink():
            shutil.rmtree(part, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                part.unlink()


def _parts_of(path: Path) -> list[Path]:
    names = path.parent.glob(f".{glob.escape(path.name)}.part-*")
    return [part for part in names if _PART.fullmatch(part.name.removeprefix(f".{path.name}"))]


def _is_held(path: Path) -> bool:
    """Whether a process is at work on it; where the system does not say, one may be."""
    if fcntl is None:
        return False
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False
