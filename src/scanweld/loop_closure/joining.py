"""Joining submaps: when two maps are believed to show one world, and how they lie to each other.

A camera that is lost for good begins a new map, with a world of its own. One frame that looks like a place of another
map is no proof that it is that place: rooms, desks and posters come in twos. A join therefore needs

1. two pairs of keyframes, all four different, each verified like a loop, that put the maps in the same place;
2. keyframes of both maps that took no part: where they see common ground they must agree in depth and in texture, and
   none may stand in what another one saw as free space (:func:`~.held_out.fits_together`).
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig
from scanweld.loop_closure.held_out import fits_together
from scanweld.loop_closure.keyframes import Keyframe
from scanweld.state import Stateful

logger = logging.getLogger(__name__)

_AGREE_M, _AGREE_RAD = 0.05, 0.04  # between two pairs that say the same, besides what the maps may have drifted
_REMEMBERED = 64  # pairs that wait for a second one


@dataclass(frozen=True, slots=True)
class PlacePair:
    """Two keyframes of different submaps that were verified to show one place.

    Attributes
    ----------
    i, j : the keyframes
    T_i_j : (4, 4), from the camera of j to that of i
    information : (6, 6), of a left perturbation of T_i_j
    """

    i: int
    j: int
    T_i_j: Float64
    information: Float64


@dataclass(frozen=True, slots=True)
class Join:
    """Two submaps that were found to be one.

    Attributes
    ----------
    kept, joined : the submaps; the older one is kept, and its world with it
    T_kept_joined : (4, 4), from the world of the second to that of the first
    pairs : what speaks for it
    """

    kept: int
    joined: int
    T_kept_joined: Float64
    pairs: tuple[PlacePair, PlacePair]


class JoinFinder(Stateful):
    """Remembers verified pairs of keyframes until a second one says the same."""

    STATE: ClassVar = {"_pairs": deque[PlacePair]}
    MADE = frozenset({"drift", "surfaces"})

    def __init__(self, drift: float, surfaces: SurfaceConfig) -> None:
        self.drift = drift
        self.surfaces = surfaces
        self._pairs: deque[PlacePair] = deque(maxlen=_REMEMBERED)

    def add(self, pair: PlacePair, keyframes: Sequence[Keyframe], submaps: Sequence[int]) -> Join | None:
        """Take in a pair; return a join when an earlier one and the keyframes around them speak for the same.

        Parameters
        ----------
        keyframes : all of them, in the worlds of their submaps
        submaps : of each keyframe
        """
        joins = (self._agreed(pair, other, keyframes, submaps) for other in reversed(self._pairs))
        join = next((join for join in joins if join is not None), None)
        self._pairs.append(pair)
        # What is refused is looked at again when the next pair speaks for it: by then more has been seen.
        return join if join is not None and self._holds(join, keyframes, submaps) else None

    def _agreed(
        self, pair: PlacePair, other: PlacePair, keyframes: Sequence[Keyframe], submaps: Sequence[int]
    ) -> Join | None:
        """Return the join that two pairs speak for; None where they are not independent or contradict each other."""
        kept, joined = sorted((submaps[pair.i], submaps[pair.j]))
        if kept == joined or sorted((submaps[other.i], submaps[other.j])) != [kept, joined]:
            return None
        if {pair.i, pair.j} & {other.i, other.j}:
            return None
        T, T_other = (_motion(p, keyframes, submaps) for p in (pair, other))
        here, there = (keyframes[p.j if submaps[p.j] == joined else p.i].T_world_camera[:3, 3] for p in (pair, other))
        off_m = float(np.linalg.norm((T - T_other)[:3] @ np.append((here + there) / 2, 1.0)))
        off_rad = float(se3.rotation_angle_rad(se3.inverse(T) @ T_other))
        if off_m > _AGREE_M + self.drift * float(np.linalg.norm(here - there)) or off_rad > _AGREE_RAD:
            return None
        return Join(kept, joined, se3.interpolate(T, T_other, 0.5), (pair, other))

    def _holds(self, join: Join, keyframes: Sequence[Keyframe], submaps: Sequence[int]) -> bool:
        """Whether keyframes of the two maps that took no part fit each other."""
        involved = {index for pair in join.pairs for index in (pair.i, pair.j)}
        kept, joined = (
            [keyframe for keyframe, submap in zip(keyframes, submaps, strict=True) if submap == which]
            for which in (join.kept, join.joined)
        )
        why = fits_together(kept, joined, join.T_kept_joined, involved, self.surfaces)
        if why:
            logger.info("submaps %d and %d are not joined: %s", join.kept, join.joined, why)
        return not why


def _motion(pair: PlacePair, keyframes: Sequence[Keyframe], submaps: Sequence[int]) -> Float64:
    """Return T_kept_joined (4, 4) as one pair has it; the older submap is kept."""
    T = keyframes[pair.i].T_world_camera @ pair.T_i_j @ se3.inverse(keyframes[pair.j].T_world_camera)
    return np.asarray(T if submaps[pair.i] < submaps[pair.j] else se3.inverse(T))
