"""Objects of other libraries, made of ours and turned into ours (docs/interop.md); each is imported when it is used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from scanweld.errors import MissingDependencyError


def imported(module: str, extra: str) -> Any:
    """Return a module of an optional library; raises MissingDependencyError, naming the extra, when it is not there."""
    try:
        return import_module(module)
    except ImportError:
        raise MissingDependencyError(module.partition(".")[0], extra) from None
