"""Where a turned scan belongs: every shift on a grid is weighed at once, by correlation.

Both scans are drawn on grids: their surfaces as fields of normals, which count what meets and faces the same way, and
the space they looked through. The correlation of two grids says, for every shift, how much of one lies on the other
(through the fast Fourier transform). What meets speaks for a shift; surface in the other's free space against it.

Large planes fit each other after many shifts: their points count less, see :attr:`Scan.weights`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.ndimage import gaussian_filter

from scanweld.arrays import Float32, Float64
from scanweld.parallel import run_ranges
from scanweld.registration.global_search.agreement import DepthMap, in_free_space
from scanweld.registration.global_search.scan import Scan

_CELL = 3.0  # voxels
_MOST_CELLS = 96  # along an edge of a grid; larger scans get larger cells
_BLUR = 0.5  # cells: surfaces need not fall into the same cell
_AGAINST = 2.0  # weight of surface in free space
_PER_TURN = 16  # shifts kept of a turn
_APART = 3  # cells between two kept shifts of a turn
_ROUND = 8  # sizes of transforms are multiples: few sizes, few transforms of the target
_LOOKED_AT = 600  # of the best shifts of a turn

Grid = tuple[Float64, tuple[int, int, int]]
"""Lower corner [m] and number of cells."""

Spectra = npt.NDArray[np.complex64]
"""Transforms of fields, (C, X', Y', Z')."""


def place(
    source: Scan, target: Scan, rotations: Float64, views: tuple[DepthMap | None, DepthMap | None], count: int
) -> list[Float64]:
    """Return up to `count` transforms (4, 4) with the given rotations (R, 3, 3), the best first."""
    if len(rotations) == 0:
        return []
    cell = _cell(source, target)
    grid = _grid(target.points, views[1], cell)
    fixed = _Fixed(_fields(target, np.eye(3), views[1], grid, cell))
    found: list[list[tuple[float, Float64]]] = [[] for _ in rotations]

    def work(start: int, stop: int) -> None:
        for k in range(start, stop):
            found[k] = list(_shifts(source, rotations[k], views[0], fixed, grid, cell))

    run_ranges(len(rotations), work)
    ranked = sorted((shift for turn in found for shift in turn), key=lambda shift: -shift[0])
    return [T for _, T in ranked[:count]]


@dataclass(frozen=True, slots=True)
class _Fields:
    """What a scan's grid holds.

    Attributes
    ----------
    facing : (C, X, Y, Z), sums of the weighted normals, or of their products where they have no sign
    surface : (1, X, Y, Z), sums of the weights
    free : (1, X, Y, Z), 1 where the scan looked through
    """

    facing: Float32
    surface: Float32
    free: Float32


class _Fixed:
    """The target's fields, blurred, and their transforms for every size of grid that a turn of the source asks for."""

    def __init__(self, fields: _Fields) -> None:
        facing, surface = (
            gaussian_filter(f, (0, *[_BLUR] * 3), mode="constant") for f in (fields.facing, fields.surface)
        )
        self._fields = _Fields(facing, surface, fields.free)
        self._transformed: dict[tuple[int, ...], tuple[Spectra, Spectra, Spectra]] = {}

    def transformed(self, size: tuple[int, ...]) -> tuple[Spectra, Spectra, Spectra]:
        """Return the transforms of what faces, of the surface and of free space."""
        if size not in self._transformed:  # threads that meet here do the same work twice
            f = self._fields
            self._transformed[size] = _transform(f.facing, size), _transform(f.surface, size), _transform(f.free, size)
        return self._transformed[size]


def _transform(fields: Float32, size: tuple[int, ...]) -> Spectra:
    return np.asarray(scipy.fft.rfftn(fields, size, axes=(1, 2, 3)))


def _cell(source: Scan, target: Scan) -> float:
    extent = max(float(np.ptp(scan.points, axis=0).max()) for scan in (source, target))
    return max(_CELL * target.voxel_m, extent / _MOST_CELLS)


def _grid(points: Float64, view: DepthMap | None, cell: float, rotation: Float64 | None = None) -> Grid:
    """Return a grid around points (N, 3) and the viewpoint, which `rotation` turns into the frame of the points."""
    low, high = points.min(axis=0), points.max(axis=0)
    if view is not None:
        at = view.viewpoint if rotation is None else rotation @ view.viewpoint
        low, high = np.minimum(low, at), np.maximum(high, at)
    low = low - cell
    shape = np.ceil((high + cell - low) / cell).astype(int) + 1
    return low, (int(shape[0]), int(shape[1]), int(shape[2]))


def _fields(scan: Scan, rotation: Float64, view: DepthMap | None, grid: Grid, cell: float) -> _Fields:
    """Draw a scan, turned by `rotation`."""
    low, shape = grid
    points, normals = scan.points @ rotation.T, scan.normals @ rotation.T
    rows = np.ravel_multi_index(((points - low) / cell).astype(np.int64).T, shape)
    size = int(np.prod(shape))
    # Many points in a cell are hardly more than a few: a grid of 3 voxels has room for nine of a plane.
    crowd = np.sqrt(np.bincount(rows, minlength=size)[rows])
    weights = scan.weights / crowd
    channels = [weights * column for column in _channels(normals, scan.oriented).T]
    facing = np.stack([np.bincount(rows, c, size).reshape(shape) for c in channels])
    surface = np.bincount(rows, weights, size).reshape(1, *shape)
    free = np.zeros((1, *shape), np.float32)
    if view is not None:
        axes = [low[k] + cell * (np.arange(shape[k]) + 0.5) for k in range(3)]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) @ rotation
        free[0] = in_free_space(centers, view, cell).reshape(shape)
    return _Fields(facing.astype(np.float32), surface.astype(np.float32), free)


def _channels(normals: Float64, oriented: bool) -> Float64:
    """Return what to multiply for the cosine of two normals (N, 3); without signs, for its square (N, 6)."""
    if oriented:
        return normals
    x, y, z = normals.T
    half = np.sqrt(2.0)
    return np.stack([x * x, y * y, z * z, half * x * y, half * y * z, half * z * x], axis=1)


def _shifts(
    source: Scan, rotation: Float64, view: DepthMap | None, fixed: _Fixed, grid: Grid, cell: float
) -> Iterator[tuple[float, Float64]]:
    """Yield the score and the transform of the best shifts of a turn."""
    low, shape = _grid(source.points @ rotation.T, view, cell, rotation)
    fields = _fields(source, rotation, view, (low, shape), cell)
    size = tuple(scipy.fft.next_fast_len(-(-(a + b) // _ROUND) * _ROUND) for a, b in zip(shape, grid[1], strict=True))
    facing, surface, free = (np.conj(_transform(field, size)) for field in (fields.facing, fields.surface, fields.free))
    their_facing, their_surface, their_free = fixed.transformed(size)
    product = (facing * their_facing).sum(axis=0) - _AGAINST * (surface * their_free + free * their_surface)[0]
    scores = scipy.fft.irfftn(product, size)
    flat = scores.ravel()
    best = np.argpartition(-flat, min(_LOOKED_AT, len(flat) - 1))[:_LOOKED_AT]
    best = best[np.lexsort([best, -flat[best]])]
    kept: list[Float64] = []
    for row, index in zip(best, np.stack(np.unravel_index(best, size), axis=1), strict=True):
        steps = np.where(index >= grid[1], index - np.array(size), index)
        if any(np.abs(steps - other).max() < _APART for other in kept):
            continue
        kept.append(steps)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation, grid[0] - low + cell * steps
        yield float(flat[row]), T
        if len(kept) == _PER_TURN:
            return
