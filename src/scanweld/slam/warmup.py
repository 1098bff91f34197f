"""Compile the kernels of the SLAM loop once, and say so."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.mapping.mapper import SurfelMapper
from scanweld.mapping.rendering import render_picture
from scanweld.parallel import kernels_are_cached
from scanweld.tracking.tracker import FrameToModelTracker


def compile_kernels(report: Callable[[str], None]) -> bool:
    """Run every stage once on a tiny frame when no earlier process did; `report` is told what is being compiled.

    Returns whether anything was compiled.
    """
    if kernels_are_cached("slam"):
        return False
    camera = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48)
    depth = (1.0 + 0.2 * np.random.default_rng(0).random(camera.shape)).astype(np.float32)
    frame = Frame(0.0, depth, np.zeros((*camera.shape, 3), np.uint8), camera)
    pose = np.eye(4)
    report("surfaces of a frame (1 of 4)")
    pyramid = build_pyramid(frame)
    report("fusion (2 of 4)")
    mapper = SurfelMapper()
    mapper.fuse(pyramid, pose)
    report("alignment (3 of 4)")
    FrameToModelTracker().track(pyramid, mapper.view(pose, camera), pose)
    report("pictures (4 of 4)")
    render_picture(mapper.map, pose, camera)
    kernels_are_cached("slam", now=True)
    return True
