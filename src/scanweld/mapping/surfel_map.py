"""Storage of surfels, and nothing else: columns over the pages that they live in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.errors import InvalidInputError
from scanweld.geometry.views import MapCorrection
from scanweld.mapping.storage.kernels import PAGE, ROWS
from scanweld.mapping.storage.pages import MapConfig, PagePool
from scanweld.notebook import card, seen_from_above
from scanweld.state import Stateful

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


class SurfelMap(Stateful):
    """A growing set of oriented discs with colour and confidence.

    Surfels live in pages, each of them within one cell of space (docs/decisions/0012-blocks.md): what is out of view
    is passed over page by page, and neighbours in space are neighbours in memory.

    Properties are read-only copies of the live surfels, page by page; new ones are not always the last. A map may be
    larger than memory (`MapConfig.memory_budget_mb`); then :meth:`batches` and :meth:`sample` are for it.
    """

    STATE: ClassVar = {"pages": Stateful, "anchor": int}

    def __init__(self, capacity: int = 1 << 16, config: MapConfig | None = None) -> None:
        self.pages = PagePool(-(-capacity // PAGE), config)
        """The storage, for the kernels of fusion and rendering."""
        self.anchor = 0
        """Keyframe that new surfels move with."""

    def __len__(self) -> int:
        return self.pages.total

    def __repr__(self) -> str:
        return f"<SurfelMap of {len(self):,} surfels>"

    def _repr_html_(self) -> str:
        """Show the map in a notebook, from above."""
        title = f"Map of {len(self):,} surfels"
        if len(self) == 0:
            return card(title, [])
        some = self.sample(50_000)
        points, normals, colors = (
            np.column_stack([some[name] for name in names])
            for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
        )
        extent = np.subtract(*np.quantile(points, [0.99, 0.01], axis=0))
        rows = [
            ("extent", " x ".join(f"{side:.2f}" for side in extent) + " m"),
            ("radius", f"{1e3 * np.median(some['radius']):.1f} mm (median)"),
            ("confidence", f"{np.median(some['confidence']):.1f} (median)"),
        ]
        return card(title, rows, picture=seen_from_above(points, normals, colors))

    @property
    def capacity(self) -> int:
        """Number of surfels that fit before the storage grows."""
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
        colors = _rounded(self._column("colors"))
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
        parts = list(self.batches())
        if not parts:
            return _file_columns(np.empty((ROWS, 0), np.float32))
        return parts[0] if len(parts) == 1 else {
            name: np.concatenate([part[name] for part in parts]) for name in parts[0]
        }  # fmt: skip

    def batches(self) -> Iterator[dict[str, Array]]:
        """Yield :meth:`columns` in parts, in order; with a memory budget none of them is larger."""
        for slots in self.pages.batches():
            yield _file_columns(self.pages.rows_in(slots))

    def sample(self, count: int) -> dict[str, Array]:
        """Return about `count` surfels from all over the map, in the form of :meth:`columns`; all of a smaller one."""
        step, first, parts = max(1, len(self) // max(count, 1)), 0, []
        for slots in self.pages.batches():
            numbers = self.pages.numbers_in(slots)
            parts.append(self.pages.rows(numbers[-first % step :: step]))
            first += len(numbers)
        return _file_columns(np.concatenate([np.empty((ROWS, 0), np.float32), *parts], axis=1))

    def table(self) -> dict[str, Array]:
        """Return a copy of everything the map holds, colours as float32 with their fractions; see `replace`."""
        return {name: self._column(name).copy() for name in _ROWS}

    def replace(self, table: Mapping[str, Array]) -> None:
        """Hold what a table says, in the form of `table()`, instead of what the map held."""
        self.pages = PagePool(-(-len(table["radii_m"]) // PAGE), self.pages.config)
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

    def take_in(self, other: SurfelMap) -> None:
        """Add the surfels of another map in the same world, as they are: their keyframes and ages stay theirs."""
        self.pages.take_in(other.pages)

    def remove(self, doomed: Bool) -> int:
        """Drop the surfels where `doomed` (N,) is true; returns how many went."""
        if doomed.shape != (len(self),):
            raise InvalidInputError(f"map: expected a mask of shape ({len(self)},), got {doomed.shape}")
        self.pages.drop(self.pages.numbers_in(self.pages.live)[doomed])
        return int(np.count_nonzero(doomed))

    def clean(self, slots: Int64, frame_id: int, unstable_frames: int, stable_confidence: float) -> int:
        """Drop from pages what is unstable after so many frames, or without confidence; returns how many went."""
        return self.pages.clean(slots, frame_id, unstable_frames, stable_confidence)

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
        """Move the surfels of each named keyframe by its T_new_old; each page follows when it is next looked at."""
        self.pages.correct(motions(correction))

    def _add(self, table: Mapping[str, Array]) -> None:
        """Add surfels that come with all their columns."""
        rows = np.empty((ROWS, len(table["radii_m"])), np.float32)
        for name, (some, kind) in _ROWS.items():
            rows[some] = np.asarray(table[name]).astype(kind).view(np.float32)
        self.pages.add(rows)

    def _column(self, name: str) -> Array:
        some, kind = _ROWS[name]
        values: Array = np.empty((some.stop - some.start, len(self)), kind)
        done = 0
        for slots in self.pages.batches():
            rows: Array = self.pages.rows_in(slots, some).view(kind)
            values[:, done : done + rows.shape[1]] = rows
            done += rows.shape[1]
        values = values if len(values) > 1 else values[0]
        values.flags.writeable = False
        return values


def motions(correction: MapCorrection) -> Float64:
    """Return T_new_old (A + 1, 4, 4) of each keyframe by its number; the last, the identity, is for all others."""
    table = np.tile(np.eye(4), (int(correction.keyframe_ids.max(initial=0)) + 2, 1, 1))
    table[correction.keyframe_ids] = correction.T_new_old
    return table


def _file_columns(rows: Float32) -> dict[str, Array]:
    """Name rows (ROWS, N) as the PLY file does."""
    c = _rounded(rows[_ROWS["colors"][0]])
    return {
        "x": rows[0], "y": rows[1], "z": rows[2], "nx": rows[3], "ny": rows[4], "nz": rows[5],
        "red": c[0], "green": c[1], "blue": c[2], "radius": rows[7], "confidence": rows[6],
    }  # fmt: skip


def _rounded(colors: Float32) -> UInt8:
    return np.clip(np.rint(colors), 0, 255).astype(np.uint8)
