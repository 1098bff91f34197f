"""The three ROS messages of an RGB-D camera, parsed from their bytes: Image, CompressedImage, CameraInfo.

ROS 1 packs fields one after the other, little-endian. ROS 2 (CDR) begins with four bytes, of which the second says the
byte order, and aligns every number to its size. Both begin with a header: time, and the name of a frame; ROS 1 has a
counter before. A count is compared with the bytes that are left before anything is taken.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Float32, UInt8
from scanweld.datasets.images import (
    MAX_PIXELS,
    decode_color,
    decode_uint16_png,
    depth_from_units,
    header_of,
    valid_depth,
)
from scanweld.errors import UnreadableFrameError

IMAGE, COMPRESSED_IMAGE, CAMERA_INFO = (
    f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo")
)

COMPRESSED_DEPTH = "compressedDepth"
_PNG_MAGIC = b"\x89PNG"
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
# Channels, and OpenCV's conversion to RGB.
_COLOR_CODES = {
    "rgb8": (3, None),
    "bgr8": (3, "COLOR_BGR2RGB"),
    "8UC3": (3, "COLOR_BGR2RGB"),
    "rgba8": (4, "COLOR_RGBA2RGB"),
    "bgra8": (4, "COLOR_BGRA2RGB"),
    "8UC4": (4, "COLOR_BGRA2RGB"),
    "mono8": (1, "COLOR_GRAY2RGB"),
    "8UC1": (1, "COLOR_GRAY2RGB"),
    # OpenCV names a pattern by its second row.
    "bayer_rggb8": (1, "COLOR_BayerBG2RGB"),
    "bayer_bggr8": (1, "COLOR_BayerRG2RGB"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2RGB"),
    "bayer_grbg8": (1, "COLOR_BayerGB2RGB"),
    "yuv422": (2, "COLOR_YUV2RGB_UYVY"),
    "uyvy": (2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2RGB_YUY2"),
    "yuyv": (2, "COLOR_YUV2RGB_YUY2"),
}
GREY = ("mono8", "8UC1")


@dataclass(frozen=True, slots=True)
class RosImage:
    """An Image or a CompressedImage.

    Attributes
    ----------
    stamp_s : time in the header [s], 0 where the recorder had none
    frame_id : name of the camera's frame
    width, height : as the message says, or the header of the compressed image
    encoding : of the pixels, as "16UC1", or the format of a CompressedImage
    compressed : whether `data` is a PNG or JPEG image
    big_endian : byte order of the pixels
    step : bytes a row
    data : the pixels
    """

    stamp_s: float
    frame_id: str
    width: int
    height: int
    encoding: str
    compressed: bool
    big_endian: bool
    step: int
    data: memoryview

    @property
    def is_depth(self) -> bool:
        """Whether the encoding is one of depth; mono16 may also be infrared."""
        return COMPRESSED_DEPTH in self.encoding if self.compressed else self.encoding in _DEPTH_TYPES

    @property
    def is_color(self) -> bool:
        """Whether the image can be decoded as colour or grey."""
        return not self.is_depth and (self.compressed or self.encoding in _COLOR_CODES)

    @property
    def units_per_metre(self) -> float:
        """Of depth: 1 for floating point, 1000 for 16 bits."""
        return 1.0 if "32FC1" in self.encoding else 1000.0


@dataclass(frozen=True, slots=True)
class RosCameraInfo:
    """A CameraInfo: size, distortion coefficients, K (9,) and P (12,), row by row."""

    frame_id: str
    width: int
    height: int
    distortion: tuple[float, ...]
    K: tuple[float, ...]
    P: tuple[float, ...]


def read_stamp(data: bytes, *, is_cdr: bool, where: str) -> float:
    """Return the time in the header of a message [s]."""
    return _Cursor(data, is_cdr, where).header()[0]


def parse_image(data: bytes, msgtype: str, *, is_cdr: bool, where: str) -> RosImage:
    """Parse an Image or a CompressedImage; the pixels are not decoded.

    Raises
    ------
    UnreadableFrameError
        When the message is truncated, or its size absurd.
    """
    cursor = _Cursor(data, is_cdr, where)
    stamp_s, frame_id = cursor.header()
    if msgtype == COMPRESSED_IMAGE:
        encoding = cursor.text()
        content = cursor.rest_of(cursor.uint32())
        header = header_of(bytes(content[_config_bytes(content, encoding) :]), where)
        return RosImage(stamp_s, frame_id, header.width, header.height, encoding, True, False, 0, content)
    height, width, encoding = cursor.uint32(), cursor.uint32(), cursor.text()
    big_endian, step = bool(cursor.uint8()), cursor.uint32()
    content = cursor.rest_of(cursor.uint32())
    if not 0 < width * height <= MAX_PIXELS:
        raise UnreadableFrameError(f"{where}: the message claims an image of {width}x{height} pixels")
    return RosImage(stamp_s, frame_id, width, height, encoding, False, big_endian, step, content)


def parse_camera_info(data: bytes, *, is_cdr: bool, where: str) -> RosCameraInfo:
    """Parse a CameraInfo; raises UnreadableFrameError when the message is truncated."""
    cursor = _Cursor(data, is_cdr, where)
    frame_id = cursor.header()[1]
    height, width = cursor.uint32(), cursor.uint32()
    cursor.text()
    distortion = cursor.doubles(cursor.uint32())
    K = cursor.doubles(9)
    cursor.doubles(9)
    return RosCameraInfo(frame_id, width, height, distortion, K, cursor.doubles(12))


def decode_depth_message(image: RosImage, shape: tuple[int, int], depth_scale: float, where: str) -> Float32:
    """Return depth (H, W) [m] of an image of depth, 0 = invalid; raises UnreadableFrameError."""
    if image.compressed:
        return _decompressed_depth(image, shape, depth_scale, where)
    kind = (">" if image.big_endian else "<") + _DEPTH_TYPES[image.encoding]
    pixels = _pixels(image, np.dtype(kind), 1, shape, where)[..., 0]
    if kind.endswith("u2"):
        return depth_from_units(pixels, depth_scale)
    return valid_depth(pixels / np.float32(depth_scale))


def decode_color_message(image: RosImage, shape: tuple[int, int], where: str) -> UInt8:
    """Return the colours (H, W, 3) uint8 RGB of an image; raises UnreadableFrameError."""
    import cv2

    if image.compressed:
        return decode_color(bytes(image.data), where, shape)
    channels, code = _COLOR_CODES[image.encoding]
    pixels = np.ascontiguousarray(_pixels(image, np.dtype(np.uint8), channels, shape, where))
    if code is None:
        return pixels.copy()
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, code)), dtype=np.uint8)


def _decompressed_depth(image: RosImage, shape: tuple[int, int], depth_scale: float, where: str) -> Float32:
    """Decode compressed_depth_image_transport: a configuration of 12 bytes, then a PNG of 16 bits.

    Floating point is stored as A / depth + B, A and B single-precision numbers in the configuration.
    """
    skipped = _config_bytes(image.data, image.encoding)
    raw = decode_uint16_png(bytes(image.data[skipped:]), where, shape)
    if "32FC1" not in image.encoding:
        return depth_from_units(raw, depth_scale)
    a, b = struct.unpack_from("<2f", image.data, 4) if skipped else (np.nan, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(a) / (raw.astype(np.float32) - np.float32(b))
    return valid_depth(np.where(raw > 0, depth, 0) / np.float32(depth_scale))


def _config_bytes(content: memoryview, encoding: str) -> int:
    """Bytes before the PNG image of a compressed depth message."""
    return 12 if COMPRESSED_DEPTH in encoding and bytes(content[:4]) != _PNG_MAGIC else 0


def _pixels(image: RosImage, dtype: np.dtype[np.generic], channels: int, shape: tuple[int, int], where: str) -> Array:
    height, width = shape
    if (image.height, image.width) != shape:
        raise UnreadableFrameError(f"{where}: the image is {image.width}x{image.height}, the topic's {width}x{height}")
    row_bytes = width * channels * dtype.itemsize
    if image.step < row_bytes or len(image.data) < image.step * height:
        raise UnreadableFrameError(
            f"{where}: {image.encoding} of {width}x{height} needs {row_bytes} bytes a row, the message has a step of "
            f"{image.step} and {len(image.data)} bytes"
        )
    rows = np.frombuffer(image.data, np.uint8, image.step * height).reshape(height, image.step)
    return np.ascontiguousarray(rows[:, :row_bytes]).view(dtype).reshape(height, width, channels)


class _Cursor:
    """Take one field after the other."""

    def __init__(self, data: bytes, is_cdr: bool, where: str) -> None:
        self._data, self._is_cdr, self._where = memoryview(data), is_cdr, where
        self._position = self._origin = 4 if is_cdr else 0
        self._order = ">" if is_cdr and len(data) > 1 and not data[1] & 1 else "<"

    def header(self) -> tuple[float, str]:
        """Time [s] and frame_id."""
        if not self._is_cdr:
            self.uint32()
        seconds, nanoseconds = self._numbers("I", 4, 1)[0], self._numbers("I", 4, 1)[0]
        return float(seconds + nanoseconds * 1e-9), self.text()

    def uint8(self) -> int:
        return int(self._numbers("B", 1, 1)[0])

    def uint32(self) -> int:
        return int(self._numbers("I", 4, 1)[0])

    def doubles(self, count: int) -> tuple[float, ...]:
        return self._numbers("d", 8, count)

    def text(self) -> str:
        """A string, whose length ROS 2 counts with the zero at its end."""
        return bytes(self.rest_of(self.uint32())).rstrip(b"\0").decode("utf-8", "replace")

    def rest_of(self, count: int) -> memoryview:
        """The next `count` bytes."""
        end = self._position + count
        if end > len(self._data):
            left = max(0, len(self._data) - self._position)
            raise UnreadableFrameError(f"{self._where}: truncated message: {count} bytes announced, {left} left")
        taken, self._position = self._data[self._position : end], end
        return taken

    def _numbers(self, kind: str, size: int, count: int) -> tuple[float, ...]:
        if self._is_cdr and count:
            self._position += -(self._position - self._origin) % size
        # The length is checked before the format is built: a count may be absurd.
        taken = self.rest_of(size * count)
        return struct.unpack(f"{self._order}{count}{kind}", taken)
