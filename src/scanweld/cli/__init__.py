"""The command line: parse, call the API, print. No algorithm lives here."""

from __future__ import annotations

import signal
import sys


def main() -> None:
    """Run the command line; the entry point of `scanweld`."""
    try:
        from scanweld.cli.app import run

        # A polite request to end is an interruption: what is half-written goes, what is done stays.
        signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)
