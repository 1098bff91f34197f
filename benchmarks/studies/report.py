"""How studies print: the header that makes a figure reproducible, and Markdown tables."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from studies.systems import Bench


def header(bench: Bench) -> dict[str, Any]:
    """Command, date, machine, versions and threads."""
    versions = {"python": platform.python_version(), "numpy": metadata.version("numpy")}
    versions |= {"numba": metadata.version("numba"), "scanweld": metadata.version("scanweld")}
    versions |= {name: system.version for name, system in bench.systems.items()}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "command": "python benchmarks/registration.py " + shlex.join(sys.argv[1:]),
        "date": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}",
        "load_before": round(load, 2),
        "threads": bench.threads,
        "versions": versions,
    }


def header_text(about: dict[str, Any]) -> str:
    """The header for a person."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    return (
        f"    {about['command']}\n\n{about['date']}; {about['machine']}; {about['threads']} threads; "
        f"load before the run {about['load_before']}; {versions}"
    )


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table, its columns as wide as what they hold."""
    cells = [[str(cell) for cell in row] for row in (columns, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(columns))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
