"""Who looks on at a batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanweld.cluster.outcome import Outcome


class BatchObserver:
    """Looks on while a batch goes by, and does nothing: to be derived from."""

    def say(self, text: str) -> None:
        """Take in a line about the cluster."""

    def working(self, number: int, what: Mapping[str, Any]) -> None:
        """Take in how far a task is: {"frame", "total"} or {"doing"}."""

    def ended(self, outcome: Outcome) -> None:
        """Take in what became of a task."""
