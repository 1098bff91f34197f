"""Draw the pictures of the documentation anew, small enough for a repository.

scanweld demo --out /tmp/demo
for script in examples/0*.py; do python $script --out /tmp/examples; done
python docs/images/draw.py /tmp/demo /tmp/examples
"""

import io
import sys
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

import scanweld as sw

HERE = Path(__file__).parent
LARGEST_BYTES = 300_000


def main(run: Path, examples: Path) -> None:
    """Draw demo.png from a demo run, and shrink every picture that the examples drew."""
    save(draw_demo(run), HERE / "demo.png")
    for path in sorted(examples.glob("[0-9][0-9]_*.png")):
        save(Image.open(path), HERE / path.name)


def draw_demo(run: Path) -> Image.Image:
    """Return the overview of the map in colours and by normals, and the path of the camera."""
    estimate = sw.read_trajectory(run / "trajectory.txt")
    truth = sw.SyntheticSequence(sw.RenderConfig(scene="room", frames=len(estimate))).ground_truth
    error = sw.ate(estimate, truth)
    rgb, normals = (np.array(Image.open(run / "renders" / f"overview-{kind}.png")) for kind in ("rgb", "normals"))
    rows, columns = (np.flatnonzero((rgb < 255).any(axis=(2, axis))) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]

    figure = Figure(figsize=(14, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1, 0.85])
    for panel, image in ((left, rgb), (middle, normals)):
        panel.imshow(image[window])
        panel.set_axis_off()
    true, found = error.positions_truth_m[:, [0, 2]], error.positions_aligned_m[:, [0, 2]]
    right.plot(*true.T, color="#9ca3af", linewidth=5, alpha=0.6, solid_capstyle="round", label="true path")
    lines = LineCollection(list(np.stack([found[:-1], found[1:]], axis=1)), cmap="viridis", linewidth=2)
    lines.set_array(error.errors_m[1:] * 1000)
    right.add_collection(lines)
    figure.colorbar(lines, ax=right, label="error of the estimate [mm]", pad=0.02)
    right.set_aspect("equal", adjustable="datalim")
    right.set(xlabel="x [m]", ylabel="z [m]")
    right.set_title(f"{len(estimate)} frames, ATE {error.rmse_m * 1000:.1f} mm rms", loc="left", fontsize=10)
    right.legend(frameon=False, fontsize=9)
    right.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90)
    return Image.open(buffer)


def save(image: Image.Image, path: Path) -> None:
    """Write a PNG of 256 colours, as large as fits into LARGEST_BYTES."""
    image = image.convert("RGB")
    for width in range(min(image.width, 1260), 300, -60):
        scaled = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
        reduced = scaled.quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
        reduced.save(path, optimize=True)
        if path.stat().st_size <= LARGEST_BYTES:
            break
    print(f"{path}: {scaled.width}x{scaled.height}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
