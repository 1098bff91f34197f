"""Take the picture of docs/cluster.md of the page about a batch, in Chromium.

scanweld render --size 160x120 --frames 60 --out /tmp/rooms/room-orbit --noise kinect
scanweld render --size 160x120 --frames 60 --out /tmp/rooms/room-sweep --noise realsense --path sweep
scanweld render --size 160x120 --frames 60 --out /tmp/rooms/corridor-loop --noise kinect --scene corridor
scanweld batch /tmp/rooms/* --out /tmp/runs/rooms --sweep tracking.stable_fraction=0.03,0.3,1.0
python docs/images/draw_batch.py /tmp/runs/rooms
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from chromium import chromium

IMAGES = Path(__file__).parent
SIZE = (1100, 1530)


def main(runs: Path) -> None:
    """Take the upper part of the page, down to the table of runs."""
    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile)) as browser:
        page = browser.page()
        page.look(*SIZE)
        page.open(runs / "report.html")
        picture = Image.fromarray(page.screenshot())
    picture.quantize(128).save(IMAGES / "batch.png", optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
