"""Measure the live view: updates a second with a large map, and what it costs tracking.

    python benchmarks/live_view.py                         a made map of a million surfels, frames at 60 a second
    python benchmarks/live_view.py --sequence SEQUENCE     the same run with and without the view, in turns

Whoever looks is a process of its own that takes in what the server sends, as a browser does, and counts the updates of
the camera. Times are of this machine; what is compared is measured in turns in one process: by the clock, where whoever
looks takes part of the machine, and by the time of the processors that the run with its view took, where it does not.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

import scanweld as sw
from scanweld.datasets.base import RgbdSequence
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.viewer.live import LiveView

FRAMES_PER_SECOND = 60.0


def look_on(url: str, pipe: Connection) -> None:
    """Take in what a view sends until told to stop; answer with the times of updates of the camera, and the bytes."""
    import msgspec
    import viser
    import zstandard
    from viser._messages import ViewerCameraMessage
    from websockets.sync.client import connect

    times_s: list[float] = []
    num_bytes = 0
    place = "ws" + url.removeprefix("http")
    with connect(place, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None) as socket:
        # Where it stands: only then it is taken for a browser.
        camera = ViewerCameraMessage((1, 0, 0, 0), (0, 0, 0), 1.0, 0.1, 1e3, 480, 640, (0, 0, 1), (0, -1, 0))
        socket.send(msgspec.msgpack.encode(camera.as_serializable_dict([])))
        pipe.send("ready")
        while not pipe.poll():
            try:
                message = socket.recv(timeout=0.2)
            except TimeoutError:
                continue
            assert isinstance(message, bytes)
            num_bytes += len(message)
            packed = int.from_bytes(message[8:16], "little")
            content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(message[16 : 16 + packed]))
            if any(m.get("name") == "/camera" and "position" in m for m in content["messages"]):
                times_s.append(time.monotonic())
    pipe.send((times_s, num_bytes))


class Watched:
    """A live view with somebody who looks; `close` returns updates a second and megabytes a second."""

    def __init__(self) -> None:
        self.view = LiveView(port=0)
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe()
        self._process = spawn.Process(target=look_on, args=(self.view.url, theirs), daemon=True)
        self._process.start()
        assert self._pipe.recv() == "ready"
        while not self.view.watched:
            time.sleep(0.01)

    def close(self) -> tuple[float, float]:
        self._pipe.send("stop")
        times_s, num_bytes = self._pipe.recv()
        self._process.join()
        self.view.close()
        span_s = max(times_s[-1] - times_s[0], 1e-9) if len(times_s) > 1 else 1.0
        return (len(times_s) - 1) / span_s, num_bytes / 1e6 / span_s


def grow(
    surfels: SurfelMap, count: int, frame: int, rng: np.random.Generator, reach_m: float, x_m: float = 0.0
) -> None:
    """Add surfels to a floor, within so many metres of a place."""
    positions = np.vstack([rng.uniform(-reach_m, reach_m, (2, count)), np.zeros((1, count))]).astype(np.float32)
    positions[0] += np.float32(x_m)
    normals = np.repeat(np.float32([[0], [0], [1]]), count, axis=1)
    ones = np.ones(count, np.float32)
    surfels.append(positions, normals, 200 * np.abs(positions) / 20, 0.01 * ones, ones, frame)


def updates(num_surfels: int, seconds: float) -> dict[str, float]:
    """Frames at 60 a second over a map that grows by 500 surfels a frame near the camera; nothing is tracked."""
    rng = np.random.default_rng(0)
    camera = sw.PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
    slam = sw.build_slam(camera, sw.SlamConfig())
    grow(slam.map, num_surfels, 0, rng, 10.0)
    image = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    depth = np.full((480, 640), 2, np.float32)
    watched, spent = Watched(), []
    begin = time.monotonic()
    k = 0
    while time.monotonic() - begin < seconds:
        pose = np.eye(4)
        pose[0, 3] = 0.01 * k
        grow(slam.map, 500, k, rng, 1.5, pose[0, 3])
        result = sw.FrameResult(
            index=k, timestamp_s=k / 60, state=sw.FrameState.TRACKING, T_world_camera=pose, num_surfels=len(slam.map)
        )
        started = time.perf_counter()
        watched.view.on_frame(slam, sw.Frame(k / 60, depth, image, camera), result)
        spent.append(time.perf_counter() - started)
        k += 1
        time.sleep(max(0.0, begin + k / FRAMES_PER_SECOND - time.monotonic()))
    rate, megabytes = watched.close()
    return {
        "surfels": len(slam.map), "updates_per_second": rate, "megabytes_per_second": megabytes,
        "ms_in_run_median": 1e3 * statistics.median(spent), "ms_in_run_mean": 1e3 * statistics.fmean(spent),
    }  # fmt: skip


def cost(sequence: RgbdSequence, rounds: int) -> dict[str, object]:
    """Time of whole runs without and with a view that somebody looks at, in turns; the first round warms up."""
    rates: list[float] = []
    clock: list[tuple[float, float]] = []
    processors: list[tuple[float, float]] = []
    for number in range(rounds + 1):
        plain = timed(lambda: sw.run_sequence(sequence))
        watched = Watched()
        seen = timed(lambda watched=watched: sw.run_sequence(sequence, observers=[watched.view]))
        rate, _ = watched.close()
        if number:
            clock.append((plain[0], seen[0]))
            processors.append((plain[1], seen[1]))
            rates.append(rate)
    return {
        "frames": len(sequence), "by_the_clock": compared(clock), "by_processor_time": compared(processors),
        "updates_per_second": statistics.median(rates),
        "frames_per_second": len(sequence) / statistics.median(seen for _, seen in clock),
    }  # fmt: skip


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Return the seconds that a call takes by the clock, and of the processors for this process."""
    clock, processors = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - clock, time.process_time() - processors


def compared(seconds: list[tuple[float, float]]) -> dict[str, object]:
    """Name seconds without and with a view, and their ratios."""
    ratios = [seen / plain for plain, seen in seconds]
    return {
        "seconds_without": [plain for plain, _ in seconds], "seconds_with": [seen for _, seen in seconds],
        "ratios": ratios, "ratio_median": statistics.median(ratios),
    }  # fmt: skip


def main() -> None:
    """Measure what the arguments say and print it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", help="measure the cost on this sequence instead")
    parser.add_argument("--frames", help="A:B[:STEP] of it")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--surfels", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    if options.sequence:
        measured: dict[str, object] = cost(sw.open_sequence(options.sequence, frames=options.frames), options.rounds)
    else:
        measured = {**updates(options.surfels, options.seconds)}
    print(json.dumps(measured, indent=2))


if __name__ == "__main__":
    main()
