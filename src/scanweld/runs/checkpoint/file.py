"""The file around the state of a run: a header in plain text, and compressed chunks, each with a checksum.

Layout (numbers are little-endian, docs/checkpoints.md): `MAGIC`; version, length and checksum of the header, the header
in JSON; chunks, each with its compressed length, its length, its checksum, and a zlib stream; a chunk without content.
A checksum is the CRC-32 of what it is of, begun with the checksum before: nothing can be missing, or in another order.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from scanweld.errors import FileFormatError
from scanweld.io.atomic import write_file

MAGIC = b"\x89scanweld-run\r\n"
VERSION = 1

CHUNK = 1 << 20
"""Bytes of a chunk before it is compressed."""

_HEAD, _CHUNK_HEAD = struct.Struct("<III"), struct.Struct("<III")
_LONGEST_HEADER = 1 << 24
_MOST_DEFLATED = 1032  # times that deflate can make anything smaller, at most


def write(path: Path, header: Mapping[str, Any], pieces: Iterable[bytes]) -> None:
    """Write a checkpoint; what was there before stays until all of it is on the disk.

    Raises
    ------
    OutputError
        When it cannot be written; what was there before is still there.
    """
    write_file(path, _framed(header, pieces), sync=True)


def _framed(header: Mapping[str, Any], pieces: Iterable[bytes]) -> Iterator[bytes]:
    text = json.dumps(header).encode()
    check = zlib.crc32(text)
    yield MAGIC + _HEAD.pack(VERSION, len(text), check) + text
    for chunk in _chunks(pieces):
        # Run lengths and Huffman codes alone: nearly as small as the rest of deflate makes it, in half the time.
        deflate = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
        packed = deflate.compress(chunk) + deflate.flush()
        check = zlib.crc32(packed, check)
        yield _CHUNK_HEAD.pack(len(packed), len(chunk), check)
        yield packed
    yield _CHUNK_HEAD.pack(0, 0, check)


def _chunks(pieces: Iterable[bytes]) -> Iterator[bytes]:
    waiting = bytearray()
    for piece in pieces:
        waiting += piece
        whole = len(waiting) // CHUNK * CHUNK
        for start in range(0, whole, CHUNK):
            yield bytes(waiting[start : start + CHUNK])
        del waiting[:whole]
    if waiting:
        yield bytes(waiting)


class CheckpointFile:
    """A checkpoint that is whole: all checksums are looked at before anything is handed out.

    Attributes
    ----------
    header : what the checkpoint is of
    left : bytes of the state that are still to be read

    Raises
    ------
    FileFormatError
        When the file is missing, damaged, no checkpoint, or of another version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise FileFormatError(f"{path}: cannot be read: {error.strerror or error}") from None
        self._chunk, self._at = b"", 0
        try:
            self.header, check = self._read_header()
            begin = self._file.tell()
            self.left = self._check_chunks(check)
            self._file.seek(begin)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> CheckpointFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        """Return the next bytes of the state; raises ValueError where there are fewer."""
        if size > self.left:
            raise ValueError(f"{size} bytes where {self.left} follow")
        self.left -= size
        parts = []
        while size > len(self._chunk) - self._at:
            parts.append(self._chunk[self._at :])
            size -= len(parts[-1])
            self._chunk, self._at = self._next_chunk(), 0
        parts.append(self._chunk[self._at : self._at + size])
        self._at += size
        return b"".join(parts)

    def _read_header(self) -> tuple[Mapping[str, Any], int]:
        if self._file.read(len(MAGIC)) != MAGIC:
            raise FileFormatError(f"{self.path}: not a checkpoint of a run")
        version, length, check = _HEAD.unpack(self._exactly(_HEAD.size))
        if version != VERSION:
            raise FileFormatError(
                f"{self.path}: a checkpoint of format {version}, this version of scanweld reads {VERSION}; resume with "
                "the version that wrote it, or begin anew with --force"
            )
        text = self._exactly(length if length <= _LONGEST_HEADER else -1)
        if zlib.crc32(text) != check:
            raise self._damaged()
        try:
            header = json.loads(text)
        except (ValueError, RecursionError):
            raise self._damaged() from None
        if not isinstance(header, dict):
            raise self._damaged()
        return header, check

    def _check_chunks(self, check: int) -> int:
        """Return the length of the state; raises FileFormatError where a checksum is wrong or the end is missing."""
        total: int = 0
        while True:
            packed, size, stated = _CHUNK_HEAD.unpack(self._exactly(_CHUNK_HEAD.size))
            if size > min(CHUNK, _MOST_DEFLATED * packed):
                raise self._damaged()
            check, total = zlib.crc32(self._exactly(packed), check), total + size
            if check != stated:
                raise self._damaged()
            if size == 0:
                break
        if self._file.read(1):
            raise self._damaged()
        return total

    def _next_chunk(self) -> bytes:
        packed, size, _ = _CHUNK_HEAD.unpack(self._exactly(_CHUNK_HEAD.size))
        inflate = zlib.decompressobj()
        try:
            chunk = inflate.decompress(self._exactly(packed), size + 1)
        except zlib.error:
            raise self._damaged() from None
        if len(chunk) != size or not inflate.eof:
            raise self._damaged()
        return chunk

    def _exactly(self, size: int) -> bytes:
        """Read so many bytes, which are there, or say that the file is damaged."""
        if not 0 <= size <= os.fstat(self._file.fileno()).st_size - self._file.tell():
            raise self._damaged()
        return self._file.read(size)

    def _damaged(self) -> FileFormatError:
        return FileFormatError(
            f"{self.path}: the checkpoint is damaged at byte {self._file.tell()}, and nothing of it is used; --force "
            "begins the run anew"
        )
