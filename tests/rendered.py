"""Rendered frames in memory, shared by the tests: 160x120, each sequence is rendered once a session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

import scanweld as sw
from scanweld.errors import UnreadableFrameError

CAMERA = sw.PinholeCamera(131.25, 131.25, 79.5, 59.5, 160, 120)


@dataclass(frozen=True)
class MemorySequence:
    """Frames that were read before; None stands for one that cannot be decoded."""

    name: str
    camera: sw.PinholeCamera
    frames: tuple[sw.Frame | None, ...]
    timestamps_s: np.ndarray
    ground_truth: sw.Trajectory | None
    depth_scale: float = 5000.0

    def __len__(self) -> int:
        return len(self.frames)

    def read(self, index: int) -> sw.Frame:
        frame = self.frames[index]
        if frame is None:
            raise UnreadableFrameError(f"frame {index} is damaged")
        return frame

    def __iter__(self) -> Iterator[sw.Frame]:
        return (frame for frame in self.frames if frame is not None)

    def part(self, start: int, stop: int) -> MemorySequence:
        return replace(self, frames=self.frames[start:stop], timestamps_s=self.timestamps_s[start:stop])

    def with_frames(self, changes: dict[int, sw.Frame | None]) -> MemorySequence:
        return replace(self, frames=tuple(changes.get(i, frame) for i, frame in enumerate(self.frames)))


@lru_cache(maxsize=8)
def rendered(scene: str = "room", noise: str = "none", count: int = 40, path: str = "") -> MemorySequence:
    """The first `count` frames of a built-in path at 30 Hz."""
    size = {"width": CAMERA.width, "height": CAMERA.height}
    config = sw.RenderConfig(scene=scene, noise=noise, frames=count, path=path, **size)
    sequence = sw.SyntheticSequence(config)
    assert sequence.camera == CAMERA
    frames = tuple(sequence.read(i) for i in range(count))
    return MemorySequence(sequence.name, CAMERA, frames, sequence.timestamps_s, sequence.ground_truth)


def plane_depth(normal: object, distance_m: float, camera: sw.PinholeCamera = CAMERA) -> np.ndarray:
    """Depth of the plane {x : n . x = d} in front of the camera, n its unit normal pointing away."""
    n = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    return (distance_m / (camera.rays() @ n)).astype(np.float32)


def frame_of(depth_m: np.ndarray, timestamp_s: float = 0.0, camera: sw.PinholeCamera = CAMERA) -> sw.Frame:
    """A grey frame."""
    return sw.Frame(timestamp_s, np.asarray(depth_m, np.float32), np.full((*camera.shape, 3), 90, np.uint8), camera)


def blind(frame: sw.Frame) -> sw.Frame:
    """The same moment without any valid depth, as with a hand before the sensor."""
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def pose_error(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Translation [m] and rotation [degrees] between two poses."""
    difference = np.linalg.inv(T_true) @ T
    cosine = np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(np.arccos(cosine)))


def write_tum_folder(folder: Path, sequence: MemorySequence, *, depth_scale: float = 5000.0) -> Path:
    """Write a sequence in the layout of TUM RGB-D; frame k has the files depth/k.png and rgb/k.png."""
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    for k, frame in enumerate(sequence.frames):
        assert frame is not None
        units = np.rint(frame.depth_m * depth_scale).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"depth/{k:03d}.png"), units)
        assert cv2.imwrite(str(folder / f"rgb/{k:03d}.png"), np.ascontiguousarray(frame.color[..., ::-1]))
    times = [f"{time:.6f}" for time in sequence.timestamps_s]
    for kind in ("depth", "rgb"):
        lines = [f"{time} {kind}/{k:03d}.png" for k, time in enumerate(times)]
        (folder / f"{kind}.txt").write_text("\n".join(["# list", *lines]) + "\n")
    c = sequence.camera
    (folder / "camera.json").write_text(
        f'{{"fx": {c.fx}, "fy": {c.fy}, "cx": {c.cx}, "cy": {c.cy}, "width": {c.width}, "height": {c.height}, '
        '"depth_scale": 5000}'
    )
    if sequence.ground_truth is not None:
        sw.write_tum(folder / "groundtruth.txt", sequence.ground_truth)
    return folder
