"""Compile the kernels of the SLAM loop once, in two processes, and say so."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np

from scanweld.datasets.png.kernels import unfilter
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.keyframes import KeyframeConfig
from scanweld.loop_closure.place_recognition import KeyframeDatabase, PlaceConfig
from scanweld.loop_closure.place_verification import VerificationConfig, relocalise
from scanweld.loop_closure.search import Edge, Query, close_loop, find_place
from scanweld.mapping.mapper import SurfelMapper
from scanweld.mapping.rendering import render_picture
from scanweld.parallel import kernels_are_cached
from scanweld.registration.robust_pairs import align_pairs_robustly
from scanweld.registration.verification import noise_directions
from scanweld.tracking.dynamics import MotionDetector
from scanweld.tracking.tracker import FrameToModelTracker


def compile_kernels(report: Callable[[str], None]) -> bool:
    """Run every stage once on a tiny frame when no earlier process did; `report` is told what is being compiled.

    About half of the kernels align pairs of points. They are compiled by a process beside this one, which finds them
    in the on-disk cache then: threads would take turns, as Numba compiles one function at a time.

    Returns whether anything was compiled.
    """
    if kernels_are_cached("slam"):
        return False
    with _beside("from scanweld.slam.warmup import compile_pairs; compile_pairs()") as wait:
        _compile_frames(report, wait)
    kernels_are_cached("slam", now=True)
    return True


def load_kernels() -> None:
    """Load the kernels of the SLAM loop from the cache, or compile them, before a run that has no time for that."""
    _compile_frames(lambda part: None, lambda: None)


def compile_pairs() -> None:
    """Compile what aligns pairs of points."""
    rng = np.random.default_rng(2)
    points = rng.random((40, 3))
    for noise in (0.0, 0.02):  # more than is allowed for: the largest consistent set has to be searched for
        align_pairs_robustly(points, points + 1.0 + rng.normal(0.0, noise, points.shape), np.full(len(points), 0.01))


@contextlib.contextmanager
def _beside(code: str) -> Iterator[Callable[[], object]]:
    """Run Python code in a process of its own meanwhile; what is yielded waits for it.

    Where there is no such process, or it fails, this one compiles what is missing when it gets there.
    """
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
    except (OSError, TypeError, ValueError):  # no interpreter to be started, as in a frozen program
        yield lambda: None
        return
    try:
        yield process.wait
    finally:
        process.kill()
        process.wait()


def _compile_frames(report: Callable[[str], None], wait: Callable[[], object]) -> None:
    """Compile what the walk of a frame takes; `wait` before what the process beside compiles is used."""
    camera = PinholeCamera(120.0, 120.0, 79.5, 59.5, 160, 120)  # large enough for image features
    depth = (1.0 + 0.2 * np.random.default_rng(0).random(camera.shape)).astype(np.float32)
    frame = Frame(0.0, depth, np.random.default_rng(1).integers(0, 256, (*camera.shape, 3), np.uint8), camera)
    pose = np.eye(4)
    report("surfaces of a frame (1 of 5)")
    unfilter(np.zeros((1, 3), np.uint8), 2, np.zeros((2, 4), np.uint8))
    pyramid = build_pyramid(frame)
    report("fusion (2 of 5)")
    mapper = SurfelMapper()
    for _ in range(2):  # into an empty map, and into one that has something to merge with
        mapper.fuse(pyramid, pose)
    mapper.map.clean(mapper.map.pages.live, 0, 1, 0.0)
    report("alignment (3 of 5)")
    view = mapper.view(pose, camera)
    FrameToModelTracker().track(pyramid, view, pose)
    noise_directions(view.positions_m, view.normals, pose, pyramid.levels[0], np.zeros(3), 1.0)  # on plain walls only
    detector = MotionDetector()
    detector.remember(pyramid, pose)
    nearer = build_pyramid(Frame(1.0, 0.5 * depth, frame.color, camera))
    detector.find(nearer, view, pose)
    report("pictures (4 of 5)")
    render_picture(mapper.map, pose, camera)
    behind, correction = se3.exp([0, 0, -0.1, 0, 0, 0]), se3.exp([0, 0, 0.09, 0, 0, 0])
    mapper.fuse(
        pyramid, behind, keyframe=20
    )  # a layer behind the other one, which a loop brings to within a centimetre
    mapper.apply(MapCorrection(np.array([20], np.int32), correction[None]))
    mapper.finish()
    mapper.view(behind, camera)
    report("places (5 of 5)")
    wait()
    database = KeyframeDatabase(PlaceConfig(keyframes=KeyframeConfig(min_usable=0.001)))
    for k, T_world_camera in enumerate((pose, pose, behind, behind)):
        database.add(database.sight(pyramid), T_world_camera, frame_index=k)
    relocalise(database.sight(pyramid), database)
    steps = [Edge(k, k + 1, pose, np.eye(6), False) for k in range(3)]
    known, surfaces = (database.keyframes, np.arange(4), steps), database.config.keyframes.surfaces
    find_place(Query(3, 0, [0], []), *known, surfaces, VerificationConfig())
    close_loop(Edge(0, 3, pose, np.eye(6), True), *known, surfaces)
