"""Storage of surfels, and nothing else: pages that are culled, cleaned and sorted one by one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.errors import InvalidInputError
from scanweld.geometry.views import MapCorrection
from scanweld.mapping import kernels
from scanweld.mapping.kernels import PAGE, ROWS
from scanweld.mapping.pages import PagePool
from scanweld.parallel import run_ranges

_ROWS: dict[str, tuple[slice, type]] = {
    "positions_m": (slice(0, 3), np.float32),
    "normals": (slice(3, 6), np.float32),
    "confidences": (slice(6, 7), np.float32),
    "radii_m": (slice(7, 8), np.float32),
    "colors": (slice(8, 11), np.float32),
    "created": (slice(11, 12), np.int32),
    "last_seen": (slice(12, 13), np.int32),
    "anchors": (slice(13, 14), np.int32),
}
"""In which rows of a page a property is kept, and as what."""


class SurfelMap:
    """A growing set of oriented discs with colour and confidence.

    Surfels live in pages, each of them within one cell of space (docs/decisions/0012-blocks.md): what is out of view
    is passed over page by page, and neighbours in space are neighbours in memory.

    Properties are read-only copies of the live surfels, page by page; new ones are not always the last.
    """

    def __init__(self, capacity: int = 1 << 16) -> None:
        self.pages = PagePool(-(-capacity // PAGE))
        """The storage, for the kernels of fusion and rendering."""
        self.anchor = 0
        """Keyframe that new surfels move with."""

    def __len__(self) -> int:
        return int(self.pages.counts.sum())

    @property
    def capacity(self) -> int:
        """Number of surfels that fit before the storage is doubled."""
        return self.pages.capacity * PAGE

    @property
    def positions_m(self) -> Float32:
        """(3, N) float32, world frame [m]."""
        return self._column("positions_m")

    @property
    def normals(self) -> Float32:
        """(3, N) float32, world frame, unit."""
        return self._column("normals")

    @property
    def colors(self) -> UInt8:
        """(3, N) uint8, RGB (rounded; the map keeps fractions)."""
        colors = np.clip(np.rint(self._column("colors")), 0, 255).astype(np.uint8)
        colors.flags.writeable = False
        return colors

    @property
    def radii_m(self) -> Float32:
        """(N,) float32 [m]."""
        return self._column("radii_m")

    @property
    def confidences(self) -> Float32:
        """(N,) float32, sum of the measurements' weights."""
        return self._column("confidences")

    @property
    def created(self) -> Int32:
        """(N,) int32, number of the frame that made the surfel."""
        return self._column("created")

    @property
    def last_seen(self) -> Int32:
        """(N,) int32, number of the frame that last confirmed the surfel."""
        return self._column("last_seen")

    @property
    def anchors(self) -> Int32:
        """(N,) int32, keyframe that the surfel moves with."""
        return self._column("anchors")

    def columns(self) -> dict[str, Array]:
        """Return the map as named columns, in the order of the PLY file."""
        p, n, c = self.positions_m, self.normals, self.colors
        return {
            "x": p[0], "y": p[1], "z": p[2], "nx": n[0], "ny": n[1], "nz": n[2],
            "red": c[0], "green": c[1], "blue": c[2], "radius": self.radii_m, "confidence": self.confidences,
        }  # fmt: skip

    def table(self) -> dict[str, Array]:
        """Return a copy of everything the map holds, colours as float32 with their fractions; see `replace`."""
        return {name: self._column(name).copy() for name in _ROWS}

    def replace(self, table: Mapping[str, Array]) -> None:
        """Hold what a table says, in the form of `table()`, instead of what the map held."""
        self.pages = PagePool(-(-len(table["radii_m"]) // PAGE))
        self._add(table)

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
        frames = np.full(len(radii_m), frame_id, np.int32)
        anchors = np.full(len(radii_m), self.anchor if anchor is None else anchor, np.int32)
        self._add({
            "positions_m": positions_m, "normals": normals, "colors": colors, "radii_m": radii_m,
            "confidences": confidences, "created": frames, "last_seen": frames, "anchors": anchors,
        })  # fmt: skip

    def take_in(self, other: SurfelMap) -> Int64:
        """Add the surfels of another map in the same world, as they are: their keyframes and ages stay theirs.

        Returns at which places of the properties they are now (M,), in the order that they had.
        """
        return self._add(other.table())

    def remove(self, doomed: Bool) -> int:
        """Drop the surfels where `doomed` (N,) is true; returns how many went."""
        if doomed.shape != (len(self),):
            raise InvalidInputError(f"map: expected a mask of shape ({len(self)},), got {doomed.shape}")
        last, live, shrunk = 0, self.pages.live.tolist(), []
        for slot, count in zip(live, self.pages.counts[live].tolist(), strict=True):
            kept = ~doomed[last : last + count]
            last += count
            if not kept.all():
                shrunk.append((slot, self.pages.page(slot)[:, kept]))
        self.pages.shrink(shrunk)
        return int(np.count_nonzero(doomed))

    def clean(self, slots: Int64, frame_id: int, unstable_frames: int, stable_confidence: float) -> int:
        """Drop from pages what is unstable after so many frames, or without confidence; returns how many went."""
        pages, before, stable = self.pages, self.pages.counts[slots], np.float32(stable_confidence)

        def body(start: int, stop: int) -> None:
            kernels.clean_pages(
                start, stop, slots, frame_id, unstable_frames, stable, pages.pool, pages.whole, pages.counts,
                pages.probation,
            )  # fmt: skip

        run_ranges(len(slots), body, grain=8)
        pages.dirty[slots] = 0
        after = pages.counts[slots]
        for slot in slots[(after < before) & (after < PAGE // 4)].tolist():
            pages.shrink([(slot, pages.page(slot).copy())])
        return int((before - after).sum())

    def pages_in(self, planes: Float64) -> Int32:
        """Return the slots of the pages that may hold surfels on the inner side of all planes (6, 4)."""
        return self.pages.inside(planes)

    def rows_of(self, numbers: Array) -> Int64:
        """Return at which place of the properties the surfels are that an index map names."""
        live = self.pages.live
        first = np.zeros(self.pages.capacity, np.int64)
        first[live] = np.cumsum(self.pages.counts[live]) - self.pages.counts[live]
        return np.asarray(first[numbers // PAGE] + numbers % PAGE)

    def apply_correction(self, correction: MapCorrection) -> None:
        """Move the surfels of each named keyframe by its T_new_old."""
        pages = self.pages
        live, largest = pages.live, max(0, *correction.keyframe_ids.tolist())
        table = np.tile(np.eye(4), (largest + 2, 1, 1))  # the last one is for the keyframes that stay
        table[correction.keyframe_ids] = correction.T_new_old

        def body(start: int, stop: int) -> None:
            for slot in live[start:stop].tolist():
                rows = pages.page(slot)
                T = table[np.minimum(rows[13].view(np.int32), largest + 1)]
                rows[0:3] = np.einsum("nij,jn->in", T[:, :3, :3], rows[0:3]) + T[:, :3, 3].T
                rows[3:6] = np.einsum("nij,jn->in", T[:, :3, :3], rows[3:6])
                pages.fit_box(slot)
                pages.cells[slot] = -1  # its cell is another one now

        run_ranges(len(live), body)

    def _add(self, table: Mapping[str, Array]) -> Int64:
        """Add surfels that come with all their columns; returns their places."""
        rows = np.empty((ROWS, len(table["radii_m"])), np.float32)
        for name, (some, kind) in _ROWS.items():
            rows[some] = np.asarray(table[name]).astype(kind).view(np.float32)
        return self.rows_of(self.pages.add(rows))

    def _column(self, name: str) -> Array:
        rows, kind = _ROWS[name]
        values: Array = np.empty((rows.stop - rows.start, len(self)), kind)
        done = 0
        for slot in self.pages.live.tolist():
            page = self.pages.page(slot)
            values[:, done : done + page.shape[1]] = page[rows].view(kind)
            done += page.shape[1]
        values = values if len(values) > 1 else values[0]
        values.flags.writeable = False
        return values
