"""The operations on the map in plain NumPy and double precision; see :class:`~.backends.MapBackend`."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.mapping.backends.arrays import FARTHEST_M, NEAREST_M, DepthBuffers, IndexMap, Measurement
from scanweld.mapping.kernels import EMPTY
from scanweld.mapping.storage.kernels import PAGE, ROWS
from scanweld.mapping.storage.pages import PagePool

LUMINANCE = np.array([0.299, 0.587, 0.114])

NEIGHBOURS = tuple((dv, du) for dv in (-1, 0, 1) for du in (-1, 0, 1) if (dv, du) != (0, 0))


def index_map(
    pages: PagePool,
    slots: Int32,
    T_world_camera: Float64,
    camera: PinholeCamera,
    stable_confidence: float,
    buffers: DepthBuffers,
) -> IndexMap:
    """Find the nearest surfel at each pixel."""
    numbers = pages.numbers_in(slots)
    surfels = pages.rows(numbers)[:7].astype(np.float64)
    positions, normals, confidences = surfels[0:3], surfels[3:6], surfels[6]
    x, y, z = _moved(se3.inverse(T_world_camera), positions)
    depth = np.maximum(z, NEAREST_M)
    u, v = np.floor(camera.fx * x / depth + camera.cx + 0.5), np.floor(camera.fy * y / depth + camera.cy + 0.5)
    towards = T_world_camera[:3, 3:] - positions
    facing = (normals * towards).sum(axis=0) >= 0.1 * np.linalg.norm(towards, axis=0)
    visible = facing & (z > NEAREST_M) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)

    numbers = numbers[visible]
    pixels = (v[visible] * camera.width + u[visible]).astype(np.int64)
    depth = np.where(confidences < stable_confidence, 1.02 * depth, depth)[visible]
    micrometres = (np.minimum(depth, 1.05 * FARTHEST_M) * 1e6).astype(np.int64)
    nearest: Int64 = np.full(camera.width * camera.height, EMPTY)
    np.minimum.at(nearest, pixels, micrometres << 32 | numbers)
    winner = np.where(nearest < EMPTY, nearest & 0xFFFFFFFF, -1)

    won = winner[pixels] == numbers
    page = np.repeat(np.arange(len(slots)), pages.counts[slots])[visible]
    counts = np.bincount(page[won], minlength=len(slots)).astype(np.int32)
    listed = np.arange(PAGE) < counts[:, None]
    places: UInt8 = np.zeros(listed.shape, np.uint8)
    landed: Int32 = np.zeros(listed.shape, np.int32)
    places[listed], landed[listed] = numbers[won] % PAGE, pixels[won]
    return IndexMap(winner.reshape(camera.shape).astype(np.int32), slots, counts, places.ravel(), landed.ravel())


def show(pages: PagePool, seen: IndexMap) -> tuple[Int32, Float32]:
    """Return the view of an index map."""
    numbers, pixels = seen.winners()
    surfels = pages.rows(numbers)
    rows: Int32 = np.full(seen.numbers.shape, -1, np.int32)
    rows.ravel()[pixels] = np.arange(len(numbers))
    return rows, np.concatenate([surfels[:7], (LUMINANCE @ surfels[8:11])[None]]).astype(np.float32)


def merge(pages: PagePool, seen: IndexMap, frame: Measurement, limits: Float32) -> tuple[UInt8, Int32, Float32]:
    """Merge the surfels that are seen with what their pixels measure, in place."""
    margin, most = float(limits[3]), float(limits[5])
    numbers, pixels = seen.winners()
    surfels = pages.rows(numbers)
    positions = surfels[0:3].astype(np.float64)
    measured = _Measured(frame, pixels, limits)
    agrees = measured.agrees(positions, surfels[3:6].astype(np.float64))
    weights = frame.weights.ravel()[pixels].astype(np.float64)

    taken = agrees & (weights > 0)
    surfels[:11, taken] = _means(surfels[:11, taken], weights[taken], _Measured(frame, pixels[taken], limits), most)
    surfels[12].view(np.int32)[taken] = frame.frame_id

    crossed = agrees & (weights < 0)
    surfels[6, crossed] = np.minimum(surfels[6, crossed], 1)
    through = measured.exists & ~agrees & _seen_through(frame, pixels, positions, measured.gate, margin)
    surfels[6, through] = np.maximum(surfels[6] - np.abs(weights), 0)[through]
    pages.dirty[numbers[crossed | through] // PAGE] = 1
    pages.put(numbers, surfels)

    in_map: UInt8 = np.zeros(frame.camera.shape, np.uint8)
    in_map.ravel()[pixels] = agrees
    return in_map, *show(pages, seen)


def _means(surfels: Float32, weights: Float64, measured: _Measured, most: float) -> Float64:
    """Return surfels (11, N) merged with measurements that agree with them; the finest view sets the radius."""
    positions, normals, confidences, radii, colors = np.split(surfels.astype(np.float64), [3, 6, 7, 8])
    share = weights / (confidences + weights)

    def mean(old: Float64, new: Float64) -> Float64:
        return np.asarray((1 - share) * old + share * new)

    normal = mean(normals, measured.normals)
    return np.concatenate([
        mean(positions, measured.positions), normal / np.linalg.norm(normal, axis=0),
        np.minimum(confidences + weights, most), np.minimum(radii, 2 * measured.radii), mean(colors, measured.colors),
    ])  # fmt: skip


def new_surfels(
    rows: Int32, values: Float32, merged: UInt8, frame: Measurement, limits: Float32, anchor: int
) -> Float32:
    """Make surfels of the pixels whose measurement is not in the map."""
    camera, spread = frame.camera, float(limits[4])
    wanted = (merged == 0) & (frame.surface[..., 6] > 0) & (frame.weights > 0)
    v, u = np.nonzero(wanted)
    measured = _Measured(frame, np.flatnonzero(wanted), limits)
    own, covered = rows[v, u], np.zeros(len(v), np.bool_)
    T_camera_world = se3.inverse(frame.T_world_camera)
    for dv, du in NEIGHBOURS if values.shape[1] else ():
        y, x = v + dv, u + du
        inside = (y >= 0) & (y < camera.height) & (x >= 0) & (x < camera.width)
        row = np.where(inside, rows[y % camera.height, x % camera.width], -1)
        surfels = values[:, np.maximum(row, 0)].astype(np.float64)
        c = _moved(T_camera_world, surfels[0:3])
        # How far from the pixel's centre the surfel lands, times its depth.
        away = np.hypot(camera.fx * c[0] - (u - camera.cx) * c[2], camera.fy * c[1] - (v - camera.cy) * c[2])
        near = away < spread * np.abs(c[2])
        covered |= (row >= 0) & (row != own) & near & measured.agrees(surfels[0:3], surfels[3:6])
    v, u = v[~covered], u[~covered]
    measured = _Measured(frame, v * camera.width + u, limits)
    new: Float32 = np.empty((ROWS, len(v)), np.float32)
    new[0:3], new[3:6], new[8:11] = measured.positions, measured.normals, measured.colors
    new[6], new[7] = frame.weights[v, u], measured.radii
    new[11:14].view(np.int32)[:] = np.array([[frame.frame_id], [frame.frame_id], [anchor]])
    return new


class _Measured:
    """What some pixels (N,) measure, in the world: positions, normals, colours (3, N), radii, gates (N,)."""

    def __init__(self, frame: Measurement, pixels: Array, limits: Float32) -> None:
        sigmas, floor, self._min_cosine = limits[:3].astype(np.float64)
        surface = frame.surface.reshape(-1, 8)[pixels].T.astype(np.float64)
        self.exists = surface[6] > 0
        self.positions = _moved(frame.T_world_camera, surface[0:3])
        self.normals = frame.T_world_camera[:3, :3] @ surface[3:6]
        self.radii, self.colors = surface[7], frame.color.reshape(-1, 3)[pixels].T.astype(np.float64)
        self.gate = np.maximum(sigmas / np.maximum(surface[6], 1e-6), floor)

    def agrees(self, positions: Float64, normals: Float64) -> Bool:
        """Whether surfels (3, N) are within the gate along the normals, not far aside, and face the same way."""
        offset = positions - self.positions
        along = np.abs((self.normals * offset).sum(axis=0)) < self.gate
        alike = (self.normals * normals).sum(axis=0) > self._min_cosine
        near = np.linalg.norm(offset, axis=0) < 4 * self.radii + self.gate
        return np.asarray(self.exists & along & alike & near)


def _seen_through(frame: Measurement, pixels: Array, positions: Float64, gate: Float64, margin: float) -> Bool:
    """Whether pixels and all of their neighbours, none of them blind, look through surfels in front of them."""
    depth = np.pad(frame.surface[..., 2], 1)  # blind beyond the border
    around = np.lib.stride_tricks.sliding_window_view(depth, (3, 3)).min(axis=(-1, -2)).ravel()
    z = _moved(se3.inverse(frame.T_world_camera), positions)[2]
    return np.asarray(z < around[pixels] - np.maximum(margin, 2 * gate))


def _moved(T: Float64, points: Float64) -> Float64:
    """Return points (3, N) moved by a transform (4, 4)."""
    return np.asarray(T[:3, :3] @ points + T[:3, 3:])
