"""The path of a run that goes on: it grows by a pose a frame, and now and then all of it moves."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Bool, Float64
from scanweld.slam.motion import POSED
from scanweld.slam.system import Slam
from scanweld.trajectory import FrameResult


class LivePath:
    """Camera centres and loops of a run, in the world of the submap that the camera is in."""

    def __init__(self) -> None:
        self._positions_m: Float64 = np.empty((256, 3))
        self._lost: Bool = np.empty(256, np.bool_)
        self._count = 0
        self._loops_m: Float64 = np.empty((0, 2, 3))
        self._world: object = None
        self._corrections: object = None

    def update(self, slam: Slam, newest: FrameResult | None) -> tuple[bool, bool]:
        """Take note of the newest result; whether it is in another world, and whether earlier poses moved.

        That a loop was closed is seen here; None says that poses may have moved for another reason. Only when they
        moved all results are looked at: asking for them waits for a map that is still being made.
        """
        world = id(slam), slam.atlas.active
        corrections = slam.loop_closer.num_closures, slam.atlas.num_joins
        elsewhere = world != self._world
        moved = newest is None or elsewhere or corrections != self._corrections
        if newest is not None and not moved:
            self._append(newest)
            return False, False
        self._world, self._corrections, self._count = world, corrections, 0
        for result in slam.results:
            if result.submap == slam.atlas.active:
                self._append(result)
        self._loops_m = loop_lines(slam)
        return elsewhere, True

    def drawn(self) -> tuple[Float64, Bool, Float64]:
        """Return camera centres (N, 3), which of them were not measured (N,), and the ends of loops (L, 2, 3)."""
        # What is behind these views is never written again: a path that moves gets arrays of its own.
        return self._positions_m[: self._count], self._lost[: self._count], self._loops_m

    def _append(self, result: FrameResult) -> None:
        if self._count == 0 or self._count == len(self._lost):
            room = max(256, 2 * self._count)
            positions, flags = np.empty((room, 3)), np.empty(room, np.bool_)
            positions[: self._count], flags[: self._count] = self._positions_m[: self._count], self._lost[: self._count]
            self._positions_m, self._lost = positions, flags
        self._positions_m[self._count] = result.T_world_camera[:3, 3]
        self._lost[self._count] = result.state not in POSED
        self._count += 1


def loop_lines(slam: Slam) -> Float64:
    """Return the camera centres (L, 2, 3) of the keyframes that loops tie, in the world of the active submap."""
    database = getattr(slam.loop_closer, "database", None)  # other loop closers may know no keyframes
    if database is None:
        return np.empty((0, 2, 3))
    lines = []
    for i, j in getattr(slam.loop_closer, "loops", ()):
        ends = [slam.results[database.keyframes[k].frame_index] for k in (i, j)]
        if all(result.submap == slam.atlas.active for result in ends):
            lines.append([result.T_world_camera[:3, 3] for result in ends])
    return np.array(lines, np.float64).reshape(-1, 2, 3)
