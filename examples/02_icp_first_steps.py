"""The first steps of ICP when nobody knows which point belongs to which.

ICP pairs every source point with the nearest target point, aligns the pairs in closed form, and repeats. Started far
away it may settle in a wrong minimum, and small steps alone do not tell. This script shows one such case step by
step, and then one that works, with what the result says about each.

    python examples/02_icp_first_steps.py [--out FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.registration.explain import explain_icp
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.pictures import draw_alignment, draw_icp

parser = argparse.ArgumentParser(description="The first steps of ICP.")
parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="where the pictures go")
out = parser.parse_args().out
out.mkdir(parents=True, exist_ok=True)

# Five points whose partners lie 45 degrees and several metres away: all five first choose the same partner, the
# matrix W is zero, and the only thing that can be said is a translation.
wrong = explain_icp()
print(wrong.text())
draw_icp(out / "02_icp_first_steps.png", wrong)

# Two samples of one room, a few centimetres apart: many points, and a start that is near.
rng = np.random.default_rng(0)


def sample_room(count: int) -> np.ndarray:
    """Points on the floor and two walls of a 4 x 3 x 2.5 m room and on a column in it, with 5 mm of noise."""
    points = rng.uniform(0, 1, (count, 3)) * [4, 3, 2.5]
    for axis in range(3):
        points[axis::4, axis] = 0
    angle = rng.uniform(0, 2 * np.pi, len(points[3::4]))
    points[3::4, :2] = np.column_stack([2.5 + 0.4 * np.cos(angle), 1.8 + 0.4 * np.sin(angle)])
    return points + 0.005 * rng.normal(size=points.shape)


truth = se3.exp([0.10, -0.08, 0.05, 0.02, -0.03, 0.12])
target = PointCloud(sample_room(6000))
source = PointCloud(sample_room(6000)).transformed(se3.inverse(truth))

print("Two samples of one room, 14 cm and 7 degrees apart")
for method in ("point-to-point", "point-to-plane"):
    result = icp(source, target, config=IcpConfig(method=method))
    error = result.T_target_source @ se3.inverse(truth)
    print(
        f"  {method}: {result.status.name} after {result.num_iterations} steps, "
        f"{1000 * np.linalg.norm(error[:3, 3]):.2f} mm and {np.degrees(se3.rotation_angle_rad(error)):.3f} deg off"
    )
draw_alignment(out / "02_icp_room.png", source, target, result)

# A plane slid in itself looks perfectly aligned wherever it is. Three directions are free, and stay where they were.
plane = np.column_stack([rng.uniform(0, 3, (2000, 2)), np.zeros(2000)])
result = icp(plane + [0.15, 0, 0], np.column_stack([rng.uniform(0, 3, (2000, 2)), np.zeros(2000)]))
print(f"\nA plane slid by 15 cm in itself\n  {result.status.name}: {result.note}")
print(f"\nwrote {out / '02_icp_first_steps.png'} and {out / '02_icp_room.png'}")
