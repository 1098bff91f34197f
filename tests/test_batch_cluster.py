"""Batches on real workers, processes of this machine: what is lost, and what is not done twice."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from scanweld.cluster.batch import ClusterOptions, run_batch
from scanweld.cluster.observer import BatchObserver
from scanweld.cluster.outcome import Outcome, State
from scanweld.cluster.plan import plan_batch
from scanweld.cluster.scheduler import connected
from scanweld.cluster.task import RunTask
from scanweld.datasets.synthetic import RenderConfig, render_sequence
from scanweld.errors import InvalidInputError
from scanweld.runs.folder import CHECKPOINT
from scanweld.runs.input import RunInput
from scanweld.slam.config import SlamConfig

PATIENCE_S = 240.0
"""For what takes seconds, on a machine that may have much else to do."""

MANY = 30
"""Frames of the sequence that is met in the middle; a checkpoint after each makes it slow enough for that."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sequences "a" and "b" of few frames, "heavy" with much beside, which is run first, "long", and a corrupt one."""
    folder = tmp_path_factory.mktemp("recordings")
    small = RenderConfig(scene="room", noise="none", frames=4, width=160, height=120)
    render_sequence(folder / "a", small)
    for name in ("b", "heavy", "corrupt"):
        shutil.copytree(folder / "a", folder / name)
    (folder / "heavy" / "notes.txt").write_bytes(b"\n" * 20_000_000)
    for image in (folder / "corrupt").rglob("*.png"):
        image.write_bytes(b"\xff" * 1000)
    render_sequence(folder / "long", replace(small, frames=MANY))
    return folder


class Witness(BatchObserver):
    """Looks on at a batch."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.process_of: dict[int, int] = {}
        self.outcomes: list[Outcome] = []

    def say(self, text: str) -> None:
        self.told.append(text)

    def working(self, number: int, what: Mapping[str, Any]) -> None:
        self.process_of[number] = what["pid"]

    def ended(self, outcome: Outcome) -> None:
        self.outcomes.append(outcome)


def tasks_of(folder: Path, names: str, out: Path, **changes: Any) -> list[RunTask]:
    places = [str(folder / name) for name in names.split()]
    return [replace(task, **changes) for task in plan_batch(places, str(out), RunInput(""), lambda _: SlamConfig())]


def wait_for(condition: Callable[[], Any]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.005)


def in_the_middle_of(number: int, out: Path, witness: Witness, act: Callable[[int], None]) -> threading.Thread:
    """Act, with the process that is at work on it, once the run of a task has a checkpoint."""

    def watch() -> None:
        wait_for(lambda: (out / CHECKPOINT).is_file() and number in witness.process_of)
        act(witness.process_of[number])

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


@pytest.mark.slow
def test_a_corrupt_sequence_and_a_killed_worker(recordings: Path, tmp_path: Path) -> None:
    """The rest finishes; the run of the killed worker goes on from its checkpoint; a second batch runs nothing."""
    tasks = tasks_of(recordings, "a corrupt long b", tmp_path, checkpoint_every_s=1e-6)
    witness = Witness()
    killer = in_the_middle_of(2, tmp_path / "long", witness, lambda process: os.kill(process, signal.SIGKILL))
    outcomes = run_batch(tasks, ClusterOptions(workers=2), witness)
    killer.join(PATIENCE_S)
    assert [outcome.state for outcome in outcomes] == [State.DONE, State.FAILED, State.DONE, State.DONE]
    assert [outcome.number for outcome in outcomes] == [0, 1, 2, 3]
    assert outcomes[1].reason.startswith("corrupt: ")
    assert "long: its worker was lost; it is tried again" in witness.told
    assert [outcome.resumed for outcome in outcomes] == [0, 0, 1, 0]
    assert json.loads((tmp_path / "long" / "run.json").read_text())["resumed_at"][0] > 0
    assert outcomes[2].metrics["frames_tracked"] == MANY
    assert sorted(outcome.number for outcome in witness.outcomes) == [0, 1, 2, 3]  # each came to one end

    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/run.json")}
    again = run_batch(tasks, ClusterOptions(workers=1), Witness())
    assert [outcome.state for outcome in again] == [State.KEPT, State.FAILED, State.KEPT, State.KEPT]
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/run.json")} == written


@pytest.mark.slow
def test_a_sequence_that_kills_its_workers_is_given_up(recordings: Path, tmp_path: Path) -> None:
    """It alone: the other goes on."""
    tasks = tasks_of(recordings, "long a", tmp_path, checkpoint_every_s=1e-6)
    witness = Witness()
    killer = in_the_middle_of(0, tmp_path / "long", witness, lambda process: os.kill(process, signal.SIGKILL))
    outcomes = run_batch(tasks, ClusterOptions(workers=1, retries=0), witness)
    killer.join(PATIENCE_S)
    assert [outcome.state for outcome in outcomes] == [State.FAILED, State.DONE]
    assert outcomes[0].reason == "its worker was lost: killed, or out of memory"


def test_workers_that_have_less_than_is_asked_for(recordings: Path, tmp_path: Path) -> None:
    """Nothing would ever run; workers that say nothing of what they have are taken as they are."""
    tasks = tasks_of(recordings, "a", tmp_path)
    with connected(workers=1, resources={"threads": 1}) as client:
        options = ClusterOptions(scheduler=client.scheduler_info()["address"], threads=2)
        with pytest.raises(InvalidInputError, match="no worker offers threads=2; start them with --resources"):
            run_batch(tasks, options, Witness())
        (outcome,) = run_batch(tasks, replace(options, threads=1, memory="4GB"), Witness())
        assert outcome.good


@contextlib.contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of Dask, a scheduler or a worker, in a process group of its own, which ends with the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_a_scheduler_that_is_started_anew(recordings: Path, tmp_path: Path) -> None:
    """What was finished before the scheduler was killed is not run again; the rest is, by workers of the new one."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = (
        "worker", f"tcp://127.0.0.1:{port}", "--host", "127.0.0.1", "--nworkers", "1", "--nthreads", "1",
        "--no-dashboard", "--local-directory", str(tmp_path / "scratch"),
    )  # fmt: skip
    with contextlib.ExitStack() as running:
        first = running.enter_context(dask(*scheduler))
        running.enter_context(dask(*worker))

        def start_anew(_: int) -> None:
            os.killpg(first.pid, signal.SIGKILL)
            first.wait()
            running.enter_context(dask(*scheduler))
            running.enter_context(dask(*worker))

        witness = Witness()
        tasks = tasks_of(recordings, "heavy long b", tmp_path / "runs", checkpoint_every_s=1e-6)
        restart = in_the_middle_of(1, tmp_path / "runs" / "long", witness, start_anew)
        outcomes = run_batch(tasks, ClusterOptions(scheduler=f"tcp://127.0.0.1:{port}"), witness)
        restart.join(PATIENCE_S)
    assert [(outcome.state, outcome.resumed) for outcome in outcomes] == [
        (State.DONE, 0), (State.DONE, 1), (State.DONE, 0),
    ]  # fmt: skip
    assert f"the scheduler at tcp://127.0.0.1:{port} was lost; waiting for it" in witness.told
    assert [outcome.number for outcome in witness.outcomes] == [0, 1, 2]


@pytest.mark.slow
def test_ctrl_c_and_the_same_command_again(recordings: Path, tmp_path: Path) -> None:
    """Ctrl-C reaches the command alone; its workers end with a checkpoint, from which the same command goes on."""
    command = [
        sys.executable, "-m", "scanweld", "batch", str(recordings / "long"), str(recordings / "a"),
        "--out", str(tmp_path), "--workers", "1", "--checkpoint-every", "0.000001",
    ]  # fmt: skip
    environment = {**os.environ, "COLUMNS": "80"}
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment
    )
    wait_for(lambda: (tmp_path / "long" / CHECKPOINT).is_file() or running.poll() is not None)
    os.killpg(running.pid, signal.SIGINT)
    output, told = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 130, told
    assert "Traceback" not in told
    assert told.splitlines()[-1] == "interrupted; the same command goes on from here"
    assert [line.split() for line in output.splitlines()[1:3]] == [["long", "interrupted"], ["a", "interrupted"]]
    assert (tmp_path / "long" / CHECKPOINT).is_file()
    assert not (tmp_path / "a").exists()

    done = subprocess.run([*command, "--json"], capture_output=True, text=True, env=environment, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    runs = json.loads(done.stdout)["runs"]
    assert [(run["run"], run["state"], run["resumed"]) for run in runs] == [("long", "done", 1), ("a", "done", 0)]
    assert {path.name for path in tmp_path.iterdir()} == {"long", "a", "batch.parquet", "report.html"}
