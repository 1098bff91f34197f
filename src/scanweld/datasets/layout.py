"""Steps that the formats share: list a folder, pair by number, turn lists of files into a sequence."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from scanweld.datasets.base import DepthReader, FileSequence, FrameFiles, no_readable_frame
from scanweld.datasets.images import (
    ImageHeader,
    compare_depth_units,
    depth_header_fault,
    read_depth_png,
    read_header,
    require_depth_scale,
)
from scanweld.datasets.intrinsics import (
    CAMERA_FILE,
    CameraFile,
    Intrinsics,
    Overrides,
    doubt_camera,
    make_camera,
    read_camera_file,
    scaled_default,
)
from scanweld.errors import DatasetError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.trajectory import Trajectory

logger = logging.getLogger(__name__)

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
FRAMES_PER_SECOND = 30.0
"""Rate at which frames without a timestamp are taken: that of the cameras of these datasets."""

_NUMBERED = re.compile(r"\D*(\d{1,15})(?:-\d+)?")  # 00012, img_12, 0000012-000000399999 (number-microseconds)


def numbered_files(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Return the files of a folder by the number in their names, ascending; other files are left out.

    Raises
    ------
    DatasetError
        When two files have the same number.
    """
    found: dict[int, Path] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _NUMBERED.fullmatch(path.stem)
        if match is None or path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        number = int(match[1])
        if number in found:
            raise DatasetError(f"{folder}: {found[number].name} and {path.name} have the same number; remove one")
        found[number] = path
    return dict(sorted(found.items()))


def pair_by_number(folder: Path, depth: Mapping[int, Path], color: Mapping[int, Path]) -> dict[int, FrameFiles]:
    """Pair depth and colour images of equal number; return the frames by depth number, at number / 30 s.

    When both folders hold equally many images whose numbers differ by a constant (one counts from 0, the
    other from 1), they are paired by order. Images without a partner are left out and counted in a warning.

    Raises
    ------
    DatasetError
        When there is colour without depth, nothing at all, or no pair.
    """
    if not depth:
        if color:
            raise DatasetError(f"{folder}: {len(color)} colour images, but no depth image; both are needed")
        raise DatasetError(f"{folder}: the sequence is empty, no depth image was found")
    if not color:
        logger.warning("%s: no colour images, the map will have no colour", folder)
        return {n: FrameFiles(n / FRAMES_PER_SECOND, path, None) for n, path in depth.items()}
    shifts = {n - m for n, m in zip(color, depth, strict=False)} if len(color) == len(depth) else {0}
    shift = shifts.pop() if len(shifts) == 1 else 0
    pairs = {
        n: FrameFiles(n / FRAMES_PER_SECOND, path, color[n + shift]) for n, path in depth.items() if n + shift in color
    }
    if not pairs:
        raise DatasetError(f"{folder}: no depth image has the number of a colour image")
    dropped = len(depth) + len(color) - 2 * len(pairs)
    if dropped:
        logger.warning("%s: %d images without a partner are left out", folder, dropped)
    return pairs


def first_existing(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the first of the named files or folders that exists."""
    return next((folder / name for name in names if (folder / name).exists()), None)


def path_inside(folder: Path, name: str, where: str) -> Path:
    """Return the path of a file that a description names; it must lie within the sequence folder.

    Raises
    ------
    DatasetError
        When the name is absolute or leads out of the folder; `where` says what names it.
    """
    is_absolute = PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor
    if not name or is_absolute or ".." in PureWindowsPath(name).parts or "\0" in name:
        raise DatasetError(f"{where}: '{name}' leaves the sequence folder; paths must be inside it")
    return folder / name


def build_sequence(
    folder: Path,
    frames: Sequence[FrameFiles],
    *,
    overrides: Overrides,
    intrinsics: Intrinsics,
    default_depth_scale: float,
    intrinsics_file: Intrinsics | None = None,
    ground_truth: Trajectory | None = None,
    depth_reader: DepthReader = read_depth_png,
) -> FileSequence:
    """Return the sequence of `frames`, after looking at the first intact one.

    Parameters
    ----------
    folder : where camera.json may be, and what the sequence is called
    frames : in order of time
    overrides : what the caller fixed; goes before everything else
    intrinsics : the format's default, for 640x480 images; scaled to the images' size
    default_depth_scale : the format's units per metre
    intrinsics_file : intrinsics that the format's own file gives, for the images as they are; camera.json
        wins
    ground_truth : true poses
    depth_reader : decoder of the depth files

    Raises
    ------
    DatasetError
        When there is no frame, none is intact, or the sizes of colour, depth and camera differ.
    """
    name = folder.resolve().name or "sequence"
    if not frames:
        raise DatasetError(f"{folder}: the sequence is empty, no frame was found")
    width, height = _image_size(name, frames, depth_is_image=depth_reader is read_depth_png)
    given = read_camera_file(folder)
    camera = settle_camera(
        folder, (width, height), given, overrides, intrinsics=intrinsics, intrinsics_file=intrinsics_file
    )
    return FileSequence(
        name=name,
        camera=camera,
        frames=tuple(frames),
        depth_scale=settle_depth_scale(folder, default_depth_scale, given, overrides),
        ground_truth=ground_truth,
        depth_reader=depth_reader,
    )


def settle_camera(
    where: Path,
    size: tuple[int, int],
    given: CameraFile | None,
    overrides: Overrides,
    *,
    intrinsics: Intrinsics | None,
    intrinsics_file: Intrinsics | None = None,
) -> PinholeCamera:
    """Return the camera of a sequence: the caller's, else that of camera.json, the format's file, its default.

    Parameters
    ----------
    where : the sequence, for messages
    size : width and height of the images
    given : camera.json of the sequence
    overrides : what the caller fixed
    intrinsics : the format's default for 640x480 images, scaled to their size; None where it has none
    intrinsics_file : what the sequence itself says, for the images as they are

    Raises
    ------
    DatasetError
        When a size differs from that of the images, the values are no camera, or nothing says what they are.
    """
    width, height = size
    if given is not None and given.size not in (None, size):
        assert given.size is not None
        raise DatasetError(
            f"{where / CAMERA_FILE}: says {given.size[0]}x{given.size[1]}, the images are {width}x{height}"
        )
    named = "camera" if overrides.camera is not None else str(where if given is None else where / CAMERA_FILE)
    if isinstance(overrides.camera, PinholeCamera):
        camera = overrides.camera
        if (camera.width, camera.height) != size:
            raise DatasetError(
                f"{where}: the images are {width}x{height}, the camera {camera.width}x{camera.height}; "
                "give the intrinsics of the images on disk, before any scale"
            )
    elif overrides.camera is not None:
        camera = make_camera(overrides.camera, width, height, named)
    elif given is not None:
        camera = make_camera(given.intrinsics, width, height, named)
    elif intrinsics_file is not None:
        camera = make_camera(intrinsics_file, width, height, named)
    elif intrinsics is not None:
        camera = make_camera(scaled_default(intrinsics, width, height), width, height, named)
    else:
        raise DatasetError(f"{where}: the intrinsics are not known; pass --camera FX,FY,CX,CY")
    doubt = doubt_camera(camera)
    if doubt is not None:
        logger.warning("%s: %s", named, doubt, extra={"fault": "intrinsics"})
    return camera


def settle_depth_scale(where: Path, default: float, given: CameraFile | None, overrides: Overrides) -> float:
    """Return the units per metre: the caller's, else those of camera.json, else the format's."""
    stated, source = default, "the format"
    if given is not None and given.depth_scale is not None:
        stated, source = require_depth_scale(given.depth_scale, str(where / CAMERA_FILE)), CAMERA_FILE
    if overrides.depth_scale is None:
        return stated
    passed = require_depth_scale(overrides.depth_scale)
    contradiction = compare_depth_units(stated, passed, source)
    if contradiction is not None:
        logger.warning(contradiction, extra={"fault": "depth-unit"})
    return passed


def _image_size(name: str, frames: Sequence[FrameFiles], *, depth_is_image: bool) -> tuple[int, int]:
    """Width and height of the first frame whose files are intact."""
    fault = ""
    for files in frames:
        try:
            color = None if files.color is None else read_header(files.color)
            depth = read_header(files.depth) if depth_is_image else color
        except UnreadableFrameError as error:
            fault = fault or str(error)
            continue
        if depth is None:
            raise DatasetError(f"{files.depth}: without a colour image its size is not known")
        if depth_is_image and depth_header_fault(depth):
            swapped = color is not None and not depth_header_fault(color)
            raise DatasetError(f"{files.depth}: {depth_header_fault(depth)}", fault="swapped" if swapped else "")
        if color is not None and _size(color) != _size(depth):
            raise DatasetError(
                f"{files.color} is {color.width}x{color.height}, {files.depth.name} is "
                f"{depth.width}x{depth.height}: colour and depth must be registered and of one size"
            )
        return _size(depth)
    raise no_readable_frame(name, len(frames), fault)


def _size(header: ImageHeader) -> tuple[int, int]:
    return header.width, header.height
