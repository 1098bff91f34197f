"""The command line: parse, call the API, print. No algorithm lives here."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys


def main() -> None:
    """Run the command line; the entry point of `scanweld`."""
    _prepare_process()
    try:
        from scanweld.cli.app import run

        # A polite request to end is an interruption: what is half-written goes, what is done stays.
        signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 130
    gc.freeze()  # what is left goes with the process: looking for garbage in it takes half a second
    sys.exit(code)


def _prepare_process() -> None:
    """Set up what only a program, not a library, may set up; before NumPy loads.

    NumPy's linear algebra gets one thread: ours is 6x6, and its spinning threads take the kernels' cores. The C library
    keeps the memory of one frame for the next: giving it back and faulting it in again costs a tenth of a frame. Python
    looks for garbage less often: modules and compiled kernels are none, however often it looks.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(50_000, 20, 20)
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):
            mallopt = ctypes.CDLL(None).mallopt
            trim_threshold, mmap_threshold = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
            mallopt(mmap_threshold, 1 << 30)
            mallopt(trim_threshold, 1 << 28)
