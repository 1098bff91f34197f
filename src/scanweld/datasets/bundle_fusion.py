"""BundleFusion's folders: the files of 7-Scenes with a description of the cameras.

    info.txt (or _info.txt)    `key = value` a line, keys below
    frame-000000.color.jpg (or .png)   frame-000000.depth.png   frame-000000.pose.txt

    m_colorWidth, m_colorHeight, m_depthWidth, m_depthHeight
    m_depthShift                       units per metre of the depth, 1000
    m_calibrationColorIntrinsic, m_calibrationDepthIntrinsic    4x4, row by row
    m_calibrationDepthExtrinsic        4x4: from the depth camera to the colour camera; the identity where absent

Depth: 16 bits, 0 and 65535 invalid. A pose is a 4x4 T_world_camera [m]; one that is not finite is left out of the
ground truth. Frame n is at n / 30 s. Colour of another camera than the depth's is resampled to the pixels of the depth
(:class:`~scanweld.datasets.color_registration.ColorToDepth`). camera.json wins; it describes the depth images.

BundleFusion's `.sens` files are those of ScanNet: see :mod:`scanweld.datasets.scannet`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8, as_transform
from scanweld.datasets.base import FrameFiles
from scanweld.datasets.color_registration import ColorToDepth
from scanweld.datasets.images import MAX_PIXELS, read_color, read_depth_png, require_depth_scale
from scanweld.datasets.intrinsics import Overrides, make_camera, read_camera_file, read_text
from scanweld.datasets.layout import first_existing, pair_by_number, settle_camera, settle_depth_scale
from scanweld.datasets.recorded import RecordedSequence, require_a_readable_frame
from scanweld.datasets.seven_scenes import frame_files, frame_poses
from scanweld.errors import DatasetError, InvalidInputError

_INFO_FILES = ("info.txt", "_info.txt")


def is_bundle_fusion(folder: Path) -> bool:
    """Whether the folder has info.txt and files named as 7-Scenes names them."""
    return first_existing(folder, _INFO_FILES) is not None and bool(frame_files(folder, "depth"))


def open_bundle_fusion(folder: Path, overrides: Overrides) -> RecordedSequence:
    """Open a folder of BundleFusion; raises DatasetError when it cannot be used."""
    info = _Info(first_existing(folder, _INFO_FILES) or folder / _INFO_FILES[0])
    pairs = list(pair_by_number(folder, frame_files(folder, "depth"), frame_files(folder, "color")).values())
    given = read_camera_file(folder)
    color_size, depth_size = info.size("color"), info.size("depth")
    color_intrinsics, depth_intrinsics = (info.matrix(f"m_calibration{kind}Intrinsic") for kind in ("Color", "Depth"))
    color_camera = make_camera(_pinhole(color_intrinsics), *color_size, f"{info.path}: colour")
    camera = settle_camera(
        folder, depth_size, given, overrides, intrinsics=None, intrinsics_file=_pinhole(depth_intrinsics)
    )
    stated_scale = require_depth_scale(info.number("m_depthShift"), str(info.path))
    scale = settle_depth_scale(folder, stated_scale, given, overrides)
    registration = ColorToDepth(color_camera, camera, info.extrinsics())
    return require_a_readable_frame(
        RecordedSequence(
            name=folder.resolve().name or "sequence",
            camera=camera,
            timestamps_s=np.array([files.timestamp_s for files in pairs]),
            frame_source=_PairedFiles(pairs, camera.shape, scale, registration),
            depth_scale=scale,
            ground_truth=frame_poses(folder),
        )
    )


class _PairedFiles:
    """Read frame i of a list of files, colour registered to the depth."""

    def __init__(
        self, frames: list[FrameFiles], shape: tuple[int, int], depth_scale: float, registration: ColorToDepth
    ) -> None:
        self._frames, self._shape = frames, shape
        self._depth_scale, self._registration = depth_scale, registration

    def __call__(self, index: int) -> tuple[Float32, UInt8 | None]:
        files = self._frames[index]
        depth_m = read_depth_png(files.depth, self._shape, self._depth_scale)
        if files.color is None:
            return depth_m, None
        return depth_m, self._registration(read_color(files.color, self._registration.color_shape), depth_m)


class _Info:
    """The values of info.txt."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = (line.partition("=") for line in read_text(path).splitlines())
        self._values = {key.strip(): value.split() for key, equals, value in lines if equals}

    def number(self, key: str) -> float:
        return float(self._numbers(key, 1)[0])

    def size(self, kind: str) -> tuple[int, int]:
        width, height = self.number(f"m_{kind}Width"), self.number(f"m_{kind}Height")
        if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS):
            raise DatasetError(f"{self.path}: says that {kind} has {width:g}x{height:g} pixels")
        return int(width), int(height)

    def matrix(self, key: str) -> Float64:
        return self._numbers(key, 16).reshape(4, 4)

    def extrinsics(self) -> Float64 | None:
        """T_color_depth."""
        key = "m_calibrationDepthExtrinsic"
        if key not in self._values:
            return None
        try:
            return as_transform(self.matrix(key), key)
        except InvalidInputError as error:
            raise DatasetError(f"{self.path}: {error}") from None

    def _numbers(self, key: str, count: int) -> Float64:
        words = self._values.get(key)
        if words is None:
            raise DatasetError(f"{self.path}: has no line '{key} = ...'")
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError:
            numbers = np.empty(0)
        if len(numbers) != count or not np.isfinite(numbers).all():
            raise DatasetError(f"{self.path}: '{key}' must be {count} number{'s' * (count > 1)}")
        return numbers


def _pinhole(matrix: Float64) -> tuple[float, float, float, float]:
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
