"""What tasks hand to each other: files in a folder that all workers see, or behind a URL that all of them reach."""

from __future__ import annotations

import contextlib
import logging
import shutil
import tempfile
import uuid
import weakref
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from scanweld.errors import OutputError
from scanweld.runs.storage.recordings import scratch
from scanweld.runs.storage.urls import get, is_url, join, names_in, put, remove

logger = logging.getLogger(__name__)

ENDING = ".fragments"
"""What the name of the folder beside a run ends in, where tasks leave what they hand to each other."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """Where tasks of a run leave files for other tasks, by names with slashes.

    Behind a URL each process has copies of what it wrote and read. A name is written once, so copies are never old.

    Attributes
    ----------
    place : folder, path or URL
    run : tells the copies of this run from those of others that a process has worked for
    """

    place: str
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    @contextlib.contextmanager
    def written(self, name: str) -> Iterator[Path]:
        """Yield where to write a file; after the block it is there for all."""
        path = self._here(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield path
        if is_url(self.place):
            put(path, join(self.place, name))

    def read(self, name: str) -> Path:
        """Return where a file can be read.

        Raises
        ------
        FileFormatError
            When it is behind a URL, and cannot be fetched.
        """
        path = self._here(name)
        if is_url(self.place) and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            get(join(self.place, name), path)
        return path

    def _here(self, name: str) -> Path:
        return (_copies(self.run).folder if is_url(self.place) else Path(self.place)) / name


class _Copies:
    """A folder that goes with the object."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="exchange-", dir=scratch()))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)


@lru_cache(maxsize=2)  # a worker may begin to work for a run before it has ended its work for another one
def _copies(_: str) -> _Copies:
    return _Copies()


def exchange_beside(out: str) -> str:
    """Return where the exchange of a run lies, beside its folder `out`, path or URL."""
    return out.rstrip("/") + ENDING if is_url(out) else str(Path(out).resolve()) + ENDING


@contextlib.contextmanager
def opened_exchange(out: str | None, names: Collection[str], *, kept: Collection[str]) -> Iterator[Exchange]:
    """Yield the exchange of a run; it is removed in the end, and after an error it stays.

    Parameters
    ----------
    out : folder of the run, path or URL, that it lies beside; None: in a temporary one
    names : how names of files begin that may be left there of an earlier run
    kept : how those begin that are of use; the others are removed

    Raises
    ------
    OutputError
        When something else is there.
    """
    if out is None:
        with tempfile.TemporaryDirectory(prefix="scanweld-fragments-") as temporary:
            yield Exchange(temporary)
        return
    place = exchange_beside(out)
    left = names_in(place)
    if not all(name.startswith(tuple(names)) for name in left):
        raise OutputError(f"{place}: holds something else than fragments; choose another --out")
    for folder in sorted({name.split("/")[0] for name in left if not name.startswith(tuple(kept))}):
        remove(join(place, folder))
    yield Exchange(place)
    try:
        remove(place)
    except OutputError as error:  # the run is there and complete
        logger.warning("%s; it is of no use any more", error)
