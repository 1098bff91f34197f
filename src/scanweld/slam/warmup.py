"""Compile the kernels of the SLAM loop once, and say so."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.loop_closure.keyframes import KeyframeConfig
from scanweld.loop_closure.place_recognition import KeyframeDatabase, PlaceConfig
from scanweld.loop_closure.place_verification import relocalise
from scanweld.mapping.mapper import SurfelMapper
from scanweld.mapping.rendering import render_picture
from scanweld.parallel import kernels_are_cached
from scanweld.tracking.dynamics import MotionDetector
from scanweld.tracking.tracker import FrameToModelTracker


def compile_kernels(report: Callable[[str], None]) -> bool:
    """Run every stage once on a tiny frame when no earlier process did; `report` is told what is being compiled.

    Returns whether anything was compiled.
    """
    if kernels_are_cached("slam"):
        return False
    camera = PinholeCamera(120.0, 120.0, 79.5, 59.5, 160, 120)  # large enough for image features
    depth = (1.0 + 0.2 * np.random.default_rng(0).random(camera.shape)).astype(np.float32)
    frame = Frame(0.0, depth, np.random.default_rng(1).integers(0, 256, (*camera.shape, 3), np.uint8), camera)
    pose = np.eye(4)
    report("surfaces of a frame (1 of 5)")
    pyramid = build_pyramid(frame)
    report("fusion (2 of 5)")
    mapper = SurfelMapper()
    mapper.fuse(pyramid, pose)
    report("alignment (3 of 5)")
    FrameToModelTracker().track(pyramid, mapper.view(pose, camera), pose)
    detector = MotionDetector()
    detector.remember(pyramid, pose)
    nearer = build_pyramid(Frame(1.0, 0.5 * depth, frame.color, camera))
    detector.find(nearer, mapper.view(pose, camera), pose)
    report("places (4 of 5)")
    database = KeyframeDatabase(PlaceConfig(keyframes=KeyframeConfig(min_usable=0.001)))
    database.add(database.sight(pyramid), pose, frame_index=0)
    relocalise(database.sight(pyramid), database)
    report("pictures (5 of 5)")
    render_picture(mapper.map, pose, camera)
    kernels_are_cached("slam", now=True)
    return True
