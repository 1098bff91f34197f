"""Ten thousand sequences on a hundred machines: how long, and what holds them up.

    python benchmarks/cluster_plan.py [--figures benchmarks/cluster.json] [--machines 100] [--sequences 10000] [--json]

A simulation of events, from what benchmarks/cluster.py measured: processor seconds of a frame and of a run, bytes of a
frame and of a run folder, and the time that the scheduler is busy with a task. Each machine runs as many sequences at a
time as it has cores. A sequence is handed over by the scheduler, one after the other; is fetched from the storage,
whose bandwidth all that fetch and upload at the moment share evenly, up to that of a machine's network; is run; is
uploaded. What was not measured is assumed, and can be given:

- sequences are as long as rooms are: lengths are log-normal about `--frames`, that of ScanNet (2.5 million frames in
  1513 recordings), with a spread of 0.6 of the logarithm; handed over in any order, or the longest first;
- machines differ by a tenth, and one in a hundred takes twice as long; cores of a machine do not slow each other down;
- a worker is lost once in `--worker-hours`, and what it was at begins anew on another one: without a shared disk there
  is no checkpoint to go on from.

The bottleneck is what the places of the cluster wait for most, where they do not compute.
"""

from __future__ import annotations

import argparse
import heapq
import json
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

FIGURES = Path(__file__).with_name("cluster.json")
GB = 1e9
BANDWIDTHS = (1, 2, 5, 10, 20, 50)  # of the storage [GB/s]
SPREAD = 0.6  # of the logarithm of a sequence's length; its mean is that of `frames`


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A cluster, a batch, and what its parts take.

    Attributes
    ----------
    frame_s, run_s : time of one core for a frame, and besides for a run
    frame_bytes, run_bytes : to be fetched for a frame, and to be uploaded for a run
    dispatch_s : that the scheduler and its client are busy with a task
    task_s : that a task takes besides
    storage, network : bytes a second of the storage, and of a machine
    longest_first : whether sequences are handed over by their length, or in any order
    """

    frame_s: float
    run_s: float
    frame_bytes: float
    run_bytes: float
    dispatch_s: float
    task_s: float
    machines: int = 100
    cores: int = 16
    sequences: int = 10_000
    frames: float = 1650.0
    storage: float = 5 * GB
    network: float = 1.25 * GB
    worker_hours: float = 1000.0
    longest_first: bool = False
    seed: int = 0

    @property
    def places(self) -> int:
        """Sequences that are run at a time."""
        return self.machines * self.cores


@dataclass(frozen=True)
class Result:
    """What came of it: hours, and shares of the time of all places."""

    hours: float
    shares: dict[str, float]
    lost: int

    @property
    def bottleneck(self) -> str:
        """What places wait for most."""
        return max((name for name in self.shares if name != "computing"), key=self.shares.__getitem__)


class Storage:
    """Bandwidth that transfers share evenly: all that are under way have come equally far since they were there."""

    def __init__(self, plan: Plan) -> None:
        self._rate = plan.storage
        self._each = plan.network / plan.cores
        self._served, self._now = 0.0, 0.0
        self._ends: list[tuple[float, int]] = []  # what each is to have been served when it is done

    def _speed(self) -> float:
        return min(self._each, self._rate / len(self._ends)) if self._ends else 0.0

    def _advance(self, now: float) -> None:
        self._served += (now - self._now) * self._speed()
        self._now = now

    def begin(self, now: float, place: int, size: float) -> None:
        """Begin a transfer."""
        self._advance(now)
        heapq.heappush(self._ends, (self._served + size, place))

    def next_end(self) -> float:
        """Return when the next transfer is done, if none begins before."""
        if not self._ends:
            return float("inf")
        return self._now + max(0.0, self._ends[0][0] - self._served) / self._speed()

    def end(self, now: float) -> int:
        """End the next transfer, and return whose it was."""
        self._advance(now)
        return heapq.heappop(self._ends)[1]


def simulate(plan: Plan) -> Result:
    """Return what comes of a plan."""
    random = np.random.default_rng(plan.seed)
    lengths = plan.frames * np.exp(SPREAD * random.standard_normal(plan.sequences) - SPREAD**2 / 2)
    pace = np.exp(0.1 * random.standard_normal(plan.machines)) * np.where(random.random(plan.machines) < 0.01, 2.0, 1.0)
    waiting = deque(np.argsort(-lengths).tolist() if plan.longest_first else range(plan.sequences))
    storage = Storage(plan)
    events: list[tuple[float, int, str, int]] = []
    spent = dict.fromkeys(("computing", "storage", "scheduler", "worker lost", "nothing left"), 0.0)
    holds = [-1] * plan.places
    since = [0.0] * plan.places
    uploading = [False] * plan.places
    served = finished = 0.0
    lost = 0

    def hand_over(now: float, place: int) -> None:
        """Have the scheduler, which serves one at a time, give a place its next sequence."""
        nonlocal served
        if waiting:
            served = max(served, now) + plan.dispatch_s
            spent["scheduler"] += served + plan.task_s - now
            holds[place] = waiting.popleft()
            heapq.heappush(events, (served + plan.task_s, place, "fetch", holds[place]))
        else:
            holds[place], since[place] = -1, now

    for place in range(plan.places):
        hand_over(0.0, place)
    while events or storage.next_end() < float("inf"):
        if events and events[0][0] <= storage.next_end():
            now, place, kind, task = heapq.heappop(events)
            if kind == "fetch":
                since[place], uploading[place] = now, False
                storage.begin(now, place, lengths[task] * plan.frame_bytes)
            elif kind == "computed":
                since[place], uploading[place] = now, True
                storage.begin(now, place, plan.run_bytes)
            else:
                lost += 1
                waiting.appendleft(task)
                hand_over(now, place)
            continue
        now = storage.next_end()
        place = storage.end(now)
        spent["storage"] += now - since[place]
        if uploading[place]:
            finished = now
            hand_over(now, place)
            continue
        task = holds[place]
        needed = (plan.run_s + lengths[task] * plan.frame_s) * pace[place // plan.cores]
        until = random.exponential(plan.worker_hours * 3600)
        spent["computing" if until > needed else "worker lost"] += min(until, needed)
        heapq.heappush(events, (now + min(until, needed), place, "computed" if until > needed else "lost", task))
    spent["nothing left"] = sum(finished - since[place] for place in range(plan.places) if holds[place] < 0)
    whole = finished * plan.places
    return Result(finished / 3600, {name: value / whole for name, value in spent.items()}, lost)


def plan_from(figures: Path, **changes: Any) -> Plan:
    """Return the plan that measured figures make."""
    measured = json.loads(figures.read_text(encoding="utf-8"))
    model, overhead = measured["model"], measured["overhead"]
    names = ("frame_s", "run_s", "frame_bytes", "run_bytes")
    return Plan(
        **{name: model[name] for name in names}, dispatch_s=1 / overhead["empty_tasks_per_s"],
        task_s=overhead["overhead_s"], **changes,
    )  # fmt: skip


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figures", type=Path, default=FIGURES)
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--cores", type=int, default=16)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--frames", type=float, default=1650.0)
    parser.add_argument("--worker-hours", type=float, default=1000.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    changes = {key: value for key, value in vars(arguments).items() if key not in ("figures", "json")}
    base = plan_from(arguments.figures, **changes)
    results = {
        (first, gb): simulate(replace(base, storage=gb * GB, longest_first=first))
        for first in (False, True)
        for gb in BANDWIDTHS
    }
    if arguments.json:
        told = [
            {"longest first": first, "storage [GB/s]": gb, **vars(result), "bottleneck": result.bottleneck}
            for (first, gb), result in results.items()
        ]
        print(json.dumps(told, indent=1))
        return
    print(f"{base.sequences} sequences of {base.frames:.0f} frames on {base.machines} machines of {base.cores} cores")
    for (first, gb), result in results.items():
        order = "longest first" if first else "in any order"
        shares = ", ".join(f"{name} {100 * share:.1f} %" for name, share in result.shares.items())
        print(f"{order}, {gb:3d} GB/s: {result.hours:5.2f} h; {shares}; {result.lost} workers lost")


if __name__ == "__main__":
    main()
