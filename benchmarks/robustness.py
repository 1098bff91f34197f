"""What goes wrong, on purpose: the scenario suite, at full size. Prints a table; `--out` writes it as JSON too.

    python benchmarks/robustness.py [SCENARIO...] [--quick] [--size 640x480] [--out JSON] [--list]

Everything is rendered in memory with the noise of a Kinect; two scenarios need the recorded data and are left out where
there is none. One default configuration for all, through the public interface only. The exit status is 1 when something
asked for was missed.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from scenarios.suite import FULL, QUICK, SCENARIOS, Check, data_folder

VERDICT = {True: "pass", False: "MISS", None: "-"}


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], epilog="scenarios: " + ", ".join(SCENARIOS))
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="default: all")
    parser.add_argument("--quick", action="store_true", help="160x120, 15 frames a second, two kidnaps")
    parser.add_argument("--size", help="image size, default 320x240", metavar="WxH")
    parser.add_argument("--kidnaps", type=int, help="how many kidnaps, default 10", metavar="N")
    parser.add_argument("--out", type=Path, metavar="JSON")
    parser.add_argument("--list", action="store_true", help="say what the scenarios are")
    arguments = parser.parse_args()
    if arguments.list:
        for name, scenario in SCENARIOS.items():
            print(f"{name:<17} {scenario.text}")
        return 0
    unknown = set(arguments.scenarios) - set(SCENARIOS)
    if unknown:
        parser.error(f"unknown scenario {sorted(unknown)[0]}; known are {', '.join(SCENARIOS)}")
    size = QUICK if arguments.quick else FULL
    if arguments.size:
        width, height = (int(part) for part in arguments.size.split("x"))
        size = replace(size, width=width, height=height)
    if arguments.kidnaps:
        size = replace(size, kidnaps=arguments.kidnaps)
    rows: list[dict[str, Any]] = []
    print(f"{size.width}x{size.height}, {size.fps:g} frames a second, Kinect noise; {platform.platform()}")
    print(f"{'scenario':<17} {'asked':<44} {'reached':<52} verdict")
    for name in arguments.scenarios or SCENARIOS:
        if SCENARIOS[name].data and not data_folder().is_dir():
            print(f"{name:<17} left out: no recorded data at {data_folder()} (set SCANWELD_DATA)")
            continue
        start = time.perf_counter()
        try:
            for check in SCENARIOS[name].checks(size):
                rows.append({"scenario": name, **asdict(check)})
                print_row(name, check)
        except Exception as error:  # one scenario that breaks must not hide the others
            rows.append({"scenario": name, **asdict(Check("runs", f"{type(error).__name__}: {error}", False))})
            print_row(name, Check("runs", f"{type(error).__name__}: {error}", False))
        seconds = time.perf_counter() - start
        print(f"{name:<17} {seconds:.0f} s of wall time")
        rows.append({"scenario": name, "wall_s": round(seconds, 1)})
        if arguments.out:
            arguments.out.write_text(json.dumps({"size": asdict(size), "rows": rows}, indent=1) + "\n")
    asked = [row["passed"] for row in rows if row.get("passed") is not None]
    print(f"{sum(asked)} of {len(asked)} passed")
    return 0 if all(asked) else 1


def print_row(name: str, check: Check) -> None:
    """Print one line of the table."""
    print(f"{name:<17} {check.asked:<44} {check.reached:<52} {VERDICT[check.passed]}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
