"""Run folders at paths and behind URLs."""

from __future__ import annotations

import contextlib
import posixpath
import tempfile
from collections.abc import Iterator
from pathlib import Path

from scanweld.errors import OutputError
from scanweld.runs.folder import MARK, check_writable, write_folder
from scanweld.runs.storage.recordings import scratch
from scanweld.runs.storage.urls import faults_told, filesystem, is_url, join, names_in

UPLOADING = "upload.part"
"""Is in a run folder behind a URL while its files are on their way: there is no run.json then."""


def check_place(place: str, *, force: bool) -> None:
    """Raise OutputError before any work is done when a run could not be written to a path or URL at the end."""
    if is_url(place):
        check_uploadable(place, force=force)
    else:
        check_writable(Path(place), force=force)


@contextlib.contextmanager
def written_at(place: str, *, force: bool) -> Iterator[Path]:
    """Yield an empty folder that becomes the run folder at a path, or is copied to a URL; not so after an error."""
    if not is_url(place):
        with write_folder(Path(place), force=force) as aside:
            yield aside
        return
    with tempfile.TemporaryDirectory(prefix="run-", dir=scratch()) as aside:
        yield Path(aside)
        upload(Path(aside), place)


def check_uploadable(url: str, *, force: bool = True) -> None:
    """Raise OutputError before any work is done when a folder holds something that must stay: no run, or one without
    `force`."""
    names = set(names_in(url))
    if names and not force:
        raise OutputError(f"{url}: exists and is not empty; --force replaces it, --out writes elsewhere")
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
    with faults_told(url, OutputError):
        files, root = filesystem(url)
        sizes = {name: (folder / name).stat().st_size for name in names_in(str(folder))}
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
