"""Track against all points of the map, or against the most stable tenth of them?

A surfel that many frames have confirmed has averaged its noise away. `tracking.stable_fraction` limits the points that
a frame is aligned with to the most confirmed ones. Fewer points cost less time; whether they give less drift depends on
the sequence: they are the better points, and they hold fewer directions. So this example runs both and says which was
better.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import scanweld as sw

COLORS = ("#2563eb", "#dc2626")


def main(out: Path, small: bool) -> None:
    """Run SLAM twice on one sequence, print and draw both runs side by side."""
    size = {"width": 160, "height": 120, "frames": 12} if small else {"width": 640, "height": 480, "frames": 120}
    sequence = sw.SyntheticSequence(sw.RenderConfig(scene="room", noise="kinect", **size))
    runs = {"all points": run(sequence, 1.0), "most stable 10 %": run(sequence, 0.1)}

    figures = {name: judge(slam, sequence.ground_truth) for name, slam in runs.items()}
    for name, slam in runs.items():
        measured = slam.results[1:]  # the first frame has nothing to be aligned with
        converged = sum(result.status == "converged" for result in measured)
        print(f"{name}: {converged} of {len(measured)} frames converged")
        print(f"  ATE    {figures[name]['ATE']:.2f} mm rms, after the best alignment of the whole path")
        print(f"  drift  {figures[name]['drift']:.2f} mm at the end, from a common start")
        print(f"  loss   {np.mean([result.loss for result in measured]):.3f} at the last iteration, mean of all frames")
        print(f"  time   {np.median([result.stage_ms['track'] for result in measured]):.1f} ms of tracking a frame")
    for figure in ("ATE", "drift"):
        print(f"smaller {figure}: {min(figures, key=lambda name: figures[name][figure])}")

    out.mkdir(parents=True, exist_ok=True)
    draw(out / "06_stable_fraction.png", runs, sequence)
    print(f"see {out / '06_stable_fraction.png'}")


def run(sequence: sw.SyntheticSequence, stable_fraction: float) -> sw.Slam:
    """Return the system after the whole sequence."""
    config = sw.SlamConfig(tracking=sw.TrackingConfig(stable_fraction=stable_fraction))
    slam = sw.build_slam(sequence.camera, config)
    for frame in sequence:
        slam.process(frame)
    return slam


def judge(slam: sw.Slam, truth: sw.Trajectory) -> dict[str, float]:
    """Return ATE and final drift [mm]."""
    return {
        "ATE": 1000 * sw.ate(slam.trajectory, truth).rmse_m,
        "drift": 1000 * float(drift(slam.trajectory, truth)[-1]),
    }


def drift(estimate: sw.Trajectory, truth: sw.Trajectory) -> np.ndarray:
    """Return how far each estimated camera centre (N,) is from the true one when both paths begin alike [m]."""
    T_truth_estimate = truth.T_world_camera[0] @ sw.se3.inverse(estimate.T_world_camera[0])
    return np.linalg.norm(sw.se3.transform_points(T_truth_estimate, estimate.positions_m) - truth.positions_m, axis=1)


def zoom(camera: sw.PinholeCamera, u: float, v: float, factor: float) -> sw.PinholeCamera:
    """Return a 480x360 camera in the same place that sees `factor` times larger, pixel (u, v) in the middle."""
    return sw.PinholeCamera(
        camera.fx * factor,
        camera.fy * factor,
        239.5 + (camera.cx - u) * factor,
        179.5 + (camera.cy - v) * factor,
        480,
        360,
    )


def draw(path: Path, runs: dict[str, sw.Slam], sequence: sw.SyntheticSequence) -> None:
    """Draw zoomed colours and normals of both maps, and drift and loss of both runs."""
    figure = Figure(figsize=(13, 7.6), layout="constrained")
    panels = figure.subplots(2, 3, width_ratios=[1, 1, 1.3])
    camera = sequence.camera
    zoomed = zoom(camera, 0.57 * camera.width, 0.58 * camera.height, 1000 / camera.width)
    for row, (name, slam) in enumerate(runs.items()):
        # Every map is looked at from its own estimate of the camera in the middle of the path.
        T_world_camera = slam.trajectory.T_world_camera[len(sequence) // 2]
        picture = sw.render_picture(slam.map, T_world_camera, zoomed)
        for column, image in enumerate((picture.color, picture.normal_colors(T_world_camera))):
            panels[row, column].imshow(image)
            panels[row, column].set_axis_off()
            panels[row, column].set_title(f"{name}: {('RGB', 'normals')[column]}, zoomed", loc="left", fontsize=10)
        label = {"label": name, "color": COLORS[row], "linewidth": 1.3}
        panels[0, 2].plot(1000 * drift(slam.trajectory, sequence.ground_truth), **label)
        panels[1, 2].plot(range(1, len(slam.results)), [result.loss for result in slam.results[1:]], **label)
    panels[0, 2].set(title="drift: distance to the true camera, from a common start", ylabel="[mm]")
    panels[1, 2].set(title="loss at the last iteration", xlabel="frame", ylabel="mean Huber loss")
    for plot in panels[:, 2]:
        plot.set_ylim(bottom=0)
        plot.grid(color="#e5e7eb")
        plot.legend(frameon=False, fontsize=9)
        plot.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the picture")
    parser.add_argument("--small", action="store_true", help="few, small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
