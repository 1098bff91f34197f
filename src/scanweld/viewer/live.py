"""A run in the browser while it goes by.

The run leaves what is new in a box that holds one thing, and goes on; a thread takes it out, thirty times a second at
most, and draws it. What nobody had time to draw is replaced by what came after. Of the map the run copies pages that
changed, five times a second at most and not more than `MAP_POINTS` surfels at a time; the thread makes points of them.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from types import TracebackType

from scanweld.arrays import Bool, Float64
from scanweld.geometry.frame import Frame
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.slam.motion import POSED
from scanweld.slam.system import Slam
from scanweld.trajectory import FrameResult
from scanweld.viewer.changes import CopiedPages, MapChanges
from scanweld.viewer.coloring import Coloring
from scanweld.viewer.guard import DEFAULT_HOST, DEFAULT_PORT, start_server, stop_server
from scanweld.viewer.panel import Gate, Panel, RunPanel
from scanweld.viewer.path import LivePath
from scanweld.viewer.scene import Scene

logger = logging.getLogger(__name__)

UPDATE_S = 0.03
"""The picture changes this often at most: a little more than thirty times a second, to hold thirty."""

MAP_UPDATE_S = 0.2
"""Pieces of the map are copied this often at most: each time costs the run a millisecond."""

MAP_POINTS = 1 << 16
"""Surfels that are copied at a time."""

MAX_POINTS = 2_000_000
"""Points that a browser is given; of a larger map it gets every second surfel, every third, and so on."""

POINT_SIZE_M = 0.012

_FOLLOW_RATE = 0.1  # of the way to behind the camera, at each update: half of it in a quarter of a second


@dataclass(frozen=True, slots=True)
class _Moment:
    """What there is to draw after a frame.

    Attributes
    ----------
    path, lost : camera centres (N, 3), and which of them were not measured (N,)
    frame : the newest that could be read
    loops : (L, 2, 3)
    moved : the path is not the one before with more at its end
    """

    result: FrameResult
    frame: Frame | None
    path: Float64
    lost: Bool
    loops: Float64
    moved: bool


class LiveView:
    """Shows a run in the browser; an observer for :func:`scanweld.runs.run.run_sequence`, and a context manager.

    Attributes
    ----------
    url : where it is
    gate : holds the run

    Raises
    ------
    MissingDependencyError, InvalidInputError
        See :func:`~scanweld.viewer.guard.start_server`.
    """

    def __init__(
        self,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        *,
        title: str = "scanweld",
        max_points: int = MAX_POINTS,
    ) -> None:
        self._server, self.url = start_server(host, port, label=title)
        self.gate = Gate()
        self._scene = Scene(self._server, point_size_m=POINT_SIZE_M)
        self._run_panel = RunPanel(self._server, self.gate)
        self._panel = Panel(self._server, list(Coloring), POINT_SIZE_M)
        self._path = LivePath()
        self._changes = MapChanges(max_points)
        self._lock = threading.Lock()
        self._moment: _Moment | None = None
        self._pages: list[CopiedPages] = []
        self._forget_map = False
        self._begun = False
        self._frame: Frame | None = None
        self._slam: Slam | None = None
        self._over: Slam | None = None
        self._coloring = Coloring.RGB
        self._next_map_s = 0.0
        self._rate = _Rate()
        self._news, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._draw_all, name="scanweld-view", daemon=True)
        self._thread.start()

    def on_frame(self, slam: Slam, frame: Frame | None, result: FrameResult) -> None:
        """Take note of what is new: tens of microseconds, and a millisecond when pieces of the map are due."""
        if not self._thread.is_alive():
            return
        self._slam = slam
        self._rate.count()
        self._put(slam, frame, result)
        if not self._pages and time.monotonic() >= self._next_map_s:
            self._copy(slam, MAP_POINTS)
        self._news.set()

    def ready(self, timeout_s: float) -> bool:
        """Whether the run may go on: nobody holds it, in the browser."""
        if self.gate.wait(timeout_s):
            return True
        if self._slam is not None and not self._pages and self._copy(self._slam, MAP_POINTS):  # colours may change
            self._news.set()
        return False

    def on_end(self, slam: Slam) -> None:
        """Show where everything came to be in the end."""
        if slam.results:
            self._put(slam, None, slam.results[-1], anew=True)  # refinement may have moved it all
        self._changes.forget()  # surfels that moved by a little waited for their turn
        self._over = slam  # it does not change any more: the thread may read it by itself
        self._news.set()

    def close(self) -> None:
        """End the view; browsers say that the connection is gone."""
        self._closed.set()
        self._news.set()
        self.gate.pause(False)
        self._thread.join(5)
        stop_server(self._server)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, slam: Slam, frame: Frame | None, result: FrameResult, *, anew: bool = False) -> None:
        self._frame = frame or self._frame  # of a frame that could not be read, the place alone is new
        world_changed, moved = self._path.update(slam, None if anew else result)
        positions, lost, loops = self._path.drawn()
        with self._lock:
            waiting = self._moment
            moved = moved or (waiting is not None and waiting.moved)
            self._moment = _Moment(result, self._frame, positions, lost, loops, moved)
            if world_changed:
                self._changes.forget()
                self._pages.clear()
                self._forget_map = True

    def _copy(self, slam: Slam, num_points: int) -> bool:
        """Copy pieces that changed; whether there were any."""
        coloring = self._panel.coloring
        if coloring is not self._coloring:
            self._changes.forget()
            self._coloring = coloring
        surfels = slam.mapper.map
        if not isinstance(surfels, SurfelMap):  # another mapper's: path and camera are drawn all the same
            return False
        pages = self._changes.take(surfels, coloring, num_points)
        self._next_map_s = time.monotonic() + MAP_UPDATE_S
        if pages is None:
            return False
        with self._lock:
            self._pages.append(pages)
        return True

    def _draw_all(self) -> None:
        try:
            while not self._closed.is_set():
                # The settings of the panel are looked at also when nothing comes.
                self._news.wait(0.1)
                self._news.clear()
                started = time.monotonic()
                self._draw()
                self._closed.wait(max(0.0, UPDATE_S - (time.monotonic() - started)))
        except Exception:  # a view is no reason to end a run
            logger.exception("the live view ended; the run goes on without it")
            self.gate.pause(False)

    def _draw(self) -> None:
        over = self._over
        if over is not None and self._copy(over, 4 * MAP_POINTS):
            self._news.set()  # until all of it is there
        with self._lock:
            moment, self._moment = self._moment, None
            pages, self._pages = self._pages, []
            forget, self._forget_map = self._forget_map, False
        pieces = [piece for copied in pages for piece in copied.pieces()]
        with self._scene.together():
            if forget:
                self._scene.clear_map()
            for piece in pieces:
                self._scene.show_piece(piece)
            if moment is not None:
                self._draw_moment(moment)
            self._run_panel.label()
            self._scene.set_point_size(self._panel.point_size_m)
            for part, visible in self._panel.shown.items():
                self._scene.set_visible(part, visible)
        if over is not None and moment is not None:
            self._run_panel.end("the run is over")

    def _draw_moment(self, moment: _Moment) -> None:
        result, T = moment.result, moment.result.T_world_camera
        lost = result.state not in POSED
        if not self._begun:
            self._scene.look(T)
            self._begun = True
        if moment.frame is not None:
            self._scene.show_camera(T, moment.frame.camera, moment.frame.color, lost=lost)
        self._scene.show_path(moment.path, moment.lost, anew=moment.moved)
        if moment.moved:
            self._scene.show_loops(moment.loops[:, 0], moment.loops[:, 1])
        if self._panel.follow and not lost:
            self._scene.follow(T, rate=_FOLLOW_RATE)
        state = result.state.name + (f": {result.note}" if result.note else "")
        rate = f" · {self._rate.per_second:.0f} a second" if self._rate.per_second else ""
        where = f" · submap {result.submap}" if result.submap else ""
        self._run_panel.tell(
            f"{result.index} · {result.timestamp_s:.2f} s{rate}", state, f"{result.num_surfels:,} surfels{where}"
        )


class _Rate:
    """Frames a second, over the last second or so."""

    def __init__(self) -> None:
        self.per_second = 0.0
        self._count, self._since_s = 0, time.monotonic()

    def count(self) -> None:
        self._count += 1
        passed = time.monotonic() - self._since_s
        if passed >= 1:
            self.per_second, self._count, self._since_s = self._count / passed, 0, time.monotonic()
