"""Which shelves of a map are in memory: those that were used last, as many as the budget holds."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Array, Bool, Int64
from scanweld.mapping.storage.backing import Memory


class Residence:
    """Counts the shelves that are in memory, and lets those go that were used longest ago.

    What is used at the same time stays together, however little the budget is.

    Parameters
    ----------
    backing : the memory
    size : numbers on a shelf
    budget : numbers that may be in memory
    """

    def __init__(self, backing: Memory, size: int, budget: int) -> None:
        self._backing, self._size = backing, size
        self.room = max(1, budget // size)
        """Shelves that may be in memory."""
        self.num_held = 0
        """Shelves in memory."""
        self.most_held = 0
        """The same, at most so far."""
        self._turn = 0
        self._used: Int64 = np.empty(
            0, np.int64
        )  # the turn in which each shelf was used last, -1 for one not in memory

    @property
    def held(self) -> Bool:
        """Which shelves (S,) are in memory."""
        return self._used >= 0

    def grow(self, shelves: int) -> None:
        """Know of so many shelves; new ones are not in memory before they are used."""
        self._used = np.concatenate([self._used, np.full(shelves - len(self._used), -1, np.int64)])

    def use(self, shelves: Array) -> None:
        """Have shelves (S,), each named once, in memory."""
        self._turn += 1
        back = shelves[self._used[shelves] < 0]
        self._used[shelves] = self._turn
        if len(back) == 0:
            return
        self.num_held += len(back)
        if self.num_held > self.room:
            others = np.flatnonzero((self._used >= 0) & (self._used < self._turn))
            oldest = others[np.argsort(self._used[others], kind="stable")[: self.num_held - self.room]]
            self._used[oldest] = -1
            self.num_held -= len(oldest)
            self._backing.let_go(self._ranges(oldest))
        self.most_held = max(self.most_held, self.num_held)
        self._backing.recall(self._ranges(back))

    def _ranges(self, shelves: Array) -> list[tuple[int, int]]:
        return [(shelf * self._size, (shelf + 1) * self._size) for shelf in shelves.tolist()]
