"""The command line: parse, call the API, print. No algorithm lives here."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; the entry point of `scanweld`."""
    from scanweld.cli.app import run

    sys.exit(run(sys.argv[1:]))
