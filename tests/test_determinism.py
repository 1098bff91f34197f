"""The same input gives the same bytes: in fresh processes, with one thread, two, and more than there are cores."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import rendered, write_tum_folder
from scanweld.runs.comparison import compare_runs


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten noisy frames: noise is what makes an order of summation visible."""
    return write_tum_folder(
        tmp_path_factory.mktemp("recorded") / "room", rendered(noise="kinect", count=40).part(0, 10)
    )


def test_same_bytes_in_fresh_processes_at_any_number_of_threads(recorded: Path, tmp_path: Path) -> None:
    files = ("trajectory.txt", "map.ply", "renders/overview-rgb.png")
    seen: dict[str, set[bytes]] = {name: set() for name in files}
    for attempt, threads in enumerate((1, 2, 8, 1)):
        out = tmp_path / f"run-{attempt}"
        command = [
            sys.executable,
            "-m",
            "scanweld",
            "slam",
            str(recorded),
            "--out",
            str(out),
            "--threads",
            str(threads),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        assert json.loads((out / "run.json").read_text())["threads"] == threads
        assert compare_runs(out, tmp_path / "run-0").different == {}  # frames.csv and metrics.json, too
        for name in files:
            seen[name].add((out / name).read_bytes())
    assert {name: len(contents) for name, contents in seen.items()} == dict.fromkeys(files, 1)


def test_part_of_a_recording_is_a_recording_of_that_part(recorded: Path, tmp_path: Path) -> None:
    """Frames [k, n) equal the sliced sequence, byte for byte, through the files as well (golden 6)."""
    sliced = write_tum_folder(tmp_path / "sliced", rendered(noise="kinect", count=40).part(3, 8))
    for name, folder, frames in (("a", recorded, "3:8"), ("b", sliced, None)):
        sequence = sw.open_sequence(folder, frames=frames)
        sw.run_sequence(sequence, out=tmp_path / name)
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_reading_ahead_does_not_change_the_answer() -> None:
    from scanweld.datasets.stream import stream

    sequence = rendered(noise="kinect", count=40).part(0, 6)
    answers = set()
    for lookahead, num_threads in ((1, 1), (4, 1), (6, 3)):
        slam = sw.build_slam(sequence.camera)
        for record in stream(sequence, lookahead, num_threads=num_threads):
            slam.process(record.frame)
        answers.add(slam.trajectory.T_world_camera.tobytes() + np.array(slam.map.positions_m).tobytes())
    assert len(answers) == 1


SURFACES = """
import hashlib
import numpy as np
from scanweld.geometry import kernels
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import build_pyramid
from scanweld.geometry.frame import Frame
camera = PinholeCamera(120.0, 120.0, 79.5, 59.5, 160, 120)
v, u = np.mgrid[:120, :160]
depth = (1 + 0.003 * u + 0.001 * v + 0.01 * np.random.default_rng(0).random(camera.shape)).astype(np.float32)
surface = build_pyramid(Frame(0.0, depth, None, camera)).levels[0].surface
print(hashlib.sha256(surface.tobytes()).hexdigest(), sum(kernels.surface_rows.stats.cache_hits.values()))
"""


def test_same_bytes_whether_kernels_are_compiled_or_come_from_the_cache(tmp_path: Path) -> None:
    """Normals take several kernels that call each other: in one object file each they are optimised differently."""
    answers = []
    for _ in range(2):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-c", SURFACES], capture_output=True, text=True, timeout=300, check=True, env=environment
        )
        answers.append(done.stdout.split())
    assert [loaded for _, loaded in answers] == ["0", "1"]
    assert answers[0][0] == answers[1][0]
