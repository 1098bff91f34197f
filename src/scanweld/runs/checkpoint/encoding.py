"""Values as bytes, by their types, and back: nothing in the bytes says what is to be made of them.

The types are those of :attr:`scanweld.state.Stateful.STATE`. Reader and writer walk through them in the same order, so
a file holds no names of classes or functions, and only what a type allows can come out of it.
"""

from __future__ import annotations

import math
import struct
import types
import zlib
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from enum import Enum
from functools import lru_cache
from typing import Any, Protocol, TypeAlias, Union, get_args, get_origin, get_type_hints

import numpy as np

from scanweld.arrays import Array
from scanweld.state import Stateful

Pieces: TypeAlias = Iterator[bytes]

DTYPES = tuple(np.dtype(name) for name in ("?", "u1", "<u2", "<i4", "<i8", "<f4", "<f8"))
"""Types of arrays, by their number in a file."""

_SCALARS: dict[Any, str] = {bool: "<?", int: "<q", float: "<d"}
_COLUMNS: dict[Any, str] = {bool: "?", int: "<i8", float: "<f8"}
_ONE_BY_ONE = (Union, str, Enum, tuple, list, dict, Iterator, Stateful)  # all kinds in a column but numbers and records
_LONGEST_TEXT = 1 << 20
_MOST_DIMENSIONS = 4


class Source(Protocol):
    """What bytes are read from."""

    @property
    def left(self) -> int:
        """Bytes that are still to come."""
        ...

    def read(self, size: int) -> bytes:
        """Return the next bytes; raises ValueError where there are fewer."""
        ...


def encode(value: Any, hint: Any) -> Pieces:
    """Yield the bytes of a value of a type."""
    kind = _kind(hint)
    if kind in _SCALARS:
        yield struct.pack(_SCALARS[kind], value)
    elif kind is str:
        text = value.encode()
        yield struct.pack("<I", len(text))
        yield text
    elif kind is np.ndarray:
        yield _array_head(value)
        yield _array_bytes(value)
    elif kind is Union:
        yield struct.pack("<?", value is not None)
        if value is not None:
            yield from encode(value, _other_than_none(hint))
    elif kind is Iterator:
        for item in value:
            yield b"\1"
            yield from encode(item, get_args(hint)[0])
        yield b"\0"
    elif kind is tuple:
        for item, item_hint in zip(value, get_args(hint), strict=True):
            yield from encode(item, item_hint)
    elif kind is list:
        yield struct.pack("<Q", len(value))
        yield from _encode_column(value, get_args(hint)[0])
    elif kind is dict:
        yield struct.pack("<Q", len(value))
        for column, item_hint in zip((list(value), list(value.values())), get_args(hint), strict=True):
            yield from _encode_column(column, item_hint)
    elif kind is Enum:
        yield from encode(value.value, str)
    else:
        fields = value.STATE if kind is Stateful else _fields(hint)
        yield _signature(type(value), fields)
        for name, field_hint in fields.items():
            yield from encode(getattr(value, name), field_hint)


def decode(source: Source, hint: Any, now: Any = None) -> Any:
    """Return the next value of a type; what is stateful is put into `now`.

    Raises
    ------
    ValueError
        When the bytes are not those of such a value.
    """
    kind = _kind(hint)
    if kind in _SCALARS:
        return struct.unpack(_SCALARS[kind], source.read(struct.calcsize(_SCALARS[kind])))[0]
    if kind is str:
        return source.read(_size(source, "<I", _LONGEST_TEXT)).decode()
    if kind is np.ndarray:
        return _array(source, *_read_array_head(source, hint))
    if kind is Union:
        return decode(source, _other_than_none(hint), now) if decode(source, bool) else None
    if kind is Iterator:
        return _items(source, get_args(hint)[0])
    if kind is tuple:
        return tuple(decode(source, item_hint) for item_hint in get_args(hint))
    if kind is list:
        return _decode_column(source, get_args(hint)[0], _size(source, "<Q"))
    if kind is dict:
        size, (key_hint, item_hint) = _size(source, "<Q"), get_args(hint)
        keys = _decode_column(source, key_hint, size)
        nows = [now[key] for key in keys] if _kind(item_hint) is Stateful else None
        return dict(zip(keys, _decode_column(source, item_hint, size, nows), strict=True))
    if kind is Enum:
        return hint(decode(source, str))
    if kind is Stateful:
        if not isinstance(now, Stateful):
            raise ValueError("a part that this run does not have")
        restore(source, now)
        return now
    fields = _fields(hint)
    _check_signature(source, hint, fields)
    return hint(**{name: decode(source, field_hint) for name, field_hint in fields.items()})


def restore(source: Source, target: Stateful) -> None:
    """Put a state that was encoded into an object that was made like the one it is of.

    After an error the object is of no use any more.

    Raises
    ------
    ValueError
        When the bytes are not those of such an object.
    """
    _check_signature(source, type(target), target.STATE)
    for name, hint in target.STATE.items():
        now = getattr(target, name)
        value = decode(source, hint, now)
        if isinstance(now, deque):
            value = deque(value, now.maxlen)
        if value is not now:
            setattr(target, name, value)
        if isinstance(value, Generator) and next(value, None) is not None:
            raise ValueError(f"{name}: more than there should be")
    target.restored()


def _kind(hint: Any) -> Any:
    """Return what rules a type follows."""
    origin = get_origin(hint) or hint
    if origin in (list, deque):
        return list
    if origin in (dict, Mapping):
        return dict
    if origin is types.UnionType:
        return Union
    if isinstance(origin, type):
        for kind in (Enum, Stateful):
            if issubclass(origin, kind):
                return kind
    return origin


def _other_than_none(hint: Any) -> Any:
    (other,) = (option for option in get_args(hint) if option is not type(None))
    return other


@lru_cache(maxsize=64)
def _fields(record: type) -> dict[str, Any]:
    """Return the annotated attributes of a record, from which it is built."""
    return get_type_hints(record)


def _signature(kind: type, fields: Iterable[str]) -> bytes:
    """Return four bytes that tell a class and the names of its attributes from others."""
    return struct.pack("<I", zlib.crc32(f"{kind.__name__}: {', '.join(fields)}".encode()))


def _check_signature(source: Source, kind: type, fields: Iterable[str]) -> None:
    if source.read(4) != _signature(kind, fields):
        raise ValueError(f"not the {kind.__name__} of this version")


def _size(source: Source, code: str, most: int | None = None) -> int:
    """Read how many items or bytes follow; each takes a byte at least."""
    size: int = struct.unpack(code, source.read(struct.calcsize(code)))[0]
    if size > (source.left if most is None else min(most, source.left)):
        raise ValueError(f"{size} items where {source.left} bytes follow")
    return size


def _items(source: Source, hint: Any) -> Iterator[Any]:
    while decode(source, bool):
        yield decode(source, hint)


def _encode_column(values: Iterable[Any], hint: Any) -> Pieces:
    """Yield many values of one type; attributes of records come one after the other, as numbers lie best together."""
    values, kind = list(values), _kind(hint)
    if kind in _COLUMNS:
        yield _array_bytes(np.array(values, _COLUMNS[kind]))
    elif kind is np.ndarray:
        heads = {_array_head(value) for value in values}
        alike = len(heads) == 1 and values[0].nbytes > 0
        yield struct.pack("<?", alike)
        if alike:
            yield heads.pop()
        for value in values:
            if not alike:
                yield _array_head(value)
            yield _array_bytes(value)
    elif kind in _ONE_BY_ONE:
        for value in values:
            yield from encode(value, hint)
    else:
        yield _signature(hint, _fields(hint))
        for name, field_hint in _fields(hint).items():
            yield from _encode_column([getattr(value, name) for value in values], field_hint)


def _decode_column(source: Source, hint: Any, size: int, nows: list[Any] | None = None) -> list[Any]:
    kind = _kind(hint)
    if kind in _COLUMNS:
        return list(_array(source, np.dtype(_COLUMNS[kind]), (size,), "C").tolist())
    if kind is np.ndarray:
        head = _read_array_head(source, hint) if decode(source, bool) else None
        return [_array(source, *(head or _read_array_head(source, hint))) for _ in range(size)]
    if kind in _ONE_BY_ONE:
        return [decode(source, hint, nows[k] if nows else None) for k in range(size)]
    fields = _fields(hint)
    _check_signature(source, hint, fields)
    columns = [_decode_column(source, field_hint, size) for field_hint in fields.values()]
    return [hint(**dict(zip(fields, row, strict=True))) for row in zip(*columns, strict=True)]


def _array_head(array: Array) -> bytes:
    """Say what an array is: type, order in memory, shape. The order is kept: sums of products depend on it."""
    order = b"F" if array.flags.f_contiguous and not array.flags.c_contiguous else b"C"
    head = struct.pack("<BcB", DTYPES.index(array.dtype), order, array.ndim)
    return head + struct.pack(f"<{array.ndim}Q", *array.shape)


def _array_bytes(array: Array) -> bytes:
    """Return the bytes of an array, those of equal significance together: deflate finds more in them."""
    flat = np.frombuffer(array.tobytes("A"), np.uint8)
    return flat.reshape(-1, array.itemsize).T.tobytes() if array.itemsize > 1 else flat.tobytes()


def _read_array_head(source: Source, hint: Any) -> tuple[np.dtype[Any], tuple[int, ...], str]:
    number, order, num_dimensions = struct.unpack("<BcB", source.read(3))
    wanted = get_args(get_args(hint)[1])[0]
    if number >= len(DTYPES) or (wanted is not Any and DTYPES[number] != np.dtype(wanted)):
        raise ValueError("an array of another type")
    if order not in (b"C", b"F") or num_dimensions > _MOST_DIMENSIONS:
        raise ValueError("not an array")
    shape = struct.unpack(f"<{num_dimensions}Q", source.read(8 * num_dimensions))
    return DTYPES[number], shape, order.decode()


def _array(source: Source, dtype: np.dtype[Any], shape: tuple[int, ...], order: Any) -> Array:
    size = math.prod(shape) * dtype.itemsize
    if size > source.left:
        raise ValueError(f"an array of {size} bytes where {source.left} follow")
    planes = np.frombuffer(source.read(size), np.uint8)
    together = planes.reshape(dtype.itemsize, -1).T if dtype.itemsize > 1 and size else planes
    # A truth value is 0 or 1: kernels rely on it.
    flat = together != 0 if dtype.kind == "b" else np.frombuffer(together.tobytes(), dtype)
    return flat.reshape(shape, order=order).copy(order)
