"""Submaps: the maps of a run, of which the camera is in one, until a place that both know makes one of two.

Each submap has a world of its own. The first is that of the run; a later one begins where a camera that was lost for
good is tracked again, with that camera as its origin: where it lies in another world is not known, and not guessed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from scanweld.arrays import Float64
from scanweld.config import check_ranges, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.joining import Join
from scanweld.registration.result import RegistrationResult
from scanweld.slam.motion import POSED
from scanweld.slam.stages import LoopCloser, Mapper, SubmapLoopCloser, SubmapMapper
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult, FrameState


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapConfig:
    """When a lost camera begins a new map."""

    patience_s: float = setting(
        1.0,
        "seconds that a lost camera sees depth and knows no place, after which a submap begins; too low: a hand that "
        "stays before the lens becomes one; too high: places that were never seen before are left out",
        low=0.0,
    )
    most: int = setting(
        8, "submaps side by side, 1 for none; beyond that a lost camera stays lost. Raise for long recordings", low=1
    )
    min_usable: float = setting(
        0.1, "share of the image that must have surfaces to begin one; lower for sparse depth", low=0.001, high=1.0
    )

    def __post_init__(self) -> None:
        check_ranges(self)


_LEAST_TRIES = 10  # frames that were looked for in vain, whatever the clock says


class Atlas(Stateful):
    """The mappers of all submaps and the loop closer that knows the places of all.

    Stages that know no submaps make an atlas of one.
    """

    STATE: ClassVar = {
        "submaps": list[int], "mappers": dict[int, Stateful], "active": int, "num_joins": int, "_tries": int,
        "_lost_at_s": float,
    }  # fmt: skip
    MADE = frozenset({"config", "_loop_closer"})

    def __init__(self, mapper: Mapper, loop_closer: LoopCloser, config: SubmapConfig | None = None) -> None:
        self.config = config or SubmapConfig()
        self.mappers: dict[int, Mapper] = {0: mapper}
        self.active = 0
        self.num_joins = 0
        self._loop_closer = loop_closer
        self._tries = 0
        self._lost_at_s = 0.0

    @property
    def mapper(self) -> Mapper:
        """That of the submap that the camera is in."""
        return self.mappers[self.active]

    @property
    def submaps(self) -> list[int]:
        """The numbers of the submaps, in the order of the mappers; where they are set, new ones have empty maps."""
        return list(self.mappers)

    @submaps.setter
    def submaps(self, numbers: list[int]) -> None:
        mapper = self.mapper
        if not isinstance(mapper, SubmapMapper):
            raise ValueError("a mapper of one map has several")
        self.mappers = {number: self.mappers.get(number) or mapper.fresh() for number in numbers}

    def restored(self) -> None:
        """Check that the camera is in a submap that there is."""
        if self.active not in self.mappers:
            raise ValueError(f"the camera is in submap {self.active}, which is not there")

    def look_for(self, pyramid: SurfacePyramid) -> tuple[int, RegistrationResult]:
        """Look for a lost camera in all submaps; T_target_source is in the world of the submap that is returned."""
        if isinstance(self._loop_closer, SubmapLoopCloser):
            return self._loop_closer.look_for(pyramid)
        return self.active, self._loop_closer.relocalise(pyramid)

    def enter(self, submap: int) -> None:
        """Go on in another submap."""
        if submap != self.active and isinstance(self._loop_closer, SubmapLoopCloser):
            self._loop_closer.enter(submap)
            self.active = submap

    def gives_up(self, result: FrameResult, pyramid: SurfacePyramid) -> bool:
        """Count a frame; whether a lost camera has been looked for in vain for so long that a submap should begin."""
        if result.state is not FrameState.LOST:
            self._tries = 0
            return False
        surface = pyramid.levels[0].surface[::2, ::2, 6]
        if np.count_nonzero(surface) < self.config.min_usable * surface.size:
            return False  # a covered lens is no new place
        if self._tries == 0:
            self._lost_at_s = result.timestamp_s
        self._tries += 1
        patient = self._tries < _LEAST_TRIES or result.timestamp_s - self._lost_at_s < self.config.patience_s
        return not patient and len(self.mappers) < self.config.most

    def begin(self, pyramid: SurfacePyramid, frame_index: int) -> Float64 | None:
        """Begin a submap with a frame; return its pose (4, 4), or None where it cannot be done."""
        mapper, pose = self.mapper, np.eye(4)
        if not isinstance(mapper, SubmapMapper) or not isinstance(self._loop_closer, SubmapLoopCloser):
            return None
        submap = self._loop_closer.begin_submap(pyramid, pose, frame_index)
        if submap is None:
            return None
        self.mappers[submap], self.active, self._tries = mapper.fresh(), submap, 0
        return pose

    def other(self, join: Join) -> tuple[int, Float64]:
        """Return the submap of a join that the camera is not in, and (4, 4) from the camera's world to that one's."""
        if self.active == join.joined:
            return join.kept, join.T_kept_joined
        return join.joined, se3.inverse(join.T_kept_joined)

    def join(self, join: Join) -> MapCorrection:
        """Make one submap of two; return how the keyframes of the joined one move."""
        kept, joined = self.mappers[join.kept], self.mappers.pop(join.joined)
        assert isinstance(kept, SubmapMapper)
        assert isinstance(self._loop_closer, SubmapLoopCloser)
        correction = self._loop_closer.join(join)
        kept.take_in(joined, correction)
        self.active = join.kept if self.active == join.joined else self.active
        self.num_joins += 1
        return correction


def main_submap(results: Sequence[FrameResult]) -> int:
    """Return the submap with the most measured frames, the oldest of equals: its world is that of the run."""
    counts = Counter(result.submap for result in results if result.state in POSED)
    return min(counts, key=lambda submap: (-counts[submap], submap), default=0)


def in_one_world(results: Sequence[FrameResult], submap: int) -> list[FrameResult]:
    """Return results as one submap knows them: frames of others count as LOST.

    Where the camera was then is not known in this world; their poses are the last one before, or the first after.
    """
    mine = [result for result in results if result.submap == submap]
    T_last = next((r.T_world_camera for r in mine if r.state in POSED), np.eye(4))
    seen = []
    for result in results:
        if result.submap == submap:
            T_last = result.T_world_camera
            seen.append(result)
        else:
            state = FrameState.LOST if result.state in POSED else result.state
            seen.append(replace(result, state=state, T_world_camera=T_last, note=f"in submap {result.submap}"))
    return seen
