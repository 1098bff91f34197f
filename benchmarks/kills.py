"""Kill a run at random moments, go on with --resume, and see whether it ends with the bytes of one that never was.

    python benchmarks/kills.py [--kills 50] [--frames 40] [--size 160x120] [--seed 0] [--json]

A small room with the noise of a Kinect is rendered, and run once without a checkpoint. Then processes of `scanweld slam
--resume`, which write a checkpoint after every frame, are killed (SIGKILL): in turns at any moment of their life, while
a checkpoint is written, and while the run folder is. A run that ends before its kill is compared with the uninterrupted
one, and another begins. After each kill the checkpoint, where there is one, must be whole; what a kill fell into is
seen by what it left. Exit code 1 when anything was not recovered.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import scanweld as sw
from scanweld.errors import FileFormatError
from scanweld.io.leftovers import OLD, prefix_of
from scanweld.runs.checkpoint.file import CheckpointFile
from scanweld.runs.comparison import compare_runs
from scanweld.runs.folder import CHECKPOINT, MARK

AIMS = ("any moment", "checkpoint", "run folder")
LONGEST_S = 300.0  # that a process may take
EVERY_FRAME_S = 1e-9


def main() -> int:
    """Render, run once, kill, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    width, height = (int(number) for number in arguments.size.split("x"))
    with tempfile.TemporaryDirectory(prefix="scanweld-kills-") as folder:
        sequence = Path(folder) / "room"
        config = sw.RenderConfig(scene="room", noise="kinect", frames=arguments.frames, width=width, height=height)
        sw.render_sequence(sequence, config)
        trial = Trial(sequence, Path(folder), random.Random(arguments.seed))
        trial.run_once()
        trial.run(arguments.kills)
    figures = trial.figures()
    print(json.dumps(figures, indent=1) if arguments.json else text(figures))
    return 1 if trial.faults else 0


@dataclass(slots=True)
class Trial:
    """Runs that are killed, and what came of them."""

    sequence: Path
    folder: Path
    random: random.Random
    life_s: float = 0.0
    """How long the uninterrupted process lived."""
    folder_s: float = 0.0
    """How long it wrote its run folder."""
    moments: Counter[str] = field(default_factory=Counter)
    resumed: int = 0
    runs: int = 0
    faults: list[str] = field(default_factory=list)

    @property
    def out(self) -> Path:
        """Folder of the run at hand."""
        return self.folder / f"run-{self.runs}"

    @property
    def whole(self) -> Path:
        """Folder of the uninterrupted run."""
        return self.folder / "whole"

    @property
    def known(self) -> set[str]:
        """What may be in the folder of it all."""
        return {self.sequence.name, self.whole.name, self.out.name}

    def run_once(self) -> None:
        """Run without a kill, with all kernels compiled before, and see how long what takes."""
        subprocess.run([sys.executable, "-m", "scanweld", "warmup"], check=True, capture_output=True)
        begun = time.perf_counter()
        with self.process(self.whole, 0.0) as process:
            wait_until(process, self.folder, f"{prefix_of(self.whole)}*/config.toml")
            writing = time.perf_counter()
            process.wait(LONGEST_S)
        self.life_s, self.folder_s = time.perf_counter() - begun, time.perf_counter() - writing
        if not (self.whole / MARK).is_file():
            raise SystemExit("the uninterrupted run failed")

    def run(self, kills: int) -> None:
        """Kill so many processes, then let the last run end."""
        for number in range(kills):
            while not self.kill(AIMS[number % len(AIMS)]):
                self.finish()
            moment = self.look()
            self.moments[moment] += 1
            print(f"kill {number + 1}: {moment}", file=sys.stderr, flush=True)
        with self.process(self.out, EVERY_FRAME_S) as process:
            process.wait(LONGEST_S)
        self.finish()

    def kill(self, aim: str) -> bool:
        """Start a process and kill it; False when it came to its end before."""
        with self.process(self.out, EVERY_FRAME_S) as process:
            if aim == "any moment":
                wait_s = self.random.uniform(0.0, self.life_s)
            elif aim == "checkpoint":
                wait_until(process, self.out, f"{prefix_of(self.out / CHECKPOINT)}*")
                time.sleep(self.random.uniform(0.0, self.life_s / 4))
                wait_until(process, self.out, f"{prefix_of(self.out / CHECKPOINT)}*")
                wait_s = self.random.uniform(0.0, 0.01)
            else:
                wait_until(process, self.folder, f"{prefix_of(self.out)}*/config.toml")
                wait_s = self.random.uniform(0.0, self.folder_s)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(wait_s)
            process.kill()
        return process.returncode == -signal.SIGKILL

    def look(self) -> str:
        """Return what a kill fell into, by what is there; note a checkpoint that is not whole."""
        checkpoint = self.out / CHECKPOINT
        if checkpoint.is_file():
            try:
                with CheckpointFile(checkpoint) as file:
                    file.read(file.left)
            except (FileFormatError, ValueError) as error:
                self.faults.append(str(error))
        if any(self.folder.glob(f"{prefix_of(self.out)}*{OLD}")):
            return "putting the run folder in its place"
        if any(self.folder.glob(f"{prefix_of(self.out)}*")):
            return "writing the run folder"
        if any(self.out.glob(f"{prefix_of(checkpoint)}*")):
            return "writing a checkpoint"
        if (self.out / MARK).is_file():
            return "after the run was in its place"
        return "between checkpoints" if checkpoint.is_file() else "before the first checkpoint"

    def finish(self) -> None:
        """Compare a run that came to its end with the uninterrupted one; another begins."""
        if not (self.out / MARK).is_file():
            self.faults.append(f"{self.out.name}: did not come to its end")
        else:
            self.faults += [f"{self.out.name}: {what}" for what in compare_runs(self.out, self.whole).different.items()]
            self.resumed += len(json.loads((self.out / MARK).read_text(encoding="utf-8")).get("resumed_at", ()))
        strangers = {path.name for path in self.folder.iterdir()} - self.known
        if strangers or any(path.name.startswith(".") for path in self.out.iterdir()):
            self.faults.append(f"{self.out.name}: left behind: {', '.join(sorted(strangers)) or 'a hidden file'}")
        shutil.rmtree(self.out, ignore_errors=True)
        self.runs += 1

    @contextlib.contextmanager
    def process(self, out: Path, every_s: float) -> Iterator[subprocess.Popen[bytes]]:
        """Start a process; in the end there is none."""
        arguments = ["slam", self.sequence, "--out", out, "--resume", "--checkpoint-every", every_s]
        command = [sys.executable, "-m", "scanweld", *map(str, arguments)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                yield process
            finally:
                process.kill()
                process.wait()

    def figures(self) -> dict[str, Any]:
        """Return what came of it."""
        return {
            "kills": self.moments.total(),
            "moments": dict(sorted(self.moments.items())),
            "runs": self.runs,
            "resumptions": self.resumed,
            "seconds_uninterrupted": round(self.life_s, 2),
            "faults": self.faults,
        }


def wait_until(process: subprocess.Popen[bytes], folder: Path, pattern: str) -> None:
    """Wait until there is a file of such a name, or the process has ended."""
    while process.poll() is None and not any(folder.glob(pattern)):
        time.sleep(0.0005)


def text(figures: dict[str, Any]) -> str:
    """Return the figures as lines for a person."""
    rows = [f"{count:4d}  {moment}" for moment, count in figures["moments"].items()]
    rows.append(f"{figures['kills']:4d}  kills of {figures['runs']} runs, gone on {figures['resumptions']} times")
    faults = figures["faults"] or ["every run has the bytes of the uninterrupted one, and nothing is left behind"]
    return "\n".join([*rows, *faults])


if __name__ == "__main__":
    sys.exit(main())
