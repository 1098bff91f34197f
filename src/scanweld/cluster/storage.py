"""Recordings and run folders behind URLs: s3://, gs://, memory://, whatever fsspec reaches.

A recording is copied whole to a folder of the machine that uses it, and a run folder from there to where it belongs.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import posixpath
import shutil
import tempfile
import threading
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from scanweld.datasets.layout import path_inside
from scanweld.errors import DatasetError, InvalidInputError, MissingDependencyError, OutputError, ScanweldError
from scanweld.io.atomic import write_file
from scanweld.runs.folder import MARK

NOT_READ = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".ply", ".obj", ".pcd", ".glb", ".stl", ".pdf", ".md")
"""Endings of files that lie beside recordings, and that no reader of sequences opens."""

BAGS, IMAGES = (".bag", ".mcap", ".db3"), (".png", ".jpg", ".jpeg", ".depth")
"""A bag beside the images that were taken out of it is not read."""

UPLOADING = "upload.part"
"""Is in a run folder behind a URL while its files are on their way: there is no run.json then."""


def is_url(place: str) -> bool:
    """Whether a place is behind a URL, and no path."""
    return "://" in place


def join(place: str, name: str) -> str:
    """Return the place of something within a folder, path or URL."""
    return f"{place.rstrip('/')}/{name}" if is_url(place) else str(Path(place) / name)


def name_of(place: str) -> str:
    """Return the name of a folder or file: the last part of its path or URL."""
    return posixpath.basename(place.rstrip("/")) if is_url(place) else Path(place).resolve().name


@dataclass(frozen=True, slots=True)
class Listing:
    """The files of a recording.

    Attributes
    ----------
    place : folder or file, path or URL
    sizes : of the files that a reader may open, by their names within the folder; "" is the place itself [bytes]
    """

    place: str
    sizes: Mapping[str, int]

    def described(self) -> dict[str, Any]:
        """Return what tells these files from others: how many there are, and a checksum of names and sizes."""
        names = "\n".join(f"{self.sizes[name]} {name}" for name in sorted(self.sizes))
        digest = hashlib.sha256(names.encode("utf-8", "surrogateescape")).hexdigest()
        return {"number": len(self.sizes), "bytes": sum(self.sizes.values()), "names and sizes": digest}


def list_files(place: str) -> Listing:
    """List the files of a recording; what no reader opens is left out.

    Raises
    ------
    DatasetError
        When there is nothing, a name leads out of the folder, or the storage cannot be reached.
    """
    sizes = _remote_sizes(place) if is_url(place) else _local_sizes(Path(place))
    if not sizes:
        raise DatasetError(f"{place}: no such folder, or an empty one")
    for name in sizes:
        if name:
            path_inside(Path(), name, place)
    return Listing(place, {name: sizes[name] for name in _read(sizes)})


def _read(names: Collection[str]) -> list[str]:
    """Return the files that a reader of sequences may open."""
    files = {name: PurePosixPath(name) for name in names}
    has_images = any(path.suffix.lower() in IMAGES for path in files.values())
    unread = (*NOT_READ, *(BAGS if has_images else ()))
    return [
        name
        for name, path in files.items()
        if path.suffix.lower() not in unread and not any(part.startswith(".") for part in path.parts)
    ]


def _local_sizes(place: Path) -> dict[str, int]:
    if place.is_file():
        return {"": place.stat().st_size}
    found = {}
    seen: set[str] = set()
    for folder, folders, files in os.walk(place, followlinks=True):
        if (real := os.path.realpath(folder)) in seen:  # a link to a folder above
            folders.clear()
            continue
        seen.add(real)
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(folder) / name for name in files):
            with contextlib.suppress(OSError):  # a link that leads nowhere
                found[path.relative_to(place).as_posix()] = path.stat().st_size
    return found


def _remote_sizes(url: str) -> dict[str, int]:
    with _faults_told(url, DatasetError):
        files, root = _filesystem(url)
        found = files.find(root, detail=True)
        root = root.rstrip("/")
        return {
            "" if path == root else path.removeprefix(f"{root}/"): int(entry["size"] or 0)
            for path, entry in found.items()
            if entry["type"] == "file"
        }


def _filesystem(url: str) -> tuple[Any, str]:
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
def _faults_told(url: str, kind: type[ScanweldError]) -> Iterator[None]:
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


@dataclass(slots=True)
class _Copy:
    """A recording in the scratch folder."""

    folder: Path
    users: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


class Copies:
    """Local copies of recordings; one that nobody uses stays until the next is fetched, since a sweep uses it again.

    Parameters
    ----------
    scratch : folder for them; whoever made it removes it
    """

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch
        self._copies: dict[tuple[str, str], _Copy] = {}
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def local(self, listing: Listing) -> Iterator[Path]:
        """Yield where a recording can be opened within the block: its own place where that is a path, else a copy.

        Raises
        ------
        DatasetError
            When a file could not be fetched, or arrived with another size than it was listed with.
        """
        if not is_url(listing.place):
            yield Path(listing.place)
            return
        key = listing.place, str(listing.described()["names and sizes"])
        with self._lock:
            folder = self._scratch / hashlib.sha256("\n".join(key).encode()).hexdigest()[:16]
            copy = self._copies.setdefault(key, _Copy(folder))
            copy.users += 1
            unused = [other for other, it in self._copies.items() if it.users == 0]
            gone = [self._copies.pop(other).folder for other in unused]
        try:
            for folder in gone:
                shutil.rmtree(folder, ignore_errors=True)
            with copy.lock:
                place = copy.folder / name_of(listing.place)
                if not place.exists():
                    copy.folder.mkdir(parents=True, exist_ok=True)
                    _fetch(listing, place)
            yield place
        finally:
            with self._lock:
                copy.users -= 1


def _fetch(listing: Listing, place: Path) -> None:
    """Copy a recording; it is there whole or not at all."""
    with (
        _faults_told(listing.place, DatasetError),
        tempfile.TemporaryDirectory(prefix="part-", dir=place.parent) as aside,
    ):
        part = Path(aside) / place.name
        files, root = _filesystem(listing.place)
        names = list(listing.sizes)
        local = [part / name if name else part for name in names]
        for parent in {path.parent for path in local}:
            parent.mkdir(parents=True, exist_ok=True)
        files.get([f"{root.rstrip('/')}/{name}" if name else root for name in names], [str(path) for path in local])
        for name, path in zip(names, local, strict=True):
            got, expected = path.stat().st_size, listing.sizes[name]
            if got != expected:
                raise DatasetError(f"{join(listing.place, name)}: {got} bytes arrived of {expected}")
        part.rename(place)


def read_back(url: str, names: Collection[str], folder: Path) -> None:
    """Copy those of the named files of a folder behind a URL that are there.

    Raises
    ------
    OutputError
        When the storage cannot be reached.
    """
    with _faults_told(url, OutputError):
        files, root = _filesystem(url)
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                (folder / name).write_bytes(files.cat_file(f"{root}/{name}"))


def check_uploadable(url: str) -> None:
    """Raise OutputError before any work is done when a folder holds something that is no run, and must stay."""
    with _faults_told(url, OutputError):
        files, root = _filesystem(url)
        names = {posixpath.relpath(path, root) for path in files.find(root)}
    if names and not names & {MARK, UPLOADING}:
        raise OutputError(f"{url}: is not empty and no run folder (no {MARK}); choose another --out")


def upload(folder: Path, url: str) -> None:
    """Copy a run folder to a URL, in place of one that is there.

    run.json comes last, and that of a run in its place goes first: a folder with a run.json is a whole run at any time.

    Raises
    ------
    OutputError
        When it could not be written, or a file arrived with another size.
    """
    with _faults_told(url, OutputError):
        files, root = _filesystem(url)
        sizes = _local_sizes(folder)
        before = [posixpath.relpath(path, root) for path in files.find(root)]
        for parent in {posixpath.dirname(f"{root}/{name}") for name in sizes}:
            files.makedirs(parent, exist_ok=True)
        files.pipe_file(f"{root}/{UPLOADING}", b"")
        for name in (MARK, *(name for name in before if name not in {*sizes, MARK, UPLOADING})):
            if name in before:
                files.rm_file(f"{root}/{name}")
        last = [name for name in ("metrics.json", MARK) if name in sizes]
        for names in ([name for name in sizes if name not in last], *([name] for name in last)):
            files.put([str(folder / name) for name in names], [f"{root}/{name}" for name in names])
            files.invalidate_cache()
            arrived = {posixpath.relpath(path, root): entry for path, entry in files.find(root, detail=True).items()}
            for name in names:
                got = arrived[name]["size"] if name in arrived else 0
                if got != sizes[name]:
                    raise OutputError(f"{join(url, name)}: {got} bytes arrived of {sizes[name]}")
        files.rm_file(f"{root}/{UPLOADING}")


def write_to(place: str, content: bytes) -> None:
    """Write a file, path or URL, whole or not at all where the storage can do that.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    if not is_url(place):
        Path(place).parent.mkdir(parents=True, exist_ok=True)
        write_file(Path(place), content)
        return
    with _faults_told(place, OutputError):
        files, path = _filesystem(place)
        files.makedirs(posixpath.dirname(path), exist_ok=True)
        files.pipe_file(path, content)
