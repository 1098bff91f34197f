"""The controls beside the picture, and what they are set to.

Settings are read by whoever draws, when it draws; only the buttons act by themselves.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

from scanweld.viewer.coloring import Coloring

POINT_SIZES_MM = (1.0, 40.0)


class Gate:
    """Lets a run pass, or holds it between two frames; used by the run and by buttons, on threads of their own."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._paused = False
        self._steps = 0

    @property
    def paused(self) -> bool:
        """Whether the run waits, but for single steps."""
        return self._paused

    def pause(self, paused: bool) -> None:
        """Hold the run, or let it go on."""
        with self._condition:
            self._paused, self._steps = paused, 0
            self._condition.notify_all()

    def step(self) -> None:
        """Let a held run go on by one frame more; one that is not held is held after the next frame."""
        with self._condition:
            self._steps = self._steps + 1 if self._paused else 1
            self._paused = True
            self._condition.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Whether the next frame may come; waits for it for a while where it may not yet."""
        with self._condition:
            if not self._condition.wait_for(lambda: not self._paused or self._steps > 0, timeout_s):
                return False
            if self._paused:
                self._steps -= 1
            return True


class Panel:
    """Controls of the picture: what colours mean, sizes, what is shown, whether to go along with the camera.

    Parameters
    ----------
    server : of viser
    colorings : that the map can be shown in
    point_size_m : at first [m]
    """

    def __init__(self, server: Any, colorings: Sequence[Coloring], point_size_m: float) -> None:
        gui = server.gui
        with gui.add_folder("Picture"):
            self._coloring = gui.add_dropdown("Colour", [coloring.value for coloring in colorings])
            self._size = gui.add_slider(
                "Point size [mm]", *POINT_SIZES_MM, 0.5, initial_value=_within(point_size_m * 1e3, *POINT_SIZES_MM)
            )
            self._follow = gui.add_checkbox("Follow camera", False)
            self._shown = {
                part: gui.add_checkbox(label, True)
                for part, label in (("path", "Path"), ("loops", "Loops"), ("camera", "Camera"))
            }

    @property
    def coloring(self) -> Coloring:
        """What colours show."""
        return Coloring(self._coloring.value)

    @property
    def point_size_m(self) -> float:
        """Diameter of a point [m]."""
        return float(self._size.value) * 1e-3

    @property
    def follow(self) -> bool:
        """Whether the eye goes along with the camera."""
        return bool(self._follow.value)

    @property
    def shown(self) -> dict[str, bool]:
        """Which of "path", "loops" and "camera" are shown."""
        return {part: bool(handle.value) for part, handle in self._shown.items()}


class RunPanel:
    """What a run is at, and the buttons that hold it."""

    def __init__(self, server: Any, gate: Gate) -> None:
        self._gate = gate
        with server.gui.add_folder("Run"):
            self._frame = server.gui.add_text("Frame", "waiting", disabled=True)
            self._state = server.gui.add_text("State", "", disabled=True)
            self._surfels = server.gui.add_text("Map", "", disabled=True)
            self._pause = server.gui.add_button("Pause", hint="hold the run after this frame, or let it go on")
            self._step = server.gui.add_button("Step", hint="one frame more, then hold")

        self._pause.on_click(self._on_pause)
        self._step.on_click(self._on_step)

    def tell(self, frame: str, state: str, surfels: str) -> None:
        """Show three short texts."""
        self._frame.value, self._state.value, self._surfels.value = frame, state, surfels

    def label(self) -> None:
        """Let the button say what it would do."""
        label = "Go on" if self._gate.paused else "Pause"
        if self._pause.label != label:
            self._pause.label = label

    def end(self, text: str) -> None:
        """Say that the run is over: there is nothing to hold any more."""
        self._state.value = text
        self._pause.disabled = self._step.disabled = True

    def _on_pause(self, event: object) -> None:
        self._gate.pause(not self._gate.paused)

    def _on_step(self, event: object) -> None:
        self._gate.step()


def _within(value: float, low: float, high: float) -> float:
    """The nearest value that a slider of half steps can have."""
    return min(max(round(2 * value) / 2, low), high)
