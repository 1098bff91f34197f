"""What this machine is, and how fast its memory can be: the floor under every stage."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanweld.parallel import get_num_threads, run_ranges

FLOOR_BYTES = 1 << 26
"""Size of the array that is read and copied: larger than most caches."""

REPEATS = 7
"""The fastest of so many counts: what else runs can only slow it down."""


@dataclass(frozen=True, slots=True)
class Machine:
    """A machine and its floors.

    Attributes
    ----------
    processor : name
    cores : that this process may use
    threads : that kernels use
    read_gb_s : memory read by all threads together [10^9 bytes a second]
    copy_gb_s : memory read and written in copying, both counted [10^9 bytes a second]
    """

    processor: str
    cores: int
    threads: int
    read_gb_s: float
    copy_gb_s: float

    def floor_ms(self, num_bytes: float) -> float:
        """Milliseconds in which so many bytes can be moved, half of them read and half written."""
        return num_bytes / self.copy_gb_s / 1e6


def measure_machine(num_bytes: int = FLOOR_BYTES) -> Machine:
    """Measure the floors with the threads that kernels use; takes about a quarter of a second."""
    source = np.ones(num_bytes // 4, np.float32)
    target = np.empty_like(source)
    maxima = np.empty(len(source) // 4096 + 1, np.float32)

    def read(start: int, stop: int) -> None:
        maxima[start // 4096] = source[start:stop].max()

    def copy(start: int, stop: int) -> None:
        np.copyto(target[start:stop], source[start:stop])

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    read_s = _fastest(lambda: run_ranges(len(source), read))
    copy_s = _fastest(lambda: run_ranges(len(source), copy))
    return Machine(
        _processor(), cores, get_num_threads(), source.nbytes / read_s / 1e9, 2 * source.nbytes / copy_s / 1e9
    )


def _fastest(call: Callable[[], object]) -> float:
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def _processor() -> str:
    """Name of the processor, as Linux tells it, or else what Python knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), platform.processor() or platform.machine())
