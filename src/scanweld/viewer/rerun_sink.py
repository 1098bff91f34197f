"""A run as a recording of Rerun: into a file, or to its viewer while the run goes by."""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from scanweld.errors import InvalidInputError, MissingDependencyError, OutputError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.slam.motion import POSED
from scanweld.slam.system import Slam
from scanweld.trajectory import FrameResult
from scanweld.viewer.changes import MapChanges
from scanweld.viewer.coloring import Coloring
from scanweld.viewer.live import MAX_POINTS
from scanweld.viewer.path import LivePath
from scanweld.viewer.scene import LOOP, LOST, TRACKED, smaller

MAP_UPDATE_S = 1.0
"""Changes of the map are written this often at most: a recording keeps each of them."""

MAP_POINTS = 1 << 16
"""Surfels that are written at a time."""

POINT_RADIUS_M = 0.005

_PATH_STEP = 64  # poses of one line of the path: only the last line grows


class RerunSink:
    """Writes a run for Rerun; an observer for :func:`scanweld.runs.run.run_sequence`, and a context manager.

    Parameters
    ----------
    target : a file that ends in .rrd; "live" starts the viewer that comes with Rerun; rerun+http://.. connects to one
    title : what the recording is called

    Raises
    ------
    MissingDependencyError
        When rerun-sdk is not installed.
    InvalidInputError
        When the target is none of these.
    OutputError
        When the file cannot be written.
    """

    def __init__(self, target: str, *, title: str = "scanweld") -> None:
        try:
            import rerun
        except ImportError:
            raise MissingDependencyError("rerun-sdk", "rerun") from None
        self._rr = rerun
        self._to = rerun.RecordingStream(title)
        _connect(self._to, target)
        self._changes, self._path = MapChanges(MAX_POINTS), LivePath()
        self._camera: PinholeCamera | None = None
        self._written: set[int] = set()
        self._next_map_s = 0.0
        self._to.log("world", rerun.ViewCoordinates.RDF, static=True)

    def on_frame(self, slam: Slam, frame: Frame | None, result: FrameResult) -> None:
        """Write where the camera is, what it sees and what is measured; now and then, how the map changed."""
        rr, to = self._rr, self._to
        to.set_time("frame", sequence=result.index)
        to.set_time("time", duration=result.timestamp_s)
        T = result.T_world_camera
        to.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        if frame is not None:
            self._write_image(frame)
        for name, value in (("surfels", result.num_surfels), ("rmse_m", result.rmse_m), ("overlap", result.overlap)):
            to.log(f"measured/{name}", rr.Scalars(float(value)))
        if result.state not in POSED or result.note:
            level = "WARN" if result.state not in POSED else "INFO"
            to.log("log", rr.TextLog(f"{result.state.name} {result.note}".strip(), level=level))
        self._write_path(slam, result)
        if time.monotonic() >= self._next_map_s:
            self._write_map(slam)
            self._next_map_s = time.monotonic() + MAP_UPDATE_S

    def ready(self, timeout_s: float) -> bool:
        """A recording holds nothing up."""
        return True

    def on_end(self, slam: Slam) -> None:
        """Write where everything came to be in the end."""
        self._write_path(slam, None)
        self._changes.forget()  # surfels that moved by a little waited for their turn
        while self._write_map(slam):
            pass

    def close(self) -> None:
        """Write out what is left."""
        self._to.flush()
        self._to.disconnect()

    def __enter__(self) -> RerunSink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write_image(self, frame: Frame) -> None:
        rr, camera = self._rr, frame.camera
        if frame.color is None:
            return
        image = smaller(frame.color)
        if camera != self._camera:
            self._camera = camera
            scale = image.shape[1] / camera.width
            K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
            K[:2] *= scale
            size = [image.shape[1], image.shape[0]]
            pinhole = rr.Pinhole(
                image_from_camera=K, resolution=size, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.25
            )
            self._to.log("world/camera/image", pinhole, static=True)
        done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])
        if done:
            self._to.log("world/camera/image", rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg"))

    def _write_path(self, slam: Slam, newest: FrameResult | None) -> None:
        rr = self._rr
        elsewhere, moved = self._path.update(slam, newest)
        if elsewhere:
            self._changes.forget()
            for number in self._written:
                self._to.log(f"world/map/{number}", rr.Clear(recursive=False))
            self._written.clear()
        positions, lost, loops = self._path.drawn()
        last = max(0, len(positions) - 2) // _PATH_STEP
        if moved:
            self._to.log("world/path", rr.Clear(recursive=True))
            self._to.log("world/loops", rr.LineStrips3D(list(loops), colors=LOOP))
        for part in range(0 if moved else last, last + 1):
            piece = slice(part * _PATH_STEP, (part + 1) * _PATH_STEP + 1)
            points, colors = positions[piece], np.where(lost[piece][1:, None], LOST, TRACKED).astype(np.uint8)
            if len(points) > 1:
                segments = np.stack([points[:-1], points[1:]], axis=1)
                self._to.log(f"world/path/{part}", rr.LineStrips3D(segments, colors=colors))

    def _write_map(self, slam: Slam) -> bool:
        """Write changes of the map; whether there were any."""
        surfels = slam.mapper.map
        pages = self._changes.take(surfels, Coloring.RGB, MAP_POINTS) if isinstance(surfels, SurfelMap) else None
        if pages is None:
            return False
        for piece in pages.pieces():
            name = f"world/map/{piece.number}"
            self._written.add(piece.number)
            points = self._rr.Points3D(piece.positions_m, colors=piece.colors, radii=POINT_RADIUS_M)
            self._to.log(name, points)
        return True


def _connect(stream: Any, target: str) -> None:
    if target == "live":
        stream.spawn()
    elif target.startswith("rerun+http"):
        stream.connect_grpc(target)
    elif target.endswith(".rrd"):
        path = Path(target)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None
        stream.save(target)
    else:
        raise InvalidInputError(
            f"rerun {target!r}: expected a file that ends in .rrd, 'live', or the address of a viewer, rerun+http://.."
        )
