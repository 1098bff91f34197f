"""Whether `scanweld check` names every fault that is made on purpose, and none that is not there.

Every sequence is looked at as it is, and with each fault that can be made in memory. Prints which faults were named,
and for each figure that is judged its range over sound sequences, its limit, and its range over those with the fault.

    python benchmarks/checkup.py SEQUENCE...     recorded or rendered, with ground truth for all of the faults
    python benchmarks/checkup.py --scenes        every scene, path and noise, 320x240, as they are
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator

import scanweld as sw
from scanweld.checkup import brims, examine, motions, pictures
from scanweld.checkup.findings import Checkup
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.synthetic import NOISE_MODELS
from scanweld.datasets.synthetic.paths import PATHS
from scanweld.datasets.synthetic.spoiling import SPOILS, spoil
from scanweld.errors import ConfigError

JUDGED = {
    "little-depth": ("valid_share", examine.LEAST_VALID),
    "unregistered": ("color_misplaced", brims.LEAST_MISPLACED),
    "unsynchronised": ("color_lag_sigmas", brims.LATE_GAIN),
    "motion-blur": ("edge_spread_px", pictures.MOST_SPREAD_PX),
    "exposure": ("brightness_factor", pictures.MOST_GAIN),
    "fast-motion": ("displacement", pictures.MOST_DISPLACEMENT),
    "intrinsics": ("focal_factor", motions.WRONG_FOCAL),
    "truth-inverted": ("truth_disagreement", motions.AGREES),
    "truth-unit": ("truth_scale", motions.WRONG_SCALE),
}
"""Faults that are judged by a figure, the figure and its limit."""


def main() -> None:
    """Look at sequences and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE")
    parser.add_argument("--scenes", action="store_true", help="look at every rendered scene, without faults")
    parser.add_argument("--least", type=int, default=30, help="frames below which no fault is made (default: 30)")
    arguments = parser.parse_args()
    figures: dict[str, list[Checkup]] = defaultdict(list)
    missed, false, made = [], [], 0
    started = time.process_time()
    for name, fault, sequence in _cases(arguments.sequences, arguments.scenes, arguments.least):
        checkup = examine.examine(sequence)
        named = [finding.fault for finding in checkup.findings]
        wrong = [other for other in named if other != fault]
        figures[fault].append(checkup)
        made += bool(fault)
        missed += [f"{name}: {fault}"] if fault and fault not in named else []
        false += [f"{name}, {fault or 'sound'}: {other}" for other in wrong]
        print(f"{name:<32} {fault or 'sound':<16} {', '.join(named) or '-'}", flush=True)
    looked = sum(map(len, figures.values()))
    print(f"\n{made - len(missed)} of {made} faults named; {len(false)} false alarms in {looked} sequences looked at")
    print(f"{(time.process_time() - started) / looked:.1f} s of CPU each\n", *missed, *false, sep="\n")
    print("\n| fault | figure | sound | limit | with the fault |\n|---|---|---|---|---|")
    for fault, (figure, limit) in JUDGED.items():
        print(f"| {fault} | {figure} | {_span(figures[''], figure)} | {limit:g} | {_span(figures[fault], figure)} |")


def _cases(paths: list[str], scenes: bool, least: int) -> Iterator[tuple[str, str, RgbdSequence]]:
    """Yield name, fault and sequence; the fault is "" where there is none."""
    for path in paths:
        sequence = sw.open_sequence(path)
        yield sequence.name, "", sequence
        for fault, made in SPOILS.items():
            if made.sequence is None or len(sequence) < least:
                continue
            try:
                spoiled = spoil(sequence, fault)
            except ConfigError as reason:
                print(f"{sequence.name:<32} {fault:<16} not made: {reason}")
                continue
            yield sequence.name, fault, spoiled
    for name, path in PATHS.items() if scenes else ():
        for noise in NOISE_MODELS:
            config = sw.RenderConfig(scene=path.scene, path=name, noise=noise, width=320, height=240, frames=240)
            rendered = sw.SyntheticSequence(config)
            yield rendered.name, "", rendered


def _span(checkups: list[Checkup], figure: str) -> str:
    values = [value for checkup in checkups if (value := checkup.figures.get(figure)) is not None]
    return f"{min(values):.3g} to {max(values):.3g}" if values else "-"


if __name__ == "__main__":
    main()
