"""What looks on while a run goes by: a viewer, a recorder."""

from __future__ import annotations

from typing import Protocol

from scanweld.geometry.frame import Frame
from scanweld.slam.system import Slam
from scanweld.trajectory import FrameResult


class RunObserver(Protocol):
    """Sees a run from the thread that it runs in, between two frames, when map and results stand still.

    What it reads it must copy: the next frame changes the map. What takes time belongs on a thread of its own.
    """

    def on_frame(self, slam: Slam, frame: Frame | None, result: FrameResult) -> None:
        """Look at the run after a frame; `frame` is None where it could not be read.

        Another `slam` than before means that the run was begun again, with another camera.
        """
        ...

    def ready(self, timeout_s: float) -> bool:
        """Whether the run may go on to the next frame; it is asked again when the answer was no.

        An answer of no may take up to `timeout_s`, so that asking costs nothing.
        """
        ...

    def on_end(self, slam: Slam) -> None:
        """Look at the run after its last frame and its refinement: nothing changes any more."""
        ...
