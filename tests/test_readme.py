"""The README's commands and programs do what it says, run in order in one folder as a reader would."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from scanweld.cli.app import run

REPOSITORY = Path(__file__).parents[1]
SMALL = {"scanweld render --out room --noise kinect --frames 60": "--frames 6 --size 160x120"}
"""What is added to a command to make it quick; the last of two equal options counts."""


def blocks() -> list[tuple[str, str]]:
    """Return the language and text of every fenced block, in order."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def write_scans(folder: Path) -> np.ndarray:
    """Write two scans of one room, scan_1.ply and scan_2.ply, and return the true T_2_1 (4, 4)."""
    sequence = sw.SyntheticSequence(sw.RenderConfig(width=160, height=120))
    T_world_camera = sequence.ground_truth.T_world_camera
    for number, index in ((1, 0), (2, 4)):
        frame = sequence.read(index)
        points = frame.camera.back_project(frame.depth_m)[frame.depth_m > 0]
        sw.write_ply(folder / f"scan_{number}.ply", sw.PointCloud(points))
    return sw.se3.inverse(T_world_camera[4]) @ T_world_camera[0]


@pytest.mark.slow
def test_commands_and_programs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    T_2_1 = write_scans(tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    commands = 0
    for language, text in blocks():
        if language == "python":
            exec(compile(text, "README.md", "exec"), names)
            continue
        for line in text.splitlines():
            command = line.partition("#")[0].strip()
            if command.startswith("scanweld "):
                assert run(shlex.split(f"{command} {SMALL.get(command, '')}")[1:]) == 0, command
                commands += 1
    printed = capsys.readouterr().out
    assert commands == 9
    assert "6 of 6 tracked" in printed

    # The clouds were aligned, and both ways of running SLAM gave a map.
    error = sw.se3.inverse(T_2_1) @ names["result"].T_target_source  # type: ignore[attr-defined]
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert len(sw.read_ply("map.ply")) > 10_000
    assert len(names["slam"].results) == 6  # type: ignore[attr-defined]


def test_links_lead_somewhere() -> None:
    """Relative links of the front pages point to files that are there."""
    for page in ("README.md", "docs/index.md", "examples/README.md"):
        source = REPOSITORY / page
        links = re.findall(r"\]\(([^)#]+?)\)", source.read_text(encoding="utf-8"))
        relative = [link for link in links if not link.startswith("http")]
        assert relative
        missing = [link for link in relative if not (source.parent / link).exists()]
        assert missing == [], page
