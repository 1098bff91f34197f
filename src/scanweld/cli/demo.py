"""`scanweld demo`: the whole job on a rendered room, with nothing to prepare."""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

DEMO_FRAMES = 120


def demo(
    out: Annotated[Path, typer.Option(help="Run folder; the demo's own is replaced.", metavar="RUN")] = Path(
        "scanweld-demo"
    ),
    frames: Annotated[int, typer.Option(help="Number of frames.", min=2)] = DEMO_FRAMES,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing run elsewhere, too.")] = False,
    threads: Annotated[int | None, typer.Option(help="Number of threads. Default: all cores.", min=1)] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print the metrics as one JSON object.")] = False,
) -> int:
    """Render a furnished room with the noise of a Kinect, run SLAM on it, evaluate, and draw the map."""
    started = time.perf_counter()
    from scanweld.cli.progress import CountProgress
    from scanweld.cli.slam import print_summary, run_with_progress
    from scanweld.datasets.open import open_sequence
    from scanweld.datasets.synthetic import RenderConfig, render_sequence
    from scanweld.runs.folder import check_writable
    from scanweld.slam.config import SlamConfig

    force = force or out == Path("scanweld-demo")
    check_writable(out, force=force)
    config = RenderConfig(scene="room", noise="kinect", frames=frames)
    # Rendered to files first: the speed that is reported is that of reading and mapping a recording.
    with tempfile.TemporaryDirectory(prefix="scanweld-demo-") as folder:
        with CountProgress("rendering frames") as progress:
            render_sequence(Path(folder) / "room", config, progress=progress.update)
        summary = run_with_progress(
            open_sequence(Path(folder) / "room"), SlamConfig(), out, threads=threads, force=force,
            resumable=False, description={"input": "rendered room", "render": asdict(config.resolved())},
            started=started,
        )  # fmt: skip
    code = print_summary(summary, json_output=json_output)
    if not json_output:
        typer.echo(f"look at {out}/report.html in a browser, and at {out}/renders/overview-rgb.png")
    return code
