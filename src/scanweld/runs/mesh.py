"""The mesh of a finished run, and its surfels as Gaussian splats."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanweld.arrays import Array, Int64, finite_rows
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.selection import SelectedSequence, parse_frames
from scanweld.datasets.stream import stream
from scanweld.errors import DatasetError, FileFormatError, InvalidInputError, OutputError, UnreadableFrameError
from scanweld.geometry.frame import Frame
from scanweld.geometry.mesh import TriangleMesh
from scanweld.io.atomic import write_file
from scanweld.io.mesh_files import writer_for
from scanweld.io.ply import read_ply_columns, write_ply
from scanweld.meshing.config import MeshConfig
from scanweld.meshing.fuse import Progress, finished_mesh, frames_with_news, median_depth_m, voxel_for
from scanweld.meshing.splats import SURFEL_COLUMNS, splats_from_surfels
from scanweld.meshing.volume import GridTooLargeError, SurfaceFrame, TsdfVolume, prepare_frame
from scanweld.runs.reopen import PosedFrames, posed_frames, read_description, reopen_sequence

logger = logging.getLogger(__name__)

LOOKED_AT = 5
"""Frames, evenly spread, by which the spacing of the grid is chosen."""

LEAST_CONFIDENCE = 2.0
"""Surfels below this are mostly noise at edges, and left out where most of the map was seen more often."""

SURFEL_RADII = 2.0
"""Spacing of the grid when surfels are fused, in their median radius."""

COARSER = 1.5
"""Factor on a spacing that was chosen and whose grid takes too much memory."""


@dataclass(frozen=True, slots=True)
class MeshSummary:
    """What a mesh was made of.

    Attributes
    ----------
    path : where it was written
    mesh : the mesh
    voxel_m : spacing of the grid [m]
    num_frames : frames that were fused; 0 where the surfels were
    memory_mb : what the grid took [MB]
    seconds : from start to end
    """

    path: Path
    mesh: TriangleMesh
    voxel_m: float
    num_frames: int
    memory_mb: float
    seconds: float


def mesh_run(
    folder: Path,
    *,
    out: Path | None = None,
    config: MeshConfig | None = None,
    frames: str | None = None,
    from_surfels: bool = False,
    progress: Progress | None = None,
) -> MeshSummary:
    """Fuse the depth of a run at its poses into a mesh and write it.

    The sequence is read again. Where it is not there any more the surfels of the map are fused instead, which the log
    says: the mesh is coarser then, and nothing is carved.

    Parameters
    ----------
    folder : run folder
    out : file to write, .ply, .obj or .glb; default mesh.ply in the folder
    config : how; a `voxel_m` of 0 is chosen by the depth, and made coarser where its grid takes too much memory
    frames : "A:B" or "A:B:STEP" by number in the run; default every frame that shows something new
    from_surfels : fuse the surfels in any case
    progress : called after each frame with the number done and of all

    Raises
    ------
    FileFormatError
        When the folder is no run folder, or one of its files cannot be read.
    InvalidInputError
        When no frame is selected, there is nothing to mesh, or the grid takes too much memory at the given spacing.
    OutputError
        When the file cannot be written.
    """
    started = time.perf_counter()
    config = config or MeshConfig()
    path = out or folder / "mesh.ply"
    as_bytes = writer_for(path)  # an unknown kind is told before the work
    run = read_description(folder)
    sequence = None
    if not from_surfels:
        try:
            sequence = reopen_sequence(run)
        except DatasetError as error:
            logger.warning("%s; the mesh is made of the surfels in map.ply", error)
    if sequence is None:
        volume = _fuse_surfels(folder / "map.ply", config)
    else:
        volume = _fuse_frames(sequence, _choose_frames(folder, sequence, frames, config), config, progress)
    mesh = finished_mesh(volume)
    write_file(path, as_bytes(mesh))
    return MeshSummary(path, mesh, volume.voxel_m, volume.num_frames, volume.memory_mb, time.perf_counter() - started)


def write_splats(folder: Path, *, out: Path | None = None) -> tuple[Path, int]:
    """Write the surfels of a run as Gaussian splats (docs/meshing.md); return the file and their number.

    Raises
    ------
    FileFormatError
        When the folder is no run folder, or its map cannot be read.
    OutputError
        When the file cannot be written.
    """
    read_description(folder)
    path = out or folder / "splats.ply"
    if path.suffix.lower() != ".ply":
        raise OutputError(f"{path}: splats are written as PLY; choose a name that ends so")
    surfels = read_ply_columns(folder / "map.ply")
    splats = splats_from_surfels(surfels, least_confidence=_least_confidence(surfels))
    write_ply(path, splats)
    return path, len(splats)


def _least_confidence(surfels: Mapping[str, Array]) -> float:
    """A run too short to confirm anything keeps all it has."""
    confidence = surfels.get("confidence", np.zeros(1))
    return LEAST_CONFIDENCE if np.median(confidence) > 2 * LEAST_CONFIDENCE else 0.0


@dataclass(frozen=True, slots=True)
class _Chosen:
    """Frames to fuse, and a spacing of the grid [m] that suits them."""

    frames: PosedFrames
    voxel_m: float


def _choose_frames(folder: Path, sequence: RgbdSequence, frames: str | None, config: MeshConfig) -> _Chosen:
    """Return the frames of a run to fuse: those that are asked for, or those that show something new."""
    posed = posed_frames(folder)
    posed = posed.select(posed.rows < len(sequence))
    if frames is not None:
        total = int(posed.rows.max(initial=0)) + 1
        asked = np.arange(*parse_frames(frames).indices(total))
        posed = posed.select(np.isin(posed.rows, asked))
    if len(posed.rows) == 0:
        what = "of the frames with a measured pose" if frames is None else f"with a measured pose in {frames}"
        raise InvalidInputError(f"{folder}: there are no frames {what} that the sequence has")
    looked_at = _look_at(sequence, posed.rows[np.linspace(0, len(posed.rows) - 1, LOOKED_AT).astype(int)])
    farthest = config.surfaces.max_depth_m
    voxel_m = config.voxel_m or voxel_for(looked_at, config.surfaces)
    if frames is None:
        posed = posed.select(frames_with_news(posed.T_world_camera, median_depth_m(looked_at, farthest)))
    return _Chosen(posed, voxel_m)


def _look_at(sequence: RgbdSequence, rows: Int64) -> list[Frame]:
    seen = []
    for row in dict.fromkeys(rows.tolist()):
        with contextlib.suppress(UnreadableFrameError):
            seen.append(sequence.read(row))
    return seen


def _fuse_frames(sequence: RgbdSequence, chosen: _Chosen, config: MeshConfig, progress: Progress | None) -> TsdfVolume:
    voxel_m = chosen.voxel_m
    while True:
        try:
            return _fuse_at(sequence, chosen.frames, voxel_m, config, progress)
        except GridTooLargeError as error:
            if config.voxel_m > 0:
                raise
            logger.warning("%s; it is made coarser", error)
            voxel_m *= COARSER


def _fuse_at(
    sequence: RgbdSequence, posed: PosedFrames, voxel_m: float, config: MeshConfig, progress: Progress | None
) -> TsdfVolume:
    volume = TsdfVolume(voxel_m, config)
    picked = SelectedSequence(sequence, posed.rows.tolist())

    def prepare(frame: Frame) -> SurfaceFrame:
        return prepare_frame(frame, config.surfaces)

    with contextlib.closing(stream(picked, 2, prepare=prepare)) as records:
        for record in records:
            if record.prepared is None:
                logger.warning("frame %d is left out: %s", posed.rows[record.index], record.error)
            else:
                volume.integrate(record.prepared, posed.T_world_camera[record.index])
            if progress is not None:
                progress(record.index + 1, len(picked))
    return volume


def _fuse_surfels(path: Path, config: MeshConfig) -> TsdfVolume:
    surfels = read_ply_columns(path)
    missing = [name for name in SURFEL_COLUMNS if name not in surfels]
    if missing:
        raise FileFormatError(f"{path}: is no map of a run, it has no {', '.join(missing)}")
    kept = (surfels["confidence"] >= _least_confidence(surfels)) & (surfels["radius"] > 0)
    kept &= finite_rows(*(surfels[name] for name in SURFEL_COLUMNS))
    kept &= (surfels["nx"] != 0) | (surfels["ny"] != 0) | (surfels["nz"] != 0)
    if not kept.any():
        raise InvalidInputError(f"{path}: the map is empty")
    surfels = {name: values[kept] for name, values in surfels.items()}
    voxel_m = config.voxel_m or float(f"{SURFEL_RADII * float(np.median(surfels['radius'])):.2g}")
    volume = TsdfVolume(voxel_m, config)
    volume.integrate_surfels(surfels)
    return volume
