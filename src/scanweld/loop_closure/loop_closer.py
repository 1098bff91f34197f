"""Loop closers: what may correct the map after a frame."""

from __future__ import annotations

from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection
from scanweld.trajectory import FrameResult


class NoLoopCloser:
    """Never corrects anything: odometry against the map."""

    def process(self, pyramid: SurfacePyramid, result: FrameResult) -> MapCorrection | None:
        """Look at a tracked frame; return a correction when a loop was closed."""
        return None
