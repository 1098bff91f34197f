"""Two frames before and after: find the motion between two views, and know whether to believe it.

Two frames of a rendered room, recorded with the noise of a Kinect, are aligned without a first guess: a near pair, and
one that is more than two metres and 68 degrees apart, where image features find the start. Then the same is tried with
a frame of another place: there is no answer, and the status says so.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import scanweld as sw


def main(out: Path, small: bool) -> None:
    """Align a near and a far pair of frames, and one without overlap; print the figures, draw the far pair."""
    size = {"width": 320, "height": 240} if small else {}
    room, corridor = (
        sw.SyntheticSequence(sw.RenderConfig(scene=scene, noise="kinect", **size)) for scene in ("room", "corridor")
    )
    first, near, far = 75, 25, 250
    a = room.read(first)
    for other in (near, far):
        b = room.read(other)
        result = sw.align_frames(a, b)
        T_truth = motion(room.ground_truth, first, other)
        print(f"frames {first} and {other}: {result.status.value}, overlap {result.overlap:.0%}")
        print(f"  error before  {describe(T_truth)}  (the motion between them)")
        print(f"  error after   {describe(sw.se3.inverse(T_truth) @ result.T_target_source)}")
        print(
            f"  {result.num_inliers} points lie {result.rmse_m * 1000:.1f} mm (rms) off the surfaces of the other frame"
        )

    nothing = sw.align_frames(a, corridor.read(0))
    print(f"a frame of the room and one of a corridor: {nothing.status.value}: {nothing.note}")

    out.mkdir(parents=True, exist_ok=True)
    draw(out / "03_two_frames.png", a, b, result.T_target_source)
    print(f"see {out / '03_two_frames.png'}")


def motion(truth: sw.Trajectory, source: int, target: int) -> np.ndarray:
    """Return the true T_target_source (4, 4) between the cameras of two frames."""
    return sw.se3.inverse(truth.T_world_camera[target]) @ truth.T_world_camera[source]


def describe(T: np.ndarray) -> str:
    """Return the size of a motion in words."""
    distance_mm, angle_deg = 1000 * np.linalg.norm(T[:3, 3]), np.degrees(sw.se3.rotation_angle_rad(T))
    return f"{distance_mm:6.1f} mm  {angle_deg:7.3f} deg"


def draw(path: Path, a: sw.Frame, b: sw.Frame, T_b_a: np.ndarray) -> None:
    """Draw slices of both frames in the camera of b, from above and from the side, before and after the alignment."""
    points_a, points_b = (frame.camera.back_project(frame.depth_m)[frame.depth_m > 0] for frame in (a, b))
    figure = Figure(figsize=(10, 7), layout="constrained")
    panels = figure.subplots(2, 2, sharex="row", sharey="row")
    for column, (moment, T) in enumerate((("before", np.eye(4)), ("after", T_b_a))):
        for points, color, label in (
            (sw.se3.transform_points(T, points_a), "#dc2626", "first frame"),
            (points_b, "#2563eb", "second frame"),
        ):
            x, y, z = points.T
            level, middle = np.abs(y) < 0.1, np.abs(x) < 0.1  # slices of 20 cm
            panels[0, column].plot(x[level], z[level], ",", color=color)
            panels[1, column].plot(z[middle], -y[middle], ",", color=color)
            panels[0, column].plot([], [], "s", color=color, label=label)
        panels[0, column].set(title=f"{moment}, from above", xlabel="x, right [m]", ylabel="z, forward [m]")
        panels[1, column].set(title=f"{moment}, from the side", xlabel="z, forward [m]", ylabel="-y, up [m]")
    panels[0, 0].legend(frameon=False)
    for panel in panels.flat:
        panel.set_aspect("equal")
        panel.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="folder for the pictures")
    parser.add_argument("--small", action="store_true", help="small images: a quick check")
    arguments = parser.parse_args()
    main(arguments.out, arguments.small)
