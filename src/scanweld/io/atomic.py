"""Files and folders that appear complete or not at all: written aside, then renamed."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from scanweld.errors import OutputError
from scanweld.io import leftovers


def write_file(path: Path, content: bytes | Iterable[bytes], *, sync: bool = False) -> None:
    """Write a file, or replace one; `content` may come in parts, which are written as they come.

    With `sync` it is on the disk in the end, and not only in the memory of the system: a power cut leaves one or the
    other, too.

    Raises
    ------
    OutputError
        When it cannot be written; what was there before is still there.
    """
    temporary = None
    try:
        leftovers.clear(path)
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=leftovers.prefix_of(path))
        temporary = Path(name)
        with leftovers.held(temporary):
            with open(descriptor, "wb") as file:
                file.writelines([content] if isinstance(content, bytes) else content)
                if sync:
                    file.flush()
                    os.fsync(file.fileno())
            temporary.chmod(0o666 & ~_umask())  # temporary files are private, results are not
            temporary.replace(path)
        if sync:
            _sync_folder(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)  # it is there no longer, or half written


def check_writable(folder: Path, *, force: bool, kind: str, mark: str) -> None:
    """Raise OutputError before any work is done when `folder` could not be written at the end.

    What a killed process left half done there is put back or taken away (:mod:`scanweld.io.leftovers`).

    Parameters
    ----------
    folder : what :func:`write_folder` will make
    force : whether one that holds something may be replaced
    kind, mark : only a folder of this kind is ever replaced, which is one that holds the file `mark`
    """
    _check_no_file(folder)
    folder = folder.resolve()
    if Path.cwd().is_relative_to(folder):
        raise OutputError(f"{folder}: is or holds the current folder; choose another --out")
    leftovers.put_back(folder, [mark])
    leftovers.clear(folder)
    if folder.is_dir() and any(folder.iterdir()):
        if not force:
            raise OutputError(f"{folder}: exists and is not empty; --force replaces it, --out writes elsewhere")
        if not (folder / mark).is_file():
            raise OutputError(f"{folder}: not a {kind} (no {mark}), so --force will not replace it")
    _try_beside(folder)


def check_holds(folder: Path) -> None:
    """Raise OutputError before any work is done when nothing could be written within `folder`, there or not."""
    _check_no_file(folder)
    _try_beside(folder.resolve() / "any")


def _check_no_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: exists and is a file; choose another --out")


def _try_beside(folder: Path) -> None:
    """Make what a folder needs to be written, and take it away again."""
    with _parents(folder, keep=False):
        shutil.rmtree(_folder_beside(folder), ignore_errors=True)


@contextlib.contextmanager
def write_folder(folder: Path, *, force: bool, kind: str, mark: str) -> Iterator[Path]:
    """Yield an empty folder beside `folder`; at the end it takes its place, on an error it vanishes.

    Parameters are those of :func:`check_writable`.

    Raises
    ------
    OutputError
        When the folder cannot be written, or exists and must not be replaced.
    """
    check_writable(folder, force=force, kind=kind, mark=mark)
    folder = folder.resolve()  # a link keeps pointing at the result
    with _parents(folder, keep=True):
        aside = _folder_beside(folder)
        try:
            with leftovers.held(aside):
                yield aside
                aside.chmod(0o777 & ~_umask())
                _put_in_place(aside, folder)
        except OutputError as error:  # the one that asked knows nothing of the folder aside
            raise OutputError(str(error).replace(str(aside), str(folder))) from None
        except OSError as error:
            error.filename = error.filename and str(error.filename).replace(str(aside), str(folder))
            raise
        finally:
            shutil.rmtree(aside, ignore_errors=True)


def _folder_beside(folder: Path) -> Path:
    """Make a hidden folder in the place where `folder` shall be; what keeps it from being made keeps `folder`, too."""
    try:
        return Path(tempfile.mkdtemp(prefix=leftovers.prefix_of(folder), dir=folder.parent))
    except OSError as error:
        error.filename = str(folder)
        raise


def _sync_folder(folder: Path) -> None:
    """Have the names of a folder on the disk, where the system can do that."""
    with contextlib.suppress(OSError):  # Windows, and some network drives
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _put_in_place(aside: Path, folder: Path) -> None:
    """Rename `aside` to `folder`; what was there goes away only once the new one is in its place."""
    if not folder.exists():
        aside.rename(folder)
        return
    old = aside.with_name(aside.name + leftovers.OLD)
    with leftovers.held(folder):
        folder.rename(old)
        try:
            aside.rename(folder)
        except OSError:
            old.rename(folder)
            raise
        with contextlib.suppress(OSError):
            old = old.rename(aside)  # the new one is there: this one is to be put back no more
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
