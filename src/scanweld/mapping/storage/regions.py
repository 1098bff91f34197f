"""Which shelves belong to which region of space, so that what is in view together is on few shelves.

Pages come and go all the time: without regions, those of a place would end up on shelves all over the storage, and a
view would need them all in memory.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from scanweld.arrays import Array, Bool, Int32, Int64
from scanweld.mapping.storage import kernels
from scanweld.mapping.storage.kernels import SHELF
from scanweld.state import Stateful

_FEWEST = 16
"""Room of the table of regions at first, a power of two: half of it may be taken."""


class Regions(Stateful):
    """Shelves of each region, as chains; the arrays are for `kernels.deposit`, which takes empty shelves.

    Attributes
    ----------
    used : (S,) int32, pages of each shelf with surfels
    owners : (S,) int64, key of the region that a shelf which is not empty is of
    following : (S,) int32, the next shelf of the same region, -1 after the last
    keys, heads : (2^n,) int64 and int32, the regions, -1 where free, and the first shelf of each
    free : (S,) int32, empty shelves, the first `left[0]` of it; the last of these is taken first
    left : (2,) int64, empty shelves, and regions that there is room for in the table
    """

    STATE: ClassVar = {
        "used": Int32, "owners": Int64, "following": Int32, "keys": Int64, "heads": Int32, "free": Int32, "left": Int64,
    }  # fmt: skip

    def __init__(self) -> None:
        self.used: Int32 = np.empty(0, np.int32)
        self.owners: Int64 = np.empty(0, np.int64)
        self.following: Int32 = np.empty(0, np.int32)
        self.keys: Int64 = np.full(_FEWEST, -1, np.int64)
        self.heads: Int32 = np.full(_FEWEST, -1, np.int32)
        self.free: Int32 = np.empty(0, np.int32)
        self.left: Int64 = np.array([0, _FEWEST // 2])

    def grow(self, shelves: int) -> None:
        """Know of so many shelves; the lowest of the new ones is taken first."""
        more = np.arange(len(self.used), shelves, dtype=np.int32)[::-1]
        zeros = np.zeros(len(more), np.int32)
        self.used = np.concatenate([self.used, zeros])
        self.owners = np.concatenate([self.owners, zeros.astype(np.int64)])
        self.following = np.concatenate([self.following, zeros - 1])
        free = np.concatenate([more, self.free[: self.left[0]]])
        self.left[0] = len(free)
        self.free = np.concatenate([free, np.zeros(shelves - len(free), np.int32)])

    def release(self, slots: Array) -> None:
        """Note that pages hold no surfels any more; a shelf that is empty then can be any region's."""
        shelves, pages = np.unique(slots // SHELF, return_counts=True)
        self.used[shelves] -= pages.astype(np.int32)
        for shelf in shelves[self.used[shelves] == 0].tolist():
            place = kernels.find_cell(self.owners[shelf], self.keys)
            before, at = -1, int(self.heads[place])
            while at != shelf:
                before, at = at, int(self.following[at])
            if before < 0:
                self.heads[place] = self.following[shelf]
            else:
                self.following[before] = self.following[shelf]
            self.free[self.left[0]] = shelf
            self.left[0] += 1

    def make_room(self) -> None:
        """Make the table larger, and leave out the regions without a shelf."""
        size = max(_FEWEST, 1 << (4 * int(np.count_nonzero(self.heads >= 0))).bit_length())
        keys: Int64 = np.full(size, -1, np.int64)
        heads: Int32 = np.full(size, -1, np.int32)
        filled = kernels.rehash(self.keys, self.heads, self.owners, keys, heads)
        self.keys, self.heads, self.left[1] = keys, heads, size // 2 - filled

    def check(self, holds: Bool) -> None:
        """Raise ValueError where kernels would leave the arrays; `holds` (P,): whether a page has surfels."""
        count, size = len(holds) // SHELF, len(self.keys)
        used = np.bincount(np.flatnonzero(holds) // SHELF, minlength=count)
        right = self.owners.shape == self.following.shape == self.free.shape == (count,) and self.left.shape == (2,)
        if not right or not np.array_equal(self.used, used) or not 0 <= self.left[0] <= count:
            raise ValueError("shelves of other pages")
        if not np.array_equal(np.sort(self.free[: self.left[0]]), np.flatnonzero(used == 0)):
            raise ValueError("empty shelves that are not empty")
        taken = int(np.count_nonzero(self.keys >= 0))
        if size < _FEWEST or size & (size - 1) or self.heads.shape != (size,) or self.left[1] != size // 2 - taken:
            raise ValueError("a table of regions of another size")
        seen: Bool = np.zeros(count, np.bool_)
        for shelf in self.heads[self.heads != -1].tolist():
            while shelf != -1:
                if not 0 <= shelf < count or seen[shelf]:
                    raise ValueError("chains of shelves that are none")
                seen[shelf], shelf = True, int(self.following[shelf])
        if not np.array_equal(seen, used > 0):
            raise ValueError("shelves of no region")
