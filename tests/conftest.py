"""Shared fixtures."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

# Compiling a kernel on first use is slow and is no failure of a property.
hypothesis.settings.register_profile("scanweld", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.register_profile(
    "few", hypothesis.settings.get_profile("scanweld"), max_examples=3
)  # scripts/coverage
hypothesis.settings.load_profile("scanweld")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the recorded sequences: `SCANWELD_DATA`, else `../shared/data`; tests skip without it."""
    configured = os.environ.get("SCANWELD_DATA")
    folder = Path(configured) if configured else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"recorded sequences not found at {folder} (set SCANWELD_DATA)")
    return folder
