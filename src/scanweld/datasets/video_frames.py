"""Frames of a video file by their number, through OpenCV and FFmpeg."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Array
from scanweld.datasets.images import MAX_PIXELS
from scanweld.errors import DatasetError, UnreadableFrameError

_KEPT = 8
_MIN_BYTES_PER_FRAME = 16
_SILENT = 0  # what OpenCV calls LOG_LEVEL_SILENT

_opening = threading.Lock()


class VideoFrames:
    """Read frame i of a video: forward frame by frame, backward by seeking.

    Frames are counted as they are decoded, never by time: a phone's video has no constant rate, and seeking by a frame
    number in such a file may end at a neighbour. A seek backward is therefore checked against the time stamp that the
    frame had when it was passed, and the file is decoded from its beginning where the two differ. Jumping forward
    decodes what lies between. Threads take turns; the last few frames are kept for those that come late.

    Parameters
    ----------
    path : video file of any codec that OpenCV's FFmpeg decodes
    convert : what is made of a decoded frame, (H, W, 3) BGR uint8 or as stored, before it is kept
    as_stored : leave out the conversion to BGR, for videos of 16-bit depth

    Raises
    ------
    DatasetError
        When the file cannot be opened as a video, or claims absurd sizes.
    """

    def __init__(self, path: Path, convert: Callable[[Array], Array], *, as_stored: bool = False) -> None:
        self._path, self._convert, self._as_stored = path, convert, as_stored
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, Array] = OrderedDict()
        self._times_ms: list[float] = []  # of the frames that were passed, from the first
        self._num_frames: int | None = None  # known when the end was met
        self._capture, self._next = self._opened(), 0
        import cv2

        width, height = (int(self._capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not 0 < width * height <= MAX_PIXELS:
            raise DatasetError(f"{path}: the video claims frames of {width}x{height} pixels")
        self.size = width, height
        """Width and height."""
        self.rate_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        """Frames a second, as the file says; 0 or NaN where it does not."""
        stated = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        fits = path.stat().st_size // _MIN_BYTES_PER_FRAME
        self.stated_count = int(stated) if 0 < stated <= fits else 0
        """Number of frames that the file says, or estimates, to have; 0 where it does not say."""

    def count(self) -> int:
        """Return the number of frames; decodes the video where the file does not say it."""
        if self.stated_count:
            return self.stated_count
        with self._lock:
            self._advance(None)
            return self._next

    def __call__(self, index: int) -> Array:
        """Return frame `index` as `convert` made it.

        Raises
        ------
        UnreadableFrameError
            When the video ends before, or the frame cannot be decoded.
        """
        with self._lock:
            if index not in self._kept:
                self._keep(index, self._convert(self._decoded(index)))
            return self._kept[index].copy()

    def _decoded(self, index: int) -> Array:
        if self._num_frames is not None and index >= self._num_frames:
            raise UnreadableFrameError(f"{self._path}: the video has {self._num_frames} frames, no frame {index}")
        if index < self._next:
            self._go_back(index)
        if not self._advance(index):
            raise UnreadableFrameError(f"{self._path}: the video ends after {self._next} frames, before frame {index}")
        decoded, image = self._capture.retrieve()
        if not decoded or image is None:
            raise UnreadableFrameError(f"{self._path}: frame {index} cannot be decoded")
        return np.asarray(image)

    def _keep(self, index: int, image: Array) -> None:
        self._kept[index] = image
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)

    def _advance(self, index: int | None) -> bool:
        """Grab up to and with frame `index`, or up to the end; whether it was there."""
        import cv2

        while index is None or self._next <= index:
            if not self._capture.grab():
                self._num_frames = self._next
                return False
            if self._next == len(self._times_ms):
                self._times_ms.append(self._capture.get(cv2.CAP_PROP_POS_MSEC))
            self._next += 1
        return True

    def _go_back(self, index: int) -> None:
        """Make frame `index`, which was passed before, the next one to be grabbed."""
        import cv2

        passed = self._times_ms
        if index > 1 and passed[index - 2] < passed[index - 1]:
            # The frame before it is grabbed, and its time compared: then the next one is the frame wanted.
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, index - 1)
            if self._capture.grab() and self._capture.get(cv2.CAP_PROP_POS_MSEC) == passed[index - 1]:
                self._next = index
                return
        try:
            self._capture, self._next = self._opened(), 0
        except DatasetError as error:  # the file has gone away
            raise UnreadableFrameError(str(error)) from None

    def _opened(self) -> Any:
        # OpenCV reads this when its FFmpeg is used for the first time; its reports are not in our one line.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        import cv2

        options = [cv2.CAP_PROP_CONVERT_RGB, 0] if self._as_stored else []
        with _quiet():
            capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG, options)
        if not capture.isOpened():
            raise DatasetError(f"{self._path}: cannot be opened as a video; truncated, or of an unknown codec")
        # A rotation in the file is for viewers: the depth image has none.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return capture


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV from writing to standard error meanwhile."""
    import cv2

    with _opening:
        log = getattr(cv2.utils, "logging", cv2)  # where OpenCV 5 has them, and 4
        level = log.getLogLevel()
        log.setLogLevel(_SILENT)
        try:
            yield
        finally:
            log.setLogLevel(level)
