"""Align two scans without a first guess, and know when there is no answer.

One of two scans of a rendered room is turned and moved at random. Local methods end somewhere; features, matches that
agree with one another, and a check of what each scan says about the other's free space find the motion.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import scanweld as sw
from scanweld.geometry import se3
from scanweld.registration.global_registration import register_global
from scanweld.registration.pictures import draw_alignment


def main(out: Path, small: bool) -> None:
    """Register a pair from anywhere, and one that does not belong together; draw the first."""
    size = {"width": 160, "height": 120} if small else {"width": 320, "height": 240}
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="room", noise="kinect", **size))
    rng = np.random.default_rng(0)
    anywhere = se3.from_quaternion_xyzw(rng.normal(size=4), rng.uniform(-3, 3, 3))
    target, source = scan(sequence, 25), scan(sequence, 75).transformed(anywhere)
    T_world_camera = sequence.ground_truth.T_world_camera
    truth = se3.inverse(T_world_camera[25]) @ T_world_camera[75] @ se3.inverse(anywhere)
    print(f"{len(source):,} and {len(target):,} points, {size_of(truth)} apart")

    local = sw.icp(source, target)
    print(
        f"  local, from the identity: {local.status.value}, {size_of(se3.inverse(truth) @ local.T_target_source)} off"
    )
    started = time.perf_counter()
    result = register_global(source, target)
    seconds = time.perf_counter() - started
    error = se3.inverse(truth) @ result.T_target_source
    print(f"  global: {result.status.value}, {size_of(error)} off, overlap {result.overlap:.0%}, {seconds:.1f} s")

    balls = scattered_balls(rng)
    nothing = register_global(balls, target)
    print(f"forty balls against the room: {nothing.status.value}: {nothing.note}")

    out.mkdir(parents=True, exist_ok=True)
    draw_alignment(out / "08_global_registration.png", source, target, result)
    print(f"see {out / '08_global_registration.png'}")


def scan(sequence: sw.SyntheticSequence, index: int) -> sw.PointCloud:
    """Return the points of a frame, in its camera's frame."""
    frame = sequence.read(index)
    return sw.PointCloud(frame.camera.back_project(frame.depth_m)[frame.depth_m > 0])


def scattered_balls(rng: np.random.Generator) -> sw.PointCloud:
    """Return points on forty balls."""
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return sw.PointCloud(rng.uniform(-2, 2, (40, 3))[rng.integers(0, 40, 20_000)] + 0.3 * directions)


def size_of(T: np.ndarray) -> str:
    """Return the size of a motion in words."""
    return f"{1000 * np.linalg.norm(T[:3, 3]):.1f} mm and {np.degrees(se3.rotation_angle_rad(T)):.2f} deg"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the pictures")
    parser.add_argument("--small", action="store_true", help="small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
