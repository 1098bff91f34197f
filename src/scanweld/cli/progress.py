"""Progress on a terminal, quiet lines elsewhere; always on standard error."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Column

from scanweld.cluster.observer import BatchObserver
from scanweld.trajectory import FrameResult, FrameState

if TYPE_CHECKING:
    from scanweld.cluster.outcome import Outcome

QUIET_INTERVAL_S = 5.0
"""Without a terminal, a line is printed this often."""

WIDE_COLUMNS = 80
"""A narrower terminal has no room for a bar beside the figures."""


def _is_wide(console: Console) -> bool:
    return console.width >= WIDE_COLUMNS


def _bar(console: Console, *details: ProgressColumn) -> Progress:
    """Return a line that says what is done, how much of it, and `details`; it shows nothing without a terminal."""
    what = TextColumn("{task.description}", markup=False)
    count = MofNCompleteColumn(table_column=Column(no_wrap=True))
    columns = [what, count, *details]
    if _is_wide(console):
        columns = [what, count, BarColumn(bar_width=None), *details, TimeRemainingColumn()]
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


class FrameProgress:
    """Shows frames, frames per second, state and surfels of a run, of which each pass begins with frame 0, and how many
    frames were dropped.

    `then` is said when the frames of the first pass are done, where something follows that takes its time.
    """

    def __init__(self, total: int | None, title: str, then: str = "") -> None:
        self.total, self.title, self.then = total, title, then
        self._console = Console(stderr=True)
        self._live = self._console.is_terminal
        self._done = self._dropped = self._before = 0
        self._first = self._spoken = time.perf_counter()

    def __enter__(self) -> FrameProgress:
        self._bar = _bar(self._console, TextColumn("{task.fields[detail]}"))
        self._bar.start()
        self._task = self._bar.add_task(self.title, total=self.total, detail="")
        # Log lines and the bar share the terminal: both must go through one console.
        self._handlers = logging.getLogger().handlers[:]
        if self._live:
            handler = RichHandler(console=self._console, show_time=False, show_path=False)
            logging.getLogger().handlers[:] = [handler]
        return self

    def say(self, text: str) -> None:
        """Print one line above the bar."""
        if self._live:
            self._bar.console.print(text, style="dim", markup=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def update(self, result: FrameResult) -> None:
        """Count one frame."""
        now = time.perf_counter()
        if result.index == 0:
            if self._done:
                self.title += " again"
                self._bar.reset(self._task, description=self.title)
            self._done, self._dropped, self._before, self._first = 0, 0, 0, now
        elif self._done == 0:  # the frames before this one were taken in by the run that is resumed
            self._done = self._before = result.index
            self._first = now
            self._bar.update(self._task, completed=self._done)
        self._done += 1
        self._dropped += result.state is FrameState.DROPPED
        taken = self._done - self._before - self._dropped
        fps = (taken - 1) / (now - self._first) if taken > 1 else 0.0
        detail = f"{fps:5.1f} fps  {result.state.name}"
        if not self._live or _is_wide(self._console):
            detail = f"{detail:<22}  {result.num_surfels / 1e3:,.0f}k surfels"
        if self._dropped:
            detail += f"  {self._dropped} dropped"
        if self._live:
            self._bar.update(self._task, advance=1, detail=detail)
        elif now - self._spoken > QUIET_INTERVAL_S:
            self._spoken = now
            of = "" if self.total is None else f"/{self.total}"
            print(f"{self.title}: frame {self._done}{of} {detail}", file=sys.stderr, flush=True)
        if self.then and self._done == self.total:
            self.say(self.then)
            self.then = ""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._bar.stop()
        logging.getLogger().handlers[:] = self._handlers


class BatchProgress(BatchObserver):
    """Shows how many runs of a batch have ended, and how far those are that are at work."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names, self._spoken = names, time.perf_counter()
        self._console = Console(stderr=True)
        self._live = self._console.is_terminal
        self._doing: dict[int, str] = {}
        self._ended: set[int] = set()

    def __enter__(self) -> BatchProgress:
        self._bar = _bar(self._console, TextColumn("{task.fields[detail]}", markup=False))
        self._bar.start()
        self._task = self._bar.add_task("batch", total=len(self._names), detail="starting workers")
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """Print one line, above the bar where there is one."""
        if self._live:
            self._bar.console.print(text, style="dim", markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def working(self, number: int, what: Mapping[str, Any]) -> None:
        """Show how far a run is."""
        if number not in self._ended:  # word of that may come sooner than of what was before
            self._doing[number] = str(what.get("doing") or f"{what.get('frame')}/{what.get('total')}")
            self._show()

    def ended(self, outcome: Outcome) -> None:
        """Say what became of a run."""
        self._ended.add(outcome.number)
        self._doing.pop(outcome.number, None)
        because = f": {outcome.reason}" if outcome.reason and not outcome.good else ""
        what = outcome.verdict or outcome.state.value
        self.say(f"{len(self._ended)}/{len(self._names)}  {self._names[outcome.number]}  {what}{because}")
        self._show()

    def _show(self) -> None:
        at_work = [f"{self._names[number]} {doing}" for number, doing in sorted(self._doing.items())]
        if self._live:
            room = max(self._console.width - 50, 20)
            fitting = (text for k in range(len(at_work), 0, -1) if len(text := _some(at_work, k)) <= room)
            self._bar.update(self._task, completed=len(self._ended), detail=next(fitting, _some(at_work, 0)))
        elif time.perf_counter() - self._spoken > QUIET_INTERVAL_S:
            self._spoken = time.perf_counter()
            print(f"batch: {len(self._ended)}/{len(self._names)} {', '.join(at_work)}", file=sys.stderr, flush=True)


def _some(texts: Sequence[str], count: int) -> str:
    """The first of some texts, and how many more there are."""
    left = len(texts) - count
    return ", ".join([*texts[:count], *([f"{left} at work" if count == 0 else f"{left} more"] if left else [])])


class CountProgress:
    """Shows what is being done, and how much of it is."""

    def __init__(self, title: str = "") -> None:
        self._title, self._spoken = title, time.perf_counter()
        console = Console(stderr=True)
        self._live = console.is_terminal
        self._bar = _bar(console)
        self._task = self._bar.add_task(title, total=None)

    def __enter__(self) -> CountProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, title: str) -> None:
        """Say what begins."""
        self._title, self._spoken = title, time.perf_counter()
        if self._live:
            self._bar.reset(self._task, description=title, total=None)
        else:
            print(title, file=sys.stderr, flush=True)

    def update(self, done: int, total: int) -> None:
        """Show `done` of `total`."""
        now = time.perf_counter()
        if self._live:
            self._bar.update(self._task, completed=done, total=total)
        elif now - self._spoken > QUIET_INTERVAL_S:
            self._spoken = now
            print(f"{self._title}: {done}/{total}", file=sys.stderr, flush=True)
