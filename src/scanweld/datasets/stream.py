"""Decode ahead of the consumer, and prepare what it asks for, on threads of its own, in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from scanweld.datasets.base import LiveSequence, RgbdSequence, no_readable_frame
from scanweld.errors import InvalidInputError, UnreadableFrameError
from scanweld.geometry.frame import Frame


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame of the input, readable or not.

    Attributes
    ----------
    index : position in the sequence, from 0
    timestamp_s : [s]
    frame : the frame, or None where it cannot be decoded
    error : why it cannot, or was not, else ""
    prepared : what `prepare` made of the frame; None where there is neither
    dropped : the consumer was too slow for it; it was not read (:mod:`.playback`)
    """

    index: int
    timestamp_s: float
    frame: Frame | None
    error: str = ""
    prepared: Any = None
    dropped: bool = False


def stream(
    sequence: RgbdSequence,
    lookahead: int = 4,
    *,
    num_threads: int = 1,
    prepare: Callable[[Frame], Any] | None = None,
    first: int = 0,
) -> Generator[FrameRecord]:
    """Yield a record for every frame, in order, while the next `lookahead` frames are being decoded.

    Of a live camera nothing is read ahead: each record is of the newest frame, and the camera is closed in the end.

    Decoders release the GIL, so the consumer computes meanwhile. At most `lookahead` frames wait in memory.
    Closing the generator, or leaving the loop by an exception, ends the threads after the frame in work.

    Parameters
    ----------
    sequence : what to read
    lookahead : frames decoded ahead, at least 1
    num_threads : decoding threads, at least 1; the order does not depend on it
    prepare : called with each frame on its decoding thread, so it must depend on the frame alone and not wait for
        the consumer; what it returns waits in memory with the frame
    first : frames before this one are left out; a live camera has none

    Raises
    ------
    InvalidInputError
        When `lookahead` or `num_threads` is below 1.
    DatasetError
        At the end, when no frame at all could be decoded, and whatever else reading or preparing raises, at its frame.
    """
    if lookahead < 1 or num_threads < 1:
        raise InvalidInputError(f"stream: expected at least one frame and thread, got {lookahead} and {num_threads}")
    if isinstance(sequence, LiveSequence):
        return _live_records(sequence, prepare)
    return _records(sequence, lookahead, num_threads, prepare, first)


def read_record(sequence: RgbdSequence, index: int, prepare: Callable[[Frame], Any] | None) -> FrameRecord:
    """Read and prepare one frame."""
    timestamp_s = float(sequence.timestamps_s[index])
    try:
        frame = sequence.read(index)
    except UnreadableFrameError as error:
        return FrameRecord(index, timestamp_s, None, str(error))
    return FrameRecord(index, timestamp_s, frame, prepared=prepare(frame) if prepare else None)


def _live_records(sequence: LiveSequence, prepare: Callable[[Frame], Any] | None) -> Generator[FrameRecord]:
    try:
        for index, frame in enumerate(sequence.live()):
            yield FrameRecord(index, frame.timestamp_s, frame, prepared=prepare(frame) if prepare else None)
    finally:
        sequence.close()


def _records(
    sequence: RgbdSequence, lookahead: int, num_threads: int, prepare: Callable[[Frame], Any] | None, first: int
) -> Generator[FrameRecord]:
    count = len(sequence.timestamps_s)
    pending: deque[Future[FrameRecord]] = deque()
    first_fault, num_read = "", 0
    pool = ThreadPoolExecutor(max_workers=num_threads, thread_name_prefix="scanweld-decode")
    try:
        for index in range(first, count):
            while len(pending) < lookahead and index + len(pending) < count:
                pending.append(pool.submit(read_record, sequence, index + len(pending), prepare))
            current = pending.popleft().result()
            # The slot that has just become free is filled before the consumer starts to compute.
            ahead = index + 1 + len(pending)
            if ahead < count:
                pending.append(pool.submit(read_record, sequence, ahead, prepare))
            num_read += current.frame is not None
            first_fault = first_fault or current.error
            yield current
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    if num_read == 0 and first == 0:
        raise no_readable_frame(sequence.name, count, first_fault)
