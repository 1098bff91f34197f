"""Camera paths: built in, one table, and read from files.

Built-in paths are closed curves, walked at constant speed by a hand that is not quite steady. They are
functions of the arc length and repeat exactly, so a path of any length is smooth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanweld.arrays import Float64
from scanweld.datasets.synthetic import corridor, twin_rooms, wall
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.trajectory import Trajectory

View = tuple[Float64, Float64, Float64]
"""Positions (N, 3) as (x, height, z) [m], yaw (N,) and pitch (N,) [rad]; yaw 0 is +z, 90 degrees is +x."""

_SAMPLES = 8192
OVERLAP = 1.06
"""Rounds of a path that are rendered unless a number of frames is asked for."""


@dataclass(frozen=True, slots=True)
class BuiltInPath:
    """A closed curve for phases in [0, 2 pi), the scene it belongs to, and the speed along it [m/s]."""

    scene: str
    view: Callable[[Float64], View]
    speed_mps: float


def _orbit(phase: Float64) -> View:
    """A figure of eight on an arc before the seating, looking at the low table."""
    angle = np.deg2rad(50) * np.sin(phase)
    radius = 1.85 + 0.12 * np.cos(phase)
    height = 1.32 + 0.24 * np.sin(2 * phase)
    position = np.stack([1.2 + radius * np.sin(angle), height, -1.1 + radius * np.cos(angle)], axis=-1)
    target = np.array([1.2, 0.72, -1.35]) + np.stack(
        [0.25 * np.sin(phase + 0.8), 0.12 * np.cos(2 * phase), np.zeros_like(phase)], axis=-1
    )
    return position, *_look(target - position)


def _sweep(phase: Float64) -> View:
    """A round of the whole room, looking outwards."""
    x, z = 1.25 + 0.55 * np.sin(phase), 0.35 + 0.7 * np.cos(phase)
    position = np.stack([x, 1.4 + 0.12 * np.sin(3 * phase), z], axis=-1)
    return position, phase + 0.06 * np.sin(5 * phase), np.deg2rad(-13 + 7 * np.sin(2 * phase))


def _loop(phase: Float64) -> View:
    """Once around the corridor, looking ahead and a little to either side."""
    xz, heading = corridor.centre_line(phase)
    position = np.insert(xz, 1, 1.38 + 0.04 * np.sin(9 * phase), axis=-1)
    return position, heading + np.deg2rad(11) * np.sin(7 * phase), np.deg2rad(-9 + 4 * np.sin(5 * phase))


def _visit(phase: Float64) -> View:
    """Around both of the twin rooms and twice through their corridor; half a round later all looks the same."""
    xz, heading = twin_rooms.centre_line(phase)
    position = np.insert(xz, 1, 1.36 + 0.04 * np.sin(8 * phase), axis=-1)
    return position, heading + np.deg2rad(4) * np.sin(6 * phase), np.deg2rad(-9 + 4 * np.sin(4 * phase))


def _along(phase: Float64) -> View:
    """There and back along the plain wall, looking straight at it."""
    x, z = -2.05 * np.cos(phase), wall.WIDTH / 2 - wall.DISTANCE - 0.2 * np.sin(phase)
    position = np.stack([x, 1.35 + 0.03 * np.sin(3 * phase), z], axis=-1)
    return position, np.deg2rad(2) * np.sin(2 * phase), np.deg2rad(1.5) * np.sin(3 * phase)


def _along_bricks(phase: Float64) -> View:
    """The same along the brick wall."""
    position, yaw, pitch = _along(phase)
    return position * np.array([1.0, 1.0, -1.0]), np.pi - yaw, pitch


PATHS = {
    "orbit": BuiltInPath("room", _orbit, 0.6),
    "sweep": BuiltInPath("room", _sweep, 0.3),
    "loop": BuiltInPath("corridor", _loop, 0.7),
    "visit": BuiltInPath("twin-rooms", _visit, 0.45),
    "plain": BuiltInPath("wall", _along, 0.5),
    "brick": BuiltInPath("wall", _along_bricks, 0.5),
}
"""Built-in paths by name; the first of a scene is its default."""


def path_names(scene: str) -> list[str]:
    """Return the names of the built-in paths of a scene, its default first."""
    return [name for name, path in PATHS.items() if path.scene == scene]


def built_in_path(name: str, num_frames: int, fps: float) -> Trajectory:
    """Return the poses of a built-in path at `fps` frames a second; 0 frames is a round and a little more."""
    path = PATHS[name]
    phase = np.linspace(0, 2 * np.pi, _SAMPLES + 1)
    steps = np.linalg.norm(np.diff(path.view(phase)[0], axis=0), axis=1)
    arc_m = np.concatenate([[0.0], np.cumsum(steps)])
    length_m = arc_m[-1]
    count = num_frames or round(OVERLAP * length_m / path.speed_mps * fps)
    travelled = np.arange(count) * path.speed_mps / fps
    rounds = np.floor(travelled / length_m)
    at = np.interp(travelled - rounds * length_m, arc_m, phase)
    position, yaw, pitch = path.view(at)
    return Trajectory(frame_times_s(count, fps), _handheld(position, yaw, pitch, at, length_m / path.speed_mps))


def frame_times_s(count: int, fps: float) -> Float64:
    """Return the times (N,) of frames [s], rounded to the microseconds that file names hold."""
    return np.round(np.arange(count) / fps, 6)


def path_from_file(path: Path, frame: str, num_frames: int, fps: float) -> Trajectory:
    """Return the poses of a trajectory file: TUM, rows of 3x4 matrices, or a (gzipped) Redwood log.

    The file is sampled `fps` times a second of its own clock and interpolated in between; poses without times
    count as 30 a second. `num_frames` keeps the first; 0 keeps all.

    `frame` is "cv", or "icl" for the convention of ICL-NUIM. That was rendered by POV-Ray, whose axes are x
    right, y up, z forward: left-handed, in the world and in the camera (hence fy = -480). Turning y around on
    both sides, T = F T_icl F with F = diag(1, -1, 1, 1), leaves a proper rotation and a right-handed world
    whose height is -y; turning it in the camera alone would mirror the world.

    Raises
    ------
    FileFormatError
        When the file is missing or is no trajectory.
    InvalidInputError
        When more frames are asked for than the path holds.
    """
    from scanweld.io.trajectory_files import read_trajectory

    poses = sample_trajectory(read_trajectory(path, format="icl" if frame == "icl" else "auto"), fps)
    if num_frames > len(poses):
        raise InvalidInputError(
            f"{path}: the path has {len(poses)} frames at {fps:g} a second, {num_frames} were asked for"
        )
    return poses.subset(slice(num_frames or None))


def sample_trajectory(trajectory: Trajectory, fps: float) -> Trajectory:
    """Return poses `fps` times a second, interpolated; times 1, 2, 3, .. are numbers of frames of 1/30 s."""
    times = trajectory.timestamps_s
    if len(times) < 2:
        return trajectory
    if np.all(np.diff(times) == 1.0):
        times = times / 30.0
    count = int(np.floor((times[-1] - times[0]) * fps + 1e-6)) + 1
    wanted = np.round(times[0] + np.arange(count) / fps, 6)
    after = np.clip(np.searchsorted(times, wanted - 2e-6), 1, len(times) - 1)
    before = after - 1
    fraction = np.clip((wanted - times[before]) / (times[after] - times[before]), 0.0, 1.0)
    T_a, T_b = trajectory.T_world_camera[before], trajectory.T_world_camera[after]
    T = se3.interpolate(T_a, T_b, fraction)
    # A wanted time that is a pose's own (to the microsecond of its file) takes that pose as it is.
    T = np.where((np.abs(wanted - times[after]) < 2e-6)[:, None, None], T_b, T)
    T = np.where((np.abs(wanted - times[before]) < 2e-6)[:, None, None], T_a, T)
    return Trajectory(wanted, T)


def choose_path(scene: str, path: str, frame: str, num_frames: int, fps: float) -> tuple[str, Trajectory]:
    """Return the name and the poses of a path given by name or file name; "" is the default of the scene.

    Raises
    ------
    ConfigError
        When the name is no built-in path of this scene and no file.
    """
    names = path_names(scene)
    name = path or names[0]
    if name in names:
        if frame != "cv":
            raise ConfigError(f"path_frame = '{frame}': only files have it, the built-in path '{name}' is in 'cv'")
        return name, built_in_path(name, num_frames, fps)
    if name in PATHS:
        raise ConfigError(
            f"path '{name}' belongs to scene '{PATHS[name].scene}'; scene '{scene}' has: {', '.join(names)}"
        )
    if not Path(name).is_file():
        raise ConfigError(f"path '{name}': no such file, and no path of scene '{scene}', which has: {', '.join(names)}")
    return Path(name).name.split(".")[0], path_from_file(Path(name), frame, num_frames, fps)


def _look(direction: Float64) -> tuple[Float64, Float64]:
    """Yaw and pitch (N,) of directions (N, 3) given as (x, height, z)."""
    x, height, z = direction.T
    return np.arctan2(x, z), np.arctan2(height, np.hypot(x, z))


def _handheld(position: Float64, yaw: Float64, pitch: Float64, phase: Float64, seconds_per_round: float) -> Float64:
    """T_world_camera (N, 4, 4): a steady view with the sway of a hand, millimetres and tenths of a degree."""

    def sway(hertz: float, start: float) -> Float64:
        waves = max(1, round(hertz * seconds_per_round))  # whole waves, so that the round closes
        return np.asarray(np.sin(waves * phase + start))

    offset = np.stack(
        [
            0.006 * sway(0.7, 0.3) + 0.002 * sway(1.9, 1.0),
            0.006 * sway(1.1, 2.0) + 0.002 * sway(2.3, 0.4),
            0.006 * sway(0.9, 4.0) + 0.002 * sway(1.7, 3.0),
        ],
        axis=-1,
    )
    yaw = yaw + np.deg2rad(0.5 * sway(0.8, 1.1) + 0.15 * sway(2.1, 0.0))
    pitch = pitch + np.deg2rad(0.5 * sway(0.6, 2.2) + 0.15 * sway(1.8, 5.0))
    roll = np.deg2rad(1.2 * sway(0.4, 0.5) + 0.2 * sway(1.6, 1.5))
    x, height, z = (position + offset).T
    T = np.zeros((len(yaw), 4, 4))
    T[:, :3, :3] = se3.exp_so3(_about(1, yaw)) @ se3.exp_so3(_about(0, pitch)) @ se3.exp_so3(_about(2, roll))
    T[:, :3, 3] = np.stack([x, -height, z], axis=-1)
    T[:, 3, 3] = 1.0
    return T


def _about(axis: int, angle: Float64) -> Float64:
    """Rotation vectors (N, 3) about one axis."""
    vectors = np.zeros((len(angle), 3))
    vectors[:, axis] = angle
    return vectors
