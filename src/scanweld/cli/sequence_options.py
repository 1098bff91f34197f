"""Options that several commands have to open a sequence, or to configure and run SLAM on it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scanweld.cli.completion import formats, slam_settings
from scanweld.cli.usage import well_formed

Option = typer.Option

Format = Annotated[
    str,
    Option(
        "--format",
        help="auto, 7scenes, bonn, bundlefusion, eth3d, icl, realsense, record3d, redwood, replica, rosbag, "
        "scannet, stray, tum, video.",
        autocompletion=formats,
    ),
]
Topics = Annotated[
    str | None,
    Option(
        help="Topics of a bag, where it has several.", metavar="depth=/A,color=/B",
        callback=well_formed("scanweld.datasets.ros_bag", "parse_topics"),
    ),
]  # fmt: skip
Camera = Annotated[
    str | None,
    Option(
        help="Intrinsics of the images on disk.", metavar="FX,FY,CX,CY",
        callback=well_formed("scanweld.datasets.intrinsics", "parse_intrinsics"),
    ),
]  # fmt: skip
DepthScale = Annotated[float | None, Option(help="Depth units per metre, for example 5000.")]
FRAMES_FORM = well_formed("scanweld.datasets.selection", "parse_frames")
Frames = Annotated[str | None, Option(help="Use a part of the frames.", metavar="A:B[:STEP]", callback=FRAMES_FORM)]
Scale = Annotated[float, Option(help="Resize the images, for example 0.5.")]
Config = Annotated[Path | None, Option(help="Configuration file.", metavar="F.toml")]
SET_FORM = well_formed("scanweld.config", "parse_override")
Overrides = Annotated[
    list[str] | None,
    Option(
        "--set", help="Set one value, for example tracking.stable_fraction=0.1.", autocompletion=slam_settings,
        callback=SET_FORM,
    ),
]  # fmt: skip
CheckpointEvery = Annotated[
    float | None,
    Option(help="Seconds between checkpoints, 0: on Ctrl-C only. Default: 60, or what costs 2 %.", min=0.0),
]
