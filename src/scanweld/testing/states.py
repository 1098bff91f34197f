"""The contracts of what is stored: an object that says what its state is, and the source that it is read from."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from scanweld.runs.checkpoint.encoding import Source, encode, restore
from scanweld.state import Stateful
from scanweld.testing.promises import require

_Any = TypeVar("_Any")


class StoredBytes:
    """The bytes of a state in memory, as a source."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    @property
    def left(self) -> int:
        """Bytes that are still to come."""
        return len(self._data)

    def read(self, size: int) -> bytes:
        """Return the next bytes; raises ValueError where there are fewer."""
        if size > self.left:
            raise ValueError(f"{size} bytes where {self.left} follow")
        read, self._data = self._data[:size], self._data[size:]
        return read


def check_source(open_source: Callable[[bytes], Source]) -> None:
    """Check that a source gives the bytes that it was made of, says how many are left, and refuses to give more.

    Parameters
    ----------
    open_source : makes a source of bytes, which may be none

    Raises
    ------
    AssertionError
        When it does not.
    """
    data = bytes(range(256)) * 17
    source = open_source(data)
    read = b""
    for size in (0, 1, 255, 0, 4000):
        require(source.left == len(data) - len(read), f"left: {source.left} of {len(data)} after {len(read)} were read")
        part = source.read(size)
        require(isinstance(part, bytes), f"read: expected bytes, got {type(part).__name__}")
        require(len(part) == size, f"read: {len(part)} bytes where {size} were asked for")
        read += part
    require(read == data[: len(read)], "read: other bytes than it was made of")
    _require_end(source, len(data) - len(read) + 1)
    require(source.read(source.left) == data[len(read) :], "read: after too many were asked for, the rest is not there")
    _require_end(source, 1)
    require(open_source(b"").left == 0, "left: expected 0 where there is nothing")


def _require_end(source: Source, size: int) -> None:
    try:
        source.read(size)
    except ValueError:
        return
    raise AssertionError(f"read: {size} bytes where {size - 1} are left must raise ValueError")


def stored_copy(value: _Any, fresh: _Any, what: str) -> _Any:
    """Return `fresh` with the state of `value`, as a checkpoint would bring it back.

    Raises
    ------
    AssertionError
        When an attribute is neither state nor said to follow from how the object was made.
    """
    assert isinstance(value, Stateful)
    assert isinstance(fresh, Stateful)
    unnamed = set(vars(value)) - set(value.STATE) - value.MADE
    require(not unnamed, f"{what}: {', '.join(sorted(unnamed))} is neither in STATE nor in MADE")
    source = StoredBytes(b"".join(encode(value, Stateful)))
    restore(source, fresh)
    require(source.left == 0, f"{what}: {source.left} bytes of its state are not read again")
    return fresh
