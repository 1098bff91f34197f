"""A run in the browser while it goes by.

The run leaves what is new in a box that holds one thing, and goes on; a thread takes it out, thirty times a second at
most, and draws it. What nobody had time to draw is replaced by what came after. Pages of the map that changed are
copied as soon as the newest frame is fused, which nobody waits for, a few at a time; the thread makes points of them.
While no browser is connected nothing of this happens.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, replace
from types import TracebackType

from scanweld.arrays import Bool, Float64
from scanweld.geometry.frame import Frame
from scanweld.mapping.backends.arrays import FARTHEST_M
from scanweld.mapping.rendering import VIEW_MARGIN_PIXELS, frustum
from scanweld.slam.motion import POSED
from scanweld.slam.system import Slam
from scanweld.trajectory import FrameResult
from scanweld.viewer.coloring import Coloring
from scanweld.viewer.guard import DEFAULT_HOST, DEFAULT_PORT, start_server, stop_server
from scanweld.viewer.live_map import LiveMap
from scanweld.viewer.panel import Gate, Panel, RunPanel
from scanweld.viewer.path import LivePath
from scanweld.viewer.scene import Scene

logger = logging.getLogger(__name__)

UPDATE_S = 0.03
"""The picture changes this often at most: a little more than thirty times a second, to hold thirty."""

DETAIL_S = 0.1
"""The camera's image, the path and the words change this often at most; the camera itself with each update."""

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
    moved : the path is not the one that was drawn with more at its end
    """

    result: FrameResult
    frame: Frame | None
    path: Float64
    lost: Bool
    loops: Float64
    moved: bool

    def instead_of(self, other: _Moment | None) -> _Moment:
        """Return this one, for whoever has not drawn the other one."""
        return replace(self, moved=self.moved or (other is not None and other.moved))


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
        self._map = LiveMap(max_points)
        self._lock = threading.Lock()
        self._moment: _Moment | None = None
        self._undetailed: _Moment | None = None
        self._next_detail_s = 0.0
        self._begun = False
        self._frame: Frame | None = None
        self._slam: Slam | None = None
        self._over: Slam | None = None
        self._rate = _Rate()
        self._news, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._draw_all, name="scanweld-view", daemon=True)
        self._thread.start()

    @property
    def watched(self) -> bool:
        """Whether a browser is connected; nothing is drawn for nobody."""
        return self._scene.watched

    def on_frame(self, slam: Slam, frame: Frame | None, result: FrameResult) -> None:
        """Take note of what is new, in tens of microseconds."""
        if not self._thread.is_alive():
            return
        if not self._begun:
            self._scene.look(result.T_world_camera)
            self._begun = True
        self._slam = slam
        self._rate.count()
        self._put(slam, frame, result)
        if self.watched:
            if self._map.due():
                self._map.copy(slam.mapper, self._panel.coloring, _seen(frame, result))
            self._news.set()

    def ready(self, timeout_s: float) -> bool:
        """Whether the run may go on: nobody holds it, in the browser."""
        if self.gate.wait(timeout_s):
            return True
        if self._slam is not None and self.watched and self._map.due(held=True):  # not all is drawn, or in old colours
            self._map.copy(self._slam.mapper, self._panel.coloring)
            self._news.set()
        return False

    def on_end(self, slam: Slam) -> None:
        """Show where everything came to be in the end."""
        if slam.results:
            self._put(slam, None, slam.results[-1], anew=True)  # refinement may have moved it all
        self._map.forget(elsewhere=False)  # surfels that moved by a little waited for their turn
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
        if world_changed:
            self._map.forget(elsewhere=True)
        with self._lock:
            self._moment = _Moment(result, self._frame, positions, lost, loops, moved).instead_of(self._moment)

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
        if not self.watched:
            return
        over = self._over
        if over is not None and self._map.copy_rest(over.mapper, self._panel.coloring):
            self._news.set()  # until all of it is there
        with self._lock:
            moment, self._moment = self._moment, None
        with self._scene.together():
            self._map.draw(self._scene)
            if moment is not None:
                self._draw_camera(moment)
                self._undetailed = moment.instead_of(self._undetailed)
            if self._undetailed is not None and time.monotonic() >= self._next_detail_s:
                self._draw_detail(self._undetailed)
                self._undetailed, self._next_detail_s = None, time.monotonic() + DETAIL_S
            if over is not None:
                self._run_panel.end("the run is over")
            self._run_panel.label()
            self._scene.set_point_size(self._panel.point_size_m)
            for part, visible in self._panel.shown.items():
                self._scene.set_visible(part, visible)

    def _draw_camera(self, moment: _Moment) -> None:
        T, lost = moment.result.T_world_camera, moment.result.state not in POSED
        if moment.frame is not None:
            self._scene.show_camera(T, moment.frame.camera, lost=lost)
        if self._panel.follow and not lost:
            self._scene.follow(T, rate=_FOLLOW_RATE)

    def _draw_detail(self, moment: _Moment) -> None:
        result = moment.result
        if moment.frame is not None:
            self._scene.show_image(moment.frame.color)
        self._scene.show_path(moment.path, moment.lost, anew=moment.moved)
        if moment.moved:
            self._scene.show_loops(moment.loops[:, 0], moment.loops[:, 1])
        state = result.state.name + (f": {result.note}" if result.note else "")
        rate = f" · {self._rate.per_second:.0f} a second" if self._rate.per_second else ""
        where = f" · submap {result.submap}" if result.submap else ""
        self._run_panel.tell(
            f"{result.index} · {result.timestamp_s:.2f} s{rate}", state, f"{result.num_surfels:,} surfels{where}"
        )


def _seen(frame: Frame | None, result: FrameResult) -> Float64 | None:
    """Return the planes (6, 4) around what was seen in a frame, in the world; None where that is not known."""
    if frame is None or result.state not in POSED:
        return None
    return frustum(result.T_world_camera, frame.camera, VIEW_MARGIN_PIXELS, FARTHEST_M)


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
