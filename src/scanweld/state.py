"""What an object keeps from frame to frame, named, so that it can be stored and put back (docs/checkpoints.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar


class Stateful:
    """An object whose state is some of its attributes; whatever else it holds follows from how it was made.

    A stored state is put into an object that was made in the same way as the one it was taken from: attribute by
    attribute, in the order of `STATE`, and into what an attribute holds where that is stateful itself.
    """

    STATE: ClassVar[Mapping[str, Any]] = {}
    """Name and type of each attribute that is state: scalars, strings, enumerations, arrays, sequences, mappings and
    records (classes that are built from their annotated attributes) of these, other stateful objects, each perhaps
    None. An `Iterator` is written, and has to be read, item by item: for what does not fit in memory twice."""

    MADE: ClassVar[frozenset[str]] = frozenset()
    """Names of the other attributes: configuration, what follows from it or from the state, and scratch memory."""

    def restored(self) -> None:
        """Check a state that was put back, and what follows from it; raises ValueError where it cannot be one."""
