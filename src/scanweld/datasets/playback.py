"""Play a recording at the speed of its timestamps, as a camera would deliver it."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from scanweld.datasets.base import RgbdSequence, no_readable_frame
from scanweld.datasets.stream import FrameRecord, read_record
from scanweld.geometry.frame import Frame


class Clock(Protocol):
    """Tells the time, and lets it pass."""

    def now(self) -> float:
        """Return the time since some moment [s]."""
        ...

    def sleep(self, seconds: float) -> None:
        """Return when so much time has passed."""
        ...


class WallClock:
    """The clock of the machine."""

    def now(self) -> float:
        """Return the time since some moment [s]."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Return when so much time has passed."""
        time.sleep(seconds)


def play(
    sequence: RgbdSequence, *, prepare: Callable[[Frame], Any] | None = None, clock: Clock | None = None
) -> Generator[FrameRecord]:
    """Yield a record for every frame, in order, none before its time; those that the consumer is too slow for are
    dropped.

    While a frame is with the consumer, the next one to come is read and prepared; what comes after that, before the
    consumer is back, is dropped: its record says so, and has no frame. So the consumer is never behind by more than
    it needs for one frame. Time runs from the first frame on.

    A frame may be read from the disk and prepared a little before its time: a camera has nothing to read.

    Parameters
    ----------
    sequence : a recording
    prepare : as of :func:`~.stream.stream`
    clock : by default that of the machine; which frames are dropped depends on nothing else

    Raises
    ------
    DatasetError
        At the end, when no frame at all could be decoded, and whatever else reading or preparing raises, at its frame.
    """
    clock = clock or WallClock()
    times_s = (sequence.timestamps_s - sequence.timestamps_s[:1]).tolist()
    started, first_fault, num_read = None, "", 0
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="scanweld-decode") as pool:
        index, pending = 0, pool.submit(read_record, sequence, 0, prepare)
        while index < len(times_s):
            record = pending.result()
            started = clock.now() if started is None else started
            early_s = started + times_s[index] - clock.now()
            if early_s > 0:
                clock.sleep(early_s)
            come = bisect_right(times_s, clock.now() - started)
            following = max(index + 1, come)
            if following < len(times_s):
                pending = pool.submit(read_record, sequence, following, prepare)
            num_read += record.frame is not None
            first_fault = first_fault or record.error
            yield record
            for missed in range(index + 1, following):
                why = f"dropped to keep pace: it had come before frame {index} was taken up"
                yield FrameRecord(missed, float(sequence.timestamps_s[missed]), None, why, dropped=True)
            index = following
    if num_read == 0:
        raise no_readable_frame(sequence.name, len(times_s), first_fault)
