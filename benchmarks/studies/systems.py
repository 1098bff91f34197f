"""The systems under test: each a process that takes requests, ours and the peers' in turn."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

WORKER = Path(__file__).with_name("worker.py")
PEERS = ("small_gicp", "open3d")
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Contender:
    """One method of one system, as tables name it."""

    system: System
    method: str

    @property
    def name(self) -> str:
        return f"{self.system.name} {self.method}"


class System:
    """A running worker. `methods` are those it has; `request` returns the answer, or raises what went wrong."""

    def __init__(self, name: str, python: str, threads: int) -> None:
        environment = {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads)), "OMP_WAIT_POLICY": "PASSIVE"}
        self.name = name
        self._process = subprocess.Popen(
            [python, str(WORKER), name, str(threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            env=environment,
        )
        about = self.request(do="about")
        self.version: str = about["version"]
        self.methods: list[str] = about["methods"]

    def request(self, **request: Any) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(request) + "\n")
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name} ended with code {self._process.wait()} on {request}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(f"{self.name}: {answer['error']}")
        return answer

    def close(self) -> None:
        """End the process."""
        if self._process.stdin:
            self._process.stdin.close()
        self._process.wait()


@dataclass
class Bench:
    """What a study works with: the systems, and a folder for the clouds that they share."""

    systems: dict[str, System]
    threads: int
    folder: Path
    said: list[str] = field(default_factory=list)

    def put(self, name: str, points: np.ndarray) -> str:
        """Write a cloud where every worker can read it."""
        path = self.folder / f"{name}.npy"
        np.save(path, points)
        return str(path)

    def drop(self, path: str) -> None:
        """Remove a cloud that nobody needs again."""
        Path(path).unlink()

    def contenders(self, wanted: Sequence[tuple[str, str]]) -> list[Contender]:
        """Return those of the wanted (system, method) that are there, and say which are not."""
        found = []
        for name, method in wanted:
            if name not in self.systems:
                self.said.append(f"{name} is left out: not asked for, or no --peer-python")
            elif method not in self.systems[name].methods:
                self.said.append(f"{name} has no {method} in this version: left out")
            else:
                found.append(Contender(self.systems[name], method))
        return found


@contextlib.contextmanager
def open_bench(names: Sequence[str], threads: int, peer_python: str | None) -> Iterator[Bench]:
    """Start the systems; the peers only where their Python is given and has them."""
    systems: dict[str, System] = {}
    with tempfile.TemporaryDirectory(prefix="scanweld-bench-") as folder:
        try:
            for name in names:
                if name not in PEERS:
                    systems[name] = System(name, sys.executable, threads)
                elif peer_python:
                    systems[name] = System(name, peer_python, threads)
            yield Bench(systems, threads, Path(folder))
        finally:
            for system in systems.values():
                system.close()
