"""The memory that pages lie in: the process's own, or a file of which only a part need be in memory."""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import sys
import tempfile
import weakref
from collections.abc import Iterable
from typing import Any

import numpy as np

from scanweld.arrays import Float32

logger = logging.getLogger(__name__)


class Memory:
    """The process's own memory.

    It lies in a range of addresses with room for the largest map, behind which the system puts memory where it is
    written to: so growing copies nothing. Where there are no such ranges, or none is left, the array is copied.
    """

    paged = False
    """Whether parts of the array can leave memory."""

    def __init__(self, room: int = 0) -> None:
        """`room`: numbers that the array may grow to without being copied."""
        self._room = room
        self._range: mmap.mmap | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_room": self._room, "_range": None}  # a copy of the array is an array of its own

    def grow(self, array: Float32, size: int) -> Float32:
        """Return an array of `size` numbers that begins with what `array` holds."""
        if self._range is not None and size <= self._room:
            return np.frombuffer(self._range, np.float32, size)
        self._range = _reserve(4 * self._room) if size <= self._room else None
        grown: Float32
        grown = np.empty(size, np.float32) if self._range is None else np.frombuffer(self._range, np.float32, size)
        grown[: len(array)] = array
        return grown

    def recall(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Say that parts of the array, as (first, last + 1), are going to be read."""

    def let_go(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Say that parts of the array will not be needed for a while."""


_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000 if sys.platform == "linux" else 0)
"""Memory is not counted before it is used; other systems never do. Python has a name for it from 3.13 on."""


def _reserve(size: int) -> mmap.mmap | None:
    """Return a range of addresses without memory behind them yet; None where the system has none to give."""
    if not hasattr(mmap, "MAP_ANONYMOUS"):
        return None
    try:
        addresses = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _NORESERVE)
    except (OSError, ValueError, OverflowError):  # a limit on addresses, or a system that counts them as memory
        return None
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):  # a kernel without them
            addresses.madvise(mmap.MADV_HUGEPAGE)
    return addresses


class MappedFile(Memory):
    """A file without a name in `folder` ("": the system's choice) that is mapped into memory, and gone with the object.

    What the map writes goes to the file, sooner or later, as the system likes; parts that are let go leave the memory
    of the process and come back by themselves when they are read. So no result can depend on what is where.
    """

    def __init__(self, folder: str = "", room: int = 0) -> None:
        super().__init__(room)
        self._folder = folder
        self._file: int | None = None
        self._map: mmap.mmap | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A copy of the map is in memory.
        return {**super().__getstate__(), "_folder": self._folder, "_file": None, "_map": None}

    @property
    def paged(self) -> bool:  # type: ignore[override]
        """Whether parts of the array can leave memory: not where the file could not be made, nor without `madvise`."""
        return self._map is not None and hasattr(self._map, "madvise")

    def grow(self, array: Float32, size: int) -> Float32:
        """Return an array of `size` numbers that begins with what `array` holds; nothing is copied but at first."""
        if len(array) and self._map is None:  # the file failed before
            return super().grow(array, size)
        try:
            grown = self._mapped(size)
        except (OSError, ValueError) as error:
            logger.warning(
                "memory_budget_mb: no file of %.0f MB for the map in %s (%s); the map stays in memory from here on",
                4e-6 * size, self._folder or tempfile.gettempdir(), getattr(error, "strerror", None) or error,
            )  # fmt: skip
            self._give_up()
            return super().grow(array, size)
        return grown

    def recall(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Have the system read parts of the array from the file, without waiting for it."""
        self._advise(ranges, "MADV_WILLNEED")

    def let_go(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Take parts of the array out of the process's memory; the file has them."""
        self._advise(ranges, "MADV_DONTNEED")

    def _advise(self, ranges: Iterable[tuple[int, int]], advice: str) -> None:
        if not self.paged or not hasattr(mmap, advice):
            return
        assert self._map is not None
        for first, end in ranges:
            start = 4 * first // mmap.PAGESIZE * mmap.PAGESIZE
            self._map.madvise(getattr(mmap, advice), start, min(4 * end, len(self._map)) - start)

    def _mapped(self, size: int) -> Float32:
        """Make the file large enough and map all of it; arrays of earlier mappings see the same bytes."""
        if self._file is None:
            with tempfile.TemporaryFile(dir=self._folder or None) as file:
                self._file = os.dup(file.fileno())
            self._close = weakref.finalize(self, os.close, self._file)
        if hasattr(os, "posix_fallocate"):  # a full disk is an error here, and would be a crash when it is written to
            os.posix_fallocate(self._file, 0, 4 * size)
        else:
            os.ftruncate(self._file, 4 * size)
        self._map = mmap.mmap(self._file, 4 * size)
        return np.frombuffer(self._map, np.float32)

    def _give_up(self) -> None:
        """Let go of the file: the disk has the room back as soon as the last array over it is gone."""
        if self._file is not None:
            self._close()
        self._file = self._map = None
