"""report.html in a real Chromium: it opens by itself, draws the map, can be used, and runs nothing of a run's texts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from chromium import Browser, Page, chromium
from scanweld.report.page import write_report
from test_report import EVIL
from written_runs import GREEN, GREY, RED, rows, write_run_folder

LARGEST_REPORT_MB = 8.0
LONGEST_OPENING_S = 3.0

DESKTOP, PHONE = (1280, 900), (390, 844)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as running:
        yield running


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(write_run_folder(tmp_path_factory.mktemp("run"), error_m=0.01))


@pytest.fixture(scope="module")
def page(browser: Browser, report: Path) -> Page:
    """The report on a desktop, in the light theme."""
    opened = browser.page()
    opened.look(*DESKTOP)
    opened.open(report)
    return opened


@pytest.fixture(autouse=True)
def _as_before(request: pytest.FixtureRequest) -> Iterator[None]:
    """Put the shared page back to how it opened, and see that nothing failed in it."""
    shared: Page | None = request.getfixturevalue("page") if "page" in request.fixturenames else None
    if shared:
        shared.look(*DESKTOP)
        shared.evaluate("scrollTo(0, 0); document.activeElement.blur(); report.look(0)")
        shared.evaluate("for (const box of document.querySelectorAll('.check input')) if (!box.checked) box.click()")
        shared.evaluate("document.querySelector('input[name=mode]').click()")
        shared.evaluate("document.getElementById('view-reset').click()")
    yield
    if shared:
        assert shared.errors == []


def map_picture(page: Page) -> np.ndarray:
    """The map as it is on the screen, without its legend and the frame that says that it has the focus."""
    page.evaluate("document.getElementById('viewer').scrollIntoView()")
    page.settle()
    return page.screenshot(selector="#canvas")[60:-6, 6:-6]


def share(picture: np.ndarray, color: tuple[int, int, int], tolerance: int = 30) -> float:
    """Share of pixels of about a colour."""
    return float((np.abs(picture.astype(int) - color).max(axis=2) <= tolerance).mean())


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Share of pixels that differ plainly."""
    return float((np.abs(a.astype(int) - b).max(axis=2) > 25).mean())


def middle(page: Page, selector: str) -> tuple[float, float]:
    """Middle of an element in the window, which is scrolled there."""
    page.evaluate(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
    box = page.box(selector)
    return box["x"] + box["width"] / 2, box["y"] - page.evaluate("scrollY") + box["height"] / 2


def test_asks_for_nothing_but_itself(page: Page, report: Path) -> None:
    asked = [url for url in page.requests if not url.startswith("data:")]
    assert asked == [report.resolve().as_uri()]


def test_the_map_is_drawn_in_its_colours(page: Page) -> None:
    """The corner's three walls are there, each with a good part of the picture, on the page's ground."""
    picture = map_picture(page)
    for color in (RED, GREEN, GREY):
        assert share(picture, color) > 0.03
    assert share(picture, (0xEC, 0xEE, 0xF1), 4) > 0.2


@pytest.mark.parametrize(("mode", "legend"), [(1, ""), (2, "0 … 100"), (3, "0.0 m … 2.0 m")])
def test_other_colours(page: Page, mode: int, legend: str) -> None:
    """Normals, confidence and height leave nothing of the walls' colours; what is a number has a legend."""
    page.evaluate(f"document.querySelector('input[name=mode][value=\"{mode}\"]').click()")
    picture = map_picture(page)
    assert share(picture, RED) < 0.005
    assert share(picture, (0xEC, 0xEE, 0xF1), 4) < 0.9
    ends = "[...document.querySelectorAll('#scale span')].map(e => e.textContent).filter(Boolean).join(' … ')"
    assert page.evaluate(f"document.getElementById('scale').hidden ? '' : {ends}") == legend


def test_walls_are_looked_through_from_behind(page: Page) -> None:
    """From behind the red wall, it is there only when its back is to be shown."""
    page.evaluate("document.getElementById('canvas').focus()")
    for _ in range(39):  # half a turn, in steps of 0.08 rad
        page.key("ArrowLeft")
    assert share(map_picture(page), RED) < 0.002
    page.evaluate("document.getElementById('cull').click()")
    assert share(map_picture(page), RED) > 0.05


def test_mouse_turns_moves_and_zooms(page: Page) -> None:
    first = map_picture(page)
    x, y = middle(page, "#canvas")
    page.drag((x, y), (x + 120, y + 20))
    turned = map_picture(page)
    assert changed(first, turned) > 0.03
    x, y = middle(page, "#canvas")
    page.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-200)
    assert changed(turned, map_picture(page)) > 0.03
    page.evaluate("document.getElementById('view-reset').click()")
    assert changed(first, map_picture(page)) < 0.001


def test_wheel_scrolls_the_page_until_the_map_is_clicked(page: Page) -> None:
    first = map_picture(page)
    x, y = middle(page, "#canvas")
    before = page.evaluate("scrollY")
    page.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=150)
    page.settle()
    assert page.evaluate("scrollY") > before
    assert changed(first, map_picture(page)) < 0.001


@pytest.mark.parametrize(
    ("key", "shift"), [("ArrowLeft", False), ("ArrowUp", False), ("ArrowRight", True), ("+", False)]
)
def test_keyboard(page: Page, key: str, shift: bool) -> None:
    first = map_picture(page)
    page.evaluate("document.getElementById('canvas').focus({preventScroll: true})")
    for _ in range(4):
        page.key(key, shift=shift)
    assert changed(first, map_picture(page)) > 0.02
    page.key("0")
    assert changed(first, map_picture(page)) < 0.001


def test_views_from_above_and_through_the_camera(page: Page) -> None:
    """From above the floor fills more than a wall; through the camera the red wall is straight ahead."""
    page.evaluate("document.getElementById('view-top').click()")
    above = map_picture(page)
    assert share(above, GREY) > 2 * share(above, RED)
    page.evaluate("document.getElementById('view-camera').click()")
    ahead = map_picture(page)
    height, width = ahead.shape[:2]
    assert share(ahead[height // 2 - 90 : height // 2 - 20, width // 2 - 40 : width // 2 + 40], RED) > 0.8


def test_frames_can_be_looked_at(page: Page) -> None:
    """The slider's keys move the camera's frustum, and the line below tells state and reason."""
    first = map_picture(page)
    page.evaluate("document.getElementById('slider').focus({preventScroll: true})")
    for _ in range(12):
        page.key("ArrowRight")
    assert page.evaluate("report.frame") == 12
    line = page.evaluate("document.getElementById('frame-line').textContent")
    assert line.startswith("Frame 12 · 1.20 s · LOST · residual 0.012 m")
    assert page.evaluate("document.getElementById('slider').getAttribute('aria-valuetext')") == "frame 12, 1.20 s: LOST"
    moved = map_picture(page)
    assert 0.0005 < changed(first, moved) < 0.05
    assert share(moved, (0xC4, 0x31, 0x2B), 20) > share(first, (0xC4, 0x31, 0x2B), 20)  # a lost camera is red


def test_play_goes_on_to_the_end(page: Page) -> None:
    page.evaluate("report.look(30); document.getElementById('play').click()")
    page.wait("report.frame === 39")
    page.wait("document.getElementById('play').textContent === 'Play'")


def test_charts_and_table_lead_to_frames(page: Page) -> None:
    x, y = middle(page, '[data-chart="rmse"]')
    page.drag((x, y), (x, y))
    assert 15 < page.evaluate("report.frame") < 25
    readouts = page.evaluate("[...document.querySelectorAll('.frames .readout')].map(e => e.textContent)")
    assert all(text.startswith(f"{page.evaluate('report.frame')}: ") for text in readouts)
    page.evaluate("document.querySelector('button.go').click()")
    assert page.evaluate("report.frame") == 10


def test_charts_are_drawn(page: Page) -> None:
    """Each chart has a line or areas over most of its width, and shades for each stretch."""
    drawn = page.evaluate(
        "Object.fromEntries([...document.querySelectorAll('.plot')].map(p => [p.dataset.chart, "
        "[...p.querySelectorAll('path')].reduce((w, e) => Math.max(w, e.getBBox().width / p.clientWidth), 0)]))"
    )
    assert set(drawn) == {"ate", "rpe", "rpe_rot", "drift", "path", "rmse", "overlap", "inliers", "time", "surfels"}
    assert {key for key, width in drawn.items() if width < 0.6} == set()
    bands = "[...document.querySelectorAll('[data-chart=rmse] .band')].map(e => e.getAttribute('class'))"
    assert page.evaluate(bands) == ["band lost", "band relocalised", "band unreadable", "band degenerate"]
    text = "[...document.querySelectorAll('.plot text')].map(e => e.textContent).join(' ')"
    assert "NaN" not in page.evaluate(text)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE, (320, 640)], ids=["desktop", "phone", "narrow"])
def test_themes_and_widths(page: Page, size: tuple[int, int], dark: bool) -> None:
    """The page keeps within the window, and page, map and cards follow the theme."""
    page.look(*size, dark=dark)
    page.evaluate("document.getElementById('view-reset').click()")
    page.settle()
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    picture = page.screenshot()
    corner = picture[5, 5]
    assert (corner < 60).all() if dark else (corner > 200).all()
    shown = map_picture(page)
    assert share(shown, RED) > 0.02
    assert (shown[5, 5] < 60).all() if dark else (shown[5, 5] > 200).all()
    cut = page.evaluate(
        "[...document.querySelectorAll('h1, h2, h3, button, dd, .summary, .about, .state')].filter(e => "
        "e.offsetParent && e.getBoundingClientRect().right > innerWidth + 1).map(e => e.textContent)"
    )
    assert cut == []


def test_fingers_turn_and_pinch(browser: Browser, report: Path) -> None:
    page = browser.page()
    page.look(*PHONE, phone=True)
    page.open(report)
    first = map_picture(page)
    x, y = middle(page, "#canvas")
    page.touch([(x, y)], [(x + 40, y)], [(x + 90, y)])
    turned = map_picture(page)
    assert changed(first, turned) > 0.02
    x, y = middle(page, "#canvas")
    page.touch([(x - 30, y), (x + 30, y)], [(x - 50, y), (x + 50, y)], [(x - 80, y), (x + 80, y)])
    pinched = map_picture(page)
    assert (share(pinched, RED) + share(pinched, GREEN)) > 1.3 * (share(turned, RED) + share(turned, GREEN))
    smallest = (
        "Math.min(...[...document.querySelectorAll('button:not(.go)')].map(e => e.getBoundingClientRect().height))"
    )
    assert page.evaluate(smallest) >= 32
    assert page.errors == []


def test_texts_of_a_run_run_nothing(browser: Browser, tmp_path: Path) -> None:
    table = rows()
    table[0]["note"] = table[12]["note"] = EVIL
    folder = write_run_folder(tmp_path, name=EVIL, table=table, points=600, run={"warnings": [EVIL]})
    page = browser.page()
    page.look(*DESKTOP)
    page.open(write_report(folder))
    page.evaluate("report.look(12)")
    page.settle()
    assert page.evaluate("window.owned") is None
    assert page.evaluate("document.querySelector('h1').textContent") == EVIL
    assert page.evaluate("document.getElementById('frame-line').textContent").endswith(EVIL)
    assert page.errors == []


def test_what_is_slipped_in_is_stopped_by_the_policy(browser: Browser, report: Path, tmp_path: Path) -> None:
    """Markup that came into the page in spite of all would still not run, nor reach the network."""
    slipped = '<script>window.owned = 1</script><img src="https://example.org/x.png" onerror="window.owned = 2">'
    text = report.read_text(encoding="utf-8").replace("</main>", slipped + "</main>")
    (tmp_path / "slipped.html").write_text(text, encoding="utf-8")
    page = browser.page()
    page.open(tmp_path / "slipped.html", faultless=False)
    page.settle()
    assert page.evaluate("window.owned") is None
    assert any("Content Security Policy" in error for error in page.errors)


def test_without_webgl_it_says_so_and_shows_the_rest(report: Path, tmp_path: Path) -> None:
    with chromium(tmp_path, "--disable-3d-apis") as running:
        page = running.page()
        page.look(*DESKTOP)
        page.open(report)
        message = "document.getElementById('viewer-message')"
        assert "WebGL is missing or switched off" in page.evaluate(f"{message}.textContent")
        assert page.evaluate(f"{message}.offsetHeight > 0 && document.getElementById('canvas').offsetHeight === 0")
        assert page.evaluate("document.querySelectorAll('.plot path').length") > 10
        page.evaluate("report.look(12)")
        assert "LOST" in page.evaluate("document.getElementById('frame-line').textContent")


@pytest.mark.slow
def test_a_large_run_stays_small_and_opens_quickly(browser: Browser, tmp_path: Path) -> None:
    """A map of 700,000 surfels and 3000 frames; the best of three openings, since others share the machine."""
    folder = write_run_folder(tmp_path, table=rows(3000), points=700_000)
    path = write_report(folder)
    assert path.stat().st_size < LARGEST_REPORT_MB * 1e6
    seconds = []
    for _ in range(3):
        page = browser.page()
        page.look(*DESKTOP)
        seconds.append(page.open(path))
        assert page.errors == []
    assert min(seconds) < LONGEST_OPENING_S
