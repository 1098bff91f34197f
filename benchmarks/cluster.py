"""What a batch gains from a second worker, what a task costs besides its work, and what a cluster is planned from.

    python benchmarks/cluster.py [--frames 240] [--rounds 3] [--tasks 200] [--model SEQUENCE] [--out F.json]

Workers: eight rooms are rendered at 160x120, and run by one worker and by two, one thread each, in turns. The time is
that of the whole batch, with the start of the workers, and without it: from the first task that begins on. What the
machine itself gives is measured likewise: the same work in two plain processes at once, and in one.

Overhead: a run that is finished is handed to one worker many times over; it sees that, and reads what came of it. The
same calls are made without a cluster. The difference is what Dask, the network and the batch cost a task. How many
tasks without work pass through in a second is what a scheduler and its client can serve.

Model (`--model`): a sequence of 640x480 is run with one thread, all of it and its first third: seconds of a processor
for a frame and for a run, which depend little on what else the machine does; bytes of a frame and of a run folder.
`--out` keeps the figures for benchmarks/cluster_plan.py.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import scanweld as sw
from scanweld.cluster.batch import ClusterOptions, run_batch
from scanweld.cluster.observer import BatchObserver
from scanweld.cluster.outcome import Outcome, State
from scanweld.cluster.plan import plan_batch
from scanweld.cluster.scheduler import connected
from scanweld.cluster.task import RunTask, run_task
from scanweld.runs.input import RunInput
from scanweld.runs.storage.recordings import list_files
from scanweld.slam.config import SlamConfig
from scanweld.slam.warmup import compile_kernels

SEQUENCES = 8


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tasks", type=int, default=200)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    compile_kernels(print)
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="scanweld-cluster-") as aside:
        folder = Path(aside)
        places = [folder / f"room-{k}" for k in range(SEQUENCES)]
        for k, place in enumerate(places):
            size = {"width": 160, "height": 120}
            sw.render_sequence(place, sw.RenderConfig(noise="kinect", frames=arguments.frames, seed=k, **size))
        figures["workers"] = measure_workers(places, folder, arguments.rounds)
        figures["overhead"] = measure_overhead(places[0], folder, arguments.tasks)
        if arguments.model:
            figures["model"] = measure_model(arguments.model, folder)
    print(json.dumps(figures, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


class Clock(BatchObserver):
    """Takes the time from the first task that begins, and looks on otherwise."""

    def __init__(self) -> None:
        self.begun = 0.0

    def working(self, number: int, what: Mapping[str, Any]) -> None:
        """Note the first."""
        self.begun = self.begun or time.perf_counter()

    def ended(self, outcome: Outcome) -> None:
        """Fail loudly: times of what went wrong mean nothing."""
        if not outcome.good:
            raise SystemExit(f"a run failed: {outcome.reason}")


def tasks_of(places: Sequence[Path], out: Path) -> list[RunTask]:
    """Return one task a sequence."""
    return plan_batch([str(place) for place in places], str(out), RunInput(""), lambda _: SlamConfig())


def measure_workers(places: Sequence[Path], folder: Path, rounds: int) -> dict[str, Any]:
    """Run all sequences by one worker and by two, and by plain processes, in turns."""
    seconds: dict[str, list[float]] = {}
    for k in range(rounds):
        for workers in (1, 2) if k % 2 == 0 else (2, 1):
            clock, begun = Clock(), time.perf_counter()
            out = folder / f"runs-{k}-{workers}"
            run_batch(tasks_of(places, out), ClusterOptions(workers=workers, threads=1), clock)
            seconds.setdefault(f"{workers} workers, whole", []).append(time.perf_counter() - begun)
            seconds.setdefault(f"{workers} workers, from the first task", []).append(time.perf_counter() - clock.begun)
            seconds.setdefault(f"{workers} plain processes", []).append(
                plain(places, folder / f"{out.name}-p", workers)
            )
    ratios = {
        kind: statistics.median(a / b for a, b in zip(seconds[f"1 {kind}"], seconds[f"2 {kind}"], strict=True))
        for kind in ("workers, whole", "workers, from the first task", "plain processes")
    }
    return {"seconds": seconds, "one over two": ratios}


def plain(places: Sequence[Path], out: Path, processes: int) -> float:
    """Return how long the sequences take in processes without a cluster, once these have begun."""
    tasks = tasks_of(places, out)
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        pool.map(_begin, range(processes), chunksize=1)
        begun = time.perf_counter()
        for outcome in pool.imap_unordered(_run, tasks):
            Clock().ended(outcome)
        return time.perf_counter() - begun


def _begin(_: int) -> None:
    time.sleep(0.5)  # so that each process takes one


def _run(task: RunTask) -> Outcome:
    return run_task(task, "plain")


def measure_overhead(place: Path, folder: Path, count: int) -> dict[str, float]:
    """Return what a task costs besides its work [s], and how many tasks without work pass in a second."""
    (task,) = tasks_of([place], folder / "finished")
    run_task(task, "first")
    begun = time.perf_counter()
    for _ in range(count):
        assert run_task(task, "direct").state is State.KEPT
    direct_s = (time.perf_counter() - begun) / count

    class Last(Clock):
        def __init__(self) -> None:
            super().__init__()
            self.at: list[float] = []

        def ended(self, outcome: Outcome) -> None:
            assert outcome.state is State.KEPT
            self.at.append(time.perf_counter())

    last = Last()
    run_batch([replace(task, number=k) for k in range(count)], ClusterOptions(workers=1, threads=1), last)
    each_s = (last.at[-1] - last.at[0]) / (count - 1)  # between the first and the last to end
    with connected(workers=1) as client:
        client.submit(abs, -1).result()
        begun = time.perf_counter()
        client.gather(client.map(_nothing, range(10 * count)))
        through = 10 * count / (time.perf_counter() - begun)
    return {"direct_s": direct_s, "task_s": each_s, "overhead_s": each_s - direct_s, "empty_tasks_per_s": through}


def _nothing(_: int) -> None:
    pass


def measure_model(place: Path, folder: Path) -> dict[str, float]:
    """Return what a frame and a run of 640x480 take: seconds of a processor, bytes to read and to keep."""
    count = len(sw.open_sequence(place))
    seconds: dict[int, float] = {}
    for frames in (10, count // 3, count):  # the first loads the kernels
        (task,) = tasks_of([place], folder / f"model-{frames}")
        begun = time.process_time()
        outcome = run_task(replace(task, source=replace(task.source, frames=f"0:{frames}")), "model")
        Clock().ended(outcome)
        seconds[frames] = time.process_time() - begun
    (_, few), (many, many_s) = list(seconds)[:2], list(seconds.items())[-1]
    frame_s = (many_s - seconds[few]) / (many - few)
    return {
        "frames": count,
        "frame_s": frame_s,
        "run_s": seconds[few] - few * frame_s,
        "frame_bytes": sum(list_files(str(place)).sizes.values()) / count,
        "run_bytes": sum(path.stat().st_size for path in Path(task.folder).rglob("*") if path.is_file()),
    }


if __name__ == "__main__":
    main()
