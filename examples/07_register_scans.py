"""Align two scans with every local method, and read what the result says about itself.

Two depth images of a rendered room, with the noise of a Kinect, become point clouds. The first guess is the identity,
30 cm and 8 degrees off. Then what has no answer: clouds that do not belong together, and a wall that slides in itself.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import scanweld as sw
from scanweld.geometry import se3
from scanweld.registration.pictures import draw_alignment
from scanweld.registration.uncertainty import point_covariances


def main(out: Path, small: bool) -> None:
    """Align, print a line for each method, draw the last answer."""
    size = {"width": 160, "height": 120} if small else {"width": 320, "height": 240}
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="room", noise="kinect", **size))
    target, source = scan(sequence, 60), scan(sequence, 75)
    T_world_camera = sequence.ground_truth.T_world_camera
    truth = se3.inverse(T_world_camera[60]) @ T_world_camera[75]
    print(f"{len(source):,} and {len(target):,} points, {size_of(truth)} apart")

    for method in ("point-to-point", "point-to-plane", "symmetric", "gicp", "coloured"):
        started = time.perf_counter()
        result = sw.icp(source, target, config=sw.IcpConfig(method=method, voxel_m=0.02))
        error = se3.inverse(truth) @ result.T_target_source
        print(
            f"  {method:<15} {result.status.value:<13} {size_of(error)} off, overlap {result.overlap:.0%}, "
            f"{result.num_iterations} steps, {time.perf_counter() - started:.2f} s"
        )
    center = source.points_m.mean(axis=0)
    if result.covariance is not None:
        deviation = np.sqrt(np.trace(point_covariances(result, center[None])[0]))
        print(f"standard deviation at the source's centre, by its own account: {1000 * deviation:.2f} mm")

    # What cannot be answered is said, not guessed.
    wall = target.select(np.abs(target.points_m[:, 2] - np.percentile(target.points_m[:, 2], 95)) < 0.05)
    slid = wall.transformed(se3.exp([0.15, 0, 0, 0, 0, 0]))
    for name, a, b in (
        ("forty balls against the room", scattered_balls(), target),
        ("a wall slid in itself", slid, wall),
    ):
        refused = sw.icp(a, b)
        print(f"{name}: {refused.status.value}: {refused.note}")

    out.mkdir(parents=True, exist_ok=True)
    draw_alignment(out / "07_register_scans.png", source, target, result)
    print(f"see {out / '07_register_scans.png'}")


def scan(sequence: sw.SyntheticSequence, index: int) -> sw.PointCloud:
    """Return the points and colours of a frame, in its camera's frame."""
    frame = sequence.read(index)
    seen = frame.depth_m > 0
    return sw.PointCloud(frame.camera.back_project(frame.depth_m)[seen], colors=frame.color[seen])


def scattered_balls() -> sw.PointCloud:
    """Return points on forty balls."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return sw.PointCloud(rng.uniform(-2, 2, (40, 3))[rng.integers(0, 40, 20_000)] + [0, 0, 2] + 0.3 * directions)


def size_of(T: np.ndarray) -> str:
    """Return the size of a motion in words."""
    return f"{1000 * np.linalg.norm(T[:3, 3]):6.1f} mm and {np.degrees(se3.rotation_angle_rad(T)):6.2f} deg"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the pictures")
    parser.add_argument("--small", action="store_true", help="small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
