"""`scanweld mesh`: the surface of a run as triangles, or as splats."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from scanweld.cli.sequence_options import FRAMES_FORM

Option = typer.Option


def mesh(
    run: Annotated[Path, typer.Argument(help="Run folder, as slam wrote it.", metavar="RUN")],
    out: Annotated[
        Path | None, Option(help="File to write: .ply, .obj or .glb. Default: RUN/mesh.ply.", metavar="FILE")
    ] = None,
    voxel: Annotated[
        float | None,
        Option(help="Spacing of the grid in metres. Default, or 0: by pixels and noise at the usual depth.", min=0.0),
    ] = None,
    frames: Annotated[
        str | None,
        Option(
            help="Fuse these frames. Default: all that show something new.", metavar="A:B[:STEP]", callback=FRAMES_FORM
        ),
    ] = None,
    depth_max: Annotated[float | None, Option(help="Leave out depth beyond this, in metres.", min=0.1)] = None,
    fill_holes: Annotated[float, Option(help="Close holes with a border up to this long, in metres.", min=0.0)] = 0.0,
    from_surfels: Annotated[
        bool, Option("--from-surfels", help="Mesh the surfels of map.ply, without the sequence.")
    ] = False,
    splat: Annotated[bool, Option("--splat", help="Write Gaussian splats instead. Default: RUN/splats.ply.")] = False,
    memory: Annotated[float | None, Option(help="Memory that the grid may take in MB. Default: 2000.", min=1.0)] = None,
    threads: Annotated[int | None, Option(help="Number of threads. Default: all cores.", min=1)] = None,
    json_output: Annotated[bool, Option("--json", help="Print the figures as one JSON object.")] = False,
) -> int:
    """Make a coloured triangle mesh of a run: its depth is fused again, at the poses that came out in the end.

    Holes are left where nothing was seen. Where the sequence is not there any more, the mesh is made of the surfels
    in map.ply. --splat writes the surfels as a file that viewers of Gaussian splats open.
    """
    from scanweld.runs.mesh import mesh_run, write_splats

    if splat:
        path, count = write_splats(run, out=out)
        if json_output:
            typer.echo(json.dumps({"path": str(path), "splats": count}))
        else:
            typer.echo(f"splats   {count:,}\nwritten  {path}")
        return 0
    from scanweld.cli.progress import CountProgress
    from scanweld.io.mesh_files import writer_for
    from scanweld.meshing.config import MeshConfig
    from scanweld.parallel import kernels_are_cached, set_num_threads
    from scanweld.runs.reopen import read_description

    if threads is not None:
        set_num_threads(threads)
    config = MeshConfig(voxel_m=voxel or 0.0, fill_holes_m=fill_holes)
    if depth_max is not None:
        config = replace(config, surfaces=replace(config.surfaces, max_depth_m=depth_max))
    if memory is not None:
        config = replace(config, max_memory_mb=memory)
    read_description(run)  # what is wrong is told before anything is compiled
    if out is not None:
        writer_for(out)
    if not kernels_are_cached("mesh"):
        print("compiling, once for this machine", file=sys.stderr, flush=True)
    with CountProgress("fusing frames") as progress:
        made = mesh_run(run, out=out, config=config, frames=frames, from_surfels=from_surfels, progress=progress.update)
    kernels_are_cached("mesh", now=True)
    if json_output:
        figures = {
            "path": str(made.path), "triangles": len(made.mesh), "vertices": len(made.mesh.vertices_m),
            "area_m2": made.mesh.area_m2, "voxel_m": made.voxel_m, "frames": made.num_frames,
            "grid_mb": made.memory_mb, "seconds": made.seconds,
        }  # fmt: skip
        typer.echo(json.dumps(figures))
        return 0
    source = f"{made.num_frames} frames" if made.num_frames else "surfels"
    typer.echo(f"mesh     {len(made.mesh):,} triangles, {made.mesh.area_m2:.1f} m2")
    grid = f"voxel {made.voxel_m * 1e3:g} mm, grid of {made.memory_mb:.0f} MB"
    typer.echo(f"from     {source}, {grid}, {made.seconds:.1f} s")
    typer.echo(f"written  {made.path}")
    return 0
