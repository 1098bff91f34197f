"""ICL-NUIM: the TUM-compatible layout and the original one.

TUM-compatible (`living_room_traj2_frei_png`):

    rgb/1.png, depth/1.png   associations.txt (or numbers that match)   livingRoom2.gt.freiburg
    16 bits, 5000 = 1 m; the timestamp of a frame is its number, as in the truth

Original:

    scene_00_0000.png   scene_00_0000.depth   scene_00_0000.txt     one of each a frame
    .depth: distance **along the ray** [m] as text, row by row
    .txt: POV-Ray camera, lines as `cam_pos = [x, y, z]';`
    frame n is at n / 30 s

Intrinsics 481.20 480 319.5 239.5. The dataset prints fy = -480 because its camera has x right, **y up**, z
forward, in a world mirrored likewise; its images are upright. Here y points down as everywhere: fy = 480,
and the truth is turned by T = F T_file F, F = diag(1, -1, 1, 1), which keeps rotations proper (see
`io.trajectory_files`).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.datasets.base import FileSequence, FrameFiles
from scanweld.datasets.images import read_ray_distance_text
from scanweld.datasets.intrinsics import Overrides
from scanweld.datasets.layout import (
    FRAMES_PER_SECOND,
    build_sequence,
    first_existing,
    numbered_files,
    pair_by_number,
)
from scanweld.datasets.tum import ASSOCIATION_FILES, DEPTH_SCALE, listed_frames
from scanweld.errors import DatasetError
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.trajectory_files import flip_y_axes, read_trajectory
from scanweld.trajectory import Trajectory

INTRINSICS = (481.20, 480.0, 319.5, 239.5)

_FOLDER = re.compile(r"(living_room|office_room)_traj\d|^traj\d\w*_frei_png")
_SCENE = re.compile(r"scene_(\d{1,9})_(\d{1,9})")


def is_icl_nuim(folder: Path) -> bool:
    """Whether the folder has the truth or the files of this dataset, or is named as it unpacks."""
    if any(folder.glob("*.gt.freiburg")) or _scene_files(folder, ".depth"):
        return True
    # Without its truth file the name must do; a folder that brings its own camera or truth is something else.
    named = _FOLDER.search(folder.resolve().name.lower()) is not None and (folder / "rgb").is_dir()
    return named and first_existing(folder, ("camera.json", "groundtruth.txt")) is None


def has_icl_nuim_files(folder: Path) -> bool:
    """Whether the folder can be read as ICL-NUIM when the caller says that it is: rgb/ and depth/ are enough."""
    return is_icl_nuim(folder) or ((folder / "rgb").is_dir() and (folder / "depth").is_dir())


def open_icl_nuim(folder: Path, overrides: Overrides) -> FileSequence:
    """Open a sequence of ICL-NUIM in either layout; raises DatasetError when it cannot be used."""
    depth = _scene_files(folder, ".depth")
    if depth:
        return _open_original(folder, depth, overrides)
    truths = sorted(folder.glob("*.gt.freiburg"))
    if len(truths) > 1:
        raise DatasetError(f"{folder}: {', '.join(path.name for path in truths)}: keep the truth of this sequence only")
    # The axes of ICL-NUIM's truth are its own: that of a folder which another tool wrote must not be mirrored.
    foreign = first_existing(folder, ("camera.json", "rgb.txt", "depth.txt")) is not None
    truth = truths[0] if truths else None if foreign else first_existing(folder, ("groundtruth.txt",))
    return build_sequence(
        folder,
        _numbered_or_listed(folder),
        overrides=overrides,
        intrinsics=INTRINSICS,
        default_depth_scale=DEPTH_SCALE,
        ground_truth=None if truth is None else read_trajectory(truth, format="icl"),
    )


def _numbered_or_listed(folder: Path) -> list[FrameFiles]:
    if first_existing(folder, ("depth.txt", *ASSOCIATION_FILES)) is not None:
        return listed_frames(folder)
    depth, color = numbered_files(folder / "depth", (".png",)), numbered_files(folder / "rgb", (".png",))
    pairs = pair_by_number(folder, depth, color)
    return [FrameFiles(float(number), files.depth, files.color) for number, files in pairs.items()]


def _open_original(folder: Path, depth: dict[int, Path], overrides: Overrides) -> FileSequence:
    color = _scene_files(folder, ".png") or _scene_files(folder, ".jpg")
    frames = list(pair_by_number(folder, depth, color).values())
    cameras = _scene_files(folder, ".txt")
    truth = None
    if cameras:
        poses = np.stack([read_povray_camera(path) for path in cameras.values()])
        truth = Trajectory(np.array(list(cameras)) / FRAMES_PER_SECOND, poses)
    # The conversion from ray to axis needs the intrinsics, which are known only when the images have been
    # seen.
    sequence = build_sequence(
        folder,
        frames,
        overrides=overrides,
        intrinsics=INTRINSICS,
        default_depth_scale=1,
        ground_truth=truth,
        depth_reader=read_ray_distance_text,
    )
    # An image can claim any size; a number of a text takes two bytes at least.
    num_pixels, most = sequence.camera.width * sequence.camera.height, max(f.depth.stat().st_size for f in frames)
    if num_pixels > (most + 1) // 2:
        raise DatasetError(f"{folder}: images of {num_pixels} pixels, but no .depth file is longer than {most} bytes")
    return FileSequence(
        name=sequence.name,
        camera=sequence.camera,
        frames=sequence.frames,
        depth_scale=sequence.depth_scale,
        ground_truth=truth,
        depth_reader=RayDepthReader(sequence.camera),
    )


class RayDepthReader:
    """Read `.depth` files as distance along the optical axis: z = distance / |(x/z, y/z, 1)|."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._z_per_distance: Float32 = (1 / np.linalg.norm(camera.rays(), axis=-1)).astype(np.float32)

    def __call__(self, path: Path, shape: tuple[int, int], depth_scale: float) -> Float32:
        """Decode one file; see :data:`scanweld.datasets.base.DepthReader`."""
        return read_ray_distance_text(path, shape, depth_scale) * self._z_per_distance


def _scene_files(folder: Path, suffix: str) -> dict[int, Path]:
    found: dict[int, Path] = {}
    for path in folder.glob(f"scene_*{suffix}"):
        match = _SCENE.fullmatch(path.stem)
        if match is None:
            continue
        if int(match[2]) in found:
            raise DatasetError(f"{folder}: {path.name} and {found[int(match[2])].name}: keep one scene a folder")
        found[int(match[2])] = path
    return dict(sorted(found.items()))


def read_povray_camera(path: Path) -> Float64:
    """Return T_world_camera (4, 4) of a POV-Ray camera file, y down in both frames.

    The dataset's own construction is z = cam_dir / |cam_dir|, x = cam_up x z / |..|, y = z x x, R = [x y z],
    t = cam_pos, in POV-Ray's left-handed coordinates (x right, y up, z forward). Turning both y axes,
    T = F [R t] F, gives a right-handed world that the upright images agree with.

    Raises
    ------
    DatasetError
        When cam_pos, cam_dir or cam_up is missing or no finite vector, or direction and up are parallel.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from None
    position, direction, up = (_vector(path, text, key) for key in ("cam_pos", "cam_dir", "cam_up"))
    right = np.cross(up, direction)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(up) * np.linalg.norm(direction):
        raise DatasetError(f"{path}: cam_dir and cam_up are parallel or zero")
    z = direction / np.linalg.norm(direction)
    x = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = position
    return flip_y_axes(T)


def _vector(path: Path, text: str, key: str) -> Float64:
    match = re.search(rf"\b{key}\s*=\s*[\[<]([^\]>]*)[\]>]", text)
    try:
        vector = np.array([float(word) for word in match[1].replace(",", " ").split()]) if match else np.empty(0)
    except ValueError:
        vector = np.empty(0)
    if vector.shape != (3,) or not (np.abs(vector) < 1e50).all():  # products of larger ones are infinite
        raise DatasetError(f"{path}: expected a line `{key} = [x, y, z]';`")
    return vector
