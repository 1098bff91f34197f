"""The tutorials do what they say: their commands are run in order, in a folder that holds what each begins with."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import scanweld as sw
from rendered import rendered
from scanweld.cli.app import run

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
SMALL = "--frames 8 --size 160x120"
"""Added to a command that renders; the last of two equal options counts."""

TO_ARKIT = np.diag([1.0, -1.0, -1.0, 1.0])


def blocks(page: str, heading: str) -> list[tuple[str, str]]:
    """Return language and text of the fenced blocks below a heading of a tutorial, as far as the next one."""
    text = (TUTORIALS / page).read_text(encoding="utf-8")
    section = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"^```(\w+)\n(.*?)^```$", section, flags=re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[list[str]]:
    """Return the command lines of a block, without `scanweld`."""
    lines = [shlex.split(line, comments=True) for line in text.splitlines() if line.strip()]
    assert all(line[0] == "scanweld" for line in lines)
    return [line[1:] for line in lines]


def check_map_report_and_mesh(folder: Path, num_frames: int) -> None:
    """A newcomer has a map, a report and a mesh, and every frame was tracked."""
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    assert (metrics["frames"], metrics["frames_tracked"]) == (num_frames, num_frames)
    assert metrics["ate_rmse_m"] < 0.01
    assert len(sw.read_ply(folder / "map.ply")) > 5_000
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")
    assert b"element face" in (folder / "mesh.ply").read_bytes()[:1000]


def write_record3d(folder: Path) -> int:
    """Write an unpacked recording of a phone: rendered frames in Record3D's layout; return their number.

    Colour is twice as large as depth and of the same field of view; K is column by column, poses are ARKit's.
    """
    sequence = rendered(count=8)
    camera = sequence.camera
    (folder / "rgbd").mkdir(parents=True)
    assert sequence.ground_truth is not None
    T = sequence.ground_truth.T_world_camera @ TO_ARKIT
    cx, cy = (2 * (center + 0.5) - 0.5 for center in (camera.cx, camera.cy))
    metadata = {
        "w": 2 * camera.width, "h": 2 * camera.height, "dw": camera.width, "dh": camera.height, "fps": 30,
        "K": [2 * camera.fx, 0, 0, 0, 2 * camera.fy, 0, cx, cy, 1],
        "poses": np.column_stack([sw.se3.quaternion_xyzw_from_rotation(T[:, :3, :3]), T[:, :3, 3]]).tolist(),
    }  # fmt: skip
    (folder / "metadata").write_text(json.dumps(metadata))
    for k, frame in enumerate(sequence.frames):
        assert frame is not None
        assert frame.color is not None
        large = cv2.resize(frame.color[..., ::-1], (2 * camera.width, 2 * camera.height))
        assert cv2.imwrite(str(folder / f"rgbd/{k}.jpg"), large)
        depth = np.where(frame.depth_m > 0, frame.depth_m, np.nan).astype("<f4")
        (folder / f"rgbd/{k}.depth").write_bytes(depth.tobytes())
    return len(sequence)


def write_scans(folder: Path) -> np.ndarray:
    """Write two scans of one room, scan_1.ply and scan_2.ply; return the true T_2_1 (4, 4)."""
    sequence = rendered(noise="kinect", count=6)
    assert sequence.ground_truth is not None
    T_world_camera = sequence.ground_truth.T_world_camera
    for number, index in ((1, 0), (2, 5)):
        frame = sequence.read(index)
        points = frame.camera.back_project(frame.depth_m)[frame.depth_m > 0]
        sw.write_ply(folder / f"scan_{number}.ply", sw.PointCloud(points))
    return np.asarray(sw.se3.inverse(T_world_camera[5]) @ T_world_camera[0])


@pytest.mark.slow
def test_a_tum_folder_becomes_a_mesh_in_three_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (_, prepare), (_, tutorial) = blocks("recording.md", "With a folder in the layout of TUM RGB-D")
    (render,) = commands(prepare)
    assert run([*render, *shlex.split(SMALL)]) == 0
    assert {"rgb.txt", "depth.txt", "groundtruth.txt"} <= {path.name for path in Path("desk").iterdir()}
    steps = commands(tutorial)
    assert [step[0] for step in steps] == ["slam", "report", "mesh"]
    for step in steps:
        assert run(step) == 0, step
    check_map_report_and_mesh(tmp_path / "run", 8)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["file", "folder"])
def test_a_phone_recording_becomes_a_mesh_in_three_commands(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file that the app exports, and the folder that it unpacks to."""
    monkeypatch.chdir(tmp_path)
    count = write_record3d(tmp_path / ("desk.r3d" if form == "folder" else "unpacked"))
    if form == "file":
        shutil.make_archive("desk", "zip", "unpacked")
        Path("desk.zip").rename("desk.r3d")
        shutil.rmtree("unpacked")
    ((_, tutorial),) = blocks("recording.md", "With a phone")
    steps = commands(tutorial)
    assert [step[0] for step in steps] == ["slam", "report", "mesh"]
    for step in steps:
        assert run(step) == 0, step
    check_map_report_and_mesh(tmp_path / "phone", count)


def test_the_camera_file_of_the_tutorial_is_read(tmp_path: Path) -> None:
    """camera.json as printed serves images in two numbered folders."""
    ((language, text),) = blocks("recording.md", "With a recording of your own")
    assert language == "json"
    (tmp_path / "camera.json").write_text(text)
    for folder, image in (
        ("depth", np.full((480, 640), 1500, np.uint16)),
        ("color", np.zeros((480, 640, 3), np.uint8)),
    ):
        (tmp_path / folder).mkdir()
        assert cv2.imwrite(str(tmp_path / folder / "00000.png"), image)
    sequence = sw.open_sequence(tmp_path)
    values = json.loads(text)
    assert (sequence.camera.fx, sequence.camera.cx) == (values["fx"], values["cx"])
    assert np.allclose(sequence.read(0).depth_m, 1.5)


@pytest.mark.slow
def test_two_scans_are_aligned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearly aligned, from anywhere, and in Python; the first writes a picture and the aligned source."""
    T_2_1 = write_scans(tmp_path)
    monkeypatch.chdir(tmp_path)
    ((_, near),) = blocks("scans.md", "They are nearly aligned")
    (step,) = commands(near)
    assert run(step) == 0
    assert Path("before_and_after.png").stat().st_size > 10_000
    truth = sw.se3.transform_points(T_2_1, sw.read_ply("scan_1.ply").points_m)
    assert np.median(np.linalg.norm(sw.read_ply("aligned.ply").points_m - truth, axis=1)) < 0.02
    Path("aligned.ply").unlink()

    ((_, anywhere),) = blocks("scans.md", "They are anywhere")
    (step,) = commands(anywhere)
    assert run(step) == 0

    ((_, program),) = blocks("scans.md", "In Python")
    exec(compile(program, "scans.md", "exec"), {})
    assert np.median(np.linalg.norm(sw.read_ply("aligned.ply").points_m - truth, axis=1)) < 0.02


def test_every_command_of_the_tutorials_is_run_here() -> None:
    """A block that is added to a tutorial needs a test: these are all there are."""
    sections = {"recording.md": [2, 1], "scans.md": [1, 1]}
    for page, counts in sections.items():
        text = (TUTORIALS / page).read_text(encoding="utf-8")
        found = [part.count("```bash") for part in text.split("\n## ") if "```bash" in part]
        assert found == counts, page
    assert {path.name for path in TUTORIALS.glob("*.md")} == {*sections, "index.md"}
