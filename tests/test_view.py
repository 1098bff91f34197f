"""The live view without a browser: what is sent of a growing map, who holds a run, and who may look."""

from __future__ import annotations

import contextlib
import http.client
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scanweld as sw
from rendered import rendered
from scanweld.errors import FileFormatError, InvalidInputError
from scanweld.mapping.storage.pages import MapConfig
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.viewer.changes import GROUP, REFRESH_S, MapChanges, Piece
from scanweld.viewer.coloring import Coloring, age_colors, confidence_colors, normal_colors, ramp
from scanweld.viewer.guard import Guard, is_loopback
from scanweld.viewer.panel import Gate
from scanweld.viewer.path import LivePath
from written_runs import write_run_folder
from written_sequences import write_tum

MANY = 1 << 30


def until(condition: Callable[[], bool], patience_s: float = 30.0) -> None:
    """Wait for a condition."""
    end = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


class Observer:
    """Notes what it sees; holds the run after `hold_after` frames until `hold` is cleared."""

    def __init__(self, hold_after: int = -1) -> None:
        self.seen: list[tuple[int, bool]] = []
        self.ended: list[int] = []
        self.hold_after, self.hold = hold_after, True
        self.asked = 0

    def on_frame(self, slam: sw.Slam, frame: sw.Frame | None, result: sw.FrameResult) -> None:
        assert len(slam.results) == result.index + 1
        self.seen.append((result.index, frame is not None))

    def ready(self, timeout_s: float) -> bool:
        if len(self.seen) == self.hold_after and self.hold:
            self.asked += 1
            time.sleep(min(timeout_s, 0.01))
            return False
        return True

    def on_end(self, slam: sw.Slam) -> None:
        self.ended.append(len(slam.results))


class TestObservers:
    def test_they_see_every_frame_and_the_end(self) -> None:
        sequence = rendered(count=6).with_frames({3: None})
        first, second = Observer(), Observer()
        sw.run_sequence(sequence, observers=[first, second])
        assert first.seen == second.seen == [(k, k != 3) for k in range(6)]
        assert first.ended == second.ended == [6]

    def test_a_held_run_waits(self) -> None:
        observer = Observer(hold_after=2)
        run = threading.Thread(
            target=sw.run_sequence, args=(rendered(count=4),), kwargs={"observers": [observer]}, daemon=True
        )
        run.start()
        until(lambda: observer.asked >= 5)
        assert len(observer.seen) == 2
        observer.hold = False
        run.join(30)
        assert len(observer.seen) == 4

    def test_ctrl_c_ends_a_held_run(self) -> None:
        """And what was done until then is kept, as in any run."""
        observer = Observer(hold_after=2)
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        summary = sw.run_sequence(rendered(count=4), observers=[observer])
        assert summary.interrupted
        assert len(summary.results) == 2
        assert observer.ended == [2]


class TestGate:
    def test_pause_and_step(self) -> None:
        gate = Gate()
        assert gate.wait(0)
        gate.pause(True)
        assert not gate.wait(0)
        gate.step()
        gate.step()
        assert [gate.wait(0) for _ in range(3)] == [True, True, False]
        gate.pause(False)
        assert gate.wait(0)
        assert gate.wait(0)

    def test_a_step_holds_a_run_that_goes(self) -> None:
        gate = Gate()
        gate.step()
        assert [gate.wait(0) for _ in range(2)] == [True, False]

    def test_who_waits_is_woken(self) -> None:
        gate = Gate()
        gate.pause(True)
        threading.Timer(0.05, gate.pause, (False,)).start()
        started = time.monotonic()
        assert gate.wait(20)
        assert time.monotonic() - started < 10


def wall(count: int, *, z: float = 2.0, frame: int = 0, seed: int = 0, surfels: SurfelMap | None = None) -> SurfelMap:
    """A map of a red wall of 4 m x 4 m at depth `z`, or a given one with such a wall added."""
    surfels = SurfelMap(256) if surfels is None else surfels
    rng = np.random.default_rng(seed)
    positions = np.vstack([rng.uniform(-2, 2, (2, count)), np.full((1, count), z)]).astype(np.float32)
    normals = np.repeat(np.float32([[0], [0], [-1]]), count, axis=1)
    colors = np.repeat(np.float32([[200], [10], [30]]), count, axis=1)
    ones = np.ones(count, np.float32)
    surfels.append(positions, normals, colors, 0.01 * ones, 3 * ones, frame)
    return surfels


def drawn(pieces: dict[int, Piece]) -> np.ndarray:
    """All points (N, 3) that are shown, sorted."""
    points = np.concatenate([piece.positions_m for piece in pieces.values()] or [np.zeros((0, 3), np.float32)])
    return points[np.lexsort(points.T)]


def everything(surfels: SurfelMap) -> np.ndarray:
    return surfels.positions_m.T[np.lexsort(surfels.positions_m)]


def show(changes: MapChanges, surfels: SurfelMap, pieces: dict[int, Piece], num_points: int = MANY) -> int:
    """Show one lot of changes; returns how many points were sent."""
    pages = changes.take(surfels, Coloring.RGB, num_points)
    sent = [] if pages is None else pages.pieces()
    pieces.update({piece.number: piece for piece in sent})
    return sum(len(piece.positions_m) for piece in sent)


class TestMapChanges:
    def test_all_is_shown_once(self) -> None:
        surfels, changes, pieces = wall(20_000), MapChanges(MANY), {}
        assert show(changes, surfels, pieces) == 20_000
        np.testing.assert_array_equal(drawn(pieces), everything(surfels))
        assert changes.take(surfels, Coloring.RGB, MANY) is None

    def test_only_what_changed_is_sent(self) -> None:
        """A second wall 10 m behind fills pages of its own: the pieces of the first are not sent again."""
        surfels, changes, pieces = wall(60_000), MapChanges(MANY), {}
        show(changes, surfels, pieces)
        wall(3000, z=12.0, surfels=surfels, seed=1)
        assert 3000 <= show(changes, surfels, pieces) <= 3000 + 256 * GROUP
        np.testing.assert_array_equal(drawn(pieces), everything(surfels))

    def test_a_little_at_a_time(self) -> None:
        """At most about so many points at once, and no piece twice before all were shown."""
        surfels, changes, pieces = wall(60_000), MapChanges(MANY), {}
        sent = []
        while count := show(changes, surfels, pieces, 10_000):
            sent.append(count)
        assert sum(sent) == 60_000
        assert max(sent) <= 10_000 + 256 * GROUP
        np.testing.assert_array_equal(drawn(pieces), everything(surfels))

    def test_what_is_gone_goes(self) -> None:
        surfels, changes, pieces = wall(20_000), MapChanges(MANY), {}
        show(changes, surfels, pieces)
        surfels.remove(np.ones(len(surfels), np.bool_))
        show(changes, surfels, pieces)
        assert len(drawn(pieces)) == 0

    def test_what_is_gone_goes_also_when_all_is_shown_again(self) -> None:
        surfels, changes, pieces = wall(20_000), MapChanges(MANY), {}
        show(changes, surfels, pieces)
        surfels.remove(surfels.positions_m[0] < 0)
        changes.forget()
        show(changes, surfels, pieces)
        np.testing.assert_array_equal(drawn(pieces), everything(surfels))

    def test_a_correction_moves_it(self) -> None:
        surfels, changes, pieces = wall(20_000), MapChanges(MANY), {}
        show(changes, surfels, pieces)
        T = np.eye(4)
        T[0, 3] = 0.02
        surfels.apply_correction(sw.MapCorrection(np.array([0], np.int32), T[None]))
        surfels.pages.follow(surfels.capacity)
        assert show(changes, surfels, pieces) == 20_000
        np.testing.assert_array_equal(drawn(pieces), everything(surfels))

    def test_a_small_change_waits_for_its_turn(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A twentieth of a piece, or that the camera looks there, is shown after `REFRESH_S`; a tenth at once."""
        surfels, changes, pieces = wall(40_000), MapChanges(MANY), {}
        show(changes, surfels, pieces)
        planes = np.tile([[0.0, 0.0, 0.0, 1.0]], (6, 1))  # everything is on their inner sides
        surfels.remove(np.arange(40_000) % 20 == 0)
        assert changes.take(surfels, Coloring.RGB, MANY, planes) is None
        surfels.remove(np.arange(38_000) % 10 == 0)
        show(changes, surfels, pieces)
        np.testing.assert_array_equal(drawn(pieces), everything(surfels))
        assert changes.take(surfels, Coloring.RGB, MANY, planes) is None
        monkeypatch.setattr(time, "monotonic", lambda now=time.monotonic: now() + REFRESH_S)
        assert show(changes, surfels, pieces) == len(surfels)
        assert changes.take(surfels, Coloring.RGB, MANY) is None

    def test_what_waits_on_disk_stays_there(self, tmp_path: Path) -> None:
        """A megabyte holds one shelf: of a larger map that moved only what is in memory is shown anew."""
        surfels = SurfelMap(256, MapConfig(memory_budget_mb=1.0, folder=str(tmp_path)))
        for k in range(3):
            wall(20_000, z=2.0 * k, seed=k, surfels=surfels)
        changes, pieces = MapChanges(MANY), {}
        show(changes, surfels, pieces)
        T = np.eye(4)
        T[0, 3] = 0.02
        surfels.apply_correction(sw.MapCorrection(np.array([0], np.int32), T[None]))
        held = surfels.pages.in_memory
        assert 0 < np.count_nonzero(held) < len(held)
        pages = changes.take(surfels, Coloring.RGB, MANY, in_memory=True)
        assert pages is not None
        assert held[pages.numbers].all()
        np.testing.assert_array_equal(surfels.pages.in_memory, held)
        show(changes, surfels, pieces)
        assert sum(len(piece.positions_m) for piece in pieces.values()) == 60_000

    def test_a_map_that_is_too_large_is_thinned(self) -> None:
        """25,000 points of 100,000 surfels: every fourth of each page, a last part of a page counting as a whole."""
        surfels, changes, pieces = wall(100_000), MapChanges(25_000), {}
        show(changes, surfels, pieces)
        assert changes.stride == 4
        num_pages = len(surfels.pages.live)
        assert 25_000 <= len(drawn(pieces)) <= 25_000 + num_pages
        assert {tuple(p) for p in drawn(pieces)} <= {tuple(p) for p in everything(surfels)}

    def test_colours(self) -> None:
        """The wall is red, faces the camera (z = -1 is dark blue), has confidence 3, and its second half is new."""
        surfels = wall(2000, frame=0)
        wall(2000, z=12.0, frame=9, surfels=surfels)

        def colors(coloring: Coloring) -> np.ndarray:
            pages = MapChanges(MANY).take(surfels, coloring, MANY)
            assert pages is not None
            return np.unique(np.concatenate([piece.colors for piece in pages.pieces()]), axis=0)

        assert colors(Coloring.RGB).tolist() == [[200, 10, 30]]
        assert colors(Coloring.NORMAL).tolist() == [[128, 128, 0]]
        # log(1 + 3) / log(1 + 100) = 0.3004 of the ramp, 0.2015 of the way from (59, 82, 139) to (33, 145, 140).
        assert colors(Coloring.CONFIDENCE).tolist() == [[54, 95, 139]]
        assert colors(Coloring.AGE).tolist() == [[68, 1, 84], [253, 231, 37]]


def test_ramps() -> None:
    """Both ends, the middle, and beyond the ends."""
    assert ramp(np.float32([-1, 0, 0.5, 1, 2])).tolist() == [
        [68, 1, 84], [68, 1, 84], [33, 145, 140], [253, 231, 37], [253, 231, 37]
    ]  # fmt: skip
    assert confidence_colors(np.float32([0, 100])).tolist() == [[68, 1, 84], [253, 231, 37]]
    assert age_colors(np.float32([0, 5]), 5).tolist() == [[68, 1, 84], [253, 231, 37]]
    assert normal_colors(np.float32([[1, 0, -1]])).tolist() == [[255, 128, 0]]


class TestPath:
    def test_it_grows_and_moves(self) -> None:
        """A pose a frame; when earlier poses were moved, and it is told, all of them come anew."""
        sequence = rendered(count=4)
        slam, path = sw.build_slam(sequence.camera, sw.SlamConfig()), LivePath()
        told = []
        for frame in sequence:
            told.append(path.update(slam, slam.process(frame)))
        positions, lost, loops = path.drawn()
        assert told == [(True, True), (False, False), (False, False), (False, False)]
        np.testing.assert_array_equal(positions, [r.T_world_camera[:3, 3] for r in slam.results])
        assert not lost.any()
        assert loops.shape == (0, 2, 3)
        before = positions.copy()
        moved = np.eye(4)
        moved[0, 3] = 1.0
        slam._results.move(np.arange(len(slam.results)), np.tile(moved, (len(slam.results), 1, 1)))
        assert path.update(slam, None) == (False, True)
        np.testing.assert_allclose(path.drawn()[0], before + [1, 0, 0])
        np.testing.assert_array_equal(positions, before)  # what was given out does not change


class Headers(dict[str, str]):
    def get_all(self, name: str) -> list[str]:
        return [self[name]] if name in self else []


class TestGuard:
    @pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "127.0.0.1"])
    def test_this_machine_may_look(self, host: str) -> None:
        guard = Guard("127.0.0.1")
        assert guard.refusal("/", Headers(Host=host)) == ""
        assert guard.refusal("/", Headers(Host=host, Origin=f"http://{host}")) == ""

    @pytest.mark.parametrize(
        "headers",
        [
            {"Host": "evil.example:8080"},  # a name that was bent to point here
            {"Host": "127.0.0.1:8080", "Origin": "http://evil.example"},  # a page from elsewhere
            {"Host": "127.0.0.1:8080", "Origin": "null"},
            {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8000"},  # another server of this machine
            {"Host": "[::1"},
            {},
        ],
    )
    def test_others_may_not(self, headers: dict[str, str]) -> None:
        assert Guard("127.0.0.1").refusal("/", Headers(headers))

    def test_beyond_this_machine_the_token_is_needed(self) -> None:
        """In the address at first, then in the cookie that this gives; one that is not ours does not help."""
        guard = Guard("0.0.0.0")
        assert len(guard.token) >= 20
        host = {"Host": "robot:8080"}
        path = f"/?token={guard.token}"
        assert guard.refusal("/", Headers(host)) == guard.refusal("/?token=guess", Headers(host)) != ""
        assert guard.refusal("/?token=%C3%A9", Headers(host)) != ""
        assert guard.refusal(path, Headers(host)) == ""
        cookie = guard.cookie(path)
        assert cookie is not None
        assert "HttpOnly; SameSite=Strict" in cookie
        pair = cookie.partition(";")[0]
        assert guard.refusal("/", Headers(host, Cookie=f"other=1; {pair}")) == ""
        assert guard.refusal("/", Headers(host, Cookie=pair + "x")) != ""
        assert guard.refusal(path, Headers(host, Origin="http://evil.example")) != ""
        assert guard.cookie("/") is None
        assert Guard("0.0.0.0").token != guard.token

    def test_loopback(self) -> None:
        assert all(is_loopback(host) for host in ("localhost", "127.0.0.1", "127.1.2.3", "::1"))
        assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "192.168.0.7", "robot", ""))


@pytest.fixture
def live() -> Iterator[object]:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
    from scanweld.viewer.live import LiveView

    with LiveView(port=0) as view:
        yield view


def answer(url: str, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPMessage]:
    place = url.removeprefix("http://").partition("/")[0]
    connection = http.client.HTTPConnection("127.0.0.1", int(place.rpartition(":")[2]), timeout=20)
    connection.request("GET", path, headers={"Host": place, **headers})
    response = connection.getresponse()
    response.read()
    connection.close()
    return response.status, response.headers


class TestServer:
    def test_listens_to_this_machine_alone(self, live) -> None:  # type: ignore[no-untyped-def]
        assert live.url.startswith("http://127.0.0.1:")
        assert answer(live.url)[0] == 200
        assert answer(live.url, Host="evil.example")[0] == 403
        assert answer(live.url, Origin="http://evil.example")[0] == 403

    def test_the_web_socket_is_guarded_too(self, live) -> None:  # type: ignore[no-untyped-def]
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        upgrade["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
        assert answer(live.url, Origin="http://evil.example", **upgrade)[0] == 403
        assert answer(live.url, **upgrade)[0] == 101

    def test_the_token(self) -> None:
        pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
        from scanweld.viewer.guard import start_server, stop_server

        server, url = start_server("0.0.0.0", 0)
        try:
            path = "/" + url.partition("/?")[2].join(("?", ""))
            assert "token=" in path
            assert answer(url)[0] == 403
            status, headers = answer(url, path)
            assert status == 200
            assert answer(url, Cookie=headers["Set-Cookie"].partition(";")[0])[0] == 200
        finally:
            stop_server(server)

    def test_no_tunnel_is_opened(self, live) -> None:  # type: ignore[no-untyped-def]
        """viser would make the scene public on request of any page that it serves."""
        assert live._server.request_share_url() is None

    def test_a_host_of_another_machine(self) -> None:
        pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
        from scanweld.viewer.live import LiveView

        with pytest.raises(InvalidInputError, match=r"view host '192\.0\.2\.1': nothing can listen there"):
            LiveView("192.0.2.1")

    def test_a_run_is_watched(self, live, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
        """Paused and stepped by the gate; in the end all of the map is drawn, and nothing was printed."""
        live.gate.pause(True)
        with looking_on(live.url):
            done: list[sw.RunSummary] = []
            run = threading.Thread(
                target=lambda: done.append(sw.run_sequence(rendered(count=6), observers=[live])), daemon=True
            )
            run.start()
            until(lambda: live._run_panel._frame.value != "waiting")
            assert live._run_panel._frame.value.startswith("0 ·")
            until(lambda: num_points(live) > 0)  # also while it is held
            live.gate.step()
            until(lambda: live._run_panel._frame.value.startswith("1 ·"))
            live.gate.pause(False)
            run.join(60)
            until(lambda: num_points(live) == len(done[0].map))
            until(lambda: live._run_panel._pause.disabled)
        assert capsys.readouterr().out == ""

    def test_nothing_is_drawn_for_nobody(self, live) -> None:  # type: ignore[no-untyped-def]
        """Who comes when the run is over sees all of it."""
        summary = sw.run_sequence(rendered(count=6), observers=[live])
        time.sleep(0.3)
        assert not live.watched
        assert num_points(live) == 0
        assert live._scene._frustum is None
        with looking_on(live.url):
            until(lambda: num_points(live) == len(summary.map))
            until(lambda: live._run_panel._frame.value.startswith("5 ·"))
            assert live._scene._path_length == 6
            assert live.watched
        until(lambda: not live.watched)


def num_points(live: Any) -> int:
    return sum(len(piece.points) for piece in live._scene._pieces.values())


@contextlib.contextmanager
def looking_on(url: str) -> Iterator[None]:
    """Be connected to a view as a browser is, which says where it stands."""
    import msgspec
    import viser
    from viser._messages import ViewerCameraMessage
    from websockets.sync.client import connect

    stands = ViewerCameraMessage((1, 0, 0, 0), (0, 0, 0), 1.0, 0.1, 1e3, 480, 640, (0, 0, 1), (0, -1, 0))
    with connect(
        url.replace("http", "ws", 1), subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None
    ) as socket:
        socket.send(msgspec.msgpack.encode(stands.as_serializable_dict([])))
        yield


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("viser", "view", ["slam", "SEQUENCE", "--view"]),
        ("rerun", "rerun", ["slam", "SEQUENCE", "--rerun", "F.rrd"]),
        ("pyrealsense2", "realsense", ["slam", "realsense:"]),
    ],
)
def test_without_the_extra(tmp_path: Path, module: str, extra: str, arguments: list[str]) -> None:
    """One line with the command that installs it; nothing was written."""
    code = "import sys; sys.modules[sys.argv[1]] = None; from scanweld.cli.app import run; sys.exit(run(sys.argv[2:]))"
    sequence = write_tum(tmp_path / "rgbd")
    arguments = [str(sequence) if argument == "SEQUENCE" else argument for argument in arguments]
    done = subprocess.run(
        [sys.executable, "-c", code, module, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(f"pip install 'scanweld[{extra}]'")
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()
    assert not (tmp_path / "F.rrd").exists()


def test_view_of_a_finished_run_on_the_command_line(tmp_path: Path) -> None:
    """The address is on standard error, nothing on standard output; Ctrl-C is how it ends: exit code 0."""
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
    folder = write_run_folder(tmp_path / "run")
    command = [sys.executable, "-m", "scanweld", "view", str(folder), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines: list[str] = []
        while not lines or not lines[-1].startswith("view "):
            lines.append(process.stderr.readline())
            assert lines[-1], lines
        assert answer(lines[-1].split()[1])[0] == 200
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert out == ""
    assert lines[0].startswith("warning: no images of the camera: the sequence of the run is not there any more")


def test_points_that_are_nowhere_are_not_shown() -> None:
    """Of a damaged map; the others come in an order in which neighbours follow each other."""
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
    from scanweld.viewer.finished import _nearby_together

    x = np.array([0.2, 5.0, np.nan, 0.4, np.inf, 5.5, -3e38], np.float32)
    still = np.zeros(len(x), np.float32)
    assert _nearby_together({"x": x, "y": still, "z": still}).tolist() == [0, 3, 1, 5]


def test_view_of_something_else(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
    from scanweld.viewer.finished import FinishedView

    with pytest.raises(FileFormatError, match="not a run folder"):
        FinishedView(tmp_path, port=0)
