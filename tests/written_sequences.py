"""Tiny sequences that the tests write themselves: 16x12 images of a tilted plane, in every layout."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 16, 12


def depth_units(index: int, depth_scale: float) -> np.ndarray:
    """Raw depth (12, 16) uint16 of frame `index`: about 1.5 m, different in every pixel and frame."""
    metres = 1.5 + 0.01 * index + 0.001 * np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    return np.round(metres * depth_scale).astype(np.uint16)


def color_rgb(index: int) -> np.ndarray:
    """Colour (12, 16, 3) uint8 of frame `index`: one colour, so that JPEG keeps it nearly."""
    return np.full((HEIGHT, WIDTH, 3), (200, 100, 10 * (index % 10)), dtype=np.uint8)


def write_image(path: Path, image: np.ndarray) -> Path:
    """Write a depth image as it is, or a colour image given as RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    ok, data = cv2.imencode(path.suffix, stored)
    assert ok
    path.write_bytes(data.tobytes())
    return path


def write_frame(depth: Path, color: Path | None, index: int, depth_scale: float) -> None:
    """Write the two images of frame `index`."""
    write_image(depth, depth_units(index, depth_scale))
    if color is not None:
        write_image(color, color_rgb(index))


def poses(count: int) -> np.ndarray:
    """T_world_camera (N, 4, 4): 1 cm to the right a frame, turning about y."""
    T = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        c, s = np.cos(0.02 * i), np.sin(0.02 * i)
        T[i, :3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        T[i, :3, 3] = [0.01 * i, 0.002 * i, 0]
    return T


def tum_lines(times_s: list[float], T: np.ndarray) -> str:
    """TUM trajectory of rotations about y."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(times_s, T, strict=True):
        half = np.arctan2(pose[0, 2], pose[0, 0]) / 2
        values = [time, *pose[:3, 3], 0, np.sin(half), 0, np.cos(half)]
        lines.append(" ".join(repr(float(v)) for v in values))
    return "\n".join(lines) + "\n"


def write_redwood(folder: Path, count: int = 4, *, color: str = "color", suffix: str = ".jpg", first: int = 0) -> Path:
    """Redwood layout with groundtruth.txt."""
    for i in range(count):
        number = f"{i + first:05d}"
        write_frame(folder / "depth" / f"{number}.png", folder / color / f"{number}{suffix}", i, 1000)
    (folder / "groundtruth.txt").write_text(tum_lines([i / 30 for i in range(count)], poses(count)))
    return folder


def write_seven_scenes(folder: Path, numbers: tuple[int, ...] = (0, 1, 2, 5)) -> Path:
    """7-Scenes layout with poses; the default numbering has a gap."""
    for n in numbers:
        stem = folder / f"frame-{n:06d}"
        write_frame(Path(f"{stem}.depth.png"), Path(f"{stem}.color.png"), n, 1000)
        np.savetxt(f"{stem}.pose.txt", poses(max(numbers) + 1)[n])
    return folder


def write_tum(folder: Path, count: int = 4, *, color_delay_s: float = 0.005) -> Path:
    """TUM layout; colour comes `color_delay_s` after depth, the truth at 100 Hz."""
    depth_lines, color_lines = ["# depth"], ["# color"]
    for i in range(count):
        time = 1000 + i / 30
        write_frame(folder / f"depth/{time:.6f}.png", folder / f"rgb/{time + color_delay_s:.6f}.png", i, 5000)
        depth_lines.append(f"{time:.6f} depth/{time:.6f}.png")
        color_lines.append(f"{time + color_delay_s:.6f} rgb/{time + color_delay_s:.6f}.png")
    (folder / "depth.txt").write_text("\n".join(depth_lines) + "\n")
    (folder / "rgb.txt").write_text("\n".join(color_lines) + "\n")
    truth_times = [1000 + k / 100 for k in range(count * 4)]
    (folder / "groundtruth.txt").write_text(tum_lines(truth_times, poses(len(truth_times))))
    return folder


def write_camera(folder: Path, **changes: object) -> None:
    """camera.json of the tiny images, with some values changed."""
    values = {"fx": 13.0, "fy": 13.5, "cx": 7.5, "cy": 5.5, "width": WIDTH, "height": HEIGHT}
    (folder / "camera.json").write_text(json.dumps(values | {"depth_scale": 2000} | changes))
