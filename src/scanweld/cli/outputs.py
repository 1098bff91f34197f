"""Files that options name, looked at before any work is done for them."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from scanweld.errors import OutputError


def check_file(option: str, path: Path, endings: Sequence[str]) -> None:
    """Raise OutputError unless a file of this name, which has one of the endings, can be written."""
    wanted = " or ".join(endings)
    if path.is_dir():
        raise OutputError(f"{option} {path}: cannot be written: is a folder; the name of a file must end in {wanted}")
    if path.suffix.lower() not in endings:
        got = f"got '{path.suffix}'" if path.suffix else "got a name without ending"
        raise OutputError(f"{option} {path}: the name must end in {wanted}, {got}")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"{option} {path}: cannot be written: {path.parent}: {error.strerror or error}") from None
