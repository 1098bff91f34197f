"""The contract of a clock, as a test."""

from __future__ import annotations

import math

from scanweld.datasets.playback import Clock
from scanweld.testing.promises import require

_ROUNDING_S = 1e-6


def check_clock(clock: Clock) -> None:
    """Check that a clock keeps what :class:`~scanweld.datasets.playback.Clock` promises.

    Its time is finite and never goes back; after `sleep` at least so much of it has passed.

    Parameters
    ----------
    clock : what tells the time; it is let sleep for 30 ms

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    last_s = clock.now()
    for seconds in (0.0, 0.01, 0.02):
        require(isinstance(last_s, float) and math.isfinite(last_s), f"now: expected a time [s], got {last_s!r}")
        clock.sleep(seconds)
        now_s = clock.now()
        require(now_s >= last_s, f"now: {now_s} s after {last_s} s; time must not go back")
        require(
            now_s - last_s >= seconds - _ROUNDING_S,
            f"sleep: {now_s - last_s:.6f} s have passed where {seconds} s were to pass",
        )
        last_s = now_s
