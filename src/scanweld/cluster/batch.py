"""Many sequences, each a task of Dask, handed over one for each free place of the cluster.

The scheduler never holds more tasks than it has places. So a place is free for what comes next wherever it becomes so,
a lost worker puts nothing else in doubt than the sequence that it was at, and a scheduler that is started anew is given
what was not finished.
"""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from scanweld.cluster.observer import BatchObserver
from scanweld.cluster.outcome import Outcome, State, failed
from scanweld.cluster.scheduler import CONNECT_S, connected, load_distributed
from scanweld.cluster.task import RunTask, at_work, run_task, topic_of
from scanweld.errors import InvalidInputError, ScanweldError
from scanweld.runs.storage.recordings import list_files

if TYPE_CHECKING:
    from distributed import Client, Future

LOOK_EVERY_S = 1.0
"""Seconds between two looks at which workers there are."""

LISTED_AT_A_TIME = 16
"""Sequences that are listed at a time, to know their sizes."""

STOP_S = 120.0
"""Seconds that runs have after Ctrl-C to end with a checkpoint."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterOptions:
    """Where a batch runs.

    Attributes
    ----------
    scheduler : address, None: workers of this machine
    workers : how many of those; None: as many as the machine has room for, at most one a task
    threads : that a sequence uses; None: the cores shared among those workers, and 1 with a scheduler
    memory : that it may take, as "4GB"; None: a share of the machine's
    retries : how often a sequence is begun again, or continued, whose worker was lost
    dashboard : serve Dask's pages where the workers are of this machine
    """

    scheduler: str | None = None
    workers: int | None = None
    threads: int | None = None
    memory: str | None = None
    retries: int = 2
    dashboard: bool = False

    def for_tasks(self, count: int) -> ClusterOptions:
        """Return the options with workers and threads filled in for so many tasks."""
        if self.scheduler is not None:
            return replace(self, threads=self.threads or 1)
        from dask.system import CPU_COUNT

        workers = self.workers or max(1, min(CPU_COUNT // (self.threads or 1), count))
        return replace(self, workers=workers, threads=self.threads or max(1, CPU_COUNT // workers))


class _SchedulerLost(Exception):
    """The scheduler ended, or cannot be reached any more."""


def run_batch(tasks: Sequence[RunTask], options: ClusterOptions, observer: BatchObserver) -> list[Outcome]:
    """Run sequences on a cluster, and return what became of each, in their order.

    Ctrl-C ends it early: what is at work ends with a checkpoint, and its outcome is INTERRUPTED like that of what had
    not begun. A second one waits for nothing.

    Raises
    ------
    OutputError
        When no scheduler answers, or one that was lost does not come back in half a minute.
    InvalidInputError
        When an option is wrong, or no worker offers what a sequence is to have.
    MissingDependencyError
        When the extra `cluster` is not installed.
    """
    load_distributed()
    options = options.for_tasks(len(tasks))
    threads = options.threads or 1
    needs = {"threads": float(threads)} | ({"memory": _bytes(options.memory)} if options.memory else {})
    batch = _Batch([replace(task, threads=threads) for task in tasks], options, observer, needs)
    while batch.waiting:
        with connected(
            options.scheduler,
            workers=options.workers,
            memory_limit=options.memory or "auto",
            resources=needs if options.scheduler is None else None,
            dashboard=options.dashboard,
            allowed_failures=0,
            timeout_s=CONNECT_S,
        ) as client:
            if options.scheduler is not None or options.dashboard:
                observer.say(f"dashboard: {client.dashboard_link}")
            try:
                batch.run(client)
            except _SchedulerLost:
                batch.take_back()
                observer.say(f"the scheduler at {options.scheduler} was lost; waiting for it")
            except KeyboardInterrupt:
                batch.stop(client)
                break
    return [batch.outcomes.get(task.number, Outcome(task.number, State.INTERRUPTED)) for task in tasks]


def largest_first(tasks: Sequence[RunTask]) -> list[RunTask]:
    """Return tasks by the bytes of their sequences: what takes long and comes last leaves the other places idle.

    What cannot be listed from here comes first: where it cannot be listed from the workers, either, that is known soon.
    """
    places = list(dict.fromkeys(task.source.input for task in tasks))
    with ThreadPoolExecutor(LISTED_AT_A_TIME) as pool:
        sizes = dict(zip(places, pool.map(_size, places), strict=True))
    return sorted(tasks, key=lambda task: -sizes[task.source.input])


def _size(place: str) -> float:
    try:
        return sum(list_files(place).sizes.values())
    except ScanweldError:
        return math.inf


def _bytes(text: str) -> float:
    from dask.utils import parse_bytes

    try:
        return float(parse_bytes(text))
    except ValueError as error:
        raise InvalidInputError(f"memory: {error}; expected for example 4GB") from None


@dataclass(slots=True)
class _Batch:
    """What is to be done, what is being done, and what came of the rest."""

    tasks: Sequence[RunTask]
    options: ClusterOptions
    observer: BatchObserver
    needs: Mapping[str, float]
    name: str = field(default_factory=lambda: uuid.uuid4().hex[:8])
    waiting: deque[RunTask] = field(init=False)
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    under_way: dict[Future, RunTask] = field(default_factory=dict)
    ranks: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.waiting = deque(self.tasks)
        threading.Thread(target=self._rank, daemon=True).start()

    def _rank(self) -> None:
        """Find out which are large while the first are run: for thousands that takes minutes, and matters late."""
        self.ranks = {task.number: rank for rank, task in enumerate(largest_first(self.tasks))}

    def run(self, client: Client) -> None:
        """Hand over one task for each free place until all have ended."""
        ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
        client.subscribe_topic(topic_of(self.name), self._told)
        looked, places = -LOOK_EVERY_S, 0
        idle_told = False
        try:
            while self.waiting or self.under_way:
                if time.monotonic() - looked >= LOOK_EVERY_S:
                    places, asked = self._places(client)
                    looked = time.monotonic()
                    if not places and not self.under_way and not idle_told:
                        self.observer.say("the scheduler has no workers yet; waiting for them")
                        idle_told = True
                if self.ranks:
                    self.waiting = deque(sorted(self.waiting, key=lambda task: self.ranks[task.number]))
                    self.ranks = {}
                while self.waiting and len(self.under_way) < places:
                    future = self._submit(client, self.waiting.popleft(), asked)
                    future.add_done_callback(ended.put)
                with contextlib.suppress(queue.Empty):
                    self._end(ended.get(timeout=LOOK_EVERY_S))
        except (OSError, TimeoutError) as error:  # of the connection
            raise _SchedulerLost from error

    def stop(self, client: Client) -> None:
        """End what is under way, and wait until it has written its checkpoint."""
        with contextlib.suppress(KeyboardInterrupt, OSError, TimeoutError):
            client.cancel(list(self.under_way), force=True)
            until = time.monotonic() + STOP_S
            self.observer.say("ending what is under way with a checkpoint; Ctrl-C again to end at once")
            while any(client.run(at_work, self.name).values()) and time.monotonic() < until:
                time.sleep(0.2)

    def _places(self, client: Client) -> tuple[int, dict[str, float]]:
        """Return how many tasks the workers have room for, and what of `needs` they know to reckon with."""
        offers = client.run_on_scheduler(_offers).values()
        asked = {name: need for name, need in self.needs.items() if any(name in offer for _, offer in offers)}
        places = sum(min([slots, *(int(offer.get(k, 0) // v) for k, v in asked.items())]) for slots, offer in offers)
        if offers and not places and not self.under_way and not self.outcomes:
            raise InvalidInputError(
                f"no worker offers {' and '.join(f'{name}={need:g}' for name, need in asked.items())}; start them with "
                "--resources, or ask for less with --threads and --memory"
            )
        return places, asked

    def _submit(self, client: Client, task: RunTask, asked: dict[str, float]) -> Future:
        key = f"{task.name}-{task.number}-{self.name}-{task.attempt}"
        future = client.submit(run_task, task, self.name, key=key, resources=asked or None, pure=False)
        self.under_way[future] = task
        return future

    def _end(self, future: Future) -> None:
        """Take in what became of a task, or see that it is tried again."""
        if future.status == "cancelled":
            raise _SchedulerLost
        task = self.under_way.pop(future)
        outcome = future.result() if future.status == "finished" else self._without_result(task, future.exception())
        if outcome.state is State.INTERRUPTED:  # its worker was lost, or was about to end
            if task.attempt < self.options.retries:
                self.observer.say(f"{task.name}: its worker was lost; it is tried again")
                self.waiting.appendleft(replace(task, attempt=task.attempt + 1))
                return
            lost = "its worker was lost" if task.attempt == 0 else f"its worker was lost {task.attempt + 1} times"
            outcome = failed(task.number, f"{lost}: killed, or out of memory")
        self.outcomes[task.number] = outcome
        self.observer.ended(outcome)

    def _without_result(self, task: RunTask, error: BaseException) -> Outcome:
        if isinstance(error, load_distributed().scheduler.KilledWorker):
            return Outcome(task.number, State.INTERRUPTED)
        text = (str(error) or "no message").splitlines()[0]
        return failed(task.number, f"{type(error).__name__}: {text}")

    def take_back(self) -> None:
        """Put what was under way back in its place."""
        self.waiting.extendleft(sorted(self.under_way.values(), key=lambda task: -task.number))
        self.under_way.clear()

    def _told(self, event: tuple[float, Any]) -> None:
        _, what = event
        if isinstance(what, dict) and isinstance(what.get("number"), int):
            self.observer.working(what["number"], what)


def _offers(dask_scheduler: Any) -> dict[str, tuple[int, dict[str, float]]]:
    """Return the tasks that each worker runs at a time, and its resources; runs on the scheduler."""
    return {address: (worker.nthreads, dict(worker.resources)) for address, worker in dask_scheduler.workers.items()}
