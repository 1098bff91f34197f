"""The page about a batch in a real Chromium: it fits, its table is sorted, and its pictures are those of the runs."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from chromium import Browser, Page, chromium
from scanweld.report.batch_page import make_batch_page

DESKTOP, PHONE = (1280, 900), (390, 844)
ERRORS_M = {"desk": 0.012, "long_corridor_with_a_name_that_goes_on_and_on": 0.3, "attic": 0.002}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as running:
        yield running


@pytest.fixture(scope="module")
def page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """Three sequences with two settings each; one failed, one is in doubt."""
    folder = tmp_path_factory.mktemp("runs")
    rows = []
    for name, error_m in ERRORS_M.items():
        for seed in (1, 2):
            run = f"{name}/seed={seed}"
            renders = folder / run / "renders"
            renders.mkdir(parents=True)
            cv2.imwrite(str(renders / "overview-rgb.png"), np.full((30, 40, 3), (0, 0, 255), np.uint8))
            metrics = {
                "frames": 1508, "frames_tracked": 1500, "loop_closures": seed, "ate_rmse_m": seed * error_m,
                "fps": 31.4, "seconds_total": 61.2, "seconds": 70.0,
            }  # fmt: skip
            verdict = "untrustworthy" if error_m > 0.1 else "trustworthy"
            rows.append({"run": run, "input": name, "seed": seed, "state": "done", "verdict": verdict} | metrics)
            rows[-1]["reason"] = "Against ground truth the camera is off by far too much, " * 3
    failed = {"run": "cellar/seed=1", "input": "cellar", "seed": 1, "state": "failed", "verdict": "", "reason": "empty"}
    file = folder / "report.html"
    file.write_text(make_batch_page("runs", [*rows, failed], ["seed"], 200.0), encoding="utf-8")
    opened = browser.page()
    opened.look(*DESKTOP)
    opened.open(file)
    return opened


def names(page: Page) -> list[str]:
    return page.evaluate("[...document.querySelectorAll('#runs tbody tr')].map(row => row.cells[0].dataset.v)")


def click(page: Page, head: str) -> None:
    page.evaluate(f"[...document.querySelectorAll('#runs th button')].find(b => b.textContent === '{head}').click()")


@pytest.mark.parametrize(("size", "dark"), [(DESKTOP, False), (DESKTOP, True), (PHONE, False)])
def test_fits_the_window(page: Page, size: tuple[int, int], dark: bool) -> None:
    """Wide tables scroll by themselves, the page does not; text stands out from the ground in both themes."""
    page.look(*size, dark=dark)
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    ground = page.screenshot()[5, 5].astype(int)
    assert (ground.sum() < 200) == dark
    page.look(*DESKTOP)


def test_pictures_are_those_of_the_runs(page: Page) -> None:
    page.evaluate("for (const image of document.images) image.loading = 'eager'")
    page.wait("[...document.images].every(image => image.complete && image.naturalWidth === 40)")
    assert page.evaluate("document.images.length") == 6
    assert [url for url in page.requests if not url.startswith("file:")] == []
    assert page.errors == []


def test_rows_are_sorted_by_any_column(page: Page) -> None:
    """By number, where it is one; what has none comes last in either order."""
    before = names(page)
    click(page, "ATE")
    up = names(page)
    assert [name.partition("/")[0] for name in up] == [
        "attic",
        "attic",
        "desk",
        "desk",
        *[before[2].partition("/")[0]] * 2,
        "cellar",
    ]
    click(page, "ATE")
    assert names(page) == [*reversed(up[:-1]), "cellar/seed=1"]
    click(page, "Run")
    assert names(page)[0] == "attic/seed=1"
    click(page, "Verdict")
    assert names(page)[-1] == "cellar/seed=1"


def test_the_best_of_each_sequence_is_marked(page: Page) -> None:
    """Seed 1 has half the error of seed 2; what cannot be trusted, or failed, is none."""
    cells = page.evaluate(
        "[...document.querySelectorAll('.matrix tbody tr')].map(r => [...r.cells].slice(1).map(c => c.className))"
    )
    assert cells == [["q0", "q3"], ["x", "x"], ["q0", "q3"], ["x", "x"]]
