"""The contract of the hot operations on the map, as a test."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64
from scanweld.geometry import se3
from scanweld.mapping.backends import MapBackend, reference
from scanweld.mapping.backends.arrays import DepthBuffers, IndexMap, Measurement
from scanweld.mapping.fusion import NOTHING_MOVES, radial_weight
from scanweld.mapping.rendering import find_candidates
from scanweld.mapping.storage.kernels import ROWS
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import limited_threads
from scanweld.testing.promises import require, require_array, untouched
from scanweld.testing.scenes import CAMERA, as_map, room, wall

_LIMITS: Float32 = np.array([3.0, 0.005, 0.5, 0.05, 1.0, 100.0], np.float32)
"""Gate in sigmas, its floor [m], least cosine, margin of free space [m], spread [pixels], largest confidence."""

_STABLE = 0.5

_ATOL_M, _ATOL_GREY = 2e-5, 1e-2
"""Two ways to round the mean of a surfel and a measurement."""

_T_WORLD_CAMERA = se3.exp([0.3, -0.2, 0.1, 0.4, -0.3, 0.2])


def check_map_backend(backend: MapBackend) -> None:
    """Check that an implementation keeps what :class:`~scanweld.mapping.backends.MapBackend` promises.

    A surfel before a wall becomes what was derived by hand; on a map of a rendered room with things in free space, the
    view, what is merged and what is new are those of the reference, in the same places, with one thread and with
    several; what is only looked at stays as it is.

    Parameters
    ----------
    backend : a module or an object with the operations

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    _check_by_hand(backend)
    surfels = _lived_in()
    moving = np.zeros(CAMERA.shape, np.bool_)
    moving[30:80, 40:90] = True
    for moves in (NOTHING_MOVES, moving):
        frame = _measured(room(2).levels[0].surface, moves)
        for count in (1, 3):
            with limited_threads(count):
                _compare(backend, surfels, frame, f"{count} thread(s)")
    _compare(backend, SurfelMap(), frame, "an empty map")


def _check_by_hand(backend: MapBackend) -> None:
    """One surfel of confidence 1, 4 mm before a wall 1 m away, 0.3 pixels to the right of a pixel's centre.

    A measurement of weight 1 makes it the mean of both: 0.15 pixels to the right, 2 mm before the wall, confidence 2,
    colour half way. It then lies 0.85 pixels from the centre of the pixel to the right, and covers it; from those above
    and below it is 1.01 pixels away, and does not.
    """
    u, v = 90, 50
    T = np.eye(4)
    surfels = SurfelMap()
    ray = CAMERA.rays()[v, u]
    position = (ray + [0.3 / CAMERA.fx, 0, 0]) * 0.996
    surfels.append(
        position[:, None].astype(np.float32), np.array([[0], [0], [-1]], np.float32), np.array([[0], [100], [200]]),
        np.array([0.01], np.float32), np.ones(1, np.float32), 0,
    )  # fmt: skip
    frame = _measured(wall(1.0).levels[0].surface, NOTHING_MOVES)
    frame = replace(frame, T_world_camera=T, weights=np.ones(CAMERA.shape, np.float32))
    seen = _index_map(backend, surfels, T)
    require(
        list(map(list, np.argwhere(seen.numbers >= 0))) == [[v, u]], f"index_map: a surfel is not at pixel {u}, {v}"
    )
    merged, rows, values = backend.merge(surfels.pages, seen, frame, _LIMITS)
    require(merged.sum() == 1 and merged[v, u] == 1, "merge: 4 mm before a wall agree with it at their pixel alone")
    require(values.shape == (8, 1) and rows[v, u] == 0, "merge: the view is not that of the surfel that was merged")
    expected = {"positions_m": (position + ray) / 2, "confidences": 2, "colors": [80, 130, 180]}
    table = surfels.table()
    for name, value in expected.items():
        got = table[name][..., 0]
        require(np.allclose(got, value, atol=1e-3 if name == "colors" else 1e-6), f"merge: {name} {got}, not {value}")
    new = backend.new_surfels(rows, values, merged, frame, _LIMITS, 5)
    valid = int(np.count_nonzero(frame.surface[..., 6] > 0))
    require(
        new.shape == (ROWS, valid - 2),
        f"new_surfels: {new.shape} of {valid} pixels, of which one is in the map and one is covered",
    )
    require((new[11:14].view(np.int32) == [[7], [7], [5]]).all(), "new_surfels: not the number of the frame, or anchor")


def _lived_in() -> SurfelMap:
    """A room that is known to 3 mm, and surfels in its free space and behind its walls."""
    rng = np.random.default_rng(3)
    view = as_map(room(0), _T_WORLD_CAMERA)
    floating = rng.integers(0, len(view), 800)
    centre = _T_WORLD_CAMERA[:3, 3:]
    points: Float64 = np.concatenate([
        view.positions_m + 0.003 * rng.standard_normal(view.positions_m.shape),
        centre + (view.positions_m[:, floating] - centre) * rng.uniform(0.5, 1.3, 800),
    ], axis=1)  # fmt: skip
    normals = np.concatenate([view.normals, view.normals[:, floating]], axis=1)
    count = points.shape[1]
    surfels = SurfelMap()
    surfels.append(
        points.astype(np.float32), normals, rng.integers(0, 256, (3, count)), np.full(count, 0.01, np.float32),
        rng.uniform(0.1, 2, (count,)).astype(np.float32), 1,
    )  # fmt: skip
    return surfels


def _measured(surface: Float32, moving: Bool) -> Measurement:
    alpha = radial_weight(CAMERA)
    weights: Float32 = alpha if moving is NOTHING_MOVES else np.where(moving, -alpha, alpha)
    weights.flags.writeable = False
    color = np.full((*CAMERA.shape, 3), 160, np.uint8)
    return Measurement(_T_WORLD_CAMERA, CAMERA, surface, color, weights, moving, 7)


def _index_map(backend: MapBackend, surfels: SurfelMap, T_world_camera: Float64) -> IndexMap:
    slots = find_candidates(surfels, T_world_camera, CAMERA)
    with untouched("index_map", surfels.table(), slots, T_world_camera):
        seen = backend.index_map(surfels.pages, slots, T_world_camera, CAMERA, _STABLE, DepthBuffers())
    require_array(seen.numbers, np.int32, CAMERA.shape, "index_map: numbers")
    return seen


def _compare(backend: MapBackend, surfels: SurfelMap, frame: Measurement, what: str) -> None:
    """Require that an implementation does with a map what the reference does."""
    tables: list[dict[str, Array]] = []
    views: list[dict[str, Array]] = []
    for one in (backend, reference):
        mine = copy.deepcopy(surfels)
        seen = _index_map(one, mine, frame.T_world_camera)
        with untouched("show", mine.table(), seen.numbers):
            shown = one.show(mine.pages, seen)
        with untouched("merge", frame, _LIMITS):
            merged, rows, values = one.merge(mine.pages, seen, frame, _LIMITS)
        with untouched("new_surfels", frame, rows, values, merged, _LIMITS):
            new = one.new_surfels(rows, values, merged, frame, _LIMITS, 4)
        numbers, pixels = seen.winners()
        views.append({
            "index_map: numbers": seen.numbers, "index_map: how many are seen": seen.won, "index_map: seen": numbers,
            "index_map: pixels": pixels, "show: rows": shown[0], "show: values": shown[1][:7],
            "show: luminance": shown[1][7], "merge: merged": merged, "merge: rows": rows, "merge: values": values[:7],
            "merge: luminance": values[7], "merge: pages that lost confidence": mine.pages.dirty,
            "new_surfels: places": new[:8], "new_surfels: colours": new[8:11],
            "new_surfels: numbers": new[11:].view(np.int32),
        })  # fmt: skip
        tables.append({f"merge: {name} in the map": column for name, column in mine.table().items()})
    for ours, expected in (views, tables):
        for name in ours:
            _require_same(ours[name], expected[name], f"{name}, {what}")


def _require_same(got: Array, expected: Array, what: str) -> None:
    require_array(got, expected.dtype.type, expected.shape, what)
    grey = any(word in what for word in ("luminance", "colo"))
    atol = (_ATOL_GREY if grey else _ATOL_M) if expected.dtype == np.float32 else 0
    wrong = np.argwhere(np.abs(got.astype(np.float64) - expected) > atol)
    if len(wrong):
        place = tuple(wrong[0].tolist())
        raise AssertionError(
            f"{what}: {len(wrong)} of {expected.size} differ from the reference, at {place}: expected "
            f"{expected[place]!r}, got {got[place]!r}"
        )
