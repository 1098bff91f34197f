"""Files and folders by their paths, or by URLs: s3://, gs://, memory://, whatever fsspec reaches."""

from __future__ import annotations

import contextlib
import posixpath
import shutil
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from scanweld.errors import (
    FileFormatError,
    InvalidInputError,
    MissingDependencyError,
    OutputError,
    ScanweldError,
)
from scanweld.io.atomic import write_file


def is_url(place: str) -> bool:
    """Whether a place is behind a URL, and no path."""
    return "://" in place


def join(place: str, name: str) -> str:
    """Return the place of something within a folder, path or URL."""
    return f"{place.rstrip('/')}/{name}" if is_url(place) else str(Path(place) / name)


def name_of(place: str) -> str:
    """Return the name of a folder or file: the last part of its path or URL."""
    return posixpath.basename(place.rstrip("/")) if is_url(place) else Path(place).resolve().name


def filesystem(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it.

    Raises
    ------
    MissingDependencyError
        When fsspec, or the package by which it reaches this kind of storage, is not installed.
    InvalidInputError
        When it knows no such storage.
    """
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError:
        raise MissingDependencyError("fsspec", "cluster") from None
    try:
        files, path = url_to_fs(url)
    except ImportError as error:
        raise InvalidInputError(f"{url}: {error}") from None  # "Install s3fs to access S3"
    except ValueError as error:
        raise InvalidInputError(f"{url}: no storage that fsspec knows ({error})") from None
    files.invalidate_cache()  # what others wrote meanwhile counts
    return files, str(path)


@contextlib.contextmanager
def faults_told(url: str, kind: type[ScanweldError]) -> Iterator[None]:
    """Turn what a storage raises, which may be of any class, into one line."""
    try:
        yield
    except ScanweldError:
        raise
    except FileNotFoundError:
        raise kind(f"{url}: no such file or folder") from None
    except Exception as error:
        told = str(error).splitlines()
        raise kind(f"{url}: {told[0] if told else type(error).__name__}") from None


def names_in(place: str) -> list[str]:
    """Return the names of all files in a folder, path or URL; none where there is no folder.

    Raises
    ------
    OutputError
        When the storage cannot be reached.
    """
    if not is_url(place):
        return [path.relative_to(place).as_posix() for path in Path(place).rglob("*") if not path.is_dir()]
    with faults_told(place, OutputError):
        files, root = filesystem(place)
        return [posixpath.relpath(path, root) for path in files.find(root)]


def read_back(url: str, names: Collection[str], folder: Path) -> None:
    """Copy those of the named files of a folder behind a URL that are there.

    Raises
    ------
    OutputError
        When the storage cannot be reached.
    """
    with faults_told(url, OutputError):
        files, root = filesystem(url)
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                (folder / name).write_bytes(files.cat_file(f"{root}/{name}"))


def get(url: str, path: Path) -> None:
    """Copy a file from a URL; it is there whole or not at all.

    Raises
    ------
    FileFormatError
        When there is no such file, or it cannot be fetched.
    """
    with (
        faults_told(url, FileFormatError),
        tempfile.TemporaryDirectory(prefix="part-", dir=path.parent) as aside,
    ):
        part = Path(aside) / path.name
        files, place = filesystem(url)
        files.get_file(place, str(part))
        part.replace(path)


def put(path: Path, url: str) -> None:
    """Copy a file to a URL.

    Raises
    ------
    OutputError
        When it could not be written, or arrived with another size.
    """
    with faults_told(url, OutputError):
        files, place = filesystem(url)
        files.makedirs(posixpath.dirname(place), exist_ok=True)
        files.put_file(str(path), place)
        files.invalidate_cache()
        got, expected = files.size(place), path.stat().st_size
        if got != expected:
            raise OutputError(f"{url}: {got} bytes arrived of {expected}")


def write_to(place: str, content: bytes) -> None:
    """Write a file, path or URL, whole or not at all where the storage can do that.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    if not is_url(place):
        try:
            Path(place).parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{place}: cannot be written: {error.strerror or error}") from None
        write_file(Path(place), content)
        return
    with faults_told(place, OutputError):
        files, path = filesystem(place)
        files.makedirs(posixpath.dirname(path), exist_ok=True)
        files.pipe_file(path, content)


def remove(place: str) -> None:
    """Remove a file, or a folder and all that is in it; path or URL, which need not be there.

    Raises
    ------
    OutputError
        When it is there still.
    """
    with faults_told(place, OutputError), contextlib.suppress(FileNotFoundError):
        if is_url(place):
            files, path = filesystem(place)
            files.rm(path, recursive=True)
        elif Path(place).is_dir():
            shutil.rmtree(place)
        else:
            Path(place).unlink()
