"""How wide lines for a person may be."""

from __future__ import annotations

import shutil

NARROWEST, WIDEST = 40, 120
"""Columns that lines are fitted to at least, and at most."""


def text_columns() -> int:
    """Return how many columns lines may have: as many as the terminal, within reason; 100 where there is none."""
    return min(max(shutil.get_terminal_size((100, 24)).columns, NARROWEST), WIDEST)
