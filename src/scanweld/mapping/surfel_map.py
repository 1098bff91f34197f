"""Storage of surfels, and nothing else: structure of arrays, doubling capacity, a handful of mutators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Int32, UInt8
from scanweld.errors import InvalidInputError
from scanweld.geometry.views import MapCorrection
from scanweld.parallel import run_ranges

_COLUMNS: tuple[tuple[str, int, type], ...] = (
    ("positions", 3, np.float32),
    ("normals", 3, np.float32),
    ("colors", 3, np.float32),
    ("radii", 1, np.float32),
    ("confidences", 1, np.float32),
    ("created", 1, np.int32),
    ("last_seen", 1, np.int32),
    ("anchors", 1, np.int32),
)


_MOVED_AT_ONCE = 1 << 14
"""Surfels moved at a time: the transforms of all at once would take more memory than the map."""

ROW_PADDING = 2064
"""Extra columns: 129 cache lines, so that neighbouring rows are 129 cache sets apart."""


@dataclass(slots=True)
class SurfelArrays:
    """The arrays themselves, longer than the map; only mapping code sees them.

    positions, normals (3, capacity) float32, world frame; colors (3, capacity) float32, RGB 0..255; radii [m],
    confidences (capacity,) float32; created, last_seen (capacity,) int32, frame numbers; anchors (capacity,) int32,
    keyframe numbers.
    """

    positions: Float32
    normals: Float32
    colors: Float32
    radii: Float32
    confidences: Float32
    created: Int32
    last_seen: Int32
    anchors: Int32

    @classmethod
    def empty(cls, capacity: int) -> SurfelArrays:
        """Allocate arrays for `capacity` surfels.

        All rows lie in one block whose row length is not a power of two: equal positions in different rows would
        otherwise fall into the same few sets of the cache and push each other out.
        """
        block = np.zeros((sum(rows for _, rows, _ in _COLUMNS), capacity + ROW_PADDING), np.float32)
        columns: list[Array] = []
        first = 0
        for _, rows, kind in _COLUMNS:
            column: Array = block[first : first + rows].view(kind)
            columns.append(column if rows > 1 else column[0])
            first += rows
        return cls(*columns)


class SurfelMap:
    """A growing set of oriented discs with colour and confidence.

    Properties return read-only views of the live surfels; they are valid until the map is changed.
    """

    def __init__(self, capacity: int = 1 << 16) -> None:
        self._arrays = SurfelArrays.empty(max(16, capacity))
        self._count = 0
        self.anchor = 0
        """Keyframe that new surfels move with."""

    def __len__(self) -> int:
        return self._count

    @property
    def capacity(self) -> int:
        """Number of surfels that fit before the arrays are doubled."""
        return int(self._arrays.radii.shape[0]) - ROW_PADDING

    @property
    def positions_m(self) -> Float32:
        """(3, N) float32, world frame [m]."""
        return self._view("positions")

    @property
    def normals(self) -> Float32:
        """(3, N) float32, world frame, unit."""
        return self._view("normals")

    @property
    def colors(self) -> UInt8:
        """(3, N) uint8, RGB (a rounded copy; the map keeps fractions)."""
        return np.clip(np.rint(self._view("colors")), 0, 255).astype(np.uint8)

    @property
    def radii_m(self) -> Float32:
        """(N,) float32 [m]."""
        return self._view("radii")

    @property
    def confidences(self) -> Float32:
        """(N,) float32, sum of the measurements' weights."""
        return self._view("confidences")

    @property
    def created(self) -> Int32:
        """(N,) int32, number of the frame that made the surfel."""
        return self._view("created")

    @property
    def last_seen(self) -> Int32:
        """(N,) int32, number of the frame that last confirmed the surfel."""
        return self._view("last_seen")

    @property
    def anchors(self) -> Int32:
        """(N,) int32, keyframe that the surfel moves with."""
        return self._view("anchors")

    @property
    def arrays(self) -> SurfelArrays:
        """The storage, for the kernels of fusion and rendering: only the first ``len(map)`` columns are surfels."""
        return self._arrays

    def reserve(self, more: int) -> SurfelArrays:
        """Make room for `more` surfels behind the live ones and return the storage."""
        needed, capacity = self._count + more, self.capacity
        if needed > capacity:
            while capacity < needed:
                capacity *= 2
            grown = SurfelArrays.empty(capacity)
            for name, _, _ in _COLUMNS:
                getattr(grown, name)[..., : self._count] = getattr(self._arrays, name)[..., : self._count]
            self._arrays = grown
        return self._arrays

    def extend(self, more: int, anchor: int | None = None) -> None:
        """Count `more` surfels that a kernel wrote behind the live ones; they move with `anchor`, or the map's own."""
        if not 0 <= more <= self.capacity - self._count:
            raise InvalidInputError(f"map: cannot extend by {more}, reserve first")
        self._arrays.anchors[self._count : self._count + more] = self.anchor if anchor is None else anchor
        self._count += more

    def append(
        self,
        positions_m: Float32,
        normals: Float32,
        colors: Array,
        radii_m: Float32,
        confidences: Float32,
        frame_id: int,
        anchor: int | None = None,
    ) -> None:
        """Add surfels: positions, normals, colors (3, M), radii and confidences (M,); they move with a keyframe."""
        more = len(radii_m)
        arrays = self.reserve(more)
        new = slice(self._count, self._count + more)
        arrays.positions[:, new], arrays.normals[:, new], arrays.colors[:, new] = positions_m, normals, colors
        arrays.radii[new], arrays.confidences[new] = radii_m, confidences
        arrays.created[new] = arrays.last_seen[new] = frame_id
        self.extend(more, anchor)

    def take_in(self, other: SurfelMap) -> None:
        """Add the surfels of another map in the same world, as they are: their keyframes and ages stay theirs."""
        arrays, more = self.reserve(len(other)), slice(self._count, self._count + len(other))
        for name, _, _ in _COLUMNS:
            getattr(arrays, name)[..., more] = getattr(other.arrays, name)[..., : len(other)]
        self._count += len(other)

    def remove(self, doomed: Bool) -> int:
        """Drop the surfels where `doomed` (N,) is true, keeping the order of the others; returns how many went."""
        if doomed.shape != (self._count,):
            raise InvalidInputError(f"map: expected a mask of shape ({self._count},), got {doomed.shape}")
        gone = int(np.count_nonzero(doomed))
        if gone:
            self.keep(np.flatnonzero(~doomed))
        return gone

    def keep(self, order: Array) -> None:
        """Keep the surfels that `order` (M,) lists, each at most once, in that order, and drop the others."""
        rows = [row for name, _, _ in _COLUMNS for row in np.atleast_2d(getattr(self._arrays, name))]

        def body(start: int, stop: int) -> None:
            for row in rows[start:stop]:
                row[: len(order)] = row[order]

        run_ranges(len(rows), body)
        self._count = len(order)

    def apply_correction(self, correction: MapCorrection) -> None:
        """Move the surfels of each named keyframe by its T_new_old."""
        arrays = self._arrays
        table = np.tile(np.eye(4), (max(int(self.anchors.max(initial=0)), *correction.keyframe_ids, 0) + 1, 1, 1))
        table[correction.keyframe_ids] = correction.T_new_old

        def body(start: int, stop: int) -> None:
            for first in range(start, stop, _MOVED_AT_ONCE):
                some = slice(first, min(first + _MOVED_AT_ONCE, stop))
                T = table[arrays.anchors[some]]
                turned = np.einsum("nij,jn->in", T[:, :3, :3], arrays.positions[:, some])
                arrays.positions[:, some] = turned + T[:, :3, 3].T
                arrays.normals[:, some] = np.einsum("nij,jn->in", T[:, :3, :3], arrays.normals[:, some])

        run_ranges(self._count, body, grain=_MOVED_AT_ONCE)

    def columns(self) -> dict[str, Array]:
        """Return the map as named columns, in the order of the PLY file."""
        p, n, c = self.positions_m, self.normals, self.colors
        return {
            "x": p[0], "y": p[1], "z": p[2], "nx": n[0], "ny": n[1], "nz": n[2],
            "red": c[0], "green": c[1], "blue": c[2], "radius": self.radii_m, "confidence": self.confidences,
        }  # fmt: skip

    def _view(self, name: str) -> Array:
        view: Array = getattr(self._arrays, name)[..., : self._count]
        view.flags.writeable = False
        return view
