"""LZFSE, Apple's compression, through pyliblzfse (extra `record3d`).

The library grows its output until everything fits. The headers of the blocks say how much that is; they are added up
first, so that neither a damaged nor a malicious stream allocates more than was expected (LZFSE reference
implementation, lzfse_internal.h).
"""

from __future__ import annotations

import struct

from scanweld.errors import MissingDependencyError, UnreadableFrameError

_END, _PLAIN, _LZVN, _V1, _V2 = b"bvx$", b"bvx-", b"bvxn", b"bvx1", b"bvx2"
_V1_HEADER_BYTES = 772
_20_BITS = (1 << 20) - 1


def decompress_lzfse(data: bytes, num_bytes: int, where: str) -> bytes:
    """Return the `num_bytes` that a stream becomes; data of that size without LZFSE's mark is returned as it is.

    Parameters
    ----------
    data : the stream
    num_bytes : expected size
    where : what it is, for messages

    Raises
    ------
    UnreadableFrameError
        When the stream is truncated, damaged, or becomes something of another size.
    MissingDependencyError
        When pyliblzfse is not installed.
    """
    if not data.startswith(b"bvx"):
        if len(data) == num_bytes:
            return data
        raise UnreadableFrameError(f"{where}: no LZFSE stream (starts with {data[:4]!r})")
    promised = _promised_bytes(data, where, num_bytes)
    if promised != num_bytes:
        raise UnreadableFrameError(f"{where}: becomes {promised} bytes, expected {num_bytes}")
    try:
        import liblzfse
    except ImportError:
        raise MissingDependencyError("pyliblzfse", "record3d") from None
    try:
        result = bytes(liblzfse.decompress(data))
    except (liblzfse.error, MemoryError) as error:
        raise UnreadableFrameError(f"{where}: cannot be decompressed ({error}); the data is damaged") from None
    if len(result) != num_bytes:
        raise UnreadableFrameError(f"{where}: became {len(result)} bytes, expected {num_bytes}; the data is damaged")
    return result


def _promised_bytes(data: bytes, where: str, enough: int) -> int:
    """Walk over the blocks to the end mark; return the sum of their sizes, or anything above `enough`."""
    position, total = 0, 0
    while True:
        magic = data[position : position + 4]
        if magic == _END:
            return total
        try:
            raw_bytes, block_bytes = _block(magic, data, position)
        except struct.error:
            raise UnreadableFrameError(f"{where}: truncated LZFSE stream ({len(data)} bytes)") from None
        if block_bytes <= 0:
            raise UnreadableFrameError(f"{where}: damaged LZFSE stream (a block of {magic!r})")
        total += raw_bytes
        position += block_bytes
        if total > enough:
            return total


def _block(magic: bytes, data: bytes, position: int) -> tuple[int, int]:
    """Size of a block's content and of the block itself, 0 for no known block; struct.error at the end of the data."""
    (raw_bytes,) = struct.unpack_from("<I", data, position + 4)
    if magic == _PLAIN:
        return raw_bytes, 8 + raw_bytes
    if magic == _LZVN:
        return raw_bytes, 12 + struct.unpack_from("<I", data, position + 8)[0]
    if magic == _V1:
        return raw_bytes, _V1_HEADER_BYTES + struct.unpack_from("<I", data, position + 8)[0]
    if magic == _V2:
        first, second, third = struct.unpack_from("<3Q", data, position + 8)
        payload = ((first >> 20) & _20_BITS) + ((second >> 40) & _20_BITS)
        return raw_bytes, (third & 0xFFFFFFFF) + payload
    return raw_bytes, 0
