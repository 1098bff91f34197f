"""The table of sequence formats, and the one call that opens any of them."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.bundle_fusion import is_bundle_fusion, open_bundle_fusion
from scanweld.datasets.icl_nuim import has_icl_nuim_files, is_icl_nuim, open_icl_nuim
from scanweld.datasets.intrinsics import Intrinsics, Overrides
from scanweld.datasets.realsense import LIVE, is_realsense, open_realsense, open_realsense_camera
from scanweld.datasets.realsense import SUFFIXES as REALSENSE_SUFFIXES
from scanweld.datasets.record3d import is_record3d, open_record3d
from scanweld.datasets.redwood import empty_image_folders, is_redwood, open_redwood
from scanweld.datasets.replica import is_replica, open_replica
from scanweld.datasets.ros_bag import SUFFIXES as BAG_SUFFIXES
from scanweld.datasets.ros_bag import is_ros_bag, open_ros_bag, parse_topics
from scanweld.datasets.scannet import is_scannet, open_scannet
from scanweld.datasets.selection import ResizedSequence, select
from scanweld.datasets.seven_scenes import is_seven_scenes, open_seven_scenes
from scanweld.datasets.stray_scanner import is_stray_scanner, open_stray_scanner
from scanweld.datasets.tum import is_tum, open_tum
from scanweld.datasets.tum_variants import is_bonn, is_eth3d, open_bonn, open_eth3d
from scanweld.datasets.video_pair import has_camera_file, is_video_pair, open_video_pair
from scanweld.errors import DatasetError
from scanweld.geometry.camera import PinholeCamera

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SequenceFormat:
    """One row of the table.

    Attributes
    ----------
    name : what `--format` takes
    layout : what the folder must hold, in one line
    recognises : whether a folder is of this format, or a file whose ending is one of `suffixes`
    suffices : whether a folder has the files that this format needs, when the caller names it
    open : open it; raises DatasetError when it cannot be used
    suffixes : endings of the files that are a sequence by themselves, in lower case
    """

    name: str
    layout: str
    recognises: Callable[[Path], bool]
    suffices: Callable[[Path], bool]
    open: Callable[[Path, Overrides], RgbdSequence]
    suffixes: tuple[str, ...] = ()


FORMATS = (
    SequenceFormat("scannet", "a .sens file", is_scannet, is_scannet, open_scannet, (".sens",)),
    SequenceFormat(
        "record3d",
        "an .r3d file, or metadata with rgbd/",
        is_record3d,
        is_record3d,
        open_record3d,
        (".r3d",),
    ),
    SequenceFormat(
        "bundlefusion",
        "info.txt with frame-NNNNNN.{color.jpg,depth.png,pose.txt}",
        is_bundle_fusion,
        is_bundle_fusion,
        open_bundle_fusion,
    ),
    SequenceFormat(
        "7scenes",
        "frame-NNNNNN.{color.png,depth.png,pose.txt}",
        is_seven_scenes,
        is_seven_scenes,
        open_seven_scenes,
    ),
    SequenceFormat("replica", "results/{frame,depth}NNNNNN.* and traj.txt", is_replica, is_replica, open_replica),
    SequenceFormat(
        "icl",
        "*.gt.freiburg with rgb/ and depth/, or scene_NN_NNNN.depth",
        is_icl_nuim,
        has_icl_nuim_files,
        open_icl_nuim,
    ),
    SequenceFormat("eth3d", "calibration.txt with rgb.txt and depth.txt", is_eth3d, is_eth3d, open_eth3d),
    SequenceFormat("bonn", "rgb.txt and depth.txt, in rgbd_bonn_*", is_bonn, is_tum, open_bonn),
    SequenceFormat("tum", "rgb.txt and depth.txt, or associations.txt", is_tum, is_tum, open_tum),
    SequenceFormat(
        "stray",
        "rgb.mp4, depth/ and odometry.csv",
        is_stray_scanner,
        is_stray_scanner,
        open_stray_scanner,
    ),
    SequenceFormat(
        "video",
        "camera.json with a colour video, and depth.mkv or depth/",
        is_video_pair,
        has_camera_file,
        open_video_pair,
    ),
    SequenceFormat(
        "redwood",
        "image/ or color/, and depth/ with numbered images",
        is_redwood,
        is_redwood,
        open_redwood,
    ),
    SequenceFormat(
        "realsense",
        "a .bag or .db3 file of the RealSense SDK",
        is_realsense,
        is_realsense,
        open_realsense,
        REALSENSE_SUFFIXES,
    ),
    SequenceFormat(
        "rosbag",
        "a .bag, .mcap or .db3 file, or metadata.yaml of ROS 2",
        is_ros_bag,
        is_ros_bag,
        open_ros_bag,
        BAG_SUFFIXES,
    ),
)
"""Every format, the most telling file names first: "auto" takes the first that recognises a folder.

A bag beside the images that were taken out of it is not what is meant: rosbag comes last.
"""


_ALIASES = {
    "sevenscenes": "7scenes",
    "tumrgbd": "tum",
    "sens": "scannet",
    "r3d": "record3d",
    "ros": "rosbag",
    "bag": "rosbag",
    "strayscanner": "stray",
    "niceslam": "replica",
}


def open_sequence(
    path: str | os.PathLike[str],
    *,
    format: str = "auto",
    camera: PinholeCamera | Intrinsics | None = None,
    depth_scale: float | None = None,
    frames: str | slice | None = None,
    scale: float = 1.0,
    topics: str | Mapping[str, str] | None = None,
) -> RgbdSequence:
    """Open a recorded RGB-D sequence.

    Parameters
    ----------
    path : the sequence folder, or a folder with the sequence folder alone in it; a file where the format is one;
        "realsense:" or "realsense:SERIAL" for a camera
    format : a name of ``FORMATS``, or "auto"
    camera : intrinsics of the images on disk; fx, fy, cx, cy are enough. Default: camera.json, else the
        format's
    depth_scale : units per metre of the depth images. Default: camera.json, else the format's
    frames : "A:B" or "A:B:STEP" by position, or a slice; default all
    scale : factor on the image size; intrinsics follow
    topics : of a ROS bag, "depth=/a,color=/b,camera_info=/c" or a dictionary; default those that it can only be

    Raises
    ------
    DatasetError
        When the folder is missing, of no known format, empty, or inconsistent; the message names what to
        change.
    FileFormatError
        When its ground truth cannot be read.
    InvalidInputError
        When an argument is out of range.
    MissingDependencyError
        When the format needs an extra that is not installed.
    """
    if str(path).startswith(LIVE):
        overrides = Overrides(camera=camera, depth_scale=depth_scale, topics={})
        return open_realsense_camera(str(path), overrides, frames, scale)
    place = Path(path)
    if not os.path.exists(place):  # in contrast to Path's, at a loss for no name
        raise DatasetError(f"{place}: no such folder")
    chosen = parse_topics(topics) if isinstance(topics, str) else dict(topics or {})
    try:
        found, place = _find_format(place, format) if place.is_dir() else (_format_of_file(place, format), place)
        if chosen and found.name != "rosbag":
            raise DatasetError(f"{place}: is of format '{found.name}', which has no topics; only ROS bags have")
        sequence = found.open(place, Overrides(camera=camera, depth_scale=depth_scale, topics=chosen))
    except PermissionError as error:
        raise DatasetError(f"{error.filename or place}: {error.strerror}") from None
    logger.info("%s: %s format, %d frames", place, found.name, len(sequence))
    if frames is not None:
        sequence = select(sequence, frames)
    return sequence if scale == 1.0 else ResizedSequence(sequence, scale)


def _known_name(name: str) -> str:
    """The name of a format, or "auto", however the caller wrote it; raises DatasetError for another."""
    known = [row.name for row in FORMATS]
    wanted = name.lower().replace("-", "").replace("_", "").removesuffix("nuim")
    wanted = _ALIASES.get(wanted, wanted)
    if wanted != "auto" and wanted not in known:
        raise DatasetError(f"format '{name}' is not known; known are auto, {', '.join(known)}")
    return wanted


def _format_of_file(file: Path, name: str) -> SequenceFormat:
    wanted, suffix = _known_name(name), file.suffix.lower()
    fits = [row for row in FORMATS if suffix in row.suffixes]
    if not fits:
        files = ", ".join(dict.fromkeys(suffix for row in FORMATS for suffix in row.suffixes))
        hint = "; unpack it first" if suffix in (".zip", ".tgz", ".gz", ".tar", ".7z") else ""
        raise DatasetError(f"{file}: is a file, expected a sequence folder or one of {files}{hint}")
    found = next((row for row in fits if row.recognises(file)), fits[-1])
    named = next((row for row in fits if row.name == wanted), None)  # a bag may be read in two ways
    if wanted != "auto" and named is None:
        raise DatasetError(f"{file}: not a sequence of format '{wanted}'; it looks like '{found.name}'")
    return named or found


def _find_format(folder: Path, name: str) -> tuple[SequenceFormat, Path]:
    """Return the format and the folder it is in: `folder` itself, or the only one inside it."""
    known, wanted = {row.name: row for row in FORMATS}, _known_name(name)
    named = known.get(wanted)
    children = [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    places = (folder, *(children if len(children) == 1 else ()))
    for place in places:
        if named is not None and named.suffices(place):
            return named, place
    recognised = ((row, place) for place in places for row in FORMATS if row.recognises(place))
    found = next(recognised, None)
    if named is None and found is not None:
        return found
    if found is not None:
        raise DatasetError(
            f"{folder}: not a sequence of format '{wanted}', which needs {known[wanted].layout}; "
            f"it looks like '{found[0].name}': name that format, or 'auto'"
        )
    empty = empty_image_folders(folder)
    if empty:
        raise DatasetError(f"{folder}: {' and '.join(empty)} hold{'s' * (len(empty) == 1)} no images")
    if named is not None:
        raise DatasetError(
            f"{folder}: not a sequence of format '{wanted}', which needs {named.layout}; it holds {_content(folder)}"
        )
    raise DatasetError(
        f"{folder}: not a sequence of a known format (`scanweld datasets list` names them); it holds {_content(folder)}"
    )


def _content(folder: Path) -> str:
    names = sorted(child.name + ("/" if child.is_dir() else "") for child in folder.iterdir())
    if not names:
        return "nothing"
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
