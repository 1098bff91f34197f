"""A recording that the RealSense SDK writes itself, of a camera that is made of software.

`python tests/realsense_recording.py FILE.bag` writes tests/recorded/realsense.bag anew; SDKs from 2.57 on write .db3
only, and read both.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT = 160, 120
COUNT = 6
FIRST_MS, STEP_MS = 5000.0, 1000 / 30
FX_DEPTH, FX_COLOR = 120.0, 130.0
CX, CY = 79.5, 59.5
TURN_RAD, SHIFT_M = np.radians(2.0), 0.015
RED, BLUE = (200, 30, 40), (20, 60, 210)


def depth_of(k: int) -> np.ndarray:
    """Depth of frame k [mm]: a wall that comes nearer, with a hole in its upper left corner."""
    depth = np.full((HEIGHT, WIDTH), 1500 - 10 * k, np.uint16)
    depth[:10, :20] = 0
    return depth


def color_of() -> np.ndarray:
    """Red on the left, blue on the right; the border is at CX."""
    color = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    color[:, : WIDTH // 2], color[:, WIDTH // 2 :] = RED, BLUE
    return color


def record(folder: Path) -> Path:
    """Write a recording in whichever format the SDK writes, and return its path."""
    import pyrealsense2 as rs

    try:
        return _record(rs, folder / "made.bag")
    except RuntimeError:  # Output file must have .db3 extension
        return _record(rs, folder / "made.db3")


def _record(rs: Any, path: Path) -> Path:
    device = rs.software_device()
    depth_sensor, color_sensor = device.add_sensor("Depth"), device.add_sensor("Color")
    depth = depth_sensor.add_video_stream(_stream(rs, rs.stream.depth, 0, rs.format.z16, 2, FX_DEPTH))
    color = color_sensor.add_video_stream(_stream(rs, rs.stream.color, 1, rs.format.rgb8, 3, FX_COLOR))
    depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
    R = np.array([[np.cos(TURN_RAD), 0, np.sin(TURN_RAD)], [0, 1, 0], [-np.sin(TURN_RAD), 0, np.cos(TURN_RAD)]])
    moved = rs.extrinsics()
    moved.rotation, moved.translation = R.flatten("F").tolist(), [SHIFT_M, 0.0, 0.0]  # column by column
    depth.register_extrinsics_to(color, moved)
    recorder = rs.recorder(str(path), device)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(rs.frame_queue(2 * COUNT, True))
    for k in range(COUNT):
        for sensor, profile, image in ((depth_sensor, depth, depth_of(k)), (color_sensor, color, color_of())):
            sensor.on_video_frame(_frame(rs, profile, image, k))
        time.sleep(0.02)  # the recorder writes on a thread of its own
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    recorder.pause()
    return path


def _stream(rs: Any, kind: Any, uid: int, form: Any, num_bytes: int, focal: float) -> Any:
    k = rs.intrinsics()
    k.width, k.height, k.fx, k.fy, k.ppx, k.ppy = WIDTH, HEIGHT, focal, focal, CX, CY
    k.model, k.coeffs = rs.distortion.none, [0.0] * 5
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid, stream.fps, stream.fmt, stream.bpp = kind, 0, uid, 30, form, num_bytes
    stream.width, stream.height, stream.intrinsics = WIDTH, HEIGHT, k
    return stream


def _frame(rs: Any, profile: Any, image: np.ndarray, k: int) -> Any:
    frame = rs.software_video_frame()
    frame.pixels, frame.bpp, frame.stride = image, image.itemsize * image[0, 0].size, image.strides[0]
    frame.timestamp, frame.domain, frame.frame_number = FIRST_MS + k * STEP_MS, rs.timestamp_domain.hardware_clock, k
    frame.profile = profile.as_video_stream_profile()
    if image.ndim == 2 and hasattr(frame, "depth_units"):  # later than 2.54
        frame.depth_units = 0.001
    return frame


if __name__ == "__main__":
    import pyrealsense2

    _record(pyrealsense2, Path(sys.argv[1]))
