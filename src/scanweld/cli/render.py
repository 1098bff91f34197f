"""`scanweld render`: write a synthetic RGB-D sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from scanweld.cli.completion import noises, scenes

Option = typer.Option


def render(
    out: Annotated[Path, Option(help="Folder to write the sequence to (TUM RGB-D layout).", metavar="SEQUENCE")],
    scene: Annotated[
        str | None, Option(help="room, corridor (a loop), twin-rooms or wall. Default: room.", autocompletion=scenes)
    ] = None,
    path: Annotated[
        str | None,
        Option(
            help="Camera path: orbit or sweep (room), loop (corridor), visit (twin-rooms), plain or brick (wall), or a "
            "trajectory file (TUM, 3x4 rows, Redwood log, also gzipped). Default: the scene's first.",
            metavar="NAME|FILE",
        ),
    ] = None,
    path_frame: Annotated[
        str | None,
        Option(help="Axes of the file: cv (y down) or icl (ICL-NUIM: y up, fy = -480). Default: cv."),
    ] = None,
    noise: Annotated[
        str | None, Option(help="none, kinect or realsense. Default: none.", autocompletion=noises)
    ] = None,
    frames: Annotated[
        int | None, Option(help="Number of frames. Default, or 0: one round of a built-in path, all of a file.")
    ] = None,
    size: Annotated[str | None, Option(help="Image size. Default: 640x480.", metavar="WxH")] = None,
    fps: Annotated[float | None, Option(help="Frames per second. Default: 30.")] = None,
    spoil: Annotated[
        str | None,
        Option(help="Make a mistake on purpose, to see what scanweld check says of it.", metavar="FAULT"),
    ] = None,
    seed: Annotated[int | None, Option(help="Seed of noise and small things in the scene. Default: 0.")] = None,
    force: Annotated[bool, Option("--force", help="Replace a sequence that exists.")] = False,
) -> int:
    """Render a furnished room or a loop of corridors as an RGB-D sequence with exact ground truth."""
    from scanweld.cli.image_size import parse_size
    from scanweld.cli.progress import CountProgress
    from scanweld.datasets.synthetic import RenderConfig, render_sequence

    given: dict[str, Any] = {
        "scene": scene, "path": path, "path_frame": path_frame, "noise": noise, "frames": frames, "fps": fps,
        "seed": seed,
    }  # fmt: skip
    if size is not None:
        given["width"], given["height"] = parse_size(size)
    config = RenderConfig(**{key: value for key, value in given.items() if value is not None})
    with CountProgress("rendering frames") as progress:
        sequence = render_sequence(out, config, spoil=spoil or "", force=force, progress=progress.update)
    camera, truth = sequence.camera, sequence.ground_truth
    length_m = 0.0 if truth is None else truth.path_length_m
    typer.echo(
        f"{out}: {len(sequence)} frames of {sequence.name}, {camera.width}x{camera.height}, {length_m:.2f} m of path"
    )
    return 0
