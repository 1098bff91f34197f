"""Spoil an input: bytes anywhere, numbers and words of text, whole files, and what lies behind checksums."""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from random import Random

from inputs import Files

NUMBERS = (
    b"0", b"-1", b"1", b"2", b"255", b"256", b"65536", b"2147483647", b"2147483648", b"4294967295", b"4294967296",
    b"9223372036854775807", b"18446744073709551616", b"1" + b"0" * 30, b"1e308", b"-1e308", b"1e-320", b"1e999", b"nan",
    b"-inf", b"inf", b"0.5", b"-0", b"0x10", b"1_0", b"1,5", b"", b"null", b"true", b'"1"', b"[]", b"{}", b"9" * 400,
)  # fmt: skip
WORDS = (
    b"", b"..", b"../../etc/passwd", b"/etc/passwd", b"C:\\x", b"a\0b", b"\xff\xfe", b"\xe2\x80\xa8", b"-", b"#",
    b'"', b"'", b",", b"\r", b"\n", b"\r\n", b"\t", b" ", b"%s%n", b"{", b"}", b"[" * 300, b"(" * 2000, b"end_header",
    b"\xef\xbb\xbf", b"\xd9\xa3", b"\xc2\xb2",
)  # fmt: skip
INTEGERS = (
    0, 1, 2, 7, 8, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1,
)  # fmt: skip
FLOATS = (0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 1e38, 1e300, 5e-324)

_NUMBER = re.compile(rb"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?")
_WORD = re.compile(rb"[^\s,;:=\[\]{}\"']+")
_LONGEST = 1 << 20
_SPOILT_BEFORE = (
    ValueError, IndexError, struct.error, zlib.error, zipfile.BadZipFile, NotImplementedError, EOFError, Warning,
)  # fmt: skip
"""What taking an input apart raises that is not whole any more."""


def mutate(files: Files, others: Sequence[Files], random: Random) -> dict[str, bytes]:
    """Return the files with one to four changes; `others` are inputs to take pieces from."""
    spoilt = dict(files)
    for _ in range(random.choice((1, 1, 1, 2, 2, 4))):
        if len(spoilt) > 1 and random.random() < 0.1:
            _whole_file(spoilt, random)
        if not spoilt:
            break
        # A file is chosen without regard to how long it is: the short ones say what the others are.
        name = random.choice(sorted(spoilt))
        spoilt[name] = spoil(spoilt[name], [other[name] for other in others if name in other], random)[:_LONGEST]
    return spoilt


def spoil(content: bytes, others: Sequence[bytes], random: Random) -> bytes:
    """Change something in a file; where it has checksums that are known, they are made right afterwards."""
    repack = next((repack for knows, repack in _WRAPPED if knows(content)), None)
    if repack is not None and random.random() < 0.7:
        try:
            return repack(content, random)
        except _SPOILT_BEFORE:
            pass
    if _is_text(content) and random.random() < 0.85:
        return random.choice(_TEXTUAL)(content, random)
    if others and random.random() < 0.1:
        other = random.choice(others)
        return content[: random.randint(0, len(content))] + other[random.randint(0, len(other)) :]
    return random.choice(_BINARY)(content, random)


def _is_text(content: bytes) -> bool:
    return (
        b"\0" not in content[:4096] and sum(byte > 126 for byte in content[:4096]) < 0.05 * min(len(content), 4096) + 1
    )


def _whole_file(files: dict[str, bytes], random: Random) -> None:
    """Remove, empty, or exchange a file."""
    one, other = random.choice(sorted(files)), random.choice(sorted(files))
    match random.randrange(4):
        case 0:
            del files[one]
        case 1:
            files[one] = b""
        case 2:
            files[one], files[other] = files[other], files[one]
        case _:
            files[one] = files[other]


def _place(content: bytes, random: Random) -> int:
    """Return a place in a file, often near its beginning or its end, where headers and indices are."""
    size = len(content)
    match random.randrange(4):
        case 0:
            return random.randrange(min(size, 256) + 1)
        case 1:
            return size - random.randrange(min(size, 256) + 1)
        case _:
            return random.randrange(size + 1)


def _flip(content: bytes, random: Random) -> bytes:
    data = bytearray(content or b"\0")
    data[_place(content, random) % len(data)] ^= 1 << random.randrange(8)
    return bytes(data)


def _cut(content: bytes, random: Random) -> bytes:
    return content[: _place(content, random)]


def _remove(content: bytes, random: Random) -> bytes:
    at = _place(content, random)
    return content[:at] + content[at + random.choice((1, 2, 4, 8, 64, 1000)) :]


def _insert(content: bytes, random: Random) -> bytes:
    at = _place(content, random)
    piece = random.choice((b"\0", b"\xff", random.randbytes(4), content[at : at + 64], bytes(1000)))
    return content[:at] + piece * random.choice((1, 1, 2, 50)) + content[at:]


def _overwrite(content: bytes, random: Random) -> bytes:
    order = random.choice("<>")
    if random.random() < 0.7:
        code, value = random.choice("BHIQ"), random.choice(INTEGERS) + random.choice((0, 0, 0, -1, 1))
        piece = struct.pack(order + code, value % (1 << 8 * struct.calcsize(code)))
    else:
        code, number = random.choice("fd"), random.choice(FLOATS)
        piece = struct.pack(order + code, number if code == "d" or abs(number) < 1e39 or number != number else 1e38)
    at = _place(content, random)
    at -= at % random.choice((1, 1, 4, 8))
    return content[:at] + piece + content[at + len(piece) :]


_BINARY: tuple[Callable[[bytes, Random], bytes], ...] = (_flip, _flip, _cut, _remove, _insert, _overwrite, _overwrite)


def _number(content: bytes, random: Random) -> bytes:
    return _replace_one(_NUMBER, content, random.choice(NUMBERS), random)


def _word(content: bytes, random: Random) -> bytes:
    return _replace_one(_WORD, content, random.choice(WORDS), random)


def _swap_words(content: bytes, random: Random) -> bytes:
    words = _WORD.findall(content[:100_000])
    return _replace_one(_WORD, content, random.choice(words), random) if words else content


def _lines(content: bytes, random: Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if not lines:
        return b"\n"
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    match random.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[other])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            lines[at : at + 1] = lines[at : at + 1] * random.choice((2, 100))
    return b"".join(lines)


def _replace_one(pattern: re.Pattern[bytes], content: bytes, piece: bytes, random: Random) -> bytes:
    places = [match.span() for match in pattern.finditer(content[:200_000])]
    if not places:
        return piece + content
    # Those at the beginning more often: that is where counts and sizes are.
    start, end = places[int(len(places) * random.random() ** random.choice((1, 3)))]
    return content[:start] + piece + content[end:]


_TEXTUAL = (_number, _number, _word, _swap_words, _lines, _insert, _cut, _flip)


def _in_zip(content: bytes, random: Random) -> bytes:
    """Spoil a file of an archive, or the name of one, and pack it again."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > 1 << 24:
            raise ValueError("large")
        members = [(name, archive.read(name)) for name in archive.namelist()]
    at = random.randrange(len(members))
    name, data = members[at]
    if random.random() < 0.1:
        members[at] = (random.choice(("../../x", "/x", name + "x", "rgbd/99999999999.jpg", name)), data)
    else:
        members[at] = (name, spoil(data, [], random))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in members:
            archive.writestr(zipfile.ZipInfo(name), data)
    return packed.getvalue()


def _in_png(content: bytes, random: Random) -> bytes:
    """Spoil a chunk of a PNG, now and then what its pixels unpack to, and set the checksums right."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        (size,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    k = random.randrange(len(chunks))
    kind, data = chunks[k]
    if kind == b"IDAT" and random.random() < 0.5:
        data = zlib.compress(random.choice(_BINARY)(_inflated(data), random))
    else:
        data = random.choice(_BINARY)(data, random)
    chunks[k] = (kind, data)
    if random.random() < 0.1:
        chunks.insert(random.randrange(len(chunks)), random.choice(chunks))
    parts = [struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in chunks]
    return content[:8] + b"".join(parts)


def _inflated(data: bytes) -> bytes:
    return zlib.decompressobj().decompress(data, 1 << 22)


_CHECKPOINT_MAGIC = b"\x89scanweld-run\r\n"


def _in_checkpoint(content: bytes, random: Random) -> bytes:
    """Spoil the header or the state of a checkpoint, and frame it again with right checksums."""
    at = len(_CHECKPOINT_MAGIC)
    version, size, _ = struct.unpack_from("<III", content, at)
    text, at, state = content[at + 12 : at + 12 + size], at + 12 + size, b""
    while (packed := struct.unpack_from("<I", content, at)[0]) > 0:
        state += _inflated(content[at + 12 : at + 12 + packed])
        at += 12 + packed
    if random.random() < 0.3:
        text = random.choice(_TEXTUAL)(text, random)
    else:
        state = random.choice(_BINARY)(state, random)
    check = zlib.crc32(text)
    framed = _CHECKPOINT_MAGIC + struct.pack("<III", version, len(text), check) + text
    for start in range(0, len(state), 1 << 20):
        chunk = state[start : start + (1 << 20)]
        data = zlib.compress(chunk, 1)
        check = zlib.crc32(data, check)
        framed += struct.pack("<III", len(data), len(chunk), check) + data
    return framed + struct.pack("<III", 0, 0, check)


def _in_e57(content: bytes, random: Random) -> bytes:
    """Spoil the content of the pages of an E57 file, and set their checksums right (CRC-32C, big-endian)."""
    pages = [content[at : at + 1020] for at in range(0, len(content), 1024)]
    plain = b"".join(pages)
    at = plain.find(b"<?xml")
    if at > 0 and random.random() < 0.7:
        text = plain[at:].rstrip(b"\0")
        changed = random.choice(_TEXTUAL)(text, random)
        plain = plain[:at] + changed[: len(plain) - at].ljust(len(plain) - at, b" ")
    else:
        changed = random.choice((_flip, _overwrite))(plain, random)
        plain = changed[: len(plain)].ljust(len(plain), b"\0")
    parts = [plain[at : at + 1020] for at in range(0, len(plain), 1020)]
    return b"".join(part + struct.pack(">I", _crc32c(part)) for part in parts)


def _crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _CRC32C[(crc ^ byte) & 255] ^ crc >> 8
    return crc ^ 0xFFFFFFFF


def _crc32c_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_CRC32C = _crc32c_table()

_WRAPPED: tuple[tuple[Callable[[bytes], bool], Callable[[bytes, Random], bytes]], ...] = (
    (lambda content: content.startswith(b"PK\3\4"), _in_zip),
    (lambda content: content.startswith(b"\x89PNG\r\n\x1a\n"), _in_png),
    (lambda content: content.startswith(_CHECKPOINT_MAGIC), _in_checkpoint),
    (lambda content: content.startswith(b"ASTM-E57"), _in_e57),
)
