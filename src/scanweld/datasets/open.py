"""The table of sequence formats, and the one call that opens any of them."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.icl_nuim import has_icl_nuim_files, is_icl_nuim, open_icl_nuim
from scanweld.datasets.intrinsics import Intrinsics, Overrides
from scanweld.datasets.redwood import empty_image_folders, is_redwood, open_redwood
from scanweld.datasets.selection import ResizedSequence, select
from scanweld.datasets.seven_scenes import is_seven_scenes, open_seven_scenes
from scanweld.datasets.tum import is_tum, open_tum
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
    recognises : whether a folder is of this format
    suffices : whether a folder has the files that this format needs, when the caller names it
    open : open it; raises DatasetError when it cannot be used
    """

    name: str
    layout: str
    recognises: Callable[[Path], bool]
    suffices: Callable[[Path], bool]
    open: Callable[[Path, Overrides], RgbdSequence]


FORMATS = (
    SequenceFormat(
        "7scenes",
        "frame-NNNNNN.{color.png,depth.png,pose.txt}",
        is_seven_scenes,
        is_seven_scenes,
        open_seven_scenes,
    ),
    SequenceFormat(
        "icl",
        "*.gt.freiburg with rgb/ and depth/, or scene_NN_NNNN.depth",
        is_icl_nuim,
        has_icl_nuim_files,
        open_icl_nuim,
    ),
    SequenceFormat("tum", "rgb.txt and depth.txt, or associations.txt", is_tum, is_tum, open_tum),
    SequenceFormat(
        "redwood",
        "image/ or color/, and depth/ with numbered images",
        is_redwood,
        is_redwood,
        open_redwood,
    ),
)
"""Every format, the most telling file names first: "auto" takes the first that recognises a folder."""


def open_sequence(
    path: str | os.PathLike[str],
    *,
    format: str = "auto",
    camera: PinholeCamera | Intrinsics | None = None,
    depth_scale: float | None = None,
    frames: str | slice | None = None,
    scale: float = 1.0,
) -> RgbdSequence:
    """Open a recorded RGB-D sequence.

    Parameters
    ----------
    path : the sequence folder, or a folder with the sequence folder alone in it
    format : a name of ``FORMATS``, or "auto"
    camera : intrinsics of the images on disk; fx, fy, cx, cy are enough. Default: camera.json, else the
        format's
    depth_scale : units per metre of the depth images. Default: camera.json, else the format's
    frames : "A:B" or "A:B:STEP" by position, or a slice; default all
    scale : factor on the image size; intrinsics follow

    Raises
    ------
    DatasetError
        When the folder is missing, of no known format, empty, or inconsistent; the message names what to
        change.
    FileFormatError
        When its ground truth cannot be read.
    InvalidInputError
        When an argument is out of range.
    """
    folder = Path(path)
    if not folder.exists():
        raise DatasetError(f"{folder}: no such folder")
    if not folder.is_dir():
        hint = "; unpack it first" if folder.suffix in (".zip", ".tgz", ".gz", ".tar", ".7z") else ""
        raise DatasetError(f"{folder}: is a file, expected a sequence folder{hint}")
    try:
        found, folder = _find_format(folder, format)
        sequence = found.open(folder, Overrides(camera=camera, depth_scale=depth_scale))
    except PermissionError as error:
        raise DatasetError(f"{error.filename or folder}: {error.strerror}") from None
    logger.info("%s: %s format, %d frames", folder, found.name, len(sequence))
    if frames is not None:
        sequence = select(sequence, frames)
    return sequence if scale == 1.0 else ResizedSequence(sequence, scale)


def _find_format(folder: Path, name: str) -> tuple[SequenceFormat, Path]:
    """Return the format and the folder it is in: `folder` itself, or the only one inside it."""
    known = {row.name: row for row in FORMATS}
    wanted = name.lower().replace("-", "").replace("_", "").removesuffix("nuim")
    wanted = {"sevenscenes": "7scenes", "tumrgbd": "tum"}.get(wanted, wanted)
    if wanted != "auto" and wanted not in known:
        raise DatasetError(f"format '{name}' is not known; known are auto, {', '.join(known)}")
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
    layouts = "; ".join(f"{row.name}: {row.layout}" for row in FORMATS)
    raise DatasetError(f"{folder}: not a sequence of a known format ({layouts}); it holds {_content(folder)}")


def _content(folder: Path) -> str:
    names = sorted(child.name + ("/" if child.is_dir() else "") for child in folder.iterdir())
    if not names:
        return "nothing"
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
