"""A client of Dask's scheduler: of one that runs somewhere, or of one that is started here with workers of its own."""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import threading
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from scanweld.errors import InvalidInputError, MissingDependencyError, OutputError

if TYPE_CHECKING:
    from distributed import Client

LOOPBACK = "127.0.0.1"
"""Where schedulers and workers that are started here listen: whoever can connect to them can run code."""

CONNECT_S = 30.0
"""Seconds in which a scheduler has to answer."""

CALM: dict[str, Any] = {
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "2s",
}
"""Settings of Dask for a scheduler and workers that are started here: by default each looks at itself a hundred times a
second, on a core that a task could have (7 % of a machine with two). The dashboard's page of profiles stays empty."""


def load_distributed() -> Any:
    """Return the module `distributed`.

    Raises
    ------
    MissingDependencyError
        When it is not installed.
    """
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise MissingDependencyError(error.name or "distributed", "cluster") from None
    return distributed


@contextlib.contextmanager
def connected(
    scheduler: str | None = None,
    *,
    workers: int | None = None,
    threads_per_worker: int = 1,
    memory_limit: str | int | None = "auto",
    resources: Mapping[str, float] | None = None,
    dashboard: bool = False,
    allowed_failures: int | None = None,
    timeout_s: float = CONNECT_S,
) -> Iterator[Client]:
    """Yield a client of a scheduler, and close it in the end; workers that were started for it end with it.

    Without a scheduler, one is started here with workers that are processes of this machine and listen on its loopback
    interface alone. They leave Ctrl-C to this process, which hears it as soon as they are there, and write nothing to
    the terminal.

    Parameters
    ----------
    scheduler : its address, as tcp://HOST:8786; None: start one here
    workers : number of processes to start, by default one per core and `threads_per_worker`
    threads_per_worker : tasks that a worker runs at a time
    memory_limit : of each worker, as "4GB" or in bytes; one that exceeds it is ended and started anew. "auto" shares
        what the machine has among them; None sets no limit
    resources : what each worker has to offer, by name, for tasks that ask for it
    dashboard : serve Dask's pages about what is going on, on any free port (`client.dashboard_link`); needs Bokeh
    allowed_failures : how many workers may be lost over a task before it is given up (KilledWorker), for a scheduler
        that is started here; by default what Dask is configured to, 3
    timeout_s : time in which the scheduler, or the first worker that is started, has to answer

    Raises
    ------
    MissingDependencyError
        When distributed is not installed: pip install 'scanweld[cluster]'.
    OutputError
        When no scheduler answers at that address.
    InvalidInputError
        When the address is none, or workers are to be started although there is a scheduler.
    """
    distributed = load_distributed()
    if scheduler is None:
        cluster_options = {
            "n_workers": workers,
            "threads_per_worker": threads_per_worker,
            **({} if memory_limit == "auto" else {"memory_limit": memory_limit}),
            "resources": dict(resources or {}),
            "scheduler_kwargs": {
                "dashboard": dashboard and find_spec("bokeh") is not None,
                "allowed_failures": allowed_failures,
            },
        }
        with _started_here(distributed, cluster_options, timeout_s) as client:
            yield client
        return
    if workers is not None:
        raise InvalidInputError(f"workers: the scheduler at {scheduler} has workers of its own; leave one out")
    try:
        client = distributed.Client(scheduler, timeout=timeout_s, set_as_default=False)
    except ValueError as error:
        raise InvalidInputError(f"scheduler: {scheduler!r} is no address ({error}); one is tcp://HOST:8786") from None
    except (OSError, TimeoutError) as error:
        why = (str(error) or "no answer").splitlines()[0]
        raise OutputError(f"{scheduler}: no scheduler is reached ({why}); `dask scheduler` starts one") from None
    with _closed_in_the_end(client):
        yield client


@contextlib.contextmanager
def _started_here(distributed: Any, options: dict[str, Any], timeout_s: float) -> Iterator[Client]:
    import dask.config

    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        stack.enter_context(dask.config.set(CALM))
        with _ctrl_c_ignored():
            cluster = distributed.LocalCluster(
                host=LOOPBACK,
                dashboard_address=f"{LOOPBACK}:0",
                worker_dashboard_address=f"{LOOPBACK}:0",
                silence_logs=logging.CRITICAL,
                **options,
            )
            stack.callback(cluster.close, timeout=timeout_s)
            client = stack.enter_context(
                _closed_in_the_end(distributed.Client(cluster, timeout=timeout_s, set_as_default=False))
            )
            client.register_plugin(_plugin(distributed))
            client.wait_for_workers(1, timeout=timeout_s)
        yield client


@contextlib.contextmanager
def _closed_in_the_end(client: Client) -> Iterator[Client]:
    try:
        yield client
    finally:
        with contextlib.suppress(OSError, TimeoutError):  # the scheduler may be gone
            client.close()


@contextlib.contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    """Ignore Ctrl-C within the block, where this thread can; processes that are started within do so from then on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def _plugin(distributed: Any) -> Any:
    """Return a plugin of workers, of those that take the place of lost ones, too."""

    class StartedHere(distributed.WorkerPlugin):  # type: ignore[misc]
        name = "scanweld-started-here"

        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

        def teardown(self, worker: Any) -> None:
            gc.freeze()  # what is left goes with the process: looking for garbage in it takes half a second

    return StartedHere()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep from the terminal, within the block, what is logged of workers that come and go and of what waits for them.

    asyncio complains of Dask's own waiting when Ctrl-C ends it.
    """
    loggers = [logging.getLogger(name) for name in ("distributed", "asyncio")]
    usual = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, usual, strict=True):
            logger.setLevel(level)
