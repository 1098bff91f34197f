"""Write a rendered sequence in the layout of TUM RGB-D."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scanweld.arrays import Array
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.synthetic.sequence import RenderConfig, SyntheticSequence
from scanweld.datasets.synthetic.spoiling import Spoil, find_spoil
from scanweld.errors import OutputError
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.atomic import write_folder
from scanweld.io.trajectory_files import write_tum

_PNG_COMPRESSION = 1  # fast; renders compress well anyway


def render_sequence(
    folder: str | os.PathLike[str],
    config: RenderConfig | None = None,
    *,
    spoil: str = "",
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RgbdSequence:
    """Render a sequence into a folder: TUM RGB-D layout, exact ground truth, `camera.json`.

    The folder holds `rgb/*.png`, `depth/*.png` (16 bits, 5000 = 1 m, 0 invalid), `rgb.txt`, `depth.txt`,
    `associations.txt`, `groundtruth.txt` and `camera.json`. It is complete or absent: it is written aside and
    renamed.

    Parameters
    ----------
    folder : where to
    config : what to render
    spoil : a fault of :data:`~.spoiling.SPOILS` to be made on purpose
    force : replace a folder that holds something
    progress : called with (frames done, frames in all) after every frame

    Raises
    ------
    ConfigError
        When there is no such fault.
    OutputError
        When the folder holds something and `force` is not given, or it cannot be written.
    """
    sequence: RgbdSequence = SyntheticSequence(config)
    fault = find_spoil(spoil) if spoil else Spoil("none")
    if fault.sequence is not None:
        sequence = fault.sequence(sequence)
    with write_folder(Path(folder), force=force, kind="rendered sequence", mark="associations.txt") as aside:
        _write_frames(aside, sequence, progress)
        if sequence.ground_truth is not None:  # it never is
            write_tum(aside / "groundtruth.txt", sequence.ground_truth)
        _write_camera(aside / "camera.json", sequence.camera, sequence.depth_scale)
        if fault.folder is not None:
            fault.folder(aside)
    return sequence


def _write_frames(folder: Path, sequence: RgbdSequence, progress: Callable[[int, int], None] | None) -> None:
    """Write the images and the lists that name them."""
    stamps = [f"{time:.6f}" for time in sequence.timestamps_s]
    lists = {
        "rgb.txt": ["# timestamp filename", *(f"{s} rgb/{s}.png" for s in stamps)],
        "depth.txt": ["# timestamp filename", *(f"{s} depth/{s}.png" for s in stamps)],
        "associations.txt": [f"{s} rgb/{s}.png {s} depth/{s}.png" for s in stamps],
    }
    for name, lines in lists.items():
        (folder / name).write_text("\n".join(lines) + "\n", encoding="ascii")
    (folder / "rgb").mkdir()
    (folder / "depth").mkdir()
    for index, stamp in enumerate(stamps):
        frame = sequence.read(index)
        assert frame.color is not None
        depth = np.rint(frame.depth_m.astype(np.float64) * sequence.depth_scale).astype(np.uint16)
        _write_png(folder / "rgb" / f"{stamp}.png", np.ascontiguousarray(frame.color[..., ::-1]))  # OpenCV wants BGR
        _write_png(folder / "depth" / f"{stamp}.png", depth)
        if progress is not None:
            progress(index + 1, len(stamps))


def _write_png(path: Path, image: Array) -> None:
    import cv2

    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION])
    if not done:
        raise OutputError(f"{path}: the image cannot be encoded as PNG")
    path.write_bytes(data.tobytes())


def _write_camera(path: Path, camera: PinholeCamera, depth_scale: float) -> None:
    values = {
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "width": camera.width, "height": camera.height, "depth_scale": depth_scale,
    }  # fmt: skip
    path.write_text(json.dumps(values, indent=2) + "\n", encoding="ascii")
