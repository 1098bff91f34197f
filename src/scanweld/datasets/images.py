"""Decode and resize depth and colour images.

A damaged file is found before it reaches the decoder (every PNG chunk has a checksum, a JPEG ends with a
marker), because decoders fill what is missing with whatever they like. The size in the header is compared
with the expected one before anything is allocated. OpenCV loads on the first decode.
"""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanweld.arrays import Array, Bool, Float32, UInt8
from scanweld.errors import DatasetError, InvalidInputError, UnreadableFrameError

MAX_PIXELS = 1 << 26
"""Largest image that is decoded; a damaged header must not allocate gigabytes."""

MAX_DEPTH_M = 65535.0
"""Depth beyond this is no measurement in any unit; the mapper has its own, much shorter range."""

MAX_DEPTH_SCALE = 1e9
"""Most units per metre that a depth image can have: nanometres."""

MIN_DEPTH_SCALE = 1e-3
"""Fewest: kilometres."""

SURFACE_BAND = 0.02
"""Depths that differ by less than this share of the depth belong to one surface when an image is resized."""

MAX_SAMPLES = 8
"""Input rows, and columns, that are looked at for an output pixel when an image is resized."""

MIN_SIDE_PX = 32
"""Shorter side that an image must keep when it is made smaller; below it there is nothing to track."""

PLAUSIBLE_MEDIAN_M = (0.15, 5.5)
"""Median depth of a scene in front of an RGB-D camera, from a shelf bin at arm's length to a hall [m]."""

CONFUSABLE_UNITS = (1.5, 20.0)
"""Factors between two units after which a scene still looks like one."""

_KNOWN_DEPTH_SCALES = (1000.0, 5000.0, 1.0, 100.0, 10000.0, 6553.5)  # likeliest first
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What an intact image file says about itself."""

    width: int
    height: int
    bits: int
    channels: int


def read_header(path: Path) -> ImageHeader:
    """Return the header of a PNG or JPEG file, after checking that the file is complete.

    Raises
    ------
    UnreadableFrameError
        When the file is missing, truncated, damaged, or neither PNG nor JPEG.
    """
    return header_of(read_file(path), path)


def read_color(path: Path, shape: tuple[int, int]) -> UInt8:
    """Decode a PNG or JPEG file as RGB (H, W, 3) uint8; grey, 16-bit and transparent images are converted.

    Raises
    ------
    UnreadableFrameError
        When the file is damaged or not of the expected `shape` (height, width).
    """
    return decode_color(read_file(path), path, shape)


def decode_color(data: bytes, where: Path | str, shape: tuple[int, int]) -> UInt8:
    """Decode a PNG or JPEG image in memory as `read_color` does a file; `where` names it in errors."""
    _require_shape(where, header_of(data, where), shape)
    color = _decode_quickly(where, data)
    if color is not None and color.ndim == 3:
        return color
    import cv2

    # A camera that was held upright writes an EXIF orientation; the depth image has none.
    as_rgb = getattr(cv2, "IMREAD_COLOR_RGB", None)  # OpenCV 4.11
    flags = cv2.IMREAD_COLOR if as_rgb is None else as_rgb
    image = _decode(where, data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if as_rgb is None else image, dtype=np.uint8)


def read_depth_png(path: Path, shape: tuple[int, int], depth_scale: float) -> Float32:
    """Decode a 16-bit PNG as metres (H, W) float32, 0 where the sensor saw nothing (0 and 65535 in the file).

    Parameters
    ----------
    path : file
    shape : expected (height, width)
    depth_scale : units in the file per metre

    Raises
    ------
    UnreadableFrameError
        When the file is damaged, not of the expected shape, or not one channel of 16 bits.
    """
    return depth_from_units(decode_uint16_png(read_file(path), path, shape), depth_scale)


def decode_uint16_png(data: bytes, where: Path | str, shape: tuple[int, int]) -> Array:
    """Decode a PNG image of one channel with 16 bits in memory, (H, W) uint16; `where` names it in errors.

    Raises
    ------
    UnreadableFrameError
        When it is damaged, not of the expected shape, or of other content.
    """
    header = header_of(data, where)
    _require_shape(where, header, shape)
    fault = depth_header_fault(header)
    if fault:
        raise UnreadableFrameError(f"{where}: {fault}")
    raw = _decode_quickly(where, data)
    if raw is not None:
        return raw
    import cv2

    return _decode(where, data, cv2.IMREAD_UNCHANGED)


def decode_uint8_png(data: bytes, where: Path | str, shape: tuple[int, int]) -> UInt8:
    """Decode a PNG image of one channel with 8 bits in memory, (H, W) uint8; see `decode_uint16_png`."""
    import cv2

    header = header_of(data, where)
    _require_shape(where, header, shape)
    if (header.bits, header.channels) != (8, 1):
        raise UnreadableFrameError(
            f"{where}: it has {header.bits} bits and {header.channels} channels, expected one channel of 8 bits"
        )
    return np.asarray(_decode(where, data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


def depth_from_units(raw: Array, depth_scale: float) -> Float32:
    """Return depth (H, W) float32 [m] from unsigned 16-bit units; 0 and 65535 are invalid and become 0."""
    depth: Float32 = np.divide(raw, np.float32(depth_scale), dtype=np.float32)
    if raw.max() == 65535:
        depth[raw == 65535] = 0
    return depth


def depth_header_fault(header: ImageHeader) -> str:
    """Say why an image cannot be a depth image, or return ""."""
    if header.bits == 16 and header.channels == 1:
        return ""
    what = f"{header.bits} bits, {header.channels} channel{'s' if header.channels > 1 else ''}"
    hint = "are colour and depth swapped?" if header.channels >= 3 else "export the raw depth, not a preview of it"
    return f"not a depth image: it has {what}, expected one channel of 16 bits; {hint}"


def read_ray_distance_text(path: Path, shape: tuple[int, int], depth_scale: float) -> Float32:
    """Read H * W numbers, row by row, as (H, W) float32 [m]; what is not a positive finite number becomes 0.

    Raises
    ------
    UnreadableFrameError
        When the file is missing, holds something else than numbers, or not H * W of them.
    """
    data = read_file(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how NumPy reports text that is no number
        try:
            values = np.fromstring(data.decode("ascii"), dtype=np.float32, sep=" ")
        except (ValueError, DeprecationWarning):
            raise UnreadableFrameError(f"{path}: expected numbers separated by blanks") from None
    height, width = shape
    if values.size != height * width:
        raise UnreadableFrameError(
            f"{path}: expected {width} x {height} = {width * height} numbers, got {values.size}; truncated?"
        )
    return valid_depth(values.reshape(shape) / np.float32(depth_scale))


def valid_depth(depth_m: Array) -> Float32:
    """Return depth (H, W) [m] as float32 with NaN, infinite, negative and absurd values mapped to 0."""
    depth = np.asarray(depth_m, dtype=np.float32)
    valid = np.isfinite(depth) & (depth > 0) & (depth < MAX_DEPTH_M)
    return np.where(valid, depth, np.float32(0))


def resize_depth(depth_m: Float32, shape: tuple[int, int]) -> Float32:
    """Resize depth (H, W) [m] to `shape` without mixing surfaces; pixel centres as `PinholeCamera.scaled`.

    The footprint of an output pixel is sampled by a regular grid of input pixels: by all of them up to
    ``MAX_SAMPLES`` a side, by so many spread over it beyond. The surface is the one that most of the valid
    samples agree with to ``SURFACE_BAND``, the nearer of two equals. The samples on it are averaged in inverse
    depth, which is linear over the pixels of a plane: a plane comes out exactly, at the pixel centre between
    the samples. Enlarging takes the nearest pixel.
    """
    rows = _footprint(depth_m.shape[0], shape[0])
    columns = _footprint(depth_m.shape[1], shape[1])
    samples = [depth_m[r][:, c] for r in rows for c in columns]
    if len(samples) == 1:
        return np.ascontiguousarray(samples[0])
    surface = np.zeros(shape, dtype=np.float32)
    most = np.zeros(shape, dtype=np.int16)
    for candidate in samples:
        votes = sum(same.astype(np.int16) for same in _on_surface(samples, candidate))
        better = (votes > most) | ((votes == most) & (candidate < surface))
        np.copyto(surface, candidate, where=better)
        np.copyto(most, votes, where=better)
    total = np.zeros(shape, dtype=np.float32)
    with np.errstate(divide="ignore"):  # 1 / 0 is not taken
        for sample, same in zip(samples, _on_surface(samples, surface), strict=True):
            np.add(total, 1 / sample, out=total, where=same)
    result = np.zeros(shape, dtype=np.float32)
    np.divide(most, total, out=result, where=most > 0)
    return result


def _on_surface(samples: list[Float32], surface_m: Float32) -> Iterator[Bool]:
    """For each sample image, where it is valid and within the band of the surface."""
    tolerance = np.float32(SURFACE_BAND) * surface_m
    for sample in samples:
        yield np.abs(sample - surface_m) < tolerance  # never where the surface is 0


def _footprint(size_in: int, size_out: int) -> Array:
    """Input indices (n, size_out) that sample the footprint of each output pixel, about its centre."""
    step = size_in / size_out
    # Every sample is compared with every other: without a bound the cost grows with the fourth power of the step.
    n = min(MAX_SAMPLES, max(1, math.ceil(step - 1e-9)))
    offsets = (np.arange(n)[:, None] + 0.5) / n * step
    # In the continuous coordinate of the input, pixel i spans [i, i + 1).
    indices = np.floor(np.arange(size_out) * step + offsets + 1e-9).astype(np.int64)
    return np.clip(indices, 0, size_in - 1)


def resize_color(color: UInt8, shape: tuple[int, int]) -> UInt8:
    """Resize an image (H, W, 3) to `shape`; shrinking averages the area of each output pixel."""
    import cv2

    height, width = shape
    shrinks = height <= color.shape[0] and width <= color.shape[1]
    resized: UInt8 = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return resized


def check_depth_unit(median_depth_m: float, depth_scale: float) -> str | None:
    """Say in one line what is wrong with the depth unit, or return None when the depth is plausible.

    Parameters
    ----------
    median_depth_m : median of the valid depth of the first frames [m], or 0 when there is none
    depth_scale : units per metre that the depth was read with

    Notes
    -----
    A unit that makes the scene five times too near is not seen here: a shelf at 0.4 m is as plausible as a
    room at 2 m.
    """
    if not median_depth_m > 0:
        return "no valid depth in the first frames: is the depth folder the right one?"
    low, high = PLAUSIBLE_MEDIAN_M
    if low <= median_depth_m <= high:
        return None
    raw = median_depth_m * depth_scale
    likely = [scale for scale in _KNOWN_DEPTH_SCALES if low <= raw / scale <= high]
    seen = f"the median depth is {median_depth_m:.3g} m with {depth_scale:g} units per metre"
    if not likely:
        return f"{seen}, which is implausible; pass --depth-scale (units per metre of the depth images)"
    scale = likely[0]
    return f"{seen}; the unit is likely {_unit(scale)} ({raw / scale:.3g} m): pass --depth-scale {scale:g}"


def likely_depth_scale(measured: float) -> float:
    """Return the unit in use, in units per metre, that is within a third of a measured one; else that one."""
    nearest = min(_KNOWN_DEPTH_SCALES, key=lambda scale: abs(math.log(scale / measured)))
    return nearest if abs(math.log(nearest / measured)) < math.log(4 / 3) else measured


def explain_unusable_depth(median_depth_m: float, depth_scale: float, range_m: tuple[float, float]) -> str:
    """Say in one line why depth gave no surface, and which unit it likely has.

    Parameters
    ----------
    median_depth_m : median of the valid depth [m], or 0 when there is none
    depth_scale : units per metre that the depth was read with
    range_m : nearest and furthest depth that is used [m]
    """
    advice = check_depth_unit(median_depth_m, depth_scale)
    if advice is not None:
        return advice
    low, high = range_m
    seen = (
        f"the median depth is {median_depth_m:.3g} m with {depth_scale:g} units per metre, "
        f"{low:g} to {high:g} m are used"
    )
    if low <= median_depth_m <= high:
        return f"{seen}; the unit looks right, the valid pixels are too few or too scattered"
    raw = median_depth_m * depth_scale
    likely = [scale for scale in _KNOWN_DEPTH_SCALES if low <= raw / scale <= high]
    if not likely:
        return f"{seen}; widen the range"
    scale = likely[0]
    return f"{seen}; widen the range, or, if the unit is {_unit(scale)}, pass --depth-scale {scale:g}"


def compare_depth_units(stated: float, passed: float, source: str) -> str | None:
    """Say in one line that a caller's unit contradicts a stated one by a factor that no picture betrays.

    Parameters
    ----------
    stated : units per metre that the sequence has by itself
    passed : units per metre that the caller asks for
    source : who states it, as "camera.json" or "the format"

    Returns
    -------
    The warning, or None where the two are near each other, or so far that `check_depth_unit` sees it.
    """
    low, high = CONFUSABLE_UNITS
    factor = max(stated, passed) / min(stated, passed)
    if not low <= factor <= high:
        return None
    change = "smaller" if passed > stated else "larger"
    return (
        f"depth_scale: the unit of {source} is {stated:g} per metre, {passed:g} was passed: "
        f"the scene becomes {factor:.3g} times {change}"
    )


def _unit(depth_scale: float) -> str:
    names = {1.0: "1 m", 100.0: "1 cm", 1000.0: "1 mm", 10000.0: "0.1 mm", 5000.0: "0.2 mm (TUM)"}
    return names.get(depth_scale, f"1/{depth_scale:g} m")


def read_file(path: Path) -> bytes:
    """Return the content of an image file; raises UnreadableFrameError when it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise UnreadableFrameError(f"{path}: {error.strerror or error}") from None


def _decode_quickly(where: Path | str, data: bytes) -> Array | None:
    """Decode a PNG of a kind that there is a fast decoder for; None for others."""
    if not data.startswith(_PNG_MAGIC):
        return None
    from scanweld.datasets.png import decode_png

    try:
        return decode_png(data)
    except ValueError as error:
        raise UnreadableFrameError(f"{where}: cannot be decoded ({error})") from None


def _decode(path: Path | str, data: bytes, flags: int) -> Array:
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise UnreadableFrameError(f"{path}: cannot be decoded ({error.err})") from None
    if image is None:
        raise UnreadableFrameError(f"{path}: cannot be decoded; the file is damaged")
    return np.asarray(image)


def _require_shape(path: Path | str, header: ImageHeader, shape: tuple[int, int]) -> None:
    if (header.height, header.width) != shape:
        raise UnreadableFrameError(
            f"{path}: the image is {header.width}x{header.height}, the sequence {shape[1]}x{shape[0]}"
        )


def header_of(data: bytes, path: Path | str) -> ImageHeader:
    """Return the header of a PNG or JPEG image in memory, after checking that it is complete; see `read_header`."""
    if data.startswith(_PNG_MAGIC):
        header = _png_header(data)
    elif data.startswith(b"\xff\xd8"):
        header = _jpeg_header(data)
    elif not data:
        raise UnreadableFrameError(f"{path}: the file is empty")
    else:
        raise UnreadableFrameError(f"{path}: neither PNG nor JPEG (starts with {data[:4]!r})")
    if isinstance(header, str):
        raise UnreadableFrameError(f"{path}: {header}")
    if not 0 < header.width * header.height <= MAX_PIXELS:
        raise UnreadableFrameError(f"{path}: the header claims {header.width}x{header.height} pixels")
    return header


def _png_header(data: bytes) -> ImageHeader | str:
    """Walk the chunks (PNG specification, section 5); return the header, or what is wrong."""
    if len(data) < 33 or data[12:16] != b"IHDR":
        return "truncated PNG"
    view, position = memoryview(data), 8
    while position + 12 <= len(data):
        end = position + 12 + int.from_bytes(view[position : position + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            return "damaged PNG (checksum)"
        if data[position + 4 : position + 8] == b"IEND":
            width, height = int.from_bytes(view[16:20], "big"), int.from_bytes(view[20:24], "big")
            return ImageHeader(width, height, data[24], _PNG_CHANNELS.get(data[25], 0))
        position = end
    return f"truncated PNG ({len(data)} bytes)"


def _jpeg_header(data: bytes) -> ImageHeader | str:
    """Walk the segments to the first scan (ITU T.81, annex B); return the header, or what is wrong."""
    header: ImageHeader | None = None
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        is_frame = 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)
        if is_frame and position + 10 <= len(data):
            height = int.from_bytes(data[position + 5 : position + 7], "big")
            width = int.from_bytes(data[position + 7 : position + 9], "big")
            header = ImageHeader(width, height, data[position + 4], data[position + 9])
        position += 2 + length
        if marker == 0xDA:
            # Inside a scan 0xFF is always followed by a stuffed zero or a restart: this is the end marker.
            if header is None or data.find(b"\xff\xd9", position) < 0:
                break
            return header
    return f"truncated JPEG ({len(data)} bytes)"


def require_scale(scale: float) -> float:
    """Return an image scale factor after checking its range.

    Raises
    ------
    InvalidInputError
        When it is not within (0, 4].
    """
    if not (math.isfinite(scale) and 0 < scale <= 4):
        raise InvalidInputError(f"scale: expected a factor above 0 and up to 4, got {scale}")
    return scale


def require_depth_scale(depth_scale: float, where: str = "") -> float:
    """Return a depth scale after checking that it is a positive number; `where` is the file that states it.

    Raises
    ------
    DatasetError
        When it is not.
    """
    if not MIN_DEPTH_SCALE <= depth_scale <= MAX_DEPTH_SCALE:
        place = f"{where}: " if where else ""
        raise DatasetError(
            f"{place}depth_scale must be positive and plausible (units per metre, e.g. 1000), got {depth_scale}"
        )
    return depth_scale
