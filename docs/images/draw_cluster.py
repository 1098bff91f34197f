"""Draw docs/images/cluster.png anew: ten thousand sequences on a hundred machines, by benchmarks/cluster_plan.py.

python docs/images/draw_cluster.py
"""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "benchmarks"))

from cluster_plan import BANDWIDTHS, FIGURES, GB, Plan, Result, plan_from, simulate  # noqa: E402

COLORS = {
    "computing": "#0072b2", "storage": "#d55e00", "scheduler": "#cc79a7", "worker lost": "#22303c",
    "nothing left": "#c8ccd2",
}  # fmt: skip
WORDS = {"storage": "waiting for storage", "nothing left": "idle at the end", "worker lost": "lost with a worker"}


def main() -> None:
    """Simulate and draw."""
    base = plan_from(FIGURES)
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.25])
    results = {
        first: [simulate(replace(base, storage=gb * GB, longest_first=first)) for gb in BANDWIDTHS]
        for first in (False, True)
    }
    draw_hours(left, base, results)
    draw_shares(right, results[True])
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90)
    Image.open(buffer).quantize(64).save(HERE / "cluster.png", optimize=True)


def draw_hours(panel, base: Plan, results: dict[bool, list[Result]]) -> None:
    """How long it takes, by the bandwidth of the storage."""
    work_h = base.sequences * (base.run_s + base.frames * base.frame_s) / base.places / 3600
    panel.axhline(work_h, color=COLORS["computing"], linewidth=1, linestyle=":")
    panel.text(BANDWIDTHS[-1], work_h, "computing alone", ha="right", va="top", fontsize=8, color=COLORS["computing"])
    for first, color, label in ((False, "#9ca3af", "in any order"), (True, "#22303c", "longest first")):
        panel.plot(BANDWIDTHS, [result.hours for result in results[first]], "o-", color=color, label=label)
    panel.set(xscale="log", xlabel="bandwidth of the storage [GB/s]", ylabel="hours", ylim=(0, None))
    panel.set_xticks(BANDWIDTHS, map(str, BANDWIDTHS))
    panel.minorticks_off()
    panel.set_title(f"{base.sequences:,} sequences, {base.machines} machines", loc="left", fontsize=10)
    panel.legend(frameon=False, fontsize=9)
    panel.spines[["top", "right"]].set_visible(False)


def draw_shares(panel, results: list[Result]) -> None:
    """What the places of the cluster do meanwhile, the longest sequences first."""
    below = [0.0] * len(results)
    for name, color in COLORS.items():
        shares = [100 * result.shares[name] for result in results]
        panel.barh(range(len(results)), shares, left=below, color=color, label=WORDS.get(name, name), height=0.72)
        below = [a + b for a, b in zip(below, shares, strict=True)]
    panel.set_yticks(range(len(results)), [f"{gb} GB/s" for gb in BANDWIDTHS])
    panel.invert_yaxis()
    panel.set(xlabel="share of the time of all cores [%]", xlim=(0, 100))
    panel.set_title("longest first", loc="left", fontsize=10)
    panel.legend(frameon=False, fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.06), columnspacing=1)
    panel.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
