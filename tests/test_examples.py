"""The examples run as a newcomer runs them, on small inputs, and say what they should."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

import scanweld as sw

REPOSITORY = Path(__file__).parents[1]
EXAMPLES = sorted((REPOSITORY / "examples").glob("[0-9][0-9]_*.py"))


@dataclass(frozen=True)
class Example:
    """A small run of one example."""

    text: str
    folder: Path


@pytest.fixture(scope="module")
def run_example(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Example]:
    """Run an example, once for all tests; it must succeed without a warning."""

    @cache
    def run(stem: str) -> Example:
        out = tmp_path_factory.mktemp(stem)
        script = REPOSITORY / "examples" / f"{stem}.py"
        # Examples on a handful of points have no smaller input.
        small = ["--small"] if '"--small"' in script.read_text(encoding="utf-8") else []
        done = subprocess.run(
            [sys.executable, "-W", "error", str(script), "--out", str(out), *small],
            cwd=out, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        return Example(done.stdout, out)

    return run


def number(pattern: str, text: str) -> float:
    """Return the number that a pattern's group matches."""
    match = re.search(pattern, text)
    assert match is not None, f"{pattern!r} is not in\n{text}"
    return float(match[1].replace(",", ""))


def test_examples_are_numbered_and_listed() -> None:
    """Numbers have no gap, and examples/README.md lists every script and no other."""
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
    listed = re.findall(r"`(\d\d_\w+\.py)`", (REPOSITORY / "examples" / "README.md").read_text(encoding="utf-8"))
    assert sorted(set(listed)) == [path.name for path in EXAMPLES]


@pytest.mark.slow
@pytest.mark.parametrize("stem", [path.stem for path in EXAMPLES])
def test_example_runs(stem: str, run_example: Callable[[str], Example]) -> None:
    """Every example prints results and draws at least one picture, in the folder it is given only."""
    before = set((REPOSITORY / "examples").rglob("*"))
    example = run_example(stem)
    assert len(example.text.splitlines()) >= 3
    pictures = list(example.folder.glob("*.png"))
    assert pictures
    assert all(picture.name.startswith(stem[:2]) and picture.stat().st_size > 5000 for picture in pictures)
    assert set((REPOSITORY / "examples").rglob("*")) == before


@pytest.mark.slow
def test_two_frames_align_and_unrelated_ones_do_not(run_example: Callable[[str], Example]) -> None:
    text = run_example("03_two_frames").text
    for moment, low, high in (("before", 500, 5000), ("after", 0, 5)):
        errors = [float(value) for value in re.findall(rf"error {moment} +([\d.]+) mm", text)]
        assert len(errors) == 2  # a near and a far pair
        assert all(low < error < high for error in errors)
    assert re.findall(r"frames \d+ and \d+: (\w+)", text) == ["converged", "converged"]
    assert re.findall(r"corridor: (\w+): \w+", text) == ["no_overlap"]


@pytest.mark.slow
def test_fusion_compresses(run_example: Callable[[str], Example]) -> None:
    """Ten frames from nearly one place show nearly one image's worth of surface: the ratio is about ten."""
    text = run_example("04_fusion_given_poses").text
    assert 7 < number(r"compression ratio +([\d.]+)", text) < 14
    assert number(r"([\d,]+) points ->", text) <= 10 * 160 * 120


@pytest.mark.slow
def test_dense_slam_writes_its_results(run_example: Callable[[str], Example]) -> None:
    """What it wrote reads back, and its error is that of a tracked sequence: 22 cm of path, millimetres of error."""
    example = run_example("05_dense_slam")
    assert number(r"ATE +([\d.]+) mm", example.text) < 10
    assert len(sw.read_trajectory(example.folder / "05_trajectory.txt")) == number(r"(\d+) frames", example.text)
    assert len(sw.read_ply(example.folder / "05_map.ply")) == number(r"([\d,]+) surfels", example.text)


@pytest.mark.slow
def test_stable_fraction_compares_honestly(run_example: Callable[[str], Example]) -> None:
    """The run that is called better by a figure is the one with the smaller figure."""
    text = run_example("06_stable_fraction").text
    for figure in ("ATE", "drift"):
        every, tenth = (float(value) for value in re.findall(rf"{figure} +([\d.]+) mm", text))
        assert every < 20
        assert (f"smaller {figure}: all points" in text) == (every < tenth)
