"""Links between two fragments of a recording: where the keyframes of each lie in the map of the other.

Fragments are made apart, each in worlds of its own, as submaps are; and as with submaps (:mod:`~.joining`) what only
looks like the same place is no proof that it is.

1. Where to begin: frames that both have seen give the motion between the worlds. Elsewhere the keyframes of one are
   looked for among those of the other, verified like loops, and believed when two pairs and keyframes that took no
   part agree: :func:`~.search.find_place` and :class:`~.joining.JoinFinder`, as in a run.
2. From there on from keyframe to keyframe, forwards and backwards: each is aligned with the map of the other fragment
   where its neighbour has it, as a frame is tracked. A map knows better than a single keyframe.
3. The same the other way round.

What comes of it are edges of a pose graph. They may be wrong, and the graph decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid
from scanweld.geometry.views import ModelView
from scanweld.loop_closure.held_out import APART, views_apart
from scanweld.loop_closure.joining import JoinFinder
from scanweld.loop_closure.loop_closer import LoopClosingConfig
from scanweld.loop_closure.place_recognition import KeyframeDatabase
from scanweld.loop_closure.search import Edge, Query, find_place, tracked_edge
from scanweld.registration.result import RegistrationResult

_MOST_OFF = 0.1  # metres and radians together, of a keyframe from where its neighbour has it
_MOST_LINKS = 32  # of the keyframes of one fragment with the map of another
_FEWEST = 3  # frames that both have seen, to say how two worlds lie to each other
_AGREE = 0.05  # metres and radians together, between such frames


class MapView(Protocol):
    """A map that can be looked at; a mapper is one."""

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as seen from a pose."""
        ...


class Aligner(Protocol):
    """What aligns a keyframe with a map; a tracker does."""

    def track(self, pyramid: SurfacePyramid, view: ModelView, T_world_camera: Float64) -> RegistrationResult:
        """Align a frame with the map as seen from the predicted pose; T_target_source is T_world_camera."""
        ...


@dataclass(frozen=True, slots=True)
class Place:
    """Where a camera is.

    Attributes
    ----------
    submap : of a fragment
    T_world_camera : (4, 4), in the world of that submap
    """

    submap: int
    T_world_camera: Float64


@dataclass(frozen=True, slots=True)
class MappedPart:
    """What is known of one part of a recording.

    Attributes
    ----------
    database : its keyframes
    submaps : (K,) of each keyframe
    map_of : gives the map of a submap; asked for it only where it is needed
    """

    database: KeyframeDatabase
    submaps: Int64
    map_of: Callable[[int], MapView]


class Linker:
    """Links fragments, two at a time."""

    def __init__(self, aligner: Aligner, config: LoopClosingConfig | None = None) -> None:
        self.aligner = aligner
        self.config = config or LoopClosingConfig()

    def link(self, a: MappedPart, b: MappedPart, seen: Mapping[int, Place]) -> list[Edge]:
        """Return what ties the keyframes of two fragments together: edges from i of `a` to j of `b`, perhaps wrong.

        Parameters
        ----------
        seen : keyframes of `b` whose frames `a` has seen, too, each with where that was in `a`
        """
        placed: dict[int, Place] = {}
        self._spread(b, a, seen, placed)
        self._recognise(b, a, placed)
        mirrored = dict(_seen_from(a, b, j, place) for j, place in placed.items())
        back: dict[int, Place] = {}
        self._spread(a, b, mirrored, back)
        edges = [self._edge(i, j, T) for i, j, T in _nearest(a, _evenly(placed))]
        return edges + [self._edge(i, j, se3.inverse(T)) for j, i, T in _nearest(b, _evenly(back))]

    def _edge(self, i: int, j: int, T_i_j: Float64) -> Edge:
        return tracked_edge(i, j, T_i_j, self.config.drift, loop=True)

    def _spread(
        self, moving: MappedPart, still: MappedPart, seeds: Mapping[int, Place], placed: dict[int, Place]
    ) -> None:
        """Align keyframes of one fragment with the maps of another, from seeds on to their neighbours; adds them."""
        for seed, start in seeds.items():
            if seed in placed or not self._add(moving, still, seed, start, placed):
                continue
            for step in (1, -1):
                last, j = seed, seed + step
                while 0 <= j < len(moving.database) and j not in placed:
                    beside = _beside(moving, last, placed[last], j)
                    if beside is None:
                        break
                    last = j if self._add(moving, still, j, beside, placed) else last
                    j += step

    def _add(self, moving: MappedPart, still: MappedPart, j: int, start: Place, placed: dict[int, Place]) -> bool:
        place = self._aligned(moving, still, j, start)
        if place is not None:
            placed[j] = place
        return place is not None

    def _aligned(self, moving: MappedPart, still: MappedPart, j: int, start: Place) -> Place | None:
        """Align a keyframe with a map of another fragment; None where there is no map, or it does not fit.

        It is aligned with its own map in the same way, and the difference is what counts: so the errors that the image
        of a keyframe has, and those of a pose that was found when its map was young, are in both, and drop out.
        """
        if _nearest_keyframe(still, start)[1] > APART:
            return None
        keyframe = moving.database[j]
        pyramid = keyframe.pyramid(self._surfaces)
        there = self._tracked(pyramid, still, start)
        own = Place(int(moving.submaps[j]), keyframe.T_world_camera)
        here = None if there is None else self._tracked(pyramid, moving, own)
        if there is None or here is None:
            return None
        return Place(start.submap, there @ se3.inverse(here) @ keyframe.T_world_camera)

    def _tracked(self, pyramid: SurfacePyramid, fragment: MappedPart, start: Place) -> Float64 | None:
        view = fragment.map_of(start.submap).view(start.T_world_camera, pyramid.frame.camera)
        found = self.aligner.track(pyramid, view, start.T_world_camera)
        off = views_apart(se3.inverse(start.T_world_camera) @ found.T_target_source)
        return found.T_target_source if found.status.success and off < _MOST_OFF else None

    def _recognise(self, moving: MappedPart, still: MappedPart, placed: dict[int, Place]) -> None:
        """Look for keyframes that are not placed among those of the other fragment, and go on from where they are."""
        first, first_submap = len(still.database), 1 + int(still.submaps.max(initial=0))
        keyframes = [
            *still.database.keyframes,
            *(replace(keyframe, index=first + keyframe.index) for keyframe in moving.database.keyframes),
        ]
        submaps = [*still.submaps.tolist(), *(first_submap + moving.submaps).tolist()]
        finder = JoinFinder(self.config.drift, self._surfaces)
        for j in range(len(moving.database)):
            if j in placed:
                continue
            candidates = still.database.query(moving.database[j].sighting(self._surfaces), self.config.candidates)
            query = Query(first + j, submaps[first + j], [], [candidate.index for candidate in candidates])
            found = find_place(
                query, keyframes, np.empty(0, np.int64), (), self._surfaces, self.config.verification
            )  # fmt: skip
            for pair in found.pairs:
                join = finder.add(pair, keyframes, submaps)
                if join is None:
                    continue
                seeds = {p.j - first: Place(submaps[p.i], keyframes[p.i].T_world_camera @ p.T_i_j) for p in join.pairs}
                self._spread(moving, still, seeds, placed)
                break

    @property
    def _surfaces(self) -> SurfaceConfig:
        return self.config.places.keyframes.surfaces


def _beside(moving: MappedPart, last: int, place: Place, j: int) -> Place | None:
    """Return where a keyframe is if it lies to a placed one as in its own world; None where that is too far away."""
    T_last_j = se3.inverse(moving.database[last].T_world_camera) @ moving.database[j].T_world_camera
    if moving.submaps[last] != moving.submaps[j] or views_apart(T_last_j) > APART:
        return None
    return Place(place.submap, place.T_world_camera @ T_last_j)


def _nearest_keyframe(fragment: MappedPart, place: Place) -> tuple[int, float]:
    """Return the keyframe of a fragment that looked from nearest by, and how far apart the views are."""
    mine = np.flatnonzero(fragment.submaps == place.submap)
    if len(mine) == 0:
        return -1, np.inf
    T_camera_world = se3.inverse(np.stack([fragment.database[k].T_world_camera for k in mine.tolist()]))
    apart = views_apart(T_camera_world @ place.T_world_camera)
    return int(mine[apart.argmin()]), float(apart.min())


def _nearest(still: MappedPart, placed: Iterable[tuple[int, Place]]) -> Iterator[tuple[int, int, Float64]]:
    """Yield the nearest keyframe i of a fragment to each one j that was placed in it, and T_i_j."""
    for j, place in placed:
        i, _ = _nearest_keyframe(still, place)
        yield i, j, se3.inverse(still.database[i].T_world_camera) @ place.T_world_camera


def _seen_from(still: MappedPart, moving: MappedPart, j: int, place: Place) -> tuple[int, Place]:
    """Return the keyframe of one fragment that is nearest to one of another, and where it is in the world of that."""
    ((i, _, T_i_j),) = _nearest(still, [(j, place)])
    return i, Place(int(moving.submaps[j]), moving.database[j].T_world_camera @ se3.inverse(T_i_j))


def _evenly(placed: Mapping[int, Place]) -> list[tuple[int, Place]]:
    """Return at most so many of what was placed, evenly over the way, in order."""
    keys = sorted(placed)
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(_MOST_LINKS, len(keys))).astype(int)) if keys else ()
    return [(keys[k], placed[keys[k]]) for k in chosen]


def common_motion(T_i_j: Float64) -> Float64 | None:
    """Return the motion (4, 4) that most measurements of it (N, 4, 4) agree on; None where they do not.

    Each is from a frame that two fragments have seen: one that has slipped in either of them is outvoted.
    """
    if len(T_i_j) < _FEWEST:
        return None
    apart = views_apart(se3.inverse(T_i_j)[:, None] @ T_i_j[None])
    middle = int(np.median(apart, axis=1).argmin())
    agree = apart[middle] < _AGREE
    if np.count_nonzero(agree) < max(_FEWEST, len(T_i_j) / 2):
        return None
    offsets = np.stack([se3.log(se3.inverse(T_i_j[middle]) @ T) for T in T_i_j[agree]])
    return np.asarray(T_i_j[middle] @ se3.exp(offsets.mean(axis=0)))
