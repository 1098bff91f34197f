"""Faults that recordings have, made on purpose: `scanweld render --spoil`, and the tests of `scanweld check`.

A fault is made in what a sequence gives, rendered or recorded, or in the files of one that has been written, where no
reader lets it pass. What happens to a sound recording on its way is in :mod:`.scenarios`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.datasets.base import RgbdSequence, WrappedSequence
from scanweld.datasets.selection import SelectedSequence, select
from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.trajectory import Trajectory

WRONG_UNIT = 5.0
"""Depth comes out so many times too large: stored in the unit of TUM RGB-D, read in millimetres."""

WRONG_FOCAL = 1.3
ZOOM, SHIFT = 1.12, 0.025
"""A colour camera of its own has another field of view and sits beside the depth camera; the shift is of the width."""

LATE_FRAMES = 3
BLUR = 0.04
"""Length of the smear, as a share of the width."""

DIMMED = 0.6
FAST = 0.15
"""Share of the width by which pixels move from frame to frame."""

SEEN = 0.25
"""Share of each side of the image that keeps its depth."""


@dataclass(frozen=True, slots=True)
class SpoiledSequence(WrappedSequence):
    """The frames of `base` with something wrong about them; what is None is as in `base`.

    Attributes
    ----------
    source : (sequence, index) -> the frame that is shown as number `index`
    lens : intrinsics that are claimed
    units : units per metre that are claimed
    times_s : (N,), time stamps that are claimed
    poses : the truth that is claimed
    """

    source: Callable[[RgbdSequence, int], Frame] | None = None
    lens: PinholeCamera | None = None
    units: float | None = None
    times_s: Float64 | None = None
    poses: Trajectory | None = None

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics as claimed."""
        return self.lens or self.base.camera

    @property
    def depth_scale(self) -> float:
        """Units per metre as claimed."""
        return self.units or self.base.depth_scale

    @property
    def ground_truth(self) -> Trajectory | None:
        """Poses as claimed."""
        return self.poses or self.base.ground_truth

    @property
    def timestamps_s(self) -> Float64:
        """Times as claimed."""
        return self.base.timestamps_s if self.times_s is None else self.times_s

    def read(self, index: int) -> Frame:
        """Read the frame that is shown as number `index`."""
        frame = self.base.read(index) if self.source is None else self.source(self.base, index)
        factor = np.float32(self.base.depth_scale / self.depth_scale)
        return Frame(float(self.timestamps_s[index]), frame.depth_m * factor, frame.color, self.camera)


@dataclass(frozen=True, slots=True)
class Spoil:
    """A fault, in words, and how it is made: in a sequence, or in the folder that one was written to."""

    what: str
    sequence: Callable[[RgbdSequence], RgbdSequence] | None = None
    folder: Callable[[Path], None] | None = None


def spoil(sequence: RgbdSequence, fault: str) -> RgbdSequence:
    """Return a sequence, rendered or recorded, with a fault.

    Raises
    ------
    ConfigError
        When the fault is unknown, or can be made in files only.
    """
    change = find_spoil(fault).sequence
    if change is None:
        raise ConfigError(f"spoil = '{fault}': only written sequences can have it; use render_sequence(..., spoil=...)")
    return change(sequence)


def find_spoil(fault: str) -> Spoil:
    """Return what makes a fault; raises ConfigError when there is none of that name."""
    if fault not in SPOILS:
        raise ConfigError(f"spoil = '{fault}': expected one of {', '.join(SPOILS)}")
    return SPOILS[fault]


def _wrong_unit(sequence: RgbdSequence) -> RgbdSequence:
    return SpoiledSequence(sequence, units=sequence.depth_scale / WRONG_UNIT)


def _wrong_intrinsics(sequence: RgbdSequence) -> RgbdSequence:
    camera = sequence.camera
    return SpoiledSequence(sequence, lens=replace(camera, fx=camera.fx * WRONG_FOCAL, fy=camera.fy * WRONG_FOCAL))


def _unregistered(sequence: RgbdSequence) -> RgbdSequence:
    camera = sequence.camera
    centre = (np.array([camera.width, camera.height]) - 1) / 2
    shift = (1 - ZOOM) * centre + [SHIFT * camera.width, 0]

    def aside(color: UInt8) -> UInt8:
        import cv2

        matrix = np.column_stack([ZOOM * np.eye(2), shift])
        return np.asarray(cv2.warpAffine(color, matrix, color.shape[1::-1], borderMode=cv2.BORDER_REPLICATE), np.uint8)

    return _with_color(sequence, aside)


def _with_color(sequence: RgbdSequence, change: Callable[[UInt8], UInt8]) -> RgbdSequence:
    def source(base: RgbdSequence, index: int) -> Frame:
        frame = base.read(index)
        return frame if frame.color is None else replace(frame, color=change(frame.color))

    return SpoiledSequence(sequence, source)


def _unsynchronised(sequence: RgbdSequence) -> RgbdSequence:
    def source(base: RgbdSequence, index: int) -> Frame:
        return replace(base.read(index), color=sequence.read(index).color)

    return SpoiledSequence(select(sequence, slice(LATE_FRAMES, None)), source)


def _truth(change: Callable[[Float64], Float64]) -> Callable[[RgbdSequence], RgbdSequence]:
    def spoiled(sequence: RgbdSequence) -> RgbdSequence:
        truth = sequence.ground_truth
        if truth is None:
            raise ConfigError(f"{sequence.name}: it has no ground truth that could be spoiled")
        return SpoiledSequence(sequence, poses=Trajectory(truth.timestamps_s, change(truth.T_world_camera)))

    return spoiled


def _in_millimetres(T: Float64) -> Float64:
    scaled = T.copy()
    scaled[:, :3, 3] *= 1000.0
    return scaled


def _retimed(sequence: RgbdSequence, factor: float) -> RgbdSequence:
    truth = sequence.ground_truth
    poses = None if truth is None else Trajectory(truth.timestamps_s * factor, truth.T_world_camera)
    return SpoiledSequence(sequence, times_s=sequence.timestamps_s * factor, poses=poses)


def _with_a_gap(sequence: RgbdSequence) -> RgbdSequence:
    count = len(sequence)
    start, stop = count // 2, count // 2 + max(12, count // 20)
    return SelectedSequence(sequence, [*range(start), *range(stop, count)])


def _repeated(sequence: RgbdSequence) -> RgbdSequence:
    return SpoiledSequence(sequence, lambda base, index: base.read(index - 1 if index % 3 == 2 else index))


def _frozen(sequence: RgbdSequence) -> RgbdSequence:
    start, stop = 5 * len(sequence) // 12, 7 * len(sequence) // 12
    return SpoiledSequence(sequence, lambda base, index: base.read(start if start <= index < stop else index))


def _little_depth(sequence: RgbdSequence) -> RgbdSequence:
    def source(base: RgbdSequence, index: int) -> Frame:
        frame = base.read(index)
        kept: Float32 = np.zeros_like(frame.depth_m)
        rows, columns = (slice(round(n * (1 - SEEN) / 2), round(n * (1 + SEEN) / 2)) for n in kept.shape)
        kept[rows, columns] = frame.depth_m[rows, columns]
        return replace(frame, depth_m=kept)

    return SpoiledSequence(sequence, source)


def _blurred(sequence: RgbdSequence) -> RgbdSequence:
    length = max(3, round(BLUR * sequence.camera.width))

    def smear(color: UInt8) -> UInt8:
        import cv2

        return np.asarray(cv2.blur(color, (length, 1)), np.uint8)

    return _with_color(sequence, smear)


def _hunting(sequence: RgbdSequence) -> RgbdSequence:
    def source(base: RgbdSequence, index: int) -> Frame:
        frame = base.read(index)
        if frame.color is None or index // 4 % 2 == 0:
            return frame
        return replace(frame, color=np.rint(DIMMED * frame.color).astype(np.uint8))

    return SpoiledSequence(sequence, source)


def _hurried(sequence: RgbdSequence) -> RgbdSequence:
    """Leave out so many frames that the others have little in common, and keep the rate."""
    truth = sequence.ground_truth
    if truth is None:
        raise ConfigError(f"{sequence.name}: it has no ground truth that tells how fast it is")
    camera, depth_m = sequence.camera, sequence.read(0).depth_m
    grid = camera.rays()[camera.height // 8 :: camera.height // 4, camera.width // 8 :: camera.width // 4]
    points = (float(np.median(depth_m[depth_m > 0])) * grid).reshape(-1, 3)
    nearest = np.clip(np.searchsorted(truth.timestamps_s, sequence.timestamps_s), 0, len(truth) - 1)
    T = truth.T_world_camera[nearest]
    for times in range(2, len(sequence) // 2):
        M = se3.inverse(T[times:]) @ T[:-times]
        moved = points @ np.swapaxes(M[:, :3, :3], 1, 2) + M[:, None, :3, 3]
        shift = (moved[..., :2] / np.maximum(moved[..., 2:], 0.1) - points[:, :2] / points[:, 2:]) * camera.fx
        if np.median(np.linalg.norm(shift, axis=-1)) >= FAST * camera.width:
            return _retimed(select(sequence, slice(None, None, times)), 1 / times)
    raise ConfigError(f"{sequence.name}: its {len(sequence)} frames are too few for a fast motion")


def _swap_folders(folder: Path) -> None:
    (folder / "rgb").rename(folder / "aside")
    (folder / "depth").rename(folder / "rgb")
    (folder / "aside").rename(folder / "depth")


def _negate_fy(folder: Path) -> None:
    values = json.loads((folder / "camera.json").read_text(encoding="ascii"))
    values["fy"] = -values["fy"]
    (folder / "camera.json").write_text(json.dumps(values, indent=2) + "\n", encoding="ascii")


def _repeat_a_time(folder: Path) -> None:
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text(encoding="ascii").splitlines()
        middle = len(lines) // 2
        lines[middle] = f"{lines[middle - 1].split()[0]} {lines[middle].split()[1]}"
        (folder / name).write_text("\n".join(lines) + "\n", encoding="ascii")


SPOILS = {
    "depth-unit": Spoil("depth read in another unit, five times too large", _wrong_unit),
    "intrinsics": Spoil("intrinsics of another lens, 30 % too long", _wrong_intrinsics),
    "negative-fy": Spoil("a negative fy in camera.json", folder=_negate_fy),
    "swapped": Spoil("colour and depth swapped", folder=_swap_folders),
    "unregistered": Spoil("colour as its own camera sees it, not as the depth camera does", _unregistered),
    "unsynchronised": Spoil("colour three frames late", _unsynchronised),
    "truth-inverted": Spoil("ground truth from world to camera", _truth(se3.inverse)),
    "truth-unit": Spoil("ground truth in millimetres", _truth(_in_millimetres)),
    "time-unit": Spoil("all times in milliseconds", lambda sequence: _retimed(sequence, 1000.0)),
    "time-order": Spoil("a time stamp twice", folder=_repeat_a_time),
    "gaps": Spoil("twelve frames or more missing in the middle", _with_a_gap),
    "duplicates": Spoil("every third frame a copy of the one before", _repeated),
    "frozen": Spoil("one picture for a sixth of the recording", _frozen),
    "little-depth": Spoil("depth in a small part of the image only", _little_depth),
    "motion-blur": Spoil("colour smeared over 4 % of the width", _blurred),
    "exposure": Spoil("brightness that jumps by 40 % every fourth frame", _hunting),
    "fast-motion": Spoil("so fast that from frame to frame pixels move by 15 % of the width", _hurried),
}
"""Every fault by name, as `scanweld check` names it."""
