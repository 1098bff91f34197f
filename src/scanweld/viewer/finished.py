"""A finished run in the browser: its map, and a timeline along its path."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from scanweld.arrays import Array, Float64, UInt8
from scanweld.datasets.base import RgbdSequence
from scanweld.errors import ScanweldError
from scanweld.geometry.camera import PinholeCamera
from scanweld.report.run_files import RunFiles, poses_of_frames, read_run_files
from scanweld.runs.reopen import reopen_sequence
from scanweld.viewer.changes import Piece
from scanweld.viewer.coloring import Coloring, confidence_colors, normal_colors
from scanweld.viewer.guard import DEFAULT_HOST, DEFAULT_PORT, start_server, stop_server
from scanweld.viewer.live import MAX_POINTS, POINT_SIZE_M, UPDATE_S
from scanweld.viewer.panel import Panel
from scanweld.viewer.scene import Scene

PIECE_POINTS = 1 << 15
"""Points of a piece of the map: it does not change any more, so that pieces may be large."""

_FARTHEST_M = 1e9
"""Largest coordinate of a point that is shown."""

_COLUMNS = {
    Coloring.RGB: ("red", "green", "blue"),
    Coloring.NORMAL: ("nx", "ny", "nz"),
    Coloring.CONFIDENCE: ("confidence",),
}
"""Columns of map.ply that a colouring needs. When a surfel was made is not written there."""

_ASSUMED_CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
"""Shape of the frustum for runs whose folder tells none."""


class FinishedView:
    """Shows a run folder in the browser; a context manager.

    Attributes
    ----------
    url : where it is
    note : why there are no images of the camera, "" where there are
    frame : the number of the row of frames.csv that is shown

    Raises
    ------
    FileFormatError
        When the folder is no run folder, or one of its files cannot be read.
    MissingDependencyError, InvalidInputError
        See :func:`~scanweld.viewer.guard.start_server`.
    """

    def __init__(
        self, folder: Path, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, *, max_points: int = MAX_POINTS
    ) -> None:
        self._run = read_run_files(folder)
        self._poses, _ = poses_of_frames(self._run.frames, self._run.trajectory)
        self._posed = self._run.frames.posed
        self._sequence, self.note = _images(self._run)
        self._camera = self._sequence.camera if self._sequence else _camera_of(self._run.run)
        columns = self._run.surfels
        self._colorings = [c for c, names in _COLUMNS.items() if all(name in columns for name in names)]
        stride = max(1, -(-len(columns["x"]) // max_points))
        self._shown = _nearby_together(columns)[::stride]
        self._server, self.url = start_server(host, port, label=self._run.name)
        self._scene = Scene(self._server, point_size_m=_point_size(columns))
        self._timeline = _Timeline(self._server, len(self._poses), self.note)
        self._panel = Panel(self._server, self._colorings, _point_size(columns))
        self._coloring: Coloring | None = None
        self.frame = -1
        self._closed = threading.Event()
        self._scene.look(self._poses[0])
        loops = self._run.loops[(self._run.loops < len(self._poses)).all(axis=1)]
        ends = self._poses[loops][..., :3, 3]
        self._scene.show_loops(ends[:, 0], ends[:, 1])

    def serve(self, duration_s: float = np.inf) -> None:
        """Answer to what browsers do, for some time or until :meth:`close` or an interruption."""
        end = time.monotonic() + duration_s
        before = time.monotonic()
        while not self._closed.is_set() and time.monotonic() < end:
            now = time.monotonic()
            self._timeline.advance(now - before, self._run.frames.timestamp_s)
            before = now
            self.draw()
            self._closed.wait(max(0.0, UPDATE_S - (time.monotonic() - now)))

    def draw(self) -> None:
        """Draw what was changed since the last time."""
        with self._scene.together():
            if self._panel.coloring is not self._coloring:
                self._coloring = self._panel.coloring
                self._draw_map(self._coloring)
            self._scene.set_point_size(self._panel.point_size_m)
            for part, visible in self._panel.shown.items():
                self._scene.set_visible(part, visible)
            if self._timeline.frame != self.frame:
                self.frame = self._timeline.frame
                self._draw_frame(self.frame)
        if self._panel.follow:
            self._scene.follow(self._poses[self.frame], rate=0.1)

    def close(self) -> None:
        """End the view."""
        self._closed.set()
        stop_server(self._server)

    def __enter__(self) -> FinishedView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _draw_map(self, coloring: Coloring) -> None:
        columns = self._run.surfels
        for number, start in enumerate(range(0, len(self._shown), PIECE_POINTS)):
            rows = self._shown[start : start + PIECE_POINTS]
            positions = np.column_stack([columns[axis][rows] for axis in "xyz"]).astype(np.float32)
            values = np.column_stack([columns[name][rows] for name in _COLUMNS[coloring]])
            self._scene.show_piece(Piece(number, positions, _colors(coloring, values)))

    def _draw_frame(self, k: int) -> None:
        frames = self._run.frames
        lost = ~self._posed
        self._scene.show_camera(self._poses[k], self._camera, lost=bool(lost[k]))
        self._scene.show_image(self._image(int(frames.number[k])))
        self._scene.show_path(self._poses[: k + 1, :3, 3], lost[: k + 1])
        note = f": {frames.note[k]}" if frames.note[k] else ""
        self._timeline.tell(f"{frames.number[k]} · {frames.timestamp_s[k]:.2f} s", frames.state[k].upper() + note)

    def _image(self, number: int) -> UInt8 | None:
        if self._sequence is None or number >= len(self._sequence):
            return None
        try:
            return self._sequence.read(number).color
        except ScanweldError:
            return None


class _Timeline:
    """A slider over the frames that can go by itself."""

    def __init__(self, server: Any, count: int, note: str) -> None:
        self._playing = False
        self._time_s: float | None = None
        with server.gui.add_folder("Timeline"):
            self._text = server.gui.add_text("Frame", "", disabled=True)
            self._state = server.gui.add_text("State", "", disabled=True)
            if note:
                server.gui.add_text("Images", note, disabled=True)
            self._slider = server.gui.add_slider("Position", 0, max(1, count - 1), 1, initial_value=count - 1)
            self._speed = server.gui.add_slider("Speed", 0.25, 8.0, 0.25, initial_value=1.0)
            self._play = server.gui.add_button("Play")
            self._step = server.gui.add_button("Step")
        self._count = count
        self._play.on_click(self._on_play)
        self._step.on_click(self._on_step)

    @property
    def frame(self) -> int:
        """The frame to show."""
        return min(int(self._slider.value), self._count - 1)

    def advance(self, passed_s: float, timestamps_s: Float64) -> None:
        """Go on while playing, as fast as the frames were recorded, times the speed."""
        if not self._playing:
            self._time_s = None
            return
        frame = self.frame
        if self._time_s is None or not self._shows(frame, timestamps_s):  # somebody moved the slider
            self._time_s = float(timestamps_s[frame])
        self._time_s += passed_s * float(self._speed.value)
        following = int(np.searchsorted(timestamps_s, self._time_s, side="right")) - 1
        self._slider.value = max(following, frame)
        if self.frame == self._count - 1:
            self._set_playing(False)

    def tell(self, frame: str, state: str) -> None:
        """Show two short texts."""
        self._text.value, self._state.value = frame, state

    def _on_play(self, event: object) -> None:
        if not self._playing and self.frame == self._count - 1:
            self._slider.value = 0
        self._set_playing(not self._playing)

    def _on_step(self, event: object) -> None:
        self._set_playing(False)
        self._slider.value = min(self.frame + 1, self._count - 1)

    def _shows(self, frame: int, timestamps_s: Float64) -> bool:
        """Whether the time at hand is that of the frame."""
        assert self._time_s is not None
        return int(np.searchsorted(timestamps_s, self._time_s, side="right")) - 1 == frame

    def _set_playing(self, playing: bool) -> None:
        self._playing = playing
        self._play.label = "Pause" if playing else "Play"


def _images(run: RunFiles) -> tuple[RgbdSequence | None, str]:
    """Return the sequence of a run, or why it cannot be had."""
    try:
        return reopen_sequence(run.run), ""
    except ScanweldError as error:
        return None, str(error)


def _camera_of(run: Mapping[str, Any]) -> PinholeCamera:
    try:
        return PinholeCamera(**run["intrinsics"])
    except (KeyError, TypeError, ScanweldError):
        return _ASSUMED_CAMERA


def _point_size(columns: Mapping[str, Array]) -> float:
    """Diameter of a point that closes most gaps between surfels [m]."""
    radii = columns.get("radius")
    return POINT_SIZE_M if radii is None or len(radii) == 0 else float(np.median(radii)) * 1.5


def _nearby_together(columns: Mapping[str, Array]) -> Array:
    """Return points in an order in which neighbours in space are neighbours, so that pieces can be culled.

    What is nowhere, as a damaged map may have it, is left out.
    """
    positions = np.column_stack([columns[axis] for axis in "xyz"])
    somewhere = np.flatnonzero((np.abs(positions) < _FARTHEST_M).all(axis=1))
    cells = np.floor(positions[somewhere]).astype(np.int64)
    return np.asarray(somewhere[np.lexsort(cells.T)])


def _colors(coloring: Coloring, values: Array) -> UInt8:
    if coloring is Coloring.NORMAL:
        return normal_colors(values.astype(np.float32))
    if coloring is Coloring.CONFIDENCE:
        return confidence_colors(values[:, 0].astype(np.float32))
    return values.astype(np.uint8)
