"""RealSense cameras and their recordings, through the SDK (pyrealsense2, extra `realsense`).

    recording.bag, recording.db3   what realsense-viewer and rs-record write
    realsense:                     the camera that is connected; realsense:SERIAL where there are several

depth   Z16, in the depth units of the recording (mostly 1000 = 1 m), intrinsics of the depth stream
colour  RGB8, BGR8, RGBA8, BGRA8 or Y8, resampled to the pixels of the depth camera by intrinsics and extrinsics
time    that of the depth frame, in the clock of the recording [s]

Depth and colour that are at most 0.02 s apart make a frame; where there is a colour stream, depth for which no colour
comes is left out. Distortion is not corrected, with a warning: that of the depth of the D400 series is zero. Poses and
the motion sensor are not read.

Opening a recording plays it once, for the times. Frames are read forward; going back plays it again from the beginning.
Playback is not in real time, so that no frame is missed. A live camera gives the newest frame and drops what nobody had
the time for; it has no end but that of the run.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.datasets.color_registration import ColorToDepth
from scanweld.datasets.images import valid_depth
from scanweld.datasets.intrinsics import Overrides
from scanweld.datasets.layout import settle_camera, settle_depth_scale
from scanweld.datasets.recorded import RecordedSequence
from scanweld.errors import DatasetError, InvalidInputError, MissingDependencyError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.io.timestamps import MAX_TIME_DIFFERENCE_S

logger = logging.getLogger(__name__)

SUFFIXES = (".bag", ".db3")
LIVE = "realsense:"
"""What the name of a live camera begins with."""

_MARKS = (b"/file_version", b"/device_0/sensor_0")
_LOOKED_AT_BYTES = 1 << 18
_QUEUE = 32
"""Frames that are played ahead of whoever reads: some come between the starts of two sensors, whatever is said."""

_PATIENCE_MS, _CAMERA_PATIENCE_MS = 500, 5000


def recording(path: Path) -> Path | None:
    """Return the file that is a recording of the RealSense SDK: `path`, or the only bag in the folder.

    It is a bag of ROS with topics of its own.
    """
    bags = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())
    bags = [file for file in bags if file.suffix.lower() in SUFFIXES]
    if len(bags) != 1:
        return None
    with bags[0].open("rb") as stream:
        start = stream.read(_LOOKED_AT_BYTES)
    return bags[0] if any(mark in start for mark in _MARKS) else None


def is_realsense(path: Path) -> bool:
    """Whether this is a recording of the RealSense SDK, or a folder with one."""
    return recording(path) is not None


def open_realsense(path: Path, overrides: Overrides) -> RecordedSequence:
    """Open a recording.

    Raises
    ------
    DatasetError
        When it cannot be played, or has no depth.
    MissingDependencyError
        When pyrealsense2 is not installed: pip install 'scanweld[realsense]'.
    """
    path = recording(path) or path
    with _Playback(path) as playback:
        calibration, times_s = playback.calibration, [frameset.timestamp_s for frameset in playback]
    if not times_s:
        raise DatasetError(f"{path}: has no depth frame, or no colour frame within 0.02 s of one; is it truncated?")
    camera = settle_camera(
        path, calibration.depth_size, None, overrides, intrinsics=None, intrinsics_file=calibration.depth_intrinsics
    )
    scale = settle_depth_scale(path, calibration.units_per_metre, None, overrides)
    return RecordedSequence(
        name=path.stem,
        camera=camera,
        timestamps_s=np.array(times_s),
        frame_source=_RecordedFrames(path, times_s, _Decoder(calibration, camera, scale)),
        depth_scale=scale,
    )


class RealSenseCamera:
    """A camera that is connected, as a sequence without an end: a :class:`~scanweld.datasets.base.LiveSequence`.

    Parameters
    ----------
    serial : of the camera; "" for the only one
    max_frames : it ends after so many; None for never
    overrides : what the caller fixed
    file : play a recording in its own time instead, as if it were a camera

    Raises
    ------
    DatasetError
        When there is no such camera, or it has no depth.
    MissingDependencyError
        When pyrealsense2 is not installed: pip install 'scanweld[realsense]'.
    """

    ground_truth = None

    def __init__(
        self,
        serial: str = "",
        *,
        max_frames: int | None = None,
        overrides: Overrides | None = None,
        file: Path | None = None,
    ) -> None:
        overrides = overrides or Overrides()
        self.name = f"realsense-{serial}" if serial else "realsense"
        self._max_frames = max_frames
        self._times_s: list[float] = []
        self._playing = _Pipeline(serial, file)
        calibration, where = self._playing.calibration, Path(self.name)
        known = calibration.depth_intrinsics
        self.camera = settle_camera(
            where, calibration.depth_size, None, overrides, intrinsics=None, intrinsics_file=known
        )
        self.depth_scale = settle_depth_scale(where, calibration.units_per_metre, None, overrides)
        self._decode = _Decoder(calibration, self.camera, self.depth_scale)

    @property
    def timestamps_s(self) -> Float64:
        """Time of the frames so far (N,) [s]."""
        return np.array(self._times_s, np.float64)

    def __len__(self) -> int:
        return len(self._times_s)

    def live(self) -> Iterator[Frame]:
        """Yield the newest frame, again and again, until the camera is gone or :meth:`close` is called."""
        for frameset in self._playing:
            depth_m, color = self._decode(frameset)
            self._times_s.append(frameset.timestamp_s)
            yield Frame(frameset.timestamp_s, depth_m, color, self.camera)
            if self._max_frames is not None and len(self) >= self._max_frames:
                return

    __iter__ = live

    def read(self, index: int) -> Frame:
        """Raise UnreadableFrameError: frames of a camera are not kept."""
        raise UnreadableFrameError(f"{self.name}: frame {index} was not kept; record the camera to read frames again")

    def close(self) -> None:
        """Stop the camera."""
        self._playing.close()


def open_realsense_camera(name: str, overrides: Overrides, frames: str | slice | None, scale: float) -> RealSenseCamera:
    """Open the camera that "realsense:" or "realsense:SERIAL" names.

    Raises
    ------
    DatasetError
        When it cannot be had.
    InvalidInputError
        When other frames than the first N are asked for, or images of another size.
    """
    if scale != 1.0:
        raise InvalidInputError(f"scale: {scale:g} is for recordings; a live camera has the size that it is set to")
    wanted = frames.strip().removeprefix("0:").removeprefix(":") if isinstance(frames, str) else frames
    if wanted is not None and not (isinstance(wanted, str) and wanted.isdecimal() and int(wanted) > 0):
        raise InvalidInputError(f"frames: {frames} is for recordings; of a live camera :N takes the first N frames")
    return RealSenseCamera(
        name.removeprefix(LIVE), max_frames=None if wanted is None else int(wanted), overrides=overrides
    )


@dataclass(frozen=True, slots=True)
class _Calibration:
    """What a device says of its streams; colour is None where there is no colour stream."""

    depth_size: tuple[int, int]
    depth_intrinsics: tuple[float, float, float, float]
    color_camera: PinholeCamera | None
    T_color_depth: Float64
    units_per_metre: float


@dataclass(frozen=True, slots=True)
class _Frameset:
    """Depth (H, W) uint16 and colour of one moment, in memory of the SDK: valid while it is held."""

    timestamp_s: float
    depth: Any
    color: Any


class _Playback:
    """A recording that is played as fast as it is read, and no frame of it missed; iterating yields its framesets.

    The SDK's pipeline drops frames at the start and pairs them by arrival, so its sensors are used one by one.
    """

    def __init__(self, path: Path) -> None:
        rs = _sdk()
        self._queue = rs.frame_queue(_QUEUE, keep_frames=True)
        self._stopped = rs.playback_status.stopped
        self._depth_kind = rs.stream.depth
        self._sensors: list[Any] = []
        try:
            self._device = rs.context().load_device(str(path)).as_playback()
            self._device.set_real_time(False)
            chosen = [(sensor, _video_profiles(rs, sensor)) for sensor in self._device.query_sensors()]
            self.calibration = _calibration(rs, [p for _, some in chosen for p in some], self._device, str(path))
            for sensor, some in chosen:
                if some:
                    sensor.open(some)
                    self._sensors.append(sensor)
            self._device.pause()  # until all listen
            for sensor in self._sensors:
                sensor.start(self._queue)
            self._device.resume()
        except RuntimeError as error:
            raise DatasetError(f"{path}: the RealSense SDK cannot open it: {_first_line(error)}") from None

    def __enter__(self) -> _Playback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[_Frameset]:
        last_s = -np.inf
        has_color = self.calibration.color_camera is not None
        for depth, color in self._pairs() if has_color else ((depth, None) for depth in self._frames()):
            if _time_s(depth) > last_s:
                last_s = _time_s(depth)
                yield _Frameset(last_s, depth, color)

    def close(self) -> None:
        """Stop playing."""
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()
        self._sensors = []

    def _frames(self) -> Iterator[Any]:
        """Yield depth and colour frames as they come."""
        while self._sensors:
            came, frame = self._queue.try_wait_for_frame(_PATIENCE_MS)
            if came:
                yield frame
            elif self._device.current_status() == self._stopped:
                return

    def _pairs(self) -> Iterator[tuple[Any, Any]]:
        """Yield each depth frame with the colour frame next to it in time, if there is one."""
        depths: deque[Any] = deque()
        colors: deque[Any] = deque()
        for frame in self._frames():
            (depths if frame.get_profile().stream_type() == self._depth_kind else colors).append(frame)
            # Colour that is later than the depth, or is the last: nothing nearer can come.
            while depths and colors and _time_s(colors[-1]) >= _time_s(depths[0]):
                yield from _nearest(depths.popleft(), colors)
        while depths and colors:
            yield from _nearest(depths.popleft(), colors)


def _nearest(depth: Any, colors: deque[Any]) -> Iterator[tuple[Any, Any]]:
    """Yield a depth frame and the colour frame next to it, if near enough; earlier colour goes."""
    time_s = _time_s(depth)
    while len(colors) > 1 and abs(_time_s(colors[1]) - time_s) <= abs(_time_s(colors[0]) - time_s):
        colors.popleft()
    if abs(_time_s(colors[0]) - time_s) <= MAX_TIME_DIFFERENCE_S:
        yield depth, colors[0]


class _Pipeline:
    """A camera, or a recording in its own time, through the SDK's pipeline; iterating yields the newest frameset."""

    def __init__(self, serial: str, file: Path | None) -> None:
        rs = _sdk()
        name = str(file or (f"{LIVE}{serial}" if serial else "realsense"))
        try:
            self._pipeline, config = rs.pipeline(), rs.config()
            if file is not None:
                config.enable_device_from_file(str(file), repeat_playback=False)
            else:
                _require_camera(rs, serial, name)
                if serial:
                    config.enable_device(serial)
                config.enable_stream(rs.stream.depth, rs.format.z16)
                config.enable_stream(rs.stream.color, rs.format.rgb8)
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise DatasetError(f"{name}: the RealSense SDK cannot open it: {_first_line(error)}") from None
        self._running = True
        self._patience_ms = _CAMERA_PATIENCE_MS if file is None else _PATIENCE_MS
        try:
            self.calibration = _calibration(rs, profile.get_streams(), profile.get_device(), name)
        except (RuntimeError, DatasetError):
            self.close()
            raise

    def __iter__(self) -> Iterator[_Frameset]:
        last_s = -np.inf
        while self._running:
            came, frames = self._pipeline.try_wait_for_frames(self._patience_ms)
            if not came:
                return
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or _time_s(depth) <= last_s:
                continue
            if self.calibration.color_camera is None:
                color = None
            elif not color or abs(_time_s(color) - _time_s(depth)) > MAX_TIME_DIFFERENCE_S:
                continue
            last_s = _time_s(depth)
            yield _Frameset(last_s, depth, color)

    def close(self) -> None:
        """Stop the camera."""
        if self._running:
            self._running = False
            self._pipeline.stop()


class _Decoder:
    """Turns framesets into depth [m] and registered colour."""

    def __init__(self, calibration: _Calibration, camera: PinholeCamera, depth_scale: float) -> None:
        self._metres = np.float32(1 / depth_scale)
        color = calibration.color_camera
        self._register = None if color is None else ColorToDepth(color, camera, calibration.T_color_depth)

    def __call__(self, frameset: _Frameset) -> tuple[Float32, UInt8 | None]:
        raw = np.asanyarray(frameset.depth.get_data())
        depth_m = valid_depth(np.where(raw == 65535, 0, raw).astype(np.float32) * self._metres)
        if self._register is None:
            return depth_m, None
        return depth_m, self._register(_rgb(frameset.color), depth_m)


class _RecordedFrames:
    """Read frame i of a recording: forward as it is played, from the beginning again otherwise."""

    def __init__(self, path: Path, times_s: list[float], decode: _Decoder) -> None:
        self._path, self._times_s, self._decode = path, times_s, decode
        self._lock = threading.Lock()
        self._playback: _Playback | None = None
        self._framesets: Iterator[_Frameset] = iter(())
        self._next = 0

    def __call__(self, index: int) -> tuple[Float32, UInt8 | None]:
        with self._lock:
            if self._playback is None or index < self._next:
                self._restart()
            for frameset in self._framesets:
                self._next = int(np.searchsorted(self._times_s, frameset.timestamp_s)) + 1
                if frameset.timestamp_s == self._times_s[index]:
                    return self._decode(frameset)
                if frameset.timestamp_s > self._times_s[index]:
                    break
            raise UnreadableFrameError(f"{self._path}: frame {index} was not played again")

    def _restart(self) -> None:
        self.close()
        self._playback = _Playback(self._path)
        self._framesets, self._next = iter(self._playback), 0

    def close(self) -> None:
        """Stop playing."""
        if self._playback is not None:
            self._playback.close()
            self._playback = None

    def __del__(self) -> None:
        self.close()


def _sdk() -> Any:
    try:
        import pyrealsense2
    except ImportError:
        raise MissingDependencyError("pyrealsense2", "realsense") from None
    return pyrealsense2


def _video_profiles(rs: Any, sensor: Any) -> list[Any]:
    """The first depth and the first colour stream of a sensor, those that it has."""
    profiles = sensor.get_stream_profiles()
    return [p for kind in (rs.stream.depth, rs.stream.color) for p in profiles if p.stream_type() == kind][:2]


def _time_s(frame: Any) -> float:
    return float(frame.get_timestamp()) / 1000


def _calibration(rs: Any, profiles: list[Any], device: Any, name: str) -> _Calibration:
    """Return what the streams of a device say of themselves; raises DatasetError without depth."""
    streams = {profile.stream_type(): profile.as_video_stream_profile() for profile in profiles}
    depth, color = streams.get(rs.stream.depth), streams.get(rs.stream.color)
    if depth is None:
        raise DatasetError(f"{name}: has no depth stream")
    k = depth.get_intrinsics()
    _warn_of_distortion(k, "depth", name)
    color_camera, T_color_depth = None, np.eye(4)
    if color is not None:
        c = color.get_intrinsics()
        _warn_of_distortion(c, "colour", name)
        color_camera = PinholeCamera(c.fx, c.fy, c.ppx, c.ppy, c.width, c.height)
        moved = depth.get_extrinsics_to(color)
        T_color_depth[:3, :3] = np.reshape(moved.rotation, (3, 3)).T  # the SDK's is column by column
        T_color_depth[:3, 3] = moved.translation
    # The unit is kept as float32: 0.001 comes as 0.0010000000474974513.
    units_per_metre = float(f"{1 / device.first_depth_sensor().get_depth_scale():.6g}")
    return _Calibration((k.width, k.height), (k.fx, k.fy, k.ppx, k.ppy), color_camera, T_color_depth, units_per_metre)


def _warn_of_distortion(intrinsics: Any, what: str, name: str) -> None:
    if any(abs(c) > 1e-6 for c in intrinsics.coeffs):
        logger.warning("%s: the distortion of the %s camera is not corrected", name, what)


def _rgb(frame: Any) -> UInt8:
    """Return a colour frame as (H, W, 3) RGB."""
    kind = str(frame.get_profile().format()).removeprefix("format.")
    data: UInt8 = np.asanyarray(frame.get_data())
    if kind in ("rgb8", "rgba8"):
        return np.ascontiguousarray(data[..., :3])
    if kind in ("bgr8", "bgra8"):
        return np.ascontiguousarray(data[..., 2::-1])
    if kind == "y8":
        return np.repeat(data[..., None], 3, axis=2)
    raise UnreadableFrameError(f"colour of format {kind}; known are rgb8, bgr8, rgba8, bgra8 and y8")


def _require_camera(rs: Any, serial: str, name: str) -> None:
    """Raise DatasetError at once where a pipeline would wait for a camera that is not there."""
    there = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
    if not there or (serial and serial not in there):
        raise DatasetError(f"{name}: no such RealSense camera is connected; connected: {', '.join(there) or 'none'}")


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
