"""Loop closers: what remembers places, finds a lost camera, and corrects the map after a frame.

:class:`KeyframeLoopCloser` keeps keyframes and a pose graph over them. A new keyframe is compared with older ones that
look alike but do not fit where the map thinks they are. A place that is verified becomes an edge that may be wrong; the
graph is solved, edges that the odometry cannot explain are dropped, and the answer is kept only when keyframes that
took no part fit each other better than before: a closure that looks right but bends the rest is worse than none.
All this takes as long as several frames, so it is done on a thread beside them and takes effect a fixed number of
frames later (:mod:`~.search`, docs/decisions/0020-loops-beside-tracking.md).
Keyframes of all submaps are in one database, each with the number of its own: a new one is also compared with those of
other submaps, which may join them (:mod:`~.joining`).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from scanweld.arrays import Bool, Float64, Int64
from scanweld.config import check_ranges, section, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.joining import Join, JoinFinder
from scanweld.loop_closure.keyframes import Keyframe, Sighting
from scanweld.loop_closure.place_recognition import KeyframeDatabase, PlaceConfig
from scanweld.loop_closure.place_verification import VerificationConfig, relocalise
from scanweld.loop_closure.search import Edge, Found, Query, find_place, tracked_edge
from scanweld.parallel import get_num_threads, in_background, limited_threads
from scanweld.registration.result import RegistrationResult, Status
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult

_UNSEEN_SIGMA = 0.3  # m and rad: what is known of the motion while nothing was seen


class NoLoopCloser(Stateful):
    """Remembers nothing and corrects nothing: odometry against the map."""

    keyframe = 0
    num_closures = 0

    def process(self, pyramid: SurfacePyramid, result: FrameResult) -> MapCorrection | None:
        """Look at a tracked frame; return a correction when a loop was closed."""
        return None

    def relocalise(self, pyramid: SurfacePyramid) -> RegistrationResult:
        """Know no place that a lost camera could be at."""
        return RegistrationResult(
            T_target_source=np.eye(4),
            status=Status.NO_OVERLAP,
            information=np.zeros((6, 6)),
            note="places are not remembered",
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopClosingConfig:
    """How places are remembered, and when a loop is closed."""

    places: PlaceConfig = section(PlaceConfig, "what is remembered, and how it is found")
    verification: VerificationConfig = section(VerificationConfig, "when a place is believed")
    candidates: int = setting(
        2, "keyframes that a new one is compared with; raise to find more loops, costs time", low=1
    )
    min_gap: int = setting(
        8, "keyframes in between, at least, that make a revisit; lower it to close small loops", low=1
    )
    drift: float = setting(
        0.01,
        "standard deviation of the motion between keyframes over its length; lower it to distrust loops, raise it to "
        "believe those that bend the path more",
        low=1e-4,
        high=1.0,
    )

    lag_frames: int = setting(
        10,
        "tracked frames after which what was found out about a keyframe takes effect; raise where frames wait for it, "
        "0 lets each keyframe wait until it is known",
        low=0,
    )

    def __post_init__(self) -> None:
        check_ranges(self)


class KeyframeLoopCloser(Stateful):
    """Keyframes, places and a pose graph over them.

    Attributes
    ----------
    database : all keyframes, each in the world of its submap
    submap : the one that the camera is in
    num_closures : loops closed so far
    """

    STATE: ClassVar = {
        "database": Stateful, "num_closures": int, "submap": int, "_submaps": Int64, "_current": dict[int, int],
        "_num_submaps": int, "_joins": Stateful, "_edges": list[Edge], "_seen_since": bool,
        "_queries": list[Query], "_sought": Query | None, "_known": int, "_wait": int,
    }  # fmt: skip
    MADE = frozenset({"config", "_finding"})

    def __init__(self, config: LoopClosingConfig | None = None) -> None:
        self.config = config or LoopClosingConfig()
        self.database = KeyframeDatabase(self.config.places)
        self.num_closures = 0
        self.submap = 0
        self._submaps: Int64 = np.empty(0, np.int64)  # of each keyframe
        self._current: dict[int, int] = {}  # keyframe of each submap that the camera is at, or was at last
        self._num_submaps = 1  # that there ever were
        self._joins = JoinFinder(self.config.drift, self.config.places.keyframes.surfaces)
        self._edges: list[Edge] = []
        self._seen_since = True  # whether the camera was tracked all the way from the last keyframe
        self._queries: list[Query] = []  # that are still to be looked into
        self._sought: Query | None = None  # what is looked into now, among so many keyframes, for so many frames more
        self._known = 0
        self._wait = 0
        self._finding: Future[Found] | None = None  # where that is done on another thread

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_finding": None}  # a copy looks itself

    @property
    def keyframe(self) -> int:
        """The keyframe that new surfels and frames belong to."""
        return self._current.get(self.submap, 0)

    @property
    def loops(self) -> list[tuple[int, int]]:
        """Pairs of keyframes that loops tie together."""
        return [(edge.i, edge.j) for edge in self._edges if edge.loop]

    @property
    def edges(self) -> list[Edge]:
        """The motions between keyframes that are known: from one to the next, and those of loops and joins."""
        return list(self._edges)

    @property
    def submaps(self) -> Int64:
        """The submap (K,) of each keyframe."""
        return self._submaps.copy()

    def process(self, pyramid: SurfacePyramid, result: FrameResult) -> MapCorrection | Join | None:
        """Look at a tracked frame; return a correction where a loop is closed, or what joins two submaps.

        Both are about a keyframe of `lag_frames` ago.
        """
        self._wait -= 1
        answer = self._answer() if self._sought is not None and self._wait <= 0 else None
        if answer is None:
            self._consider(pyramid, result)
            self._begin_search()
            if self._sought is not None and self._wait <= 0:  # without a lag
                answer = self._answer()
        return answer

    def conclude(self) -> MapCorrection | Join | None:
        """Return at once what `process` would have returned some frames later; None when there is nothing more."""
        answer = None
        while answer is None and (self._sought is not None or self._queries):
            self._begin_search()
            answer = self._answer()
        return answer

    def relocalise(self, pyramid: SurfacePyramid) -> RegistrationResult:
        """Look for a lost camera; only CONVERGED says that T_target_source is T_world_camera."""
        return self.look_for(pyramid)[1]

    def look_for(self, pyramid: SurfacePyramid) -> tuple[int, RegistrationResult]:
        """Look for a lost camera in all submaps; return the submap and what :meth:`relocalise` does, in its world."""
        self._seen_since = False
        found = relocalise(self.database.sight(pyramid), self.database, self.config.verification)
        if found.T_world_camera is None:
            return self.submap, replace(found.result, T_target_source=np.eye(4))
        return int(self._submaps[found.keyframe]), replace(found.result, T_target_source=found.T_world_camera)

    def begin_submap(self, pyramid: SurfacePyramid, T_world_camera: Float64, frame_index: int) -> int | None:
        """Begin a submap with a frame, its first keyframe; return its number, or None where the frame can be none.

        `T_world_camera` is in the world of the new submap, which the camera is in from now on.
        """
        sighting = self.database.sight(pyramid)
        if len(self.database) == 0 or sighting.usable < self.database.config.keyframes.min_usable:
            return None
        self.submap, self._num_submaps = self._num_submaps, self._num_submaps + 1
        self._add(sighting, T_world_camera, frame_index)
        return self.submap

    def enter(self, submap: int) -> None:
        """Go on in a submap, in which the camera was found."""
        self.submap = submap

    def join(self, join: Join) -> MapCorrection:
        """Make one submap of two; return how the keyframes of the joined one move."""
        moved = self._members(join.joined)
        poses = [keyframe.T_world_camera for keyframe in self.database.keyframes]
        for index in moved:
            poses[index] = join.T_kept_joined @ poses[index]
        self._submaps[moved] = join.kept
        if self.submap == join.joined:
            self._current[join.kept] = self._current[join.joined]
        self.database.move(poses)
        # The first edge holds the two parts of the graph together, so it may not be dropped; the second may.
        self._edges += [
            Edge(p.i, p.j, p.T_i_j, p.information, loop) for p, loop in zip(join.pairs, (False, True), strict=True)
        ]
        self.submap = join.kept if self.submap == join.joined else self.submap
        return MapCorrection(moved.astype(np.int32), np.tile(join.T_kept_joined, (len(moved), 1, 1)))

    def restored(self) -> None:
        """Check that submaps and edges are of keyframes that there are."""
        count = len(self.database)
        named = [*self._current.values(), *(k for edge in self._edges for k in (edge.i, edge.j))]
        queries = [*self._queries, *([] if self._sought is None else [self._sought])]
        named += [k for query in queries for k in (query.keyframe, *query.revisited, *query.elsewhere)]
        sought = self._sought is None or self._sought.keyframe < self._known <= count
        if not sought or self._submaps.shape != (count,) or not all(0 <= index < count for index in named):
            raise ValueError("submaps or edges of keyframes that are not there")

    def _in_submap(self, submap: int | None = None) -> Bool:
        """Return which keyframes (K,) are those of a submap, by default of the one that the camera is in."""
        return np.asarray(self._submaps == (self.submap if submap is None else submap))

    def _members(self, submap: int | None = None) -> Int64:
        return np.flatnonzero(self._in_submap(submap))

    def _add(self, sighting: Sighting, T_world_camera: Float64, frame_index: int) -> Keyframe:
        """Remember a frame in the submap at hand, with the motion from the keyframe before."""
        before = self._current.get(self.submap)
        keyframe = self.database.add(sighting, T_world_camera, frame_index=frame_index)
        self._submaps = np.append(self._submaps, self.submap)
        self._current[self.submap] = keyframe.index
        if before is not None:
            self._edges.append(self._odometry(self.database[before], keyframe))
        self._seen_since = True
        return keyframe

    def _odometry(self, before: Keyframe, keyframe: Keyframe) -> Edge:
        """Return the edge from the keyframe before; how well the motion is known grows with its length."""
        T_i_j = se3.inverse(before.T_world_camera) @ keyframe.T_world_camera
        if self._seen_since:
            return tracked_edge(before.index, keyframe.index, T_i_j, self.config.drift)
        # It was found again against the map, which is a measurement, too, but of another kind.
        return Edge(before.index, keyframe.index, T_i_j, np.eye(6) * _UNSEEN_SIGMA**-2.0, False)

    def _consider(self, pyramid: SurfacePyramid, result: FrameResult) -> None:
        """Make a frame a keyframe if there is a reason to, and ask where else its place is known."""
        mine, last = self._in_submap(), self._current.get(self.submap)
        if not self.database.reason(pyramid, result.T_world_camera, among=mine, last=last):
            return
        known = self.database.nearest(pyramid, result.T_world_camera, among=mine)
        if known is not None:  # back where it was: the number of keyframes grows with the places, not with the time
            self._current[self.submap], self._seen_since = known, True
            return
        sighting = self.database.sight(pyramid)
        if sighting.usable < self.database.config.keyframes.min_usable:
            return
        older = mine.copy()
        older[self._members()[-self.config.min_gap :]] = False
        revisited, elsewhere = (self._alike(sighting, allowed) for allowed in (older, ~mine))
        keyframe = self._add(sighting, result.T_world_camera, result.index)
        if revisited or elsewhere:
            self._queries = [*self._queries, Query(keyframe.index, self.submap, revisited, elsewhere)][-_MOST_QUERIES:]

    def _alike(self, sighting: Sighting, allowed: Bool) -> list[int]:
        """Return the keyframes among those allowed that look most like a frame."""
        if not allowed.any():
            return []
        return [candidate.index for candidate in self.database.query(sighting, self.config.candidates, allowed=allowed)]

    def _begin_search(self) -> None:
        """Begin to look into the next query, if none is being looked into."""
        if self._sought is None and self._queries:
            self._sought, *self._queries = self._queries
            self._known, self._wait = len(self.database), self.config.lag_frames
            if get_num_threads() > 1 and self._wait > 0:
                self._finding = in_background(self._search(self._sought), lane="loops")

    def _search(self, query: Query) -> Callable[[], Found]:
        """Return what looks into a query, with keyframes as they are now."""
        keyframes, members = self.database.keyframes[: self._known], self._then(query.submap)
        edges = [edge for edge in self._edges if max(edge.i, edge.j) < self._known]
        surfaces, verification = self.config.places.keyframes.surfaces, self.config.verification

        def search() -> Found:
            with limited_threads(1):  # tracking needs the others
                return find_place(query, keyframes, members, edges, surfaces, verification)

        return search

    def _then(self, submap: int) -> Int64:
        """Return the keyframes of a submap when the search began."""
        return np.flatnonzero(self._submaps[: self._known] == submap)

    def _answer(self) -> MapCorrection | Join | None:
        """End the search, and let what it found take effect."""
        query, finding = self._sought, self._finding
        assert query is not None
        found = self._search(query)() if finding is None else finding.result()
        self._sought, self._finding = None, None
        if query.submap != self.submap:
            return None  # the camera has been found elsewhere meanwhile
        if found.loop is not None:
            return self._close(found, self._then(query.submap))
        for pair in found.pairs:
            join = self._joins.add(pair, self.database.keyframes, self._submaps.tolist())
            if join is not None:
                return join
        return None

    def _close(self, found: Found, then: Int64) -> MapCorrection:
        """Move the keyframes of the submap: those of `then` as found, later ones with the one that they came after."""
        assert found.loop is not None
        self._edges.append(found.loop)
        poses, members = [keyframe.T_world_camera for keyframe in self.database.keyframes], self._members()
        old = np.stack([poses[index] for index in members])
        T_new_old = np.concatenate([found.T_world_keyframe @ se3.inverse(old[: len(then)]), old[len(then) :]])
        place = {int(index): k for k, index in enumerate(members)}
        before = {edge.j: edge.i for edge in self._edges if not edge.loop}
        for k in range(len(then), len(members)):
            T_new_old[k] = T_new_old[place[before[int(members[k])]]]
        new = np.concatenate([found.T_world_keyframe, T_new_old[len(then) :] @ old[len(then) :]])
        for index, pose in zip(members, new, strict=True):
            poses[index] = pose
        self.database.move(poses)
        self.num_closures += 1
        return MapCorrection(members.astype(np.int32), T_new_old)


_MOST_QUERIES = 4
"""Keyframes that wait to be looked for; the oldest is left out where more come than can be looked into."""
