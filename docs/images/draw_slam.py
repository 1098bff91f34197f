"""Draw the figures of docs/slam/ anew: every one is computed by the package, from rendered sequences.

scanweld render --out /tmp/corridor --scene corridor --noise kinect --size 320x240     # for loop_closure
python docs/images/draw_slam.py [--corridor /tmp/corridor] [NAME ...]                   # all of them without names
"""

from __future__ import annotations

import argparse
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import scanweld as sw
from scanweld.datasets.synthetic.crossing import CrossedSequence, walk_across
from scanweld.tracking.dynamics import MotionDetector

HERE = Path(__file__).parent / "slam"
LARGEST_BYTES = 150_000
ORANGE, BLUE, GREEN, INK, FAINT = "#d55e00", "#0072b2", "#009e73", "#22303c", "#9ca3af"
SMALL = {"width": 320, "height": 240}


def surfaces(figure: Figure, _: Path) -> None:
    """A depth image, its normals, and the noise that its pixels are expected to have."""
    sequence = sw.SyntheticSequence(sw.RenderConfig(noise="kinect", **SMALL))
    level = sw.build_pyramid(sequence.read(0)).levels[0]
    valid = (level.depth_m > 0) & (np.abs(level.normals).sum(axis=-1) > 0)
    colors = np.where(valid[..., None], 0.5 - 0.5 * level.normals, 1.0)
    sigma_mm = 1e3 * (0.0012 + 0.0019 * (level.depth_m - 0.4) ** 2)
    panels = figure.subplots(1, 3)
    for panel, image, title in (
        (panels[0], np.where(level.depth_m > 0, level.depth_m, np.nan), "depth [m]"),
        (panels[1], colors, "normals; white: none"),
        (panels[2], np.where(valid, sigma_mm, np.nan), "standard deviation of the depth [mm]"),
    ):
        shown = panel.imshow(image, cmap="viridis")
        panel.set(title=title, xticks=[], yticks=[])
        panel.set_anchor("N")
        if image.ndim == 2:
            figure.colorbar(shown, ax=panel, location="bottom", shrink=0.8, pad=0.03).ax.tick_params(labelsize=7)


def brightness(figure: Figure, _: Path) -> None:
    """The path along a wall of bricks, with brightness and without, in the two directions that depth leaves free."""
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="wall", path="brick", noise="kinect", frames=95, **SMALL))
    frames = [sequence.read(index) for index in range(len(sequence))]
    truth = sequence.ground_truth
    first = truth.T_world_camera[0]
    panels = figure.subplots(1, 2)
    for photometry, color in (("off", ORANGE), ("auto", BLUE)):
        config = sw.SlamConfig(tracking=sw.TrackingConfig(photometry=photometry), loop_closer="none")
        slam = sw.build_slam(sequence.camera, config)
        for frame in frames:
            slam.process(frame)
        found = np.array([first @ result.T_world_camera for result in slam.results])
        off_mm = 1e3 * (np.linalg.inv(first) @ found - np.linalg.inv(first) @ truth.T_world_camera)[:, :2, 3]
        for axis, panel in enumerate(panels):
            panel.plot(truth.timestamps_s, off_mm[:, axis], color=color, label=f"photometry = {photometry}")
    for axis, panel in enumerate(panels):
        panel.axhline(0, color=FAINT, linewidth=0.8)
        direction = ("sideways", "up and down")[axis]
        panel.set(title=f"error {direction} [mm]", xlabel="time [s]")
    panels[0].legend()


def dynamics(figure: Figure, _: Path) -> None:
    """A frame with a person, the pixels that are found to move, and the map afterwards from the same place."""
    config = sw.RenderConfig(noise="kinect", frames=60, **SMALL)
    still = sw.SyntheticSequence(config)
    sequence = CrossedSequence(config, walk_across(still.ground_truth, 15, 40))
    mapper, detector = sw.SurfelMapper(), MotionDetector()
    shown = 36
    for index, T_world_camera in enumerate(sequence.ground_truth.T_world_camera):
        frame = sequence.read(index)
        pyramid = sw.build_pyramid(frame)
        moving = None
        if index:
            moving = detector.find(pyramid, mapper.view(T_world_camera, frame.camera), T_world_camera)
        mapper.fuse(pyramid, T_world_camera, moving=moving)
        detector.remember(pyramid, T_world_camera)
        if index == shown:
            picture, mask = frame.color, moving
    painted = picture.copy()
    painted[mask] = (0.4 * painted[mask] + 0.6 * np.array([213, 94, 0])).astype(np.uint8)
    after = sw.render_picture(mapper.map, sequence.ground_truth.T_world_camera[shown], sequence.camera).color
    for panel, image, title in zip(
        figure.subplots(1, 3), (picture, painted, after), ("a frame", "what moves", "the map afterwards"), strict=True
    ):
        panel.imshow(image)
        panel.set(title=title, xticks=[], yticks=[])


def loop_closure(figure: Figure, corridor: Path) -> None:
    """The path around a loop of corridors, every third frame, focal length 5 % too long: as odometry, and closed."""
    opened = sw.open_sequence(corridor)
    camera = opened.camera
    wrong = replace(camera, fx=1.05 * camera.fx, fy=1.05 * camera.fy)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for panel, closer, title in zip(panels, ("none", "keyframes"), ("odometry alone", "loops closed"), strict=True):
        sequence = sw.open_sequence(corridor, camera=wrong, frames="::3")
        slam = sw.build_slam(wrong, sw.SlamConfig(loop_closer=closer))
        for frame in sequence:
            slam.process(frame)
        truth = sequence.ground_truth
        error = sw.ate(slam.trajectory, truth)
        # Both paths from the same start: what an alignment of the whole would hide is where the ends do not meet.
        start = slam.trajectory.T_world_camera[0]
        true = truth.T_world_camera
        panel.plot(
            *(start @ np.linalg.inv(true[0]) @ true)[:, [0, 2], 3].T, color=FAINT, linewidth=4, label="true path"
        )
        path = slam.trajectory.T_world_camera[:, [0, 2], 3]
        panel.plot(*path.T, color=BLUE, linewidth=1.2, label="estimate")
        panel.plot(*path[[0, -1]].T, "o", color=ORANGE, markersize=4, label="begin and end")
        panel.set_aspect("equal")
        lost = sum(result.state is sw.FrameState.LOST for result in slam.results)
        figures = f"ATE {100 * error.rmse_m:.0f} cm, {lost} of {len(slam.results)} frames lost"
        panel.set(title=f"{title}: {figures}", xlabel="x [m]", ylabel="z [m]")
    panels[0].legend()


FIGURES = {
    "surfaces": (surfaces, (8.4, 2.9)),
    "brightness": (brightness, (8.4, 2.9)),
    "dynamics": (dynamics, (8.4, 2.4)),
    "loop_closure": (loop_closure, (8.4, 3.6)),
}


def main(names: list[str], corridor: Path) -> None:
    """Draw the figures of these names."""
    HERE.mkdir(exist_ok=True)
    for name in names or FIGURES:
        draw, size = FIGURES[name]
        figure = Figure(figsize=size, layout="constrained")
        draw(figure, corridor)
        for panel in figure.axes:
            style(panel)
        save(figure, HERE / f"{name}.png")


def style(panel: Any) -> None:
    """Small, quiet text, and the title at the left."""
    panel.set_title(panel.get_title(), loc="left", fontsize=9, color=INK)
    panel.set_title("")
    panel.tick_params(labelsize=8)
    panel.xaxis.label.set_size(8)
    panel.yaxis.label.set_size(8)
    panel.spines[["top", "right"]].set_visible(False)
    if panel.get_legend() is not None:
        panel.get_legend().set_frame_on(False)
        for text in panel.get_legend().get_texts():
            text.set_size(7)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of at most 256 colours."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    image = Image.open(buffer).convert("RGB")
    for colors in (256, 128, 64, 32):
        image.quantize(colors, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size < LARGEST_BYTES:
            break
    print(f"{path}: {image.width}x{image.height}, {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw the figures of docs/slam/ anew.")
    parser.add_argument("names", nargs="*", help="surfaces, brightness, dynamics, loop_closure")
    parser.add_argument("--corridor", type=Path, default=Path("/tmp/corridor"), help="the rendered corridor")
    arguments = parser.parse_args()
    main(arguments.names, arguments.corridor)
