"""Compiled kernels and the threads that run them.

Kernels are serial Numba functions that release the GIL; :func:`run_ranges` splits their work over a pool of
Python threads. There is no OpenMP, no `prange` and no lock: the same kernels serve one thread and many, compile
in half the time, and give the same bytes at any thread count because every sum is formed per fixed-size chunk
and the chunks are added in order (docs/decisions/0001-threads.md).

Importing this module loads Numba (about half a second); `import scanweld` does not import it.
"""

from __future__ import annotations

import contextlib
import contextvars
import hashlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from scanweld.errors import InvalidInputError

PACKAGE = Path(__file__).parent

_One = TypeVar("_One")
_Other = TypeVar("_Other")


def _kernel_cache_folder() -> Path:
    """Folder of the on-disk kernel cache, named by a hash of every kernel source.

    Numba does not notice that a called function in another module has changed, so a changed kernel must lead to
    a fresh folder.
    """
    # Numba files what it compiles by source path and Python version: each pair has a folder, so a note that all is
    # compiled (see `kernels_are_cached`) holds for this installation.
    digest = hashlib.sha256(f"{PACKAGE} {sys.version_info[:2]}".encode())
    for source in sorted([*PACKAGE.rglob("kernels.py"), Path(__file__)]):
        digest.update(source.relative_to(PACKAGE).as_posix().encode())
        digest.update(source.read_bytes())
    root = os.environ.get("XDG_CACHE_HOME") or (Path.home() / ".cache" if os.environ.get("HOME") else None)
    name = f"kernels-{digest.hexdigest()[:16]}"
    if root is not None:
        folder = Path(root) / "scanweld" / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            pass
    return Path(tempfile.gettempdir()) / f"scanweld-{os.getuid() if hasattr(os, 'getuid') else 'user'}" / name


os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernel_cache_folder()))
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning OpenMP workers of other libraries starve ours

import numba  # noqa: E402  (the two variables above must be set before it loads)

# error_model "numpy": a division by zero gives inf, not a branch. Kernels test masks, never NaN (fast-math).
# forceinline: a kernel that another one calls would be in both of their object files, optimised once in its own and
# twice in the caller's, and the linker keeps the first that it meets: its own in the process that compiles, the
# caller's in those that load from the cache. They round differently.
kernel: Callable[[Any], Any] = numba.njit(
    fastmath=True, error_model="numpy", boundscheck=False, cache=True, nogil=True, forceinline=True
)
"""Decorator of every compiled kernel."""

inlined: Callable[[Any], Any] = numba.njit(
    fastmath=True, error_model="numpy", boundscheck=False, cache=True, nogil=True, inline="always"
)
"""Decorator of a small function that becomes part of the kernels that call it."""


def kernels_are_cached(group: str, *, now: bool = False) -> bool:
    """Whether an earlier process compiled a group of kernels for this version; `now` notes that they are.

    The note is a file in the cache folder, so it goes with the cache.
    """
    note = Path(os.environ["NUMBA_CACHE_DIR"]) / f"{group}.compiled"
    if now:
        with contextlib.suppress(OSError):  # a read-only cache: the next process compiles again
            note.touch()
    return note.exists()


def processor() -> str:
    """Name of the kind of processor that kernels are compiled for: others may round differently."""
    from llvmlite import binding

    return str(numba.core.config.CPU_NAME or binding.get_host_cpu_name())


_num_threads = max(
    1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 16)
)
_pool: ThreadPoolExecutor | None = None
_background: dict[str, ThreadPoolExecutor] = {}
_inside = threading.local()
_limit: contextvars.ContextVar[int | None] = contextvars.ContextVar("scanweld_threads", default=None)


def get_num_threads() -> int:
    """Number of threads that :func:`run_ranges` uses."""
    return _limit.get() or _num_threads


@contextlib.contextmanager
def limited_threads(count: int | None) -> Iterator[None]:
    """Use `count` threads within the block, in this thread of the caller only; None changes nothing."""
    if count is not None and count < 1:
        raise InvalidInputError(f"num_threads: expected at least one thread, got {count}")
    token = _limit.set(count if count is not None else _limit.get())
    try:
        yield
    finally:
        _limit.reset(token)


def set_num_threads(count: int) -> None:
    """Use `count` threads from now on; results do not depend on it."""
    global _num_threads, _pool
    if count < 1:
        raise InvalidInputError(f"threads: expected at least one thread, got {count}")
    # The pool is not shut down: a background thread may be about to use it. Its threads end when nobody holds it.
    _pool = _pool if count == _num_threads else None
    _num_threads = count


def split_range(count: int, parts: int) -> list[tuple[int, int]]:
    """Split range(count) into at most `parts` contiguous, nearly equal, non-empty ranges."""
    parts = max(1, min(parts, count))
    bounds = [count * i // parts for i in range(parts + 1)]
    return list(pairwise(bounds))


def run_ranges(count: int, body: Callable[[int, int], object], *, grain: int = 1) -> None:
    """Call `body(start, stop)` on contiguous ranges that cover range(count), one range a thread.

    `grain`: a thread gets at least so many, or waking it costs more than it saves.

    The caller's thread takes the first range. What `body` writes for index i must depend on i alone.
    """
    global _pool
    if count <= 0:
        return
    ranges = split_range(count, min(get_num_threads(), max(1, count // grain)))
    if len(ranges) == 1 or getattr(_inside, "pool", False):  # a worker that waited for workers could wait for ever
        body(0, count)
        return
    pool = _pool
    if pool is None:
        pool = _pool = ThreadPoolExecutor(
            max_workers=max(_num_threads - 1, 1), thread_name_prefix="scanweld", initializer=_enter_pool
        )
    futures: list[Future[object]] = [pool.submit(body, start, stop) for start, stop in ranges[1:]]
    try:
        _inside.pool = True  # the workers are busy: what the body itself would share out, it does alone
        body(*ranges[0])
        for future, (start, stop) in zip(futures, ranges[1:], strict=True):
            if future.cancel():  # no worker has come to it yet: nobody waits for one
                body(start, stop)
    finally:
        _inside.pool = False
        # Nobody writes into the caller's arrays once it goes on. (What was cancelled has ended only for a worker.)
        wait([future for future in futures if not future.cancelled()])
    for future in futures:
        if not future.cancelled():
            future.result()


def in_background(call: Callable[[], _One], lane: str = "") -> Future[_One]:
    """Call on another thread; what it raises, the result does. Calls of one lane take turns."""
    if lane not in _background:
        name = f"scanweld-background-{lane}".rstrip("-")
        _background[lane] = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
    return _background[lane].submit(call)


def _enter_pool() -> None:
    _inside.pool = True


def _finish_background() -> None:
    for executor in list(_background.values()):
        executor.submit(lambda: None).result()  # calls take turns: those before it have ended


def _forget_pool() -> None:
    global _pool
    _pool = None
    _background.clear()


if hasattr(os, "register_at_fork"):  # threads do not survive a fork: a child would wait for its parent's
    os.register_at_fork(before=_finish_background, after_in_child=_forget_pool)


def side_by_side(one: Callable[[], _One], other: Callable[[], _Other]) -> tuple[_One, _Other]:
    """Call both, which must not depend on each other; two threads take one each, others take turns.

    For two things of about the same length this spares two threads waiting for each other; more threads share each.
    """
    if get_num_threads() != 2:
        return one(), other()
    results: list[Any] = [None, None]

    def body(start: int, stop: int) -> None:
        with limited_threads(1):
            results[start:stop] = [call() for call in (one, other)[start:stop]]

    run_ranges(2, body)
    return results[0], results[1]
