"""The contracts of `scanweld.testing`: the library keeps them, and each notices parts that break a promise."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import scanweld as sw
from rendered import rendered
from scanweld import testing
from scanweld.datasets.base import WrappedSequence
from scanweld.datasets.gyroscope import Gyroscope
from scanweld.datasets.playback import WallClock
from scanweld.errors import UnreadableFrameError
from scanweld.geometry import se3
from scanweld.geometry.neighbours import KdTree
from scanweld.geometry.neighbours.grid import HashGrid
from scanweld.mapping.backends import compiled as compiled_map
from scanweld.mapping.backends import reference as reference_map
from scanweld.meshing.splats import splats_from_surfels
from scanweld.registration.backends import compiled, reference
from scanweld.registration.projective import ProjectiveConfig
from scanweld.registration.robust import losses
from scanweld.runs.checkpoint import file as checkpoint_file
from scanweld.testing.states import StoredBytes
from scanweld.tracking.tracker import TrackingConfig

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "contracts.md"


def breaks(words: str) -> Any:
    """The check says which promise was broken, in words that match."""
    return pytest.raises(AssertionError, match=words)


class TestPage:
    def test_every_protocol_has_a_check(self) -> None:
        """Whoever adds a Protocol adds its contract, and a row of the table."""
        protocols = set()
        for source in (ROOT / "src").rglob("*.py"):
            for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "Protocol" for base in node.bases):
                    protocols.add(node.name)
        rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| `(\w+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
        assert protocols == {name for names, _ in rows for name in re.findall(r"\w+", names)}
        assert {check for _, check in rows} == set(testing.__all__)

    def test_its_programs_run(self) -> None:
        variables: dict[str, Any] = {}
        for program in re.findall(
            r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            exec(compile(program, PAGE.name, "exec"), variables)
        assert "check_tracker" in variables

    def test_no_test_framework_is_needed(self) -> None:
        code = "import sys, scanweld.testing; sys.exit('pytest' in sys.modules or 'hypothesis' in sys.modules)"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class TestSequence:
    """Readers of files are in test_datasets_*.py."""

    @pytest.mark.parametrize("noise", ["none", "kinect"])
    def test_ours(self, noise: str) -> None:
        sequence = sw.SyntheticSequence(sw.RenderConfig(width=64, height=48, frames=5, noise=noise))
        testing.check_sequence(sequence)
        testing.check_sequence(WrappedSequence(sequence))

    def test_a_gyroscope_of_another_clock(self) -> None:
        class Turning(WrappedSequence):
            @property
            def gyroscope(self) -> Gyroscope:
                return turning

        sequence = Turning(sw.SyntheticSequence(sw.RenderConfig(width=64, height=48, frames=5)))
        turning = Gyroscope(np.arange(3.0), np.zeros((3, 3)), np.eye(3))
        testing.check_gyroscope(sequence)
        turning = Gyroscope(1e9 + np.arange(3.0), np.zeros((3, 3)), np.eye(3))
        with breaks("gyroscope: its times"):
            testing.check_sequence(sequence)
        turning = np.zeros((3, 3))  # type: ignore[assignment]
        with breaks("expected a Gyroscope"):
            testing.check_gyroscope(sequence)
        with breaks("no attribute"):
            testing.check_gyroscope(object())  # type: ignore[arg-type]


class Camera:
    """A camera in memory; each fault is one that drivers have."""

    name, depth_scale, ground_truth, camera = "camera", 1000.0, None, rendered().camera

    def __init__(self, fault: str = "") -> None:
        self.fault, self._times_s, self._open = fault, [], True

    @property
    def timestamps_s(self) -> np.ndarray:
        return np.array(self._times_s, np.float64)

    def __len__(self) -> int:
        return 40 if self.fault == "knows its end" else len(self._times_s)

    def live(self) -> Iterator[sw.Frame]:
        kept = rendered().frames[0].depth_m.copy()
        for frame in rendered().frames if self.fault != "silent" else ():
            if not self._open and self.fault != "goes on":
                return
            if self.fault == "buffer":
                kept[:] = frame.depth_m
                frame = replace(frame, depth_m=kept)
            if self.fault != "uncounted":
                self._times_s.append(frame.timestamp_s if self.fault != "one time" else 1.0)
            yield replace(frame, timestamp_s=2.0) if self.fault == "own time" else frame

    __iter__ = live

    def read(self, index: int) -> sw.Frame:
        raise UnreadableFrameError("not kept")

    def close(self) -> None:
        assert self._open or self.fault != "closes once", "closed twice"
        self._open = False


class TestLiveSequence:
    def test_kept(self) -> None:
        testing.check_live_sequence(Camera())

    def test_ours(self) -> None:
        pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed: pip install 'scanweld[realsense]'")
        from scanweld.datasets.realsense import RealSenseCamera

        testing.check_live_sequence(
            RealSenseCamera(file=Path(__file__).with_name("recorded") / "realsense.bag"), max_frames=3
        )

    @pytest.mark.parametrize(
        ("fault", "words"),
        [
            ("knows its end", "40 before a frame was asked for"),
            ("silent", "no frame has come"),
            ("buffer", "share memory"),
            ("uncounted", "0 after 1 frames"),
            ("one time", "not later|the frame's"),
            ("own time", "the frame's 2.0"),
            ("goes on", "frames still come"),
            ("closes once", "closed twice"),
        ],
    )
    def test_broken(self, fault: str, words: str) -> None:
        with breaks(words):
            testing.check_live_sequence(Camera(fault))

    def test_recordings_are_none(self) -> None:
        with breaks("LiveSequence"):
            testing.check_live_sequence(rendered())  # type: ignore[arg-type]


class Bend:
    """An index that answers in another way."""

    def __init__(self, points: np.ndarray, **bends: Callable[..., Any]) -> None:
        self.index, self.bends = KdTree(points), bends

    def __getattr__(self, name: str) -> Any:
        honest = getattr(self.index, name)
        return (lambda *args: self.bends[name](honest, *args)) if name in self.bends else honest


def exclusive(search: Callable[..., Any], points: np.ndarray, reach: float, *hint: Any) -> Any:
    distances, rows = search(points, reach, *hint)
    out = distances >= reach
    return np.where(out, np.inf, distances), np.where(out, len(points) * 0 + 10**6, rows)


def over_the_edge(search: Callable[..., Any], points: np.ndarray, start: int, stop: int, *rest: Any) -> None:
    search(points, start, stop + 1, *rest)


def highest_row(search: Callable[..., Any], points: np.ndarray, k: int, *reach: float) -> Any:
    distances, rows = search(points, k, *reach)
    order = np.lexsort((-rows, distances), axis=1)
    return np.take_along_axis(distances, order, 1), np.take_along_axis(rows, order, 1)


class TestNeighbourIndex:
    @pytest.mark.parametrize("make", [HashGrid, KdTree])
    def test_ours(self, make: Callable[[np.ndarray], Any]) -> None:
        testing.check_neighbour_index(make)

    @pytest.mark.parametrize(
        ("bends", "words"),
        [
            ({"nearest": exclusive}, "nearest within"),
            ({"nearest": lambda search, p, r, h=None: search(p, r)[::-1]}, "expected float64"),
            ({"nearest_into": over_the_edge}, "nearest_into"),
            ({"k_nearest": highest_row}, "k_nearest"),
            ({"within": lambda search, p, r: search(p, r * 0.999)}, "within"),
            ({"within": lambda search, p, r: (search(p, r)[0][1:], search(p, r)[1])}, "expected int64"),
            ({"within": lambda search, p, r: (search(p, r), np.negative(p, out=p))[0]}, "differs|has changed"),
        ],
    )
    def test_broken(self, bends: dict[str, Callable[..., Any]], words: str) -> None:
        with breaks(words):
            testing.check_neighbour_index(lambda points: Bend(points, **bends))  # type: ignore[return-value]

    def test_points_in_another_order(self) -> None:
        with breaks("not the cloud"):
            testing.check_neighbour_index(lambda points: KdTree(points[::-1]))


class TestRobustKernel:
    @pytest.mark.parametrize(
        "kernel",
        [
            *(make() for make in losses.KERNELS.values()), losses.Barron(0.0), losses.Barron(1.0), losses.Barron(2.0),
            losses.Barron(-np.inf), losses.TruncatedLeastSquares(), losses.TruncatedLeastSquares(mu=0.5),
        ],
        ids=str,
    )  # fmt: skip
    def test_ours(self, kernel: losses.RobustKernel) -> None:
        testing.check_robust_kernel(kernel)

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"weight": lambda self, u: 2 * losses.Huber.weight(self, u)}, "kernels weigh|expected 1 at u = 0"),
            ({"weight": lambda self, u: losses.Huber.weight(self, u)[:, None]}, "expected float64"),
            ({"loss": lambda self, u: losses.Huber().loss(u) * 1.01}, "u\\^2 / 2 near"),
            ({"loss": lambda self, u: losses.Tukey().loss(u)}, "as the loss has it"),
            ({"loss": lambda self, u: np.where(np.abs(u) > 5, 0.0, u * u / 2)}, "costs less"),
            ({"compiled": lambda self, u: losses.Huber(2.0).compiled(u)}, "the kernels weigh"),
            ({"compiled": lambda self, u: (1, 1.345)}, "expected a CompiledWeight"),
            ({"weight": lambda self, u: losses.Huber().weight(np.abs(u, out=u))}, "has changed"),
        ],
    )
    def test_broken(self, changes: dict[str, Any], words: str) -> None:
        with breaks(words):
            testing.check_robust_kernel(type("Broken", (losses.Huber,), changes)())

    def test_one_sided(self) -> None:
        class OneSided(losses.LeastSquares):
            """Only what is in front counts less."""

            def weight(self, u: np.ndarray) -> np.ndarray:
                return np.where(u > 1, 1 / np.maximum(u, 1), 1.0)

        with breaks("differs between u and -u|kernels weigh"):
            testing.check_robust_kernel(OneSided())


class TestAgreementLimits:
    def test_ours(self) -> None:
        testing.check_agreement_limits(ProjectiveConfig())
        testing.check_agreement_limits(TrackingConfig().projective)

    @pytest.mark.parametrize(
        ("least", "most", "words"),
        [
            (60, 0.06, "min_agreement: expected a share"), (0.6, float("nan"), "max_conflict: expected a share"),
            (0.0, 1.0, "must not be trusted"),
        ],
    )  # fmt: skip
    def test_broken(self, least: float, most: float, words: str) -> None:
        with breaks(words):
            testing.check_agreement_limits(SimpleNamespace(min_agreement=least, max_conflict=most))


def sums_with(change: Callable[..., np.ndarray]) -> SimpleNamespace:
    """The reference, but for what a function makes of its arguments or sums."""
    return SimpleNamespace(point_to_plane_sums=lambda *args: change(reference.point_to_plane_sums, *args))


def scaled(column: int, factor: float) -> Callable[..., np.ndarray]:
    return lambda sums, *args: sums(*args) * np.where(np.arange(32) == column, factor, 1.0)


class TestProjectiveBackend:
    @pytest.mark.parametrize("backend", [compiled, reference])
    def test_ours(self, backend: Any) -> None:
        testing.check_projective_backend(backend)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda sums, *args: sums(*args).astype(np.float32), "expected float64"),
            (lambda sums, *args: np.tile(sums(*args).sum(axis=0), (len(args[4]) - 1, 1)), "sum"),
            (scaled(27, -1.0), "sum 27"),
            (scaled(28, 1.001), "sum 28|reference"),
            (scaled(29, 2.0), "sum 29|inliers"),
            (lambda sums, p, n, *rest: sums(p, np.negative(n, out=n), *rest), "has changed"),
            (lambda sums, p, n, T, *rest: sums(p, n, np.linalg.inv(T), *rest), "reference"),
            (lambda sums, *args: sums(*args[:-1], 1e9), "sum"),
        ],
    )
    def test_broken(self, change: Callable[..., np.ndarray], words: str) -> None:
        with breaks(words):
            testing.check_projective_backend(sums_with(change))


def map_with(**changes: Callable[..., Any]) -> SimpleNamespace:
    """The reference with some operations replaced; each is called with the one that it replaces."""
    names = ("index_map", "show", "merge", "new_surfels")
    honest = {name: getattr(reference_map, name) for name in names}
    return SimpleNamespace(
        **honest | {name: (lambda *args, n=name, c=change: c(honest[n], *args)) for name, change in changes.items()}
    )


def without_demotion(merge: Callable[..., Any], pages: Any, seen: Any, frame: Any, limits: Any) -> Any:
    return merge(pages, seen, replace(frame, weights=np.abs(frame.weights)), limits)


class TestMapBackend:
    @pytest.mark.parametrize("backend", [compiled_map, reference_map])
    def test_ours(self, backend: Any) -> None:
        testing.check_map_backend(backend)

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"index_map": lambda f, p, s, T, c, *r: f(p, s, se3.inverse(T), c, *r)}, "index_map|differ"),
            ({"index_map": lambda f, p, s, T, c, stable, b: f(p, s, T, c, 0.0, b)}, "index_map"),
            ({"show": lambda f, p, s: (f(p, s)[0], f(p, s)[1].astype(np.float64))}, "show: values"),
            ({"show": lambda f, p, s: (f(p, s)[0][::-1].copy(), f(p, s)[1])}, "show: rows"),
            ({"merge": without_demotion}, "merge"),
            ({"merge": lambda f, p, s, m, limits: f(p, s, m, limits * np.float32(1.5))}, "merge"),
            ({"new_surfels": lambda f, *args: f(*args[:-1], 0)}, "anchor"),
            ({"new_surfels": lambda f, *args: f(*args)[:, ::-1].copy()}, "new_surfels"),
            ({"new_surfels": lambda f, r, v, m, *rest: f(r, v, np.zeros_like(m), *rest)}, "new_surfels"),
        ],
    )
    def test_broken(self, changes: dict[str, Callable[..., Any]], words: str) -> None:
        with breaks(words):
            testing.check_map_backend(map_with(**changes))


class SteppedClock:
    """Time that goes on by what is slept, and perhaps in another way."""

    def __init__(self, *steps: float, start: Any = 5.0) -> None:
        self.time, self.steps = start, iter(steps)

    def now(self) -> Any:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += next(self.steps, seconds)


class TestClock:
    @pytest.mark.parametrize("clock", [WallClock(), SteppedClock()])
    def test_ours(self, clock: Any) -> None:
        testing.check_clock(clock)

    @pytest.mark.parametrize(
        ("clock", "words"),
        [
            (SteppedClock(0.0, 0.002), "sleep: 0.002000 s"),
            (SteppedClock(-1.0), "must not go back"),
            (SteppedClock(start=float("nan")), "expected a time"),
            (SteppedClock(start=5), "expected a time"),
        ],
    )
    def test_broken(self, clock: Any, words: str) -> None:
        with breaks(words):
            testing.check_clock(clock)


def small_map(count: int) -> sw.SurfelMap:
    rng = np.random.default_rng(1)
    surfels = sw.SurfelMap()
    normals = np.tile(np.array([[0], [0], [1]], np.float32), count)
    surfels.append(
        rng.uniform(-3, 3, (3, count)).astype(np.float32), normals, rng.integers(0, 256, (3, count)),
        np.full(count, 0.01, np.float32), np.ones(count, np.float32), 0,
    )  # fmt: skip
    return surfels


class Table:
    def __init__(self, columns: Any, batches: list[dict[str, np.ndarray]] | None = None, count: int = 3) -> None:
        self.columns = columns if callable(columns) else lambda: columns
        if batches is not None:
            self.batches = lambda: iter(batches)
        self.count = count

    def __len__(self) -> int:
        return self.count


THREE = {"x": np.arange(3.0), "y": np.arange(3.0)}


class TestColumns:
    def test_ours(self) -> None:
        rng = np.random.default_rng(0)
        points = rng.normal(size=(10, 3))
        mesh = sw.TriangleMesh(points.astype(np.float32), np.array([[0, 1, 2]], np.int32))
        for thing in (
            sw.PointCloud(points), sw.PointCloud(points[:, :2], points[:, :2]), mesh, small_map(0), small_map(5000),
            splats_from_surfels(small_map(30).columns()),
        ):  # fmt: skip
            testing.check_columns(thing)

    @pytest.mark.parametrize(
        ("table", "words"),
        [
            (Table([1, 2]), "expected columns by name"),
            (Table({}), "expected columns by name"),
            (Table({"": np.arange(3)}), "the name ''"),
            (Table({"x": [1, 2, 3]}), "an array of one dimension, got list"),
            (Table({"x": np.zeros((3, 1))}), "an array of one dimension"),
            (Table({"x": np.arange(3), "y": np.arange(4)}), "different lengths"),
            (Table(lambda: {"x": np.array([time.perf_counter()])}), "asked for again"),
            (Table(THREE, [THREE], count=4), "len: 4"),
            (Table(THREE, [{"y": THREE["y"], "x": THREE["x"]}]), "batches: columns y, x"),
            (Table(THREE, [{name: values[:2] for name, values in THREE.items()}]), "2 rows in all"),
            (Table(THREE, [{name: values[::-1] for name, values in THREE.items()}]), "'x' differs"),
        ],
    )
    def test_broken(self, table: Any, words: str) -> None:
        with breaks(words):
            testing.check_columns(table)


class Careless(StoredBytes):
    """Gives what there is."""

    def read(self, size: int) -> bytes:
        return super().read(min(size, self.left))


class Uncounted(StoredBytes):
    left = 4352  # type: ignore[assignment]


class Consuming(StoredBytes):
    """Where too much is asked for, the rest is lost."""

    def read(self, size: int) -> bytes:
        try:
            return super().read(size)
        except ValueError:
            self._data = b""
            raise


class TestSource:
    def test_ours(self, tmp_path: Path) -> None:
        testing.check_source(StoredBytes)

        def stored(data: bytes) -> checkpoint_file.CheckpointFile:
            path = tmp_path / "state"
            checkpoint_file.write(path, {}, [data])
            return opened.append(checkpoint_file.CheckpointFile(path)) or opened[-1]

        opened: list[checkpoint_file.CheckpointFile] = []
        testing.check_source(stored)
        for one in opened:
            one.__exit__()

    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (Careless, "must raise ValueError"),
            (Uncounted, "left: 4352"),
            (Consuming, "the rest is not there"),
            (lambda data: StoredBytes(data[::-1]), "other bytes"),
            (lambda data: StoredBytes(bytearray(data)), "expected bytes"),  # type: ignore[arg-type]
        ],
    )
    def test_broken(self, make: Callable[[bytes], Any], words: str) -> None:
        with breaks(words):
            testing.check_source(make)
