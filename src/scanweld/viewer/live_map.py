"""The map of a run that goes on, in the browser: copied by the run when nothing changes it, drawn by another thread."""

from __future__ import annotations

import threading
import time
from functools import partial

from scanweld.arrays import Float64
from scanweld.mapping.pipelined import PipelinedMapper
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.slam.stages import Mapper
from scanweld.viewer.changes import CopiedPages, MapChanges
from scanweld.viewer.coloring import Coloring
from scanweld.viewer.scene import Scene

UPDATE_S = 0.1
"""Pieces of the map are drawn this often at most."""

SHARE = 0.02
"""And so seldom that copying and drawing them takes no more than this share of the processors' time for the run."""

AT_LEAST_S = 1.0
"""But this often anyway: a run that waits for its camera takes no time at all."""

POINTS = 1 << 15
"""Surfels that are copied at a time."""

REST_POINTS = 1 << 18
"""The same after the run: nobody waits for the interpreter then."""


class LiveMap:
    """Pieces of a map on their way from a run to the browser; for two threads, of which the run's never waits.

    Parameters
    ----------
    max_points : of a larger map every second, third, .. surfel is shown
    """

    def __init__(self, max_points: int) -> None:
        self._changes = MapChanges(max_points)
        self._lock = threading.Lock()
        self._copied: CopiedPages | None = None
        self._copying_s = 0.0
        self._coloring = Coloring.RGB
        self._elsewhere = False
        self._next_s = 0.0
        self._next_work_s = 0.0

    def due(self, *, held: bool = False) -> bool:
        """Whether it is time to copy what changed; a run that is `held` leaves all processors to the view."""
        late_s = time.monotonic() - self._next_s
        if self._copied is not None or late_s < 0:
            return False
        return held or late_s > AT_LEAST_S or time.process_time() >= self._next_work_s

    def copy(self, mapper: Mapper, coloring: Coloring, planes: Float64 | None = None) -> None:
        """Copy what changed of a mapper's map, as soon as all frames are fused; does not wait for that.

        What of the map waits on disk is left as it was shown. Of mappers with another kind of map nothing is shown.

        Parameters
        ----------
        mapper, coloring : whose map is to be shown, in which colours
        planes : around what the camera sees, see :meth:`MapChanges.take`
        """
        self._next_s = time.monotonic() + UPDATE_S
        take = partial(self._take, coloring=coloring, planes=planes)
        if isinstance(mapper, PipelinedMapper):
            mapper.look(take)
        else:
            take(mapper.map)

    def copy_rest(self, mapper: Mapper, coloring: Coloring) -> bool:
        """Copy what was not shown yet of a map that nothing changes any more; whether there was anything."""
        self._take(mapper.map, coloring, num_points=REST_POINTS, in_memory=False)
        return self._copied is not None

    def forget(self, *, elsewhere: bool) -> None:
        """Show everything again; `elsewhere`: what comes next is another map, in another world."""
        with self._lock:
            self._changes.forget()
            if elsewhere:
                self._copied, self._elsewhere = None, True

    def draw(self, scene: Scene) -> None:
        """Draw what was copied."""
        started = time.thread_time()
        with self._lock:
            copied, self._copied = self._copied, None
            elsewhere, self._elsewhere = self._elsewhere, False
        if elsewhere:
            scene.clear_map()
        if copied is not None:
            for piece in copied.pieces():
                scene.show_piece(piece)
            spent_s = self._copying_s + time.thread_time() - started
            self._next_work_s = time.process_time() + spent_s / SHARE

    def _take(
        self,
        surfels: object,
        coloring: Coloring,
        planes: Float64 | None = None,
        num_points: int = POINTS,
        in_memory: bool = True,
    ) -> None:
        if not isinstance(surfels, SurfelMap):
            return
        started = time.thread_time()
        with self._lock:
            if coloring is not self._coloring:
                self._changes.forget()
                self._coloring = coloring
            self._copied = self._changes.take(surfels, coloring, num_points, planes, in_memory=in_memory)
            self._copying_s = time.thread_time() - started
