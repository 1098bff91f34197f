"""Dense SLAM: from depth and colour alone to the path of the camera and a map of the room.

The frames have the noise of a Kinect. The system is told no pose; each frame is aligned with the map that the frames
before it made, then merged into it. Since the sequence is rendered, the true path is known, and the drift can be drawn.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import scanweld as sw


def main(out: Path, small: bool) -> None:
    """Run SLAM on a rendered sequence, print its errors, draw the map and the drift."""
    size = {"width": 160, "height": 120, "frames": 12} if small else {"width": 640, "height": 480, "frames": 120}
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="room", noise="kinect", **size))

    slam = sw.build_slam(sequence.camera, sw.SlamConfig())
    for frame in sequence:
        result = slam.process(frame)
        if result.state is not sw.FrameState.TRACKING:
            print(f"frame {result.index}: {result.state.value}, {result.note}")

    error = sw.ate(slam.trajectory, sequence.ground_truth)
    step = sw.rpe(slam.trajectory, sequence.ground_truth)
    print(f"{len(sequence)} frames, {slam.trajectory.path_length_m:.2f} m of path, {len(slam.map):,} surfels")
    print(f"  ATE  {error.rmse_m * 1000:.2f} mm rms, {error.max_m * 1000:.2f} mm at most")
    print(f"  RPE  {step.rmse_trans_m * 1000:.2f} mm and {np.degrees(step.rmse_rot_rad):.3f} deg a frame")

    out.mkdir(parents=True, exist_ok=True)
    sw.write_ply(out / "05_map.ply", slam.map)
    sw.write_tum(out / "05_trajectory.txt", slam.trajectory)
    T_world_camera = slam.trajectory.T_world_camera[len(sequence) // 2]
    picture = sw.render_picture(slam.map, T_world_camera, sequence.camera.scaled(640 / sequence.camera.width))
    drift_m = drift(slam.trajectory, sequence.ground_truth)
    draw(out / "05_dense_slam.png", picture.color, picture.normal_colors(T_world_camera), drift_m)
    print(f"see {out / '05_dense_slam.png'}; {out / '05_map.ply'} opens in any point cloud viewer")


def drift(estimate: sw.Trajectory, truth: sw.Trajectory) -> np.ndarray:
    """Return how far each estimated camera centre (N,) is from the true one when both paths begin alike [m]."""
    T_truth_estimate = truth.T_world_camera[0] @ sw.se3.inverse(estimate.T_world_camera[0])
    return np.linalg.norm(sw.se3.transform_points(T_truth_estimate, estimate.positions_m) - truth.positions_m, axis=1)


def draw(path: Path, color: np.ndarray, normals: np.ndarray, drift_m: np.ndarray) -> None:
    """Draw the map in its colours, by its normals, and the drift of the camera."""
    figure = Figure(figsize=(14, 3.6), layout="constrained")
    rgb, normal, plot = figure.subplots(1, 3)
    for panel, image, name in ((rgb, color, "map"), (normal, normals, "normals")):
        panel.imshow(image)
        panel.set_title(name, loc="left", fontsize=10)
        panel.set_axis_off()
    plot.plot(1000 * drift_m, color="#2563eb")
    plot.set_title("drift: distance to the true camera, from a common start", loc="left", fontsize=10)
    plot.set(xlabel="frame", ylabel="[mm]", xlim=(0, len(drift_m) - 1))
    plot.set_ylim(bottom=0)
    plot.grid(color="#e5e7eb")
    plot.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the results")
    parser.add_argument("--small", action="store_true", help="few, small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
