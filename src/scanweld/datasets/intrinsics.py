"""Which intrinsics and depth unit a sequence has, and who decides: the caller, camera.json, the format."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanweld.errors import DatasetError, InvalidInputError
from scanweld.geometry.camera import PinholeCamera

logger = logging.getLogger(__name__)

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels."""

CAMERA_FILE = "camera.json"

MAX_TEXT_BYTES = 1 << 26
"""Largest description of a camera or a recording that is read."""

PLAUSIBLE_FOCAL = (0.2, 5.0)
"""Focal length of a depth camera as a multiple of the image width: 136 to 11 degrees across."""


_LARGEST = 1e300  # integers of JSON have any size
_ABSURD_FOCAL = (1e-3, 1e7)  # no camera in pixels; computing with it overflows


@dataclass(frozen=True, slots=True)
class CameraFile:
    """What camera.json says; None where it does not say it."""

    intrinsics: Intrinsics
    size: tuple[int, int] | None  # width, height
    depth_scale: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Overrides:
    """What the caller fixed; None leaves it to camera.json and the format.

    Attributes
    ----------
    camera : intrinsics of the images as they are on disk, with or without their size
    depth_scale : units per metre of the depth images
    topics : of a ROS bag, by "depth", "color" and "camera_info"
    """

    camera: PinholeCamera | Intrinsics | None = None
    depth_scale: float | None = None
    topics: Mapping[str, str] = field(default_factory=dict)


def parse_intrinsics(text: str) -> Intrinsics:
    """Turn "FX,FY,CX,CY" into four numbers.

    Raises
    ------
    InvalidInputError
        When the text is not four numbers.
    """
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise InvalidInputError(
            f"camera: expected FX,FY,CX,CY, for example 525,525,319.5,239.5, got '{text}'"
        ) from None
    return fx, fy, cx, cy


def make_camera(intrinsics: Intrinsics, width: int, height: int, where: str) -> PinholeCamera:
    """Return the camera of images of the given size.

    A negative fy (ICL-NUIM prints -480) describes a y axis that points up; the images are upright all the
    same, so it is taken as positive.

    Raises
    ------
    DatasetError
        When the intrinsics are not finite or not positive.
    """
    fx, fy, cx, cy = intrinsics
    if fy < 0:
        logger.warning(
            "%s: fy = %g is taken as %g (the camera's y axis points down)",
            where,
            fy,
            -fy,
            extra={"fault": "negative-fy"},
        )
        fy = -fy
    if all(map(math.isfinite, intrinsics)) and not (
        min(fx, fy) <= 0 or (_ABSURD_FOCAL[0] < min(fx, fy) and max(fx, fy, abs(cx), abs(cy)) < _ABSURD_FOCAL[1])
    ):
        raise DatasetError(f"{where}: {fx:g} {fy:g} {cx:g} {cy:g} are no intrinsics, fx fy cx cy in pixels")
    try:
        return PinholeCamera(fx, fy, cx, cy, width, height)
    except InvalidInputError as error:
        raise DatasetError(f"{where}: {str(error).removeprefix('camera: ')}") from None


def doubt_camera(camera: PinholeCamera) -> str | None:
    """Say in one line what is unlikely about a camera of images of its size, or return None."""
    doubts = []
    if not (-0.5 <= camera.cx < camera.width - 0.5 and -0.5 <= camera.cy < camera.height - 0.5):
        doubts.append(f"the principal point {camera.cx:g}, {camera.cy:g} lies outside the image")
    low, high = PLAUSIBLE_FOCAL
    doubts += [
        f"{name} = {focal:g} is {focal / camera.width:.3g} times the image width ({low:g} to {high:g} is usual)"
        for name, focal in (("fx", camera.fx), ("fy", camera.fy))
        if not low <= focal / camera.width <= high
    ]
    if not doubts:
        return None
    return (
        f"{' and '.join(doubts)}; the images are {camera.width}x{camera.height}: "
        "are these the intrinsics of the images on disk, as fx, fy, cx, cy in pixels?"
    )


def scaled_default(intrinsics: Intrinsics, width: int, height: int) -> Intrinsics:
    """Scale intrinsics of 640x480 images to another size, pixel centres as in `PinholeCamera.scaled`."""
    return resized_intrinsics(intrinsics, (640, 480), (width, height))


def resized_intrinsics(intrinsics: Intrinsics, size: tuple[int, int], new_size: tuple[int, int]) -> Intrinsics:
    """Return the intrinsics of an image of `size` (width, height) after it was resized; as `PinholeCamera.scaled`."""
    fx, fy, cx, cy = intrinsics
    sx, sy = new_size[0] / size[0], new_size[1] / size[1]
    return fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5


def read_camera_file(folder: Path) -> CameraFile | None:
    """Read `camera.json` of a sequence folder: fx, fy, cx, cy and optionally width, height, depth_scale.

    Returns None when there is none.

    Raises
    ------
    DatasetError
        When it is not JSON, or a value is missing or not a positive number.
    """
    path = folder / CAMERA_FILE
    if not path.is_file():
        return None
    values = read_json(path)
    fx, fy, cx, cy = (require_number(path, values, key) for key in ("fx", "fy", "cx", "cy"))
    size = None
    if "width" in values or "height" in values:
        size = int(require_number(path, values, "width")), int(require_number(path, values, "height"))
    depth_scale = require_number(path, values, "depth_scale") if "depth_scale" in values else None
    return CameraFile((fx, fy, cx, cy), size, depth_scale)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises
    ------
    DatasetError
        When it cannot be read, is no JSON, or holds something else.
    """
    return parse_json(read_text(path), path)


def parse_json(text: str | bytes, where: Path | str) -> dict[str, Any]:
    """Parse the text of a JSON object as `read_json` does; `where` names it in errors."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{where}: not a readable JSON file: {error}") from None
    if not isinstance(values, dict):
        raise DatasetError(f"{where}: expected a JSON object, got {type(values).__name__}")
    return values


def read_text(path: Path) -> str:
    """Read a small text file.

    Raises
    ------
    DatasetError
        When it is missing, no text in UTF-8, or larger than ``MAX_TEXT_BYTES``.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_TEXT_BYTES + 1)
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: no text in UTF-8 (byte {error.start})") from None
    if len(data) > MAX_TEXT_BYTES:
        raise DatasetError(f"{path}: larger than {MAX_TEXT_BYTES >> 20} MB, no description of a recording")
    return text


def require_number(path: Path | str, values: Mapping[str, Any], key: str) -> float:
    """Return a finite number of a JSON object; raises DatasetError when it is missing or something else."""
    value = values.get(key)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) <= _LARGEST:
        raise DatasetError(f"{path}: '{key}' must be a number, got {value!r}")
    return float(value)


def read_intrinsics_matrix(path: Path) -> Intrinsics:
    """Read a text file with a 3x3 matrix K as fx, fy, cx, cy.

    Raises
    ------
    DatasetError
        When the file does not hold an upper triangular 3x3 matrix ending in 0 0 1.
    """
    try:
        text = path.read_text(encoding="utf-8")
        rows = [[float(word) for word in line.replace(",", " ").split()] for line in text.splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable 3x3 matrix: {error}") from None
    if [len(row) for row in rows] != [3, 3, 3] or rows[2] != [0, 0, 1] or rows[1][0] != 0:
        raise DatasetError(f"{path}: expected the 3x3 matrix (fx 0 cx) (0 fy cy) (0 0 1)")
    if abs(rows[0][1]) > 1e-6 * abs(rows[0][0]):
        logger.warning("%s: the skew %g is ignored", path, rows[0][1])
    return rows[0][0], rows[1][1], rows[0][2], rows[1][2]
