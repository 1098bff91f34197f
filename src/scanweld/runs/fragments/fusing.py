"""The maps of all fragments made one, block by block: no task has more in memory than a fragment, or a block.

First each fragment moves its surfels to where its keyframes are, and sorts them into blocks of space; then each block
takes in what fragments have brought to it, and makes one surface of the layers that several of them saw.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scanweld.arrays import Float32
from scanweld.errors import FileFormatError
from scanweld.mapping.merging import merge_maps
from scanweld.mapping.storage.kernels import ROWS
from scanweld.mapping.storage.pages import CELL_M
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import limited_threads
from scanweld.runs.fragments.assembling import Piece
from scanweld.runs.fragments.making import Workplace, read_map

BLOCK_M = 16 * CELL_M
"""Edge of a block [m]: a task that is worth sending away, and a few hundred megabytes at most."""

BLOCK_FOLDER = "block-"
"""What the names of the folders of blocks begin with."""

LEAST_BUDGET_MB = 256.0
"""Memory for surfels of the process that writes the whole map [MB], where the configuration gives no budget."""


@dataclass(frozen=True, slots=True, order=True)
class Block:
    """A cube of space in the world of a component, by its place in the lattice of blocks."""

    component: int
    x: int
    y: int
    z: int

    @property
    def _folder(self) -> str:
        return f"{BLOCK_FOLDER}{self.component}-{self.x}-{self.y}-{self.z}"

    def piece(self, number: int) -> str:
        """Name in the exchange of what a piece, by number, has brought to it."""
        return f"{self._folder}/piece-{number:06d}.npy"

    @property
    def fused(self) -> str:
        """Name in the exchange of what it has become."""
        return f"{self._folder}/fused.npy"


def sort_into_blocks(place: Workplace, piece: Piece, number: int, *, last: bool) -> list[Block]:
    """Move the surfels of a piece with its keyframes, and write them into files, one for each block they come to.

    Parameters
    ----------
    number : of the piece, in the order in which blocks take pieces in
    last : of its component: what was new in the last frames is kept, as at the end of a run. The others have been seen
        again by the next fragment, and only what proved to be stable is
    """
    with limited_threads(place.threads):
        mapper = read_map(place, piece.fragment, piece.submap)
        mapper.apply(piece.correction)
        mapper.finish()
        pages, fusion = mapper.map.pages, place.config.fusion
        if not last:
            pages.clean(pages.live, _LATE, 0, fusion.stable_confidence)
        blocks: dict[Block, list[Float32]] = {}
        for slots in pages.batches():
            rows = pages.rows_in(slots)
            rows[13] = np.full(rows.shape[1], number, np.int32).view(np.float32)
            lattice = np.floor(rows[:3] / np.float32(BLOCK_M)).astype(np.int64)
            corners, of_corner = np.unique(lattice, axis=1, return_inverse=True)
            for k, corner in enumerate(corners.T.tolist()):
                blocks.setdefault(Block(piece.component, *corner), []).append(rows[:, of_corner.reshape(-1) == k])
        for block, parts in blocks.items():
            with place.exchange.written(block.piece(number)) as path:
                np.save(path, np.concatenate(parts, axis=1))
    return sorted(blocks)


def fuse_block(place: Workplace, block: Block, numbers: Sequence[int]) -> int:
    """Make one surface of what pieces, by number, have brought to a block; returns the number of surfels."""
    fusion = place.config.fusion
    with limited_threads(place.threads):
        surfels = SurfelMap()
        for number in numbers:
            surfels.pages.add(_load(place.exchange.read(block.piece(number))))
        if len(numbers) > 1:
            merge_maps(surfels, fusion.max_confidence, fusion.merging)
        with place.exchange.written(block.fused) as path:
            np.save(path, surfels.pages.rows_in(surfels.pages.live))
    return len(surfels)


def whole_map(place: Workplace, blocks: Sequence[Block]) -> SurfelMap:
    """Return the map of a component, of which only a part is in memory."""
    config = place.config.map
    surfels = SurfelMap(config=replace(config, memory_budget_mb=config.memory_budget_mb or LEAST_BUDGET_MB))
    for rows in _contents(place, blocks):
        surfels.pages.add(rows)
    return surfels


def _contents(place: Workplace, blocks: Sequence[Block]) -> Iterator[Float32]:
    for block in sorted(blocks):
        yield _load(place.exchange.read(block.fused))


def _load(path: Path) -> Float32:
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: cannot be read: {error}") from None
    if rows.dtype != np.float32 or rows.ndim != 2 or len(rows) != ROWS:
        raise FileFormatError(f"{path}: are no surfels")
    return np.asarray(rows)


_LATE = 0x40000000
"""Number of a frame after all others."""
