"""Shared fixtures."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import hypothesis
import pytest

# Compiling a kernel on first use is slow and is no failure of a property.
hypothesis.settings.register_profile("scanweld", deadline=None, derandomize=True, max_examples=50)
few = hypothesis.settings(hypothesis.settings.get_profile("scanweld"), max_examples=3)
hypothesis.settings.register_profile("few", few)  # for scripts/coverage
hypothesis.settings.load_profile("scanweld")

# A shell without job control has what it starts in the background ignore Ctrl-C, and so do the children of that: tests
# of Ctrl-C would wait for nothing.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the recorded sequences: `SCANWELD_DATA`, else `../shared/data`; tests skip without it."""
    configured = os.environ.get("SCANWELD_DATA")
    folder = Path(configured) if configured else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"recorded sequences not found at {folder} (set SCANWELD_DATA)")
    return folder


@pytest.fixture
def bucket() -> Any:
    """An empty file system behind URLs, memory://."""
    files = pytest.importorskip("fsspec").filesystem("memory")
    files.store.clear()
    files.pseudo_dirs[:] = [""]
    return files
