"""Where tasks run: in processes of this machine, or on the workers of a Dask scheduler; both as Python's own executors.

What hands out tasks knows `concurrent.futures` alone.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import cast

from scanweld.cluster.scheduler import connected, load_distributed
from scanweld.errors import InvalidInputError, OutputError
from scanweld.parallel import get_num_threads

RETRIES = 2
"""Times that a task is begun again when the worker it ran on is lost."""


@contextlib.contextmanager
def opened_executor(scheduler: str | None = None, *, workers: int | None = None) -> Iterator[Executor]:
    """Yield an executor, and close it in the end.

    Parameters
    ----------
    scheduler : address of a Dask scheduler (extra `cluster`); None: processes of this machine, for which nothing but
        Python is needed
    workers : number of these processes, by default one for each thread that this process may use

    Raises
    ------
    MissingDependencyError, OutputError, InvalidInputError
        As :func:`~.scheduler.connected`; OutputError, too, when workers are lost again and again.
    """
    if scheduler is not None:
        with connected(scheduler, workers=workers) as client:
            try:
                # Tasks write files: none is like another one.
                yield cast(Executor, client.get_executor(pure=False, retries=RETRIES))
            except load_distributed().KilledWorker as error:
                raise OutputError(f"{scheduler}: workers were lost again and again: {error}") from None
        return
    if workers is not None and workers < 1:
        raise InvalidInputError(f"workers: expected at least one, got {workers}")
    # Not forked: threads and what they hold would be half there.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or get_num_threads(), mp_context=spawn, initializer=_end_on_ctrl_c) as executor:
        yield executor


def _end_on_ctrl_c() -> None:
    """Let Ctrl-C end a worker at once and in silence: the process that it works for says what there is to say."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
