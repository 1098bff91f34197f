"""The view in a real Chromium: it loads from this machine alone, draws the points, and its controls reach the run."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")

import scanweld as sw
from chromium import Browser, Page, chromium
from rendered import rendered
from scanweld.viewer.coloring import Coloring
from scanweld.viewer.finished import FinishedView
from scanweld.viewer.live import LiveView
from written_runs import COUNT, GREEN, GREY, RED, write_run_folder

SIZE = (900, 520)
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as running:
        yield running


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FinishedView]:
    folder = write_run_folder(tmp_path_factory.mktemp("run"), points=20_000)
    with FinishedView(folder, port=0) as view:
        serving = threading.Thread(target=view.serve, daemon=True)
        serving.start()
        yield view
        view.close()
        serving.join(10)


@pytest.fixture(scope="module")
def page(browser: Browser, finished: FinishedView) -> Page:
    """The finished run, with its map on the screen."""
    opened = visit(browser, finished.url)
    until(lambda: share(picture(opened), RED) > 0.01)
    return opened


def visit(browser: Browser, url: str) -> Page:
    page = browser.page()
    page.look(*SIZE)
    page.send("Page.navigate", url=url)
    page.wait("document.querySelector('canvas') !== null && document.querySelectorAll('button').length > 2")
    return page


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def picture(page: Page) -> np.ndarray:
    """What is seen, without the panel on the right and the notice on the left that WebGL is drawn by the processor."""
    return page.screenshot()[160:, : SIZE[0] - 340]


def share(image: np.ndarray, color: tuple[int, int, int], tolerance: int = 24) -> float:
    """Share of pixels of about a colour."""
    return float((np.abs(image.astype(int) - color).max(axis=2) <= tolerance).mean())


def press(page: Page, name: str) -> None:
    """Click a button by its name."""
    button = f"[...document.querySelectorAll('button')].find(b => b.textContent.trim() === '{name}')"
    page.wait(f"!!{button}")
    page.evaluate(f"{button}.click()")


def tick(page: Page, name: str) -> None:
    """Click the box that stands in the row of a label."""
    label = f"[...document.querySelectorAll('label')].find(l => l.textContent.trim() === '{name}')"
    page.wait(f"!!{label}")
    page.evaluate(f"document.getElementById({label}.htmlFor).click()")


def choose(page: Page, old: str, new: str) -> None:
    """Choose from the list that shows `old`."""
    field = f"[...document.querySelectorAll('input')].find(e => e.value === '{old}')"
    page.evaluate(f"{field}.click()")
    option = f"[...document.querySelectorAll('[role=option]')].find(e => e.textContent.trim() === '{new}')"
    page.wait(f"!!{option}")
    page.evaluate(f"{option}.click()")


def test_asks_nobody_but_this_machine(page: Page, finished: FinishedView) -> None:
    asked = [url for url in page.requests if not url.startswith(("data:", "blob:"))]
    assert asked
    assert all(url.startswith(finished.url) for url in asked)
    assert page.errors == []


def test_the_map_is_drawn_in_its_colours(page: Page) -> None:
    """The corner's three walls."""
    for color in (RED, GREEN, GREY):
        until(lambda color=color: share(picture(page), color) > 0.01)  # type: ignore[misc]


def test_no_images_is_said(finished: FinishedView, page: Page) -> None:
    assert "not there any more" in finished.note
    page.wait("[...document.querySelectorAll('input')].some(e => e.value.includes('not there any more'))")


def test_colours_can_be_chosen(page: Page, finished: FinishedView) -> None:
    """The red wall faces the first camera: its normal is (0, 0, -1), (128, 128, 0) as a colour."""
    choose(page, "RGB", "normal")
    until(lambda: finished._panel.coloring is Coloring.NORMAL)
    until(lambda: share(picture(page), (128, 128, 0)) > 0.01 and share(picture(page), RED) < 0.002)
    choose(page, "normal", "confidence")
    until(lambda: share(picture(page), (128, 128, 0)) < 0.002)
    choose(page, "confidence", "RGB")
    until(lambda: share(picture(page), RED) > 0.01)


def test_point_size(page: Page, finished: FinishedView) -> None:
    """Smaller points leave more of the ground to be seen."""
    before = share(picture(page), RED) + share(picture(page), GREEN)
    finished._panel._size.value = 1.0
    until(lambda: share(picture(page), RED) + share(picture(page), GREEN) < 0.7 * before)
    finished._panel._size.value = 40.0
    until(lambda: share(picture(page), RED) + share(picture(page), GREEN) > 0.9 * before)


def test_parts_can_be_hidden(page: Page, finished: FinishedView) -> None:
    tick(page, "Camera")
    until(lambda: not finished._panel.shown["camera"])
    until(lambda: not finished._scene._frustum.visible)
    tick(page, "Camera")
    until(lambda: finished._scene._frustum.visible)


def test_timeline(page: Page, finished: FinishedView) -> None:
    """It begins at the end; playing goes from the start to there, a step goes on by one and stops."""
    assert finished.frame == COUNT - 1
    finished._timeline._slider.value = 20
    until(lambda: finished.frame == 20)
    page.wait("[...document.querySelectorAll('input')].some(e => e.value.startsWith('UNREADABLE: depth/20.png'))")
    press(page, "Step")
    until(lambda: finished.frame == 21)
    press(page, "Play")
    until(lambda: finished.frame == COUNT - 1)
    page.wait("[...document.querySelectorAll('button')].some(b => b.textContent.trim() === 'Play')")


def test_follow_camera(page: Page, finished: FinishedView) -> None:
    """The eye of the browser comes to stand 1.2 m behind the camera and half a metre above it."""
    tick(page, "Follow camera")
    T = finished._poses[finished.frame]
    eye = T[:3, 3] - 1.2 * T[:3, 2] - 0.5 * T[:3, 1]
    client = next(iter(finished._server.get_clients().values()))
    until(lambda: bool(np.linalg.norm(client.camera.position - eye) < 0.05))
    tick(page, "Follow camera")
    until(lambda: not finished._panel.follow)


def test_a_run_is_watched_held_and_stepped(browser: Browser, tmp_path: Path) -> None:
    """Held from the browser before its first frame; two steps are two frames; then it runs to its end."""
    sequence = rendered(count=8)
    with LiveView(port=0, title="room") as view:
        view.gate.pause(True)
        page = visit(browser, view.url)
        run = threading.Thread(
            target=sw.run_sequence, args=(sequence,), kwargs={"observers": [view], "out": tmp_path / "r"}, daemon=True
        )
        run.start()
        frame = "[...document.querySelectorAll('input')].some(e => e.value.startsWith('{} ·'))"
        page.wait(frame.format(0))
        press(page, "Step")
        page.wait(frame.format(1))
        empty = share(picture(page), (255, 255, 255), 4)
        assert empty < 0.95  # points are drawn while it is held
        choose(page, "RGB", "age")
        until(lambda: share(picture(page), (68, 1, 84)) > 0.01)  # and take other colours
        choose(page, "age", "RGB")
        assert len(view._path.drawn()[0]) == 2
        press(page, "Go on")
        run.join(60)
        assert not run.is_alive()
        page.wait("[...document.querySelectorAll('input')].some(e => e.value === 'the run is over')")
        assert page.errors == []
    metrics = (tmp_path / "r" / "metrics.json").read_text()
    assert '"frames": 8' in metrics


def test_closing_the_browser_does_not_stop_the_run(browser: Browser) -> None:
    with LiveView(port=0) as view:
        page = visit(browser, view.url)
        until(lambda: len(view._server.get_clients()) == 1)
        view.gate.pause(True)
        done: list[sw.RunSummary] = []
        run = threading.Thread(
            target=lambda: done.append(sw.run_sequence(rendered(count=8), observers=[view])), daemon=True
        )
        run.start()
        page.send("Page.close")
        until(lambda: len(view._server.get_clients()) == 0)
        view.gate.pause(False)
        run.join(60)
        assert len(done[0].results) == 8
