"""Fusion with given poses: many depth images become one map that is much smaller and still has every surface.

Each frame is merged into the surfel map at its true pose, so what is seen here is mapping alone. The compression ratio
is the number of depth measurements that one surfel stands for. A course implementation of point-based fusion kept
1,362,157 of 15,360,000 points of another living room, a ratio of 11.28. The ratio grows with the number of frames that
look at the same place, so it says little without the second figure: the share of the measurements that have the centre
of a surfel within a centimetre. (At 320x240 the centres themselves are about a centimetre apart at three metres.)
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import scanweld as sw


def main(out: Path, small: bool) -> None:
    """Fuse a rendered sequence at its true poses, print the figures, draw the map."""
    size = {"width": 160, "height": 120, "frames": 10} if small else {"width": 320, "height": 240, "frames": 200}
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="room", **size))
    poses = sequence.ground_truth.T_world_camera

    slam = sw.build_slam(sequence.camera)
    num_points, some_points = 0, []
    for frame, T_world_camera in zip(sequence, poses, strict=True):
        slam.process(frame, T_world_camera=T_world_camera)  # with a pose a frame is fused and not tracked
        points = sw.se3.transform_points(T_world_camera, frame.camera.back_project(frame.depth_m)[frame.depth_m > 0])
        num_points += len(points)
        some_points.append(points[::29])  # every 29th measurement is enough for a share

    cover = sw.surface_completeness(slam.map.positions_m.T, np.concatenate(some_points), thresholds_m=(0.01,))
    ratio = num_points / len(slam.map)
    print(f"{len(sequence)} frames, {num_points:,} points -> {len(slam.map):,} surfels")
    print(f"  compression ratio    {ratio:.2f}  (a course implementation, on another room: 11.28)")
    print(f"  within 1 cm of it    {cover.within[0.01]:.2%} of the points, median {cover.median_m * 1000:.1f} mm")

    # A person sees a picture of 640x480 from the middle of the path.
    T_world_camera = poses[len(poses) // 2]
    picture = sw.render_picture(slam.map, T_world_camera, sequence.camera.scaled(640 / sequence.camera.width))
    out.mkdir(parents=True, exist_ok=True)
    path = out / "04_fusion_given_poses.png"
    draw(path, picture.color, picture.normal_colors(T_world_camera), f"{len(slam.map):,} surfels, 1 : {ratio:.1f}")
    print(f"see {path}")


def draw(path: Path, color: np.ndarray, normals: np.ndarray, title: str) -> None:
    """Draw the map in its colours and by its normals, side by side."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    for panel, image, name in zip(figure.subplots(1, 2), (color, normals), (title, "normals"), strict=True):
        panel.imshow(image)
        panel.set_title(name, loc="left", fontsize=10)
        panel.set_axis_off()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the picture")
    parser.add_argument("--small", action="store_true", help="few, small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
