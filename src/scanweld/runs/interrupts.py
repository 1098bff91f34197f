"""Ctrl-C, when it is convenient."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType


class Patience:
    """Lets a first Ctrl-C wait for the next :meth:`check`, so that nothing is left half done; a second does not wait.

    Within a ``with`` block, in the main thread, and where nobody else handles the signal.
    """

    def __init__(self) -> None:
        self._asked = False
        self._installed = False

    def __enter__(self) -> Patience:
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._ask)
            self._installed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt when somebody has asked for it."""
        if self._asked:
            raise KeyboardInterrupt

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.check()
        self._asked = True
