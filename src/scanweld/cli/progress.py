"""Progress on a terminal, quiet lines elsewhere; always on standard error."""

from __future__ import annotations

import logging
import sys
import time
from types import TracebackType

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from scanweld.trajectory import FrameResult

QUIET_INTERVAL_S = 5.0
"""Without a terminal, a line is printed this often."""


class FrameProgress:
    """Shows frames, frames per second, state and surfels of a run."""

    def __init__(self, total: int, title: str) -> None:
        self.total, self.title = total, title
        self._console = Console(stderr=True)
        self._live = self._console.is_terminal
        self._done = 0
        self._first = self._spoken = time.perf_counter()

    def __enter__(self) -> FrameProgress:
        columns = (
            TextColumn("[bold]{task.description}"), MofNCompleteColumn(), BarColumn(bar_width=None),
            TextColumn("{task.fields[detail]}"), TimeRemainingColumn(),
        )  # fmt: skip
        self._bar = Progress(*columns, console=self._console, transient=True, disable=not self._live)
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
            self._bar.console.print(f"[dim]{text}")
        else:
            print(text, file=sys.stderr, flush=True)

    def update(self, result: FrameResult) -> None:
        """Count one frame."""
        self._done += 1
        now = time.perf_counter()
        if self._done == 1:
            self._first = now
        fps = (self._done - 1) / (now - self._first) if self._done > 1 else 0.0
        detail = f"{fps:5.1f} fps  {result.state.name:<10}  {result.num_surfels / 1e3:,.0f}k surfels"
        if self._live:
            self._bar.update(self._task, advance=1, detail=detail)
        elif now - self._spoken > QUIET_INTERVAL_S:
            self._spoken = now
            print(f"{self.title}: frame {self._done}/{self.total} {detail}", file=sys.stderr, flush=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._bar.stop()
        logging.getLogger().handlers[:] = self._handlers


class RenderProgress:
    """Shows how many frames are rendered, or what else `title` says is done with them."""

    def __init__(self, title: str = "render") -> None:
        self.title = title

    def __enter__(self) -> RenderProgress:
        console = Console(stderr=True)
        columns = (
            TextColumn("[bold]{task.description}"), BarColumn(bar_width=None), MofNCompleteColumn(),
            TimeRemainingColumn(),
        )  # fmt: skip
        self._live = console.is_terminal
        self._bar = Progress(*columns, console=console, transient=True, disable=not self._live)
        self._task = self._bar.add_task(self.title, total=None)
        self._bar.start()
        self._spoken = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, done: int, total: int) -> None:
        """Show `done` of `total` frames."""
        now = time.perf_counter()
        if self._live:
            self._bar.update(self._task, completed=done, total=total)
        elif now - self._spoken > QUIET_INTERVAL_S:
            self._spoken = now
            print(f"{self.title}: frame {done}/{total}", file=sys.stderr, flush=True)
