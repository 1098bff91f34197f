"""One sequence of a batch, as a worker runs it."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from scanweld.cluster.outcome import LISTED, SMALL_FILES, Outcome, State, failed, is_finished, read_outcome
from scanweld.errors import OutputError, ScanweldError
from scanweld.geometry.frame import Frame
from scanweld.parallel import set_num_threads
from scanweld.runs.folder import CHECKPOINT
from scanweld.runs.input import RunInput, collected_warnings
from scanweld.runs.run import run_sequence
from scanweld.runs.storage.recordings import copies, list_files, scratch
from scanweld.runs.storage.run_folders import check_uploadable, upload
from scanweld.runs.storage.urls import is_url, read_back
from scanweld.slam.config import SlamConfig
from scanweld.slam.system import Slam
from scanweld.slam.warmup import compile_kernels
from scanweld.trajectory import FrameResult

logger = logging.getLogger(__name__)

TELL_EVERY_S = 1.0
"""Seconds between two words of a worker about how far it is."""


ENDING = ("closing", "closed", "failed")
"""States of a worker that has lost its scheduler, or is to end."""

WANTED = ("executing", "long-running")
"""States of a task that somebody waits for; one that was cancelled has another."""


def topic_of(batch: str) -> str:
    """Return the topic under which workers tell how far a batch is."""
    return f"scanweld-{batch}"


@dataclass(frozen=True, slots=True)
class RunTask:
    """One sequence to be run with one configuration.

    Attributes
    ----------
    number : in the batch
    name : of its run folder within that of the batch
    source : its place may be a URL
    folder : run folder, path or URL
    config : resolved
    description : what run.json has to say besides: file of settings, overrides
    swept : values of the settings that differ within the batch
    threads : that it uses
    force : run it again even if it is finished
    checkpoint_every_s : seconds between two checkpoints, see :func:`~.run.run_sequence`
    attempt : how many workers were lost over it
    """

    number: int
    name: str
    source: RunInput
    folder: str
    config: SlamConfig
    description: Mapping[str, Any]
    swept: Mapping[str, Any]
    threads: int = 1
    force: bool = False
    checkpoint_every_s: float | None = None
    attempt: int = 0


_at_work: set[str] = set()


def at_work(batch: str) -> list[str]:
    """Return which tasks of a batch this process is at work on."""
    return [key for key in list(_at_work) if key.endswith(batch)]


def run_task(task: RunTask, batch: str) -> Outcome:
    """Run one sequence on a worker; what is wrong with the sequence is an outcome and no error."""
    key, begun = f"{task.number}-{batch}", time.perf_counter()
    _at_work.add(key)
    try:
        return _run(task, batch, begun)
    except ScanweldError as error:
        return failed(task.number, str(error), time.perf_counter() - begun)
    except KeyboardInterrupt:
        return Outcome(task.number, State.INTERRUPTED)
    except Exception as error:  # a fault of the program must not take the other sequences with it
        logger.exception("%s: failed", task.name)
        text = (str(error) or "no message").splitlines()[0]
        return failed(task.number, f"{type(error).__name__}: {text}", time.perf_counter() - begun)
    finally:
        _at_work.discard(key)


def _run(task: RunTask, batch: str, begun: float) -> Outcome:
    listing = list_files(task.source.input)
    asked = {**asdict(task.source), LISTED: listing.described()}
    del asked["input"]  # it may lie elsewhere by now
    description = {**task.source.described(), **task.description, **asked, "host": platform.node()}
    with contextlib.ExitStack() as stack:
        folder, there = Path(task.folder), Path(task.folder)
        if is_url(task.folder):
            aside = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=scratch())))
            folder, there = aside / "run", aside / "there"
            there.mkdir()
            read_back(task.folder, SMALL_FILES, there)
        if not task.force and is_finished(there, asked, task.config):
            return read_outcome(task.number, there, State.KEPT, time.perf_counter() - begun)
        if is_url(task.folder):
            check_uploadable(task.folder)
        if task.force and task.attempt == 0:
            (folder / CHECKPOINT).unlink(missing_ok=True)
        watch = _Watch(task.number, batch)
        compile_kernels(lambda part: watch.tell(doing=f"compiling {part}"))
        set_num_threads(task.threads)
        watch.tell(doing="fetching" if is_url(task.source.input) else "opening")
        with collected_warnings() as warnings:
            place = stack.enter_context(copies().local(listing))
            sequence = replace(task.source, input=str(place)).open()
        watch.total = len(sequence)
        try:
            summary = run_sequence(
                sequence, task.config, out=folder, force=task.force, resume=(folder / CHECKPOINT).is_file(),
                checkpoint_every_s=task.checkpoint_every_s, observers=[watch], started=begun,
                description={**description, "warnings": warnings},
            )  # fmt: skip
        except OutputError:  # a worker that had lost its scheduler may have been about to write it
            if task.force or not is_finished(there, asked, task.config):
                raise
            return read_outcome(task.number, there, State.KEPT, time.perf_counter() - begun)
        if summary.interrupted:
            return Outcome(task.number, State.INTERRUPTED)
        if is_url(task.folder):
            watch.tell(doing="uploading")
            upload(folder, task.folder)
        return read_outcome(task.number, folder, State.DONE, time.perf_counter() - begun)


def _worker() -> Any:
    """Return the worker of Dask that this thread belongs to, None elsewhere."""
    from distributed import get_worker

    try:
        return get_worker()
    except ValueError:
        return None


class _Watch:
    """Tells the scheduler how far a run is, and ends it with its checkpoint when nobody waits for it any more."""

    def __init__(self, number: int, batch: str) -> None:
        self.total = 0
        self._number, self._topic = number, topic_of(batch)
        self._worker = _worker()
        self._key = "" if self._worker is None else self._worker.get_current_task()
        self._told = 0.0

    def tell(self, **what: Any) -> None:
        """Tell the client what is being done."""
        self._told = time.perf_counter()
        if self._worker is not None:
            self._worker.log_event(self._topic, {"number": self._number, "pid": os.getpid(), **what})

    def on_frame(self, slam: Slam, frame: Frame | None, result: FrameResult) -> None:
        """Tell which frame it is, now and then."""
        if time.perf_counter() - self._told >= TELL_EVERY_S:
            self.tell(frame=result.index + 1, total=self.total)

    def ready(self, timeout_s: float) -> bool:
        """Go on; raises KeyboardInterrupt where the task was cancelled, or the worker is about to end."""
        if self._worker is not None:
            task = self._worker.state.tasks.get(self._key)
            if self._worker.status.name in ENDING or task is None or task.state not in WANTED:
                raise KeyboardInterrupt
        return True

    def on_end(self, slam: Slam) -> None:
        """Tell that what is left is to write it down."""
        self.tell(doing="writing")
