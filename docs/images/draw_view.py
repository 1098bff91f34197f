"""Take the pictures of docs/live-view.md in Chromium: python docs/images/draw_view.py SEQUENCE RUN

SEQUENCE is watched while it runs, RUN is a finished run to look at.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from pathlib import Path

import cv2

import scanweld as sw

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from chromium import Browser, Page, chromium

IMAGES = Path(__file__).parent
SIZE = (1280, 760)
SETTLE_S = 25.0  # for WebGL that is drawn by the processor


def visit(browser: Browser, url: str) -> Page:
    """Open a view and close the notice about software rendering."""
    page = browser.page()
    page.look(*SIZE)
    page.send("Page.navigate", url=url)
    page.wait("document.querySelector('canvas') !== null && document.querySelectorAll('button').length > 2")
    return page


def take(page: Page, name: str) -> None:
    """Wait until the picture stands still, and write it."""
    page.evaluate("for (const b of document.querySelectorAll('.mantine-Notification-closeButton')) b.click()")
    time.sleep(SETTLE_S)
    cv2.imwrite(str(IMAGES / name), page.screenshot()[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def finished(browser: Browser, run: Path) -> None:
    """The map of a finished run in its colours, and by its normals."""
    from scanweld.viewer.finished import FinishedView

    with FinishedView(run, port=0) as view:
        serving = threading.Thread(target=view.serve, daemon=True)
        serving.start()
        page = visit(browser, view.url)
        view._timeline._slider.value = len(view._poses) // 3
        take(page, "view-finished.png")
        page.send("Page.close")
        view.close()
        serving.join()


def live(browser: Browser, place: str) -> None:
    """A run that is held in the middle, coloured by age."""
    from scanweld.viewer.live import LiveView

    sequence = sw.open_sequence(place)
    with LiveView(port=0, title=sequence.name) as view:
        page = visit(browser, view.url)
        view._panel._coloring.value = "age"
        run = threading.Thread(target=sw.run_sequence, args=(sequence,), kwargs={"observers": [view]}, daemon=True)
        run.start()
        while len(view._path.drawn()[0]) < 0.9 * len(sequence):
            time.sleep(0.05)
        view.gate.pause(True)
        take(page, "view-live.png")
        view.gate.pause(False)
        run.join()


if __name__ == "__main__":
    with chromium(Path(tempfile.mkdtemp())) as running:
        finished(running, Path(sys.argv[2]))
        live(running, sys.argv[1])
