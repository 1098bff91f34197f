"""A run folder appears complete or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from scanweld.errors import OutputError


def next_run_folder(name: str, root: Path = Path("runs")) -> Path:
    """Return the first of `root`/`name`-1, -2, .. that does not exist."""
    number = 1
    while (root / f"{name}-{number}").exists():
        number += 1
    return root / f"{name}-{number}"


def check_writable(folder: Path, *, force: bool) -> None:
    """Raise OutputError before any work is done when `folder` could not be written at the end."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: exists and is a file; choose another --out")
    folder = folder.resolve()
    if Path.cwd().is_relative_to(folder):
        raise OutputError(f"{folder}: is or holds the current folder; choose another --out")
    if folder.is_dir() and any(folder.iterdir()):
        if not force:
            raise OutputError(f"{folder}: exists and is not empty; --force replaces it, --out writes elsewhere")
        if not _looks_like_run(folder):
            raise OutputError(f"{folder}: is not a run folder (no run.json), so --force will not replace it")
    with _parents(folder, keep=False), tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent):
        pass


@contextlib.contextmanager
def write_folder(folder: Path, *, force: bool) -> Iterator[Path]:
    """Yield an empty folder beside `folder`; at the end it takes its place, on an error it vanishes.

    Raises
    ------
    OutputError
        When the folder cannot be written, or exists and `force` is false.
    """
    check_writable(folder, force=force)
    folder = folder.resolve()  # a link keeps pointing at the run
    with _parents(folder, keep=True):
        aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            yield aside
            mask = os.umask(0)
            os.umask(mask)
            aside.chmod(0o777 & ~mask)  # temporary folders are private, results are not
            _put_in_place(aside, folder)
        finally:
            shutil.rmtree(aside, ignore_errors=True)


def _put_in_place(aside: Path, folder: Path) -> None:
    """Rename `aside` to `folder`; what was there goes away only once the new one is in its place."""
    if not folder.exists():
        aside.rename(folder)
        return
    old = aside.with_name(aside.name + ".old")
    folder.rename(old)
    try:
        aside.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def _parents(folder: Path, *, keep: bool) -> Iterator[None]:
    """Make the folders above `folder`; those that were made go again on an error, and at the end unless kept."""
    made = [parent for parent in folder.parents if not parent.exists()]
    done = False
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        yield
        done = keep
    except OSError as error:
        where, why = error.filename or folder, error.strerror or error
        raise OutputError(f"{where}: cannot be written: {why}; choose another --out") from None
    finally:
        if not done:
            with contextlib.suppress(OSError):  # somebody else uses it meanwhile
                for parent in made:
                    parent.rmdir()


def _looks_like_run(folder: Path) -> bool:
    return (folder / "run.json").is_file()
