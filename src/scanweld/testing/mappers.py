"""The contract of a mapper, as a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scanweld.arrays import Bool, Float64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.parallel import limited_threads
from scanweld.slam.stages import DeferringMapper, Mapper, SubmapMapper
from scanweld.state import Stateful
from scanweld.testing.promises import contents, described, require, require_array, require_pose, untouched
from scanweld.testing.scenes import CAMERA, ELSEWHERE, dark, room, room_pose
from scanweld.testing.states import stored_copy

_NEAR_M = 0.02
_MOST, _HALF = 0.9, 0.5

_CORRECTED = se3.exp([6.0, -3.0, 1.0, 0.1, -0.2, 0.3])
"""A loop closure that moves a place so far that its old one is out of sight."""


def check_mapper(make: Callable[[], Mapper]) -> None:
    """Check that a mapper keeps what :class:`~scanweld.slam.stages.Mapper` promises.

    It fuses frames of a rendered room at their true poses, and looks at the map: a view has the right shapes and types,
    lies in the world, and shows what is there; the same frame again merges; what moves and frames without depth add
    nothing; a correction moves what is anchored to its keyframes and nothing else; frames and poses stay as they are;
    the same calls give the same bytes, with one thread and with several. What is a
    :class:`~scanweld.slam.stages.DeferringMapper`, a :class:`~scanweld.slam.stages.SubmapMapper` or
    :class:`~scanweld.state.Stateful` is held to that, too.

    Parameters
    ----------
    make : makes a mapper with an empty map, the same one each time; a class that needs no arguments is one

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    _check_empty(make())
    _check_fusion(make())
    _check_what_moves(make)
    _check_corrections(make())
    _check_repetition(make)
    if isinstance(make(), DeferringMapper):
        _check_finishing(make())
    if isinstance(make(), SubmapMapper):
        _check_submaps(make())
    if isinstance(make(), Stateful):
        _check_state(make)


def _check_empty(mapper: Mapper) -> None:
    require(_size(mapper) == 0, f"map: it has {_size(mapper)} entries before anything was fused")
    view = _view(mapper, room_pose(0))
    require(len(view) == 0, f"view: {len(view)} rows of an empty map")
    mapper.apply(MapCorrection(np.zeros(1, np.int32), _CORRECTED[None]))
    _fuse(mapper, dark(), room_pose(0))
    require(_size(mapper) == 0, f"fuse: a frame without depth has added {_size(mapper)} entries")


def _check_fusion(mapper: Mapper) -> None:
    _fuse(mapper, room(0), room_pose(0))
    before = _size(mapper)
    _fuse(mapper, room(0), room_pose(0))
    require(
        _size(mapper) < 1.5 * max(1, before),
        f"fuse: {before} entries have become {_size(mapper)} by the same frame again; it should merge",
    )
    for index in (1, 2):
        _fuse(mapper, room(index), room_pose(index))
    _require_seen(mapper, room(2), room_pose(2), "fuse")
    away = _view(mapper, ELSEWHERE)
    require(
        len(away) == 0, f"view: {len(away)} rows where nothing was ever seen; T_world_camera is where it looks from"
    )


def _check_what_moves(make: Callable[[], Mapper]) -> None:
    mapper, moving = make(), np.zeros(CAMERA.shape, np.bool_)
    moving[:, : CAMERA.width // 2] = True
    _fuse(mapper, room(0), room_pose(0), moving=moving)
    seen = _view(mapper, room_pose(0)).index_map >= 0
    # A surfel may stand one pixel beside the border.
    added = int(np.count_nonzero(seen[:, : CAMERA.width // 2 - 1]))
    require(added == 0, f"fuse: {added} pixels that are moving were added to the map")
    require(seen.any(), "fuse: what is beside pixels that move was not added")


def _check_corrections(mapper: Mapper) -> None:
    """Two places, out of sight of each other, each with a keyframe of its own."""
    one, other = room_pose(0), ELSEWHERE @ room_pose(0)
    _fuse(mapper, room(0), one, keyframe=0)
    _fuse(mapper, room(0), other, keyframe=1)
    _require_seen(mapper, room(0), other, "fuse")
    correction = MapCorrection(np.array([1, 2], np.int32), np.stack([_CORRECTED, _CORRECTED]))
    with untouched("apply", correction):
        mapper.apply(correction)
    _require_seen(mapper, room(0), _CORRECTED @ other, "apply, of the keyframe that moved")
    left = len(_view(mapper, other))
    require(left == 0, f"apply: {left} rows of the map are still seen where they were before their keyframe moved")
    _require_seen(mapper, room(0), one, "apply, of a keyframe that did not move")


def _check_repetition(make: Callable[[], Mapper]) -> None:
    reference = _walk(make())
    for count in (1, 3):
        with limited_threads(count):
            require(_walk(make()) == reference, f"view: the same calls give another map with {count} thread(s)")


def _check_finishing(mapper: Any) -> None:
    """It may be asked for at any time; what the map shows is the same afterwards."""
    mapper.finish()
    for index in range(3):
        mapper.fuse(room(index), room_pose(index), keyframe=index, moving=None)
    mapper.apply(MapCorrection(np.array([1], np.int32), np.eye(4)[None]))
    mapper.finish()
    _require_seen(mapper, room(2), room_pose(2), "finish")
    before = _size(mapper), contents(_view(mapper, room_pose(2)))
    mapper.finish()
    require((_size(mapper), contents(_view(mapper, room_pose(2)))) == before, "finish: a second one changes the map")


def _check_submaps(mapper: Any) -> None:
    _fuse(mapper, room(0), room_pose(0), keyframe=0)
    before = _size(mapper), contents(_view(mapper, room_pose(0)))
    other = mapper.fresh()
    require(isinstance(other, SubmapMapper), f"fresh: expected a mapper of the same kind, got {type(other).__name__}")
    require(_size(other) == 0, f"fresh: expected an empty map, got one with {_size(other)} entries")
    _fuse(other, room(0), ELSEWHERE, keyframe=1)
    after = _size(mapper), contents(_view(mapper, room_pose(0)))
    require(after == before, "fresh: what is fused into the new map changes the old one")
    mapper.take_in(other, MapCorrection(np.array([1], np.int32), _CORRECTED[None]))
    _require_seen(mapper, room(0), room_pose(0), "take_in, of what was there before")
    _require_seen(mapper, room(0), _CORRECTED @ ELSEWHERE, "take_in, of what the other map brings")
    left = len(_view(mapper, ELSEWHERE))
    require(left == 0, f"take_in: {left} rows are where they were in the world of the other map")


def _check_state(make: Callable[[], Any]) -> None:
    mapper = make()
    for index in range(4):  # without asking for what was put off
        mapper.fuse(room(index), room_pose(index), keyframe=index // 2, moving=None)
    copied = stored_copy(mapper, make(), type(mapper).__name__)
    require(_walk(copied, 4) == _walk(mapper, 4), "STATE: a mapper that was stored and restored goes on in another way")


def _walk(mapper: Mapper, start: int = 0) -> list[Any]:
    """Fuse some frames as a run does, and return what is seen on the way."""
    seen = []
    for index in range(start, start + 4):
        seen.append(contents(mapper.view(room_pose(index), CAMERA)))
        mapper.fuse(room(index), room_pose(index), keyframe=index // 2, moving=None)
    mapper.apply(MapCorrection(np.array([0], np.int32), se3.exp([0.01, 0, 0, 0, 0, 0])[None]))
    _finish(mapper)
    return [*seen, _size(mapper), contents(mapper.view(room_pose(start), CAMERA))]


def _fuse(
    mapper: Mapper, pyramid: SurfacePyramid, T_world_camera: Float64, *, keyframe: int = 0, moving: Bool | None = None
) -> None:
    """Fuse a frame at once; it stays as it is."""
    with untouched("fuse", pyramid, T_world_camera, moving):
        mapper.fuse(pyramid, T_world_camera, keyframe=keyframe, moving=moving)
        _finish(mapper)


def _finish(mapper: Mapper) -> None:
    if isinstance(mapper, DeferringMapper):
        mapper.finish()


def _size(mapper: Mapper) -> int:
    try:
        return len(mapper.map)
    except TypeError:
        raise AssertionError(f"map: expected something with a length, got {type(mapper.map).__name__}") from None


def _view(mapper: Mapper, T_world_camera: Float64) -> ModelView:
    """Return what a mapper shows; it is of the right form."""
    with untouched("view", T_world_camera):
        view = mapper.view(T_world_camera, CAMERA)
    require(isinstance(view, ModelView), f"view: expected a ModelView, got {described(view)}")
    count = len(view)
    require(view.camera == CAMERA, "view: camera is not the one that was asked for")
    require_pose(view.T_world_camera, "view: T_world_camera")
    require_array(view.positions_m, np.float32, (3, count), "view: positions_m")
    require_array(view.normals, np.float32, (3, count), "view: normals")
    require_array(view.confidences, np.float32, (count,), "view: confidences")
    require_array(view.index_map, np.int32, CAMERA.shape, "view: index_map")
    if view.intensities is not None:
        require_array(view.intensities, np.float32, (count,), "view: intensities")
        inside = (view.intensities >= 0) & (view.intensities <= 255.5)
        require(inside.all(), "view: intensities must be 0 to 255")
    listed = np.sort(view.index_map[view.index_map >= 0])
    require(np.array_equal(listed, np.arange(count)), "view: each row must be in index_map once")
    require((view.confidences >= 0).all(), "view: a confidence is negative")
    require(
        np.abs(np.linalg.norm(view.normals, axis=0) - 1).max(initial=0) < 1e-3, "view: normals are not unit vectors"
    )
    towards = (view.normals * (view.T_world_camera[:3, 3:] - view.positions_m)).sum(axis=0)
    require((towards > 0).all(), "view: a normal points away from the camera")
    return view


def _require_seen(mapper: Mapper, pyramid: SurfacePyramid, T_world_camera: Float64, call: str) -> None:
    """Require that the map, seen from a pose, is what a frame measured there."""
    view = _view(mapper, T_world_camera)
    level = pyramid.levels[0]
    camera, depth_m = level.camera, level.depth_m
    x, y, z = se3.transform_points(se3.inverse(T_world_camera), view.positions_m.T.astype(np.float64)).T
    in_front = z > 0.01
    x, y, z = x[in_front], y[in_front], z[in_front]
    u = np.rint(camera.fx * x / z + camera.cx).astype(int)
    v = np.rint(camera.fy * y / z + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v, z = u[inside], v[inside], z[inside]
    covered = np.zeros(depth_m.shape, np.bool_)
    covered[v, u] = True
    there = float(np.mean(covered[depth_m > 0]))
    require(there > _HALF, f"{call}: the map shows {there:.0%} of what the frame sees there; expected most of it")
    # At the edges of things a pixel beside is another surface.
    right = float(np.mean(np.abs(z - depth_m[v, u]) < _NEAR_M))
    require(right > _MOST, f"{call}: {right:.0%} of the map is within {_NEAR_M} m of what the frame sees there")
