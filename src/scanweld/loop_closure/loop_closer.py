"""Loop closers: what remembers places, finds a lost camera, and corrects the map after a frame.

:class:`KeyframeLoopCloser` keeps keyframes and a pose graph over them. A new keyframe is compared with older ones that
look alike but do not fit where the map thinks they are. A place that is verified becomes an edge that may be wrong; the
graph is solved, edges that the odometry cannot explain are dropped, and the answer is kept only when keyframes that
took no part fit each other better than before: a closure that looks right but bends the rest is worse than none.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Array, Float64
from scanweld.config import check_ranges, section, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.held_out import fits_better, fits_in_place
from scanweld.loop_closure.keyframes import Keyframe, Sighting
from scanweld.loop_closure.place_recognition import KeyframeDatabase, PlaceConfig
from scanweld.loop_closure.place_verification import VerificationConfig, relocalise, verify_place
from scanweld.registration.pose_graph import PoseGraph, edge_information
from scanweld.registration.result import RegistrationResult, Status
from scanweld.trajectory import FrameResult

logger = logging.getLogger(__name__)

_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-3, 1e-3  # of the motion between two keyframes, however short
_SIGMA_RAD_PER_M = 0.005
_UNSEEN_SIGMA = 0.3  # m and rad: what is known of the motion while nothing was seen


class NoLoopCloser:
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

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class _Edge:
    """A measured motion between two keyframes; `loop` edges may be wrong."""

    i: int
    j: int
    T_i_j: Float64
    information: Float64
    loop: bool


class KeyframeLoopCloser:
    """Keyframes, places and a pose graph over them."""

    def __init__(self, config: LoopClosingConfig | None = None) -> None:
        self.config = config or LoopClosingConfig()
        self.database = KeyframeDatabase(self.config.places)
        self.num_closures = 0
        self._edges: list[_Edge] = []
        self._seen_since = True  # whether the camera was tracked all the way from the last keyframe

    @property
    def keyframe(self) -> int:
        """The keyframe that new surfels and frames belong to."""
        return max(len(self.database) - 1, 0)

    def process(self, pyramid: SurfacePyramid, result: FrameResult) -> MapCorrection | None:
        """Look at a tracked frame; return a correction when a loop was closed."""
        if not self.database.reason(pyramid, result.T_world_camera):
            return None
        sighting = self.database.sight(pyramid)
        if sighting.usable < self.database.config.keyframes.min_usable:
            return None
        keyframe = self.database.add(sighting, result.T_world_camera, frame_index=result.index)
        if keyframe.index > 0:
            self._edges.append(self._odometry(keyframe))
        self._seen_since = True
        for candidate in self._revisited(sighting, keyframe):
            loop = self._verified(sighting, keyframe, candidate)
            if loop is not None:
                correction = self._close(loop)
                if correction is not None:
                    return correction
        return None

    def relocalise(self, pyramid: SurfacePyramid) -> RegistrationResult:
        """Look for a lost camera; only CONVERGED says that T_target_source is T_world_camera."""
        self._seen_since = False
        found = relocalise(self.database.sight(pyramid), self.database, self.config.verification)
        pose = np.eye(4) if found.T_world_camera is None else found.T_world_camera
        return replace(found.result, T_target_source=pose)

    def _odometry(self, keyframe: Keyframe) -> _Edge:
        """Return the edge from the keyframe before; how well the motion is known grows with its length."""
        before = self.database[keyframe.index - 1]
        T_i_j = se3.inverse(before.T_world_camera) @ keyframe.T_world_camera
        length, turn = float(np.linalg.norm(T_i_j[:3, 3])), float(se3.rotation_angle_rad(T_i_j))
        drift = self.config.drift
        sigma_m = _LEAST_SIGMA_M + drift * length
        sigma_rad = _LEAST_SIGMA_RAD + _SIGMA_RAD_PER_M * length + drift * turn
        if not self._seen_since:  # it was found again against the map, which is a measurement, too, but of another kind
            sigma_m, sigma_rad = _UNSEEN_SIGMA, _UNSEEN_SIGMA
        sigmas = np.repeat([sigma_m, sigma_rad], 3)
        return _Edge(before.index, keyframe.index, T_i_j, np.diag(sigmas**-2.0), False)

    def _revisited(self, sighting: Sighting, keyframe: Keyframe) -> list[int]:
        """Return older keyframes that look alike, where the map does not already agree."""
        allowed: Array = np.zeros(len(self.database), np.bool_)
        allowed[: max(0, len(self.database) - 1 - self.config.min_gap)] = True
        if not allowed.any():
            return []
        found = self.database.query(sighting, self.config.candidates, allowed=allowed)
        return [
            candidate.index
            for candidate in found
            if not fits_in_place(
                sighting.pyramid,
                self.database[candidate.index],
                se3.inverse(self.database[candidate.index].T_world_camera) @ keyframe.T_world_camera,
                self.config.places.keyframes.surfaces,
            )
        ]

    def _verified(self, sighting: Sighting, keyframe: Keyframe, candidate: int) -> _Edge | None:
        """Return the edge from a candidate when it shows the place of the new keyframe."""
        result = verify_place(sighting, self.database[candidate], self.config.verification)
        if not result.status.success:
            return None
        return _Edge(candidate, keyframe.index, result.T_target_source, edge_information(result), True)

    def _close(self, loop: _Edge) -> MapCorrection | None:
        """Solve the graph with one more edge; keep the answer when keyframes that took no part fit better."""
        old = np.stack([keyframe.T_world_camera for keyframe in self.database.keyframes])
        graph = PoseGraph()
        for pose in old:
            graph.add_node(pose)
        edges = [*self._edges, loop]
        for edge in edges:
            graph.add_edge(edge.i, edge.j, edge.T_i_j, edge.information, robust=edge.loop)
        solved = graph.optimise()
        if not solved.status.has_pose or solved.weights[-1] < _KEPT_WEIGHT:
            logger.info("loop %d -> %d: the rest of the path does not allow it", loop.i, loop.j)
            return None
        new = solved.T_world_node
        if not fits_better(self.database.keyframes, old, new, loop.i, loop.j, self.config.places.keyframes.surfaces):
            logger.info("loop %d -> %d: other keyframes do not fit better", loop.i, loop.j)
            return None
        self._edges = edges
        self.database.move(new)
        self.num_closures += 1
        T_new_old = new @ se3.inverse(old)
        return MapCorrection(np.arange(len(old), dtype=np.int32), T_new_old)


_KEPT_WEIGHT = 0.5
"""Robust weight of an edge that was not dropped."""
