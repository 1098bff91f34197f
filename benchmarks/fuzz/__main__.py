"""Give every parser spoilt files, and see that each is read or refused with an error of the package.

    python benchmarks/fuzz [PARSER ...] [--seconds 600] [--seed 0] [--json]

A finding is any other exception or warning, more than 1 GiB of memory, more than 5 s for one input, or a crash of the
process. Each is made smaller and kept in benchmarks/fuzz/found/ (not in the repository); once it is mended, it moves to
benchmarks/fuzz/cases/PARSER/, from where it is spoilt further, and tests/test_fuzz.py reads it. Inputs are those of the
tests, spoilt with regard to their structure: numbers and words of text, bytes, chunks of PNG, files of archives, the
state in a checkpoint and pages of E57 with right checksums. An input that is refused with words not seen before is
spoilt further. Runs on Linux. Exit code 1 when anything was found.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from inputs import collect, save_case
from targets import TARGETS

HERE = Path(__file__).parent
CASES, FOUND = HERE / "cases", HERE / "found"

LONGEST_S = 5.0
"""What one input may take."""

START_S = 120.0
"""What a process may take until it has read the good inputs, kernels compiled included."""


def main() -> int:
    """Fuzz, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parsers", nargs="*", choices=[*TARGETS, []], metavar="PARSER", help=", ".join(TARGETS))
    parser.add_argument("--seconds", type=float, default=600.0, help="of one core for each parser")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = {name: fuzz(name, arguments.seconds, arguments.seed) for name in arguments.parsers or TARGETS}
    print(json.dumps(rows, indent=1) if arguments.json else table(rows))
    return 1 if any(row["findings"] for row in rows.values()) else 0


def fuzz(name: str, seconds: float, seed: int) -> dict[str, Any]:
    """Fuzz one parser, with another process after each that hangs or crashes."""
    row: dict[str, Any] = {"seconds": 0.0, "inputs": 0, "answers": 0, "findings": []}
    attempt = 0
    while row["seconds"] < seconds - 1:
        with tempfile.TemporaryDirectory(prefix=f"scanweld-fuzz-{name}-") as folder:
            state, faults = attend(name, f"{seed}.{attempt}", seconds - row["seconds"], Path(folder))
        for key in ("seconds", "inputs"):
            row[key] += state.get(key, 0)
        row["answers"] = max(row["answers"], state.get("answers", 0))
        row["findings"] += [fault for fault in faults if fault not in row["findings"]]
        attempt += 1
        if not state.get("inputs"):
            break
    row["seconds"] = round(row["seconds"], 1)
    print(f"{name}: {row['inputs']} inputs in {row['seconds']:.0f} s, {len(row['findings'])} findings", file=sys.stderr)
    return row


def attend(name: str, seed: str, seconds: float, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Run a process; kill it where it stays with one input. Returns its last state and what was found."""
    command = [sys.executable, str(HERE / "worker.py"), name, seed, str(seconds), str(folder), str(CASES)]
    with (folder / "out.txt").open("wb") as out, (folder / "err.txt").open("wb") as err:
        process = subprocess.Popen(command, stdout=out, stderr=err, env={**os.environ, "PYTHONFAULTHANDLER": "1"})
        hung = watch(process, folder)
    text = (folder / "out.txt").read_text(errors="replace")
    told = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
    faults = [entry["fault"] for entry in told]
    for entry in told:
        keep(name, folder / "found" / entry["case"])
    state = json.loads((folder / "state.json").read_text()) if (folder / "state.json").exists() else {}
    if hung or process.returncode != 0:
        what = f"longer than {LONGEST_S:.0f} s" if hung else f"process ended with {process.returncode}"
        tail = (folder / "err.txt").read_text(errors="replace").strip().splitlines()[-12:]
        faults.append(f"{what}: {' | '.join(tail)}"[:600])
        if (folder / "input").is_dir():
            save_case(collect(folder / "input"), folder / "last.zip")
            keep(name, folder / "last.zip", f"{'hang' if hung else 'crash'}-{seed}.zip")
    return state, faults


def watch(process: subprocess.Popen[bytes], folder: Path) -> bool:
    """Wait for a process; kill it and return True when it works on one input for too long."""
    last, worked = "", 0.0
    while process.poll() is None:
        time.sleep(0.2)
        try:
            now, used = (folder / "turns").read_text(), cpu_seconds(process.pid)
        except (FileNotFoundError, ProcessLookupError):
            continue
        if now != last:
            last, worked = now, used
        started = (folder / "state.json").exists()
        too_long = used - worked > (LONGEST_S if started else START_S)
        if too_long and process.poll() is None:
            process.kill()
            process.wait()
            return True
    return False


def cpu_seconds(pid: int) -> float:
    """Return what a process has computed: a machine that is busy with something else is no hang."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def keep(name: str, case: Path, called: str = "") -> None:
    """Keep an input that was found."""
    (FOUND / name).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(case, FOUND / name / (called or case.name))


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the rows as lines for a person."""
    lines = [f"{'parser':<14}{'s':>6}{'inputs':>10}{'answers':>9}  findings"]
    for name, row in rows.items():
        lines.append(f"{name:<14}{row['seconds']:>6.0f}{row['inputs']:>10}{row['answers']:>9}  {len(row['findings'])}")
        lines += [f"    {fault}" for fault in row["findings"]]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
