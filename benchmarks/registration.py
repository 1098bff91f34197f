"""Registration beside its peers, in one run on one machine: speed, memory, convergence, global registration.

    python benchmarks/registration.py STUDY [--peer-python PYTHON] [--threads 2] [--quick] [--out JSON] [--figure PNG]

STUDY is one of

    lidar         two laser scans, point-to-plane and GICP, end to end
    million       a million points against a million: time, peak memory, error
    scaling       ten thousand to ten million points; a plot
    closed-form   10 pairs and a million
    basin         share of solved cases over a grid of initial errors; a heat map
    global        rendered pairs with 30 % overlap and no initial guess, unrelated pairs, a car's laser clouds
    frames        pairs of RGB-D frames far apart

Peers (small_gicp, Open3D) run in processes of their own, under the Python given by --peer-python or the environment
variable SCANWELD_PEER_PYTHON; without it they are left out, and the report says so. Times on a busy machine are worth
nothing: the load is printed with the figures.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from studies import basin, frames, global_pose, timing
from studies.report import header, header_text
from studies.systems import Bench, open_bench


@dataclass(frozen=True)
class Study:
    """What a name on the command line stands for; `systems` are those whose processes it needs."""

    run: Callable[[Bench, argparse.Namespace], dict[str, Any]]
    text: Callable[[dict[str, Any]], str]
    systems: tuple[str, ...] = ("scanweld", "small_gicp", "open3d")
    draw: Callable[[dict[str, Any], Path], None] | None = None


STUDIES = {
    "lidar": Study(timing.lidar, timing.alignments_text),
    "million": Study(timing.million, timing.alignments_text),
    "scaling": Study(timing.scaling, timing.alignments_text, draw=timing.draw_scaling),
    "closed-form": Study(timing.closed_form, timing.closed_form_text, systems=()),
    "basin": Study(basin.run, basin.text, draw=basin.draw),
    "global": Study(global_pose.run, global_pose.text, systems=("scanweld", "open3d")),
    "frames": Study(frames.run, frames.text, systems=()),
}


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("SCANWELD_DATA") or Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument("study", choices=sorted(STUDIES))
    parser.add_argument("--data", type=Path, default=Path(default), help="folder of the recorded scans")
    parser.add_argument("--peer-python", default=os.environ.get("SCANWELD_PEER_PYTHON"))
    parser.add_argument("--systems", default="", help="only these, e.g. scanweld,small_gicp")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=0, help="rounds that count; 0 is the study's own number")
    parser.add_argument("--points", type=int, default=0, help="million: points of a cloud; scaling: the most points")
    parser.add_argument(
        "--pairs", type=int, default=0, help="basin, global: rendered pairs; 0 is the study's own number"
    )
    parser.add_argument("--gate", type=float, default=0.0, help="basin: gate of all methods [m]; 0 is the study's own")
    parser.add_argument("--scene", choices=("furnished", "room"), default="furnished", help="of rendered pairs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="a smaller version, to see that it works")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    parser.add_argument("--figure", type=Path, help="write the plot of scaling or basin (PNG)")
    arguments = parser.parse_args()
    study = STUDIES[arguments.study]
    if arguments.figure and study.draw is None:
        parser.error(f"{arguments.study} has no figure")
    wanted = [name for name in study.systems if not arguments.systems or name in arguments.systems.split(",")]
    with open_bench(wanted, arguments.threads, arguments.peer_python) as bench:
        about = header(bench)
        print(header_text(about) + "\n", flush=True)
        figures = study.run(bench, arguments)
        figures = {"study": arguments.study, "about": about, "left_out": sorted(set(bench.said)), **figures}
    print(study.text(figures))
    for line in figures["left_out"]:
        print(line)
    if arguments.out:
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n")
    if arguments.figure and study.draw:
        study.draw(figures, arguments.figure)


if __name__ == "__main__":
    main()
