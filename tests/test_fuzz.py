"""What fuzzing found is refused in one line; a few spoilt inputs of each parser, the same every time.

`python benchmarks/fuzz` does it for long; this sees that parsers still hold, and that the harness finds what breaks.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from random import Random
from types import ModuleType

import pytest

FUZZ = Path(__file__).parents[1] / "benchmarks" / "fuzz"
CASES = sorted(FUZZ.glob("cases/*/*.zip"))

NEEDED = {
    "las": "laspy", "e57": "pye57", "record3d": "liblzfse", "messages": "liblzfse", "bag1": "rosbags",
    "bag2-sqlite": "rosbags", "bag2-mcap": "rosbags", "run": "viser",
}  # fmt: skip

PARSERS = (
    "ply", "pcd", "tables", "las", "e57", "trajectory", "config", "gyroscope", "images", "messages", "sens", "record3d",
    "bag1", "bag2-sqlite", "bag2-mcap", "tum", "eth3d", "redwood", "7scenes", "icl", "replica", "bundlefusion", "stray",
    "video", "checkpoint", "run",
)  # fmt: skip

SPOILT = 12
"""Inputs of each parser."""


@pytest.fixture(scope="module")
def fuzz() -> Iterator[dict[str, ModuleType]]:
    """The modules of the harness, which is no package."""
    names = ("inputs", "mutation", "targets", "worker")
    sys.path.insert(0, str(FUZZ))
    try:
        yield {name: importlib.import_module(name) for name in names}
    finally:
        sys.path.remove(str(FUZZ))


def test_every_parser_is_here(fuzz: dict[str, ModuleType]) -> None:
    assert set(fuzz["targets"].TARGETS) == set(PARSERS)
    assert {path.parent.name for path in CASES} <= set(PARSERS)


@pytest.mark.parametrize("case", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_found_cases_are_mended(case: Path, fuzz: dict[str, ModuleType], tmp_path: Path) -> None:
    name = case.parent.name
    if not find_spec(NEEDED.get(name, "numpy")):
        pytest.skip(f"{NEEDED[name]} is not installed")
    files = fuzz["inputs"].load_case(case)
    assert fuzz["worker"].failure(fuzz["targets"].TARGETS[name], files, tmp_path / "input") == ""


@pytest.mark.parametrize("name", PARSERS)
def test_spoilt_inputs_are_read_or_refused(name: str, fuzz: dict[str, ModuleType], tmp_path: Path) -> None:
    if not find_spec(NEEDED.get(name, "numpy")):
        pytest.skip(f"{NEEDED[name]} is not installed")
    target, random = fuzz["targets"].TARGETS[name], Random(name)
    seeds = target.seeds(tmp_path / "seeds")
    failure = fuzz["worker"].failure
    assert [failure(target, files, tmp_path / "input") for files in seeds] == [""] * len(seeds)
    for _ in range(SPOILT):
        files = fuzz["mutation"].mutate(random.choice(seeds), seeds, random)
        assert failure(target, files, tmp_path / "input") == ""


class TestHarness:
    """It finds what it is there for."""

    def broken(self, fuzz: dict[str, ModuleType], read: object) -> object:
        return fuzz["targets"].Target(lambda _: [{"a": b"1"}], read)

    def test_other_exceptions_and_warnings_are_told_with_their_place(
        self, fuzz: dict[str, ModuleType], tmp_path: Path
    ) -> None:
        def warn(_: Path) -> None:
            warnings.warn("odd", RuntimeWarning, stacklevel=1)

        failure = fuzz["worker"].failure
        fault = failure(self.broken(fuzz, lambda folder: {}["x"]), {"a": b""}, tmp_path / "input")
        assert fault.startswith("KeyError in ")
        assert failure(self.broken(fuzz, warn), {"a": b""}, tmp_path / "input").startswith("RuntimeWarning in ")

    def test_findings_are_made_smaller(self, fuzz: dict[str, ModuleType], tmp_path: Path) -> None:
        def read(folder: Path) -> None:
            if b"7" in (folder / "a").read_bytes():
                raise IndexError("seven")

        target = self.broken(fuzz, read)
        files = {"a": b"123" * 50 + b"7" + b"456" * 50, "b": b"not needed"}
        fault = fuzz["worker"].failure(target, files, tmp_path / "input")
        assert fuzz["worker"].minimised(target, files, fault, tmp_path / "input") == {"a": b"7"}

    def test_checksums_are_right_again(self, fuzz: dict[str, ModuleType], tmp_path: Path) -> None:
        """Most spoilt checkpoints get past the checksums, or what is behind them is never reached."""
        from scanweld.errors import FileFormatError
        from scanweld.runs.checkpoint.file import CheckpointFile, write

        path, whole = tmp_path / "checkpoint.swc", 0
        write(path, {"seconds": 1.0}, [bytes(range(200))])
        content, random = path.read_bytes(), Random(0)
        for _ in range(100):
            path.write_bytes(fuzz["mutation"].spoil(content, [], random))
            try:
                CheckpointFile(path).__exit__()
                whole += 1
            except FileFormatError:
                pass
        assert whole > 40
