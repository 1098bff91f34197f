"""`scanweld view`, and the observers of `scanweld slam`: a run to look at in the browser, or recorded for Rerun."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from scanweld.runs.observer import RunObserver

Option = typer.Option

HOST, PORT = "127.0.0.1", 8080


def view(
    run: Annotated[Path, typer.Argument(help="Run folder, as slam wrote it.", metavar="RUN")],
    host: Annotated[
        str, Option(help="Where to listen; others than this machine need the token of the address.")
    ] = HOST,
    port: Annotated[int, Option(help="Port; where it is taken, the next one that is free.", min=0, max=65535)] = PORT,
) -> int:
    """Look at a finished run in the browser: its map, and a timeline along its path.

    The address is printed; Ctrl-C ends the view. Images of the camera are shown where the sequence is still there.
    """
    from scanweld.viewer.finished import FinishedView

    with FinishedView(run, host, port) as shown:
        if shown.note:
            print(f"warning: no images of the camera: {shown.note}", file=sys.stderr)
        with contextlib.suppress(KeyboardInterrupt):
            print(f"view     {shown.url}\n         until Ctrl-C", file=sys.stderr, flush=True)
            shown.serve()
    return 0


@dataclass(slots=True)
class Observers:
    """What looks on at a run.

    Attributes
    ----------
    all : to be handed to the run
    url : of the view in the browser, "" without one
    """

    all: list[RunObserver] = field(default_factory=list)
    url: str = ""

    def stay(self) -> None:
        """Leave the view open until Ctrl-C, where there is one and somebody at a terminal."""
        if not self.url or not sys.stderr.isatty():
            return
        print(f"view     {self.url} stays until Ctrl-C", file=sys.stderr, flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


@contextlib.contextmanager
def opened_observers(title: str, *, view: bool, host: str, port: int, rerun: str | None) -> Iterator[Observers]:
    """Open what was asked for, and close it in the end."""
    observers = Observers()
    with contextlib.ExitStack() as stack:
        if view:
            from scanweld.viewer.live import LiveView

            live = stack.enter_context(LiveView(host, port, title=title))
            observers.all.append(live)
            observers.url = live.url
            print(f"view     {live.url}", file=sys.stderr, flush=True)
        if rerun is not None:
            from scanweld.viewer.rerun_sink import RerunSink

            observers.all.append(stack.enter_context(RerunSink(rerun, title=title)))
        yield observers
