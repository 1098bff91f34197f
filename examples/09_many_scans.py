"""Put many scans of one room together: which belong to which, and where, nobody says.

Scans of a rendered room, in any order and every one in a frame of its own, and one stranger among them. All pairs are
aligned; alignments that others contradict are dropped; a pose graph of the rest gives the poses. The stranger stays
alone instead of being put somewhere.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import scanweld as sw
from scanweld.geometry import se3
from scanweld.registration.many import register_many

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def main(out: Path, small: bool) -> None:
    """Register the scans, print what is known about each, draw them together."""
    size = {"width": 120, "height": 90} if small else {"width": 160, "height": 120}
    frames = (75, 25, 50) if small else (75, 25, 100, 50, 0)
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="room", noise="kinect", **size))
    rng = np.random.default_rng(0)
    T_own_camera = [se3.from_quaternion_xyzw(rng.normal(size=4), rng.uniform(-3, 3, 3)) for _ in frames]
    scans = [scan(sequence, k).transformed(T) for k, T in zip(frames, T_own_camera, strict=True)]
    stranger = len(scans)
    scans.append(scattered_balls(rng))

    started = time.perf_counter()
    result = register_many(scans)
    print(
        f"{len(scans)} scans, {len(result.pairs)} pairs in {time.perf_counter() - started:.1f} s: {result.status.value}"
    )
    print(f"  {result.note}")
    print(f"  groups that connect: {', '.join(str(list(group)) for group in result.components)}")

    T_world_camera = sequence.ground_truth.T_world_camera[list(frames)]
    for k, (status, T) in enumerate(zip(result.scan_status, result.T_world_scan, strict=True)):
        if k == stranger or k not in result.components[0]:
            print(f"  scan {k}: {status.value}")
            continue
        truth = T_own_camera[0] @ se3.inverse(T_world_camera[0]) @ T_world_camera[k] @ se3.inverse(T_own_camera[k])
        error = se3.inverse(truth) @ T
        print(
            f"  scan {k}: {status.value}, {1000 * np.linalg.norm(error[:3, 3]):.1f} mm and "
            f"{np.degrees(se3.rotation_angle_rad(error)):.2f} deg off"
        )

    out.mkdir(parents=True, exist_ok=True)
    to_camera = se3.inverse(T_own_camera[0])  # the world is the first scan's frame; its camera looks along z
    draw(out / "09_many_scans.png", scans, [to_camera @ T for T in result.T_world_scan], result.components[0])
    print(f"see {out / '09_many_scans.png'}")


def scan(sequence: sw.SyntheticSequence, index: int) -> sw.PointCloud:
    """Return the points of a frame, in its camera's frame."""
    frame = sequence.read(index)
    return sw.PointCloud(frame.camera.back_project(frame.depth_m)[frame.depth_m > 0])


def scattered_balls(rng: np.random.Generator) -> sw.PointCloud:
    """Return points on forty balls."""
    directions = rng.normal(size=(5_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return sw.PointCloud(rng.uniform(-2, 2, (40, 3))[rng.integers(0, 40, 5_000)] + 0.3 * directions)


def draw(path: Path, scans: list[sw.PointCloud], poses: list[np.ndarray], group: tuple[int, ...]) -> None:
    """Draw the connected scans, as they came and together, from above."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for k in group:
        color, together = COLORS[k % len(COLORS)], scans[k].transformed(poses[k])
        left.plot(*scans[k].points_m[:, [0, 2]].T, ",", color=color)
        right.plot(*together.points_m[:, [0, 2]].T, ",", color=color)
        right.plot([], [], "s", color=color, label=f"scan {k}")
    for panel, title in ((left, "as they came, every scan in its own frame"), (right, "together, from above")):
        panel.set(title=title, xlabel="x [m]", ylabel="z [m]", aspect="equal")
        panel.spines[["top", "right"]].set_visible(False)
    right.legend(frameon=False)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the pictures")
    parser.add_argument("--small", action="store_true", help="small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
