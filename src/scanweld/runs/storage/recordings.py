"""Recordings behind URLs: what files there are, and copies of them on the machine that opens them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

from scanweld.datasets.layout import path_inside
from scanweld.errors import DatasetError
from scanweld.runs.storage.urls import faults_told, filesystem, is_url, join, name_of

NOT_READ = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".ply", ".obj", ".pcd", ".glb", ".stl", ".pdf", ".md")
"""Endings of files that lie beside recordings, and that no reader of sequences opens."""


BAGS, IMAGES = (".bag", ".mcap", ".db3"), (".png", ".jpg", ".jpeg", ".depth")
"""A bag beside the images that were taken out of it is not read."""


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
    with faults_told(url, DatasetError):
        files, root = filesystem(url)
        found = files.find(root, detail=True)
        root = root.rstrip("/")
        return {
            "" if path == root else path.removeprefix(f"{root}/"): int(entry["size"] or 0)
            for path, entry in found.items()
            if entry["type"] == "file"
        }


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
        faults_told(listing.place, DatasetError),
        tempfile.TemporaryDirectory(prefix="part-", dir=place.parent) as aside,
    ):
        part = Path(aside) / place.name
        files, root = filesystem(listing.place)
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


@cache
def _scratch_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="scanweld-", dir=_disk_of_worker())


def _disk_of_worker() -> str | None:
    """Return where the worker of Dask keeps its files that this process is, None where it is none."""
    if (distributed := sys.modules.get("distributed")) is None:
        return None
    try:
        return str(distributed.get_worker().local_directory)
    except ValueError:
        return None


def scratch() -> Path:
    """Return the folder for what this process has of what is behind URLs; it goes with the process."""
    return Path(_scratch_folder().name)


@cache
def copies() -> Copies:
    """Return the copies of recordings that this process has."""
    return Copies(scratch())


HELD = 2
"""Recordings opened by their URLs that a process keeps copies of: the last ones."""


_held: OrderedDict[str, contextlib.ExitStack] = OrderedDict()


_holding = threading.Lock()


def local_place(place: str) -> str:
    """Return where a recording can be opened: its own place where that is a path, else a copy of what is there now.

    The copy stays until others have been asked for, or the process ends.

    Raises
    ------
    DatasetError
        When it could not be fetched.
    """
    if not is_url(place):
        return place
    with _holding, contextlib.ExitStack() as stack:
        copy = stack.enter_context(copies().local(list_files(place)))
        if place in _held:
            _held.pop(place).close()
        _held[place] = stack.pop_all()
        while len(_held) > HELD:
            _held.popitem(last=False)[1].close()
    return str(copy)
