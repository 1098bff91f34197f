"""Mutation testing: small faults are put into the source one at a time, and the tests should notice each of them.

    python benchmarks/mutants.py registration --sample 120 --out build/registration.md
    python benchmarks/mutants.py fusion

By what they document, mutmut 3 wraps every function in a trampoline, which Numba cannot compile, and cosmic-ray runs
all tests for each mutant; neither draws a sample. So this: mutants are drawn with a fixed seed; a first run notes which
tests come to which line (coverage contexts) and how long they take; each mutant is then met by the tests that come to
its line, the quickest first, in a process that was forked with all but the package loaded. Mutated kernels run as plain
Python (NUMBA_DISABLE_JIT=1): they would have to be compiled with all that call them.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
SEED = 0
MOST_SECONDS = 40.0
"""Tests of a mutant take as long at most, in the run without one; the slowest are left out."""


@dataclass(frozen=True)
class Area:
    """Source files below `src/scanweld`, their tests, and whether kernels are plain Python."""

    sources: tuple[str, ...]
    without: tuple[str, ...]
    tests: tuple[str, ...]
    plain: bool


AREAS = {
    "registration": Area(
        ("registration/*.py", "registration/closed_form/*.py", "registration/local/*.py", "registration/robust/*.py"),
        ("kernels.py", "global_", "many.py", "scan_graph.py", "loop_selection.py", "pictures.py", "robust_pairs.py"),
        (
            "test_icp.py", "test_icp_family.py", "test_closed_form.py", "test_closed_form_batch.py",
            "test_closed_form_covariance.py", "test_gauss_newton.py", "test_robust.py", "test_projective.py",
            "test_residuals.py", "test_verification.py", "test_pose_graph.py", "test_uncertainty.py",
            "test_local_kernels.py",
        ),
        False,
    ),
    "registration-kernels": Area(
        (
            "registration/closed_form/**/kernels.py", "registration/robust/kernels.py",
            "registration/local/kernels.py",
        ),
        (),
        (
            "test_closed_form.py", "test_closed_form_batch.py", "test_closed_form_covariance.py",
            "test_local_kernels.py", "test_robust.py",
        ),
        True,
    ),
    "fusion": Area(("mapping/fusion.py",), (), ("test_fusion.py", "test_backends.py", "test_tiny.py"), False),
    "fusion-kernels": Area(
        ("mapping/kernels.py",),
        (),
        (
            "test_backends.py::test_fusion", "test_backends.py::test_index_map_and_view",
            "test_tiny.py::test_a_map_is_corrected_merged_thinned_and_drawn",
        ),
        True,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A fault: other text at a place of a file."""

    path: Path
    line: int
    start: int
    stop: int
    text: str

    def put_into(self, source: bytes) -> bytes:
        return source[: self.start] + self.text.encode() + source[self.stop :]

    def words(self, source: bytes) -> str:
        was = source[self.start : self.stop].decode()
        line = source.splitlines()[self.line - 1].decode().strip()
        return f"`{was}` became `{self.text}` in `{line}`"


COMPARISONS = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not",
    ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
ARITHMETIC = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Pow: "*", ast.Mod: "*",
    ast.MatMult: "*", ast.BitAnd: "|", ast.BitOr: "&",
}  # fmt: skip
CALLS = {"max": "min", "min": "max", "maximum": "minimum", "minimum": "maximum", "any": "all", "all": "any",
         "argmin": "argmax", "argmax": "argmin"}  # fmt: skip


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Yield the mutants of a file: operators, comparisons, constants, branches and extremes."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def at(line: int, column: int) -> int:
        return starts[line - 1] + column

    def between(left: ast.expr, right: ast.expr, text: str) -> Mutant:
        start, stop = at(left.end_lineno or 0, left.end_col_offset or 0), at(right.lineno, right.col_offset)
        gap = source[start:stop].decode()
        before = len(gap) - len(gap.lstrip(" )\n"))
        after = len(gap.rstrip(" (\n"))
        return Mutant(path, right.lineno, start + before, start + after, text)

    def whole(node: ast.expr, text: str) -> Mutant:
        start, stop = at(node.lineno, node.col_offset), at(node.end_lineno or 0, node.end_col_offset or 0)
        return Mutant(path, node.lineno, start, stop, text)

    def text_of(node: ast.expr) -> str:
        return source[at(node.lineno, node.col_offset) : at(node.end_lineno or 0, node.end_col_offset or 0)].decode()

    tree = ast.parse(source)
    for node in _code(tree):
        if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
            yield between(node.left, node.comparators[0], COMPARISONS[type(node.ops[0])])
        elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
            yield between(node.left, node.right, ARITHMETIC[type(node.op)])
        elif isinstance(node, ast.BoolOp):
            yield between(node.values[0], node.values[1], "or" if isinstance(node.op, ast.And) else "and")
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub | ast.Invert):
            yield whole(node, f"({text_of(node.operand)})")
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
            yield whole(node, str(not node.value))
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            yield whole(node, f"{node.value + 1}" if isinstance(node.value, int) else f"{2 * node.value or 1.0}")
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in CALLS:
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id  # type: ignore[attr-defined]
            stop = at(node.func.end_lineno or 0, node.func.end_col_offset or 0)
            yield Mutant(path, node.func.end_lineno or 0, stop - len(name), stop, CALLS[name])
        elif isinstance(node, ast.IfExp | ast.If | ast.While) and not isinstance(node.test, ast.Constant):
            yield whole(node.test, f"(not ({text_of(node.test)}))")


def _code(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that run: no annotations, no messages of errors, no bounds of settings."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.Raise | ast.JoinedStr):
                continue
            if isinstance(node, ast.keyword) and node.arg in ("low", "high"):
                continue
            waiting += [
                child for child in (value if isinstance(value, list) else [value]) if isinstance(child, ast.AST)
            ]


@dataclass(frozen=True)
class Knowledge:
    """Which tests come to a line of a file, and how long each of them takes [s]."""

    tests: dict[tuple[str, int], list[str]]
    seconds: dict[str, float]

    def tests_of(self, mutant: Mutant, tree: Path) -> list[str]:
        """Return the tests of a mutant, the quickest first, within the time for them."""
        name = mutant.path.relative_to(tree).as_posix()
        found = self.tests.get((name, mutant.line), [])
        if not found and (name, mutant.line) in self.tests:  # it runs once, when the module is imported
            found = sorted({test for (file, _), tests in self.tests.items() if file == name for test in tests})
        chosen, total = [], 0.0
        for test in sorted(found, key=lambda test: self.seconds.get(test, 1.0)):
            total += self.seconds.get(test, 1.0)
            if total > MOST_SECONDS and chosen:
                break
            chosen.append(test)
        return chosen


PLUGIN = """
import json, os, time, coverage, pytest
seconds = {}

@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item, nextitem):
    coverage.Coverage.current().switch_context(item.nodeid)
    began = time.perf_counter()
    yield
    seconds[item.nodeid] = time.perf_counter() - began
    coverage.Coverage.current().switch_context("")

@pytest.hookimpl
def pytest_runtest_logreport(report):
    if report.failed:
        seconds["failed " + report.nodeid] = 0.0

def pytest_sessionfinish():
    with open(os.environ["MUTATION_SECONDS"], "w") as file:
        json.dump(seconds, file)
"""


def explore(area: Area, tree: Path, environment: dict[str, str]) -> Knowledge:
    """Run the tests of an area once."""
    from coverage import CoverageData

    (tree / "mutation_plugin.py").write_text(PLUGIN)
    times = tree / "seconds.json"
    if not times.exists():  # as it does where a tree is used again
        subprocess.run(
            [sys.executable, "-m", "coverage", "run", "--data-file", ".contexts", "--source", "src/scanweld",
             "--rcfile", "/dev/null", "-m", "pytest", "-q", "-p", "mutation_plugin", *OPTIONS,
             *(f"tests/{name}" for name in area.tests)],
            cwd=tree, env={**environment, "MUTATION_SECONDS": str(times)}, check=False,
        )  # fmt: skip
    seconds = json.loads(times.read_text())
    bad = {name.removeprefix("failed ") for name in seconds if name.startswith("failed ")}
    print(f"{len(seconds)} tests, {len(bad)} of them fail without a mutant and are left out", flush=True)
    data = CoverageData(str(tree / ".contexts"))
    data.read()
    tests = {}
    for measured in data.measured_files():
        name = Path(measured).relative_to(tree.resolve()).as_posix()
        for line, contexts in data.contexts_by_lineno(measured).items():
            tests[name, line] = sorted({context for context in contexts if context} - bad)
    return Knowledge(tests, seconds)


OPTIONS = ("-p", "no:cacheprovider", "--hypothesis-profile", "few")


def survives(mutant: Mutant, tests: list[str], limit_s: float) -> bool:
    """Put a mutant into the tree and run its tests in a forked process; whether all of them pass."""
    source = mutant.path.read_bytes()
    mutant.path.write_bytes(mutant.put_into(source))
    try:
        child = os.fork()
        if child == 0:
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(null, stream)
            os.setsid()
            code = 1
            try:
                import pytest

                code = int(pytest.main(["-x", "-q", "--no-header", *OPTIONS, *tests]))
            finally:  # whatever a mutant brings about: the child must not go on with what is the parent's
                os._exit(code)
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return status == 0
            time.sleep(0.02)
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return False
    finally:
        mutant.path.write_bytes(source)


def main() -> None:
    """Draw mutants of an area, run their tests, and write what survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("area", choices=AREAS)
    parser.add_argument("--sample", type=int, default=100, help="number of mutants; 0 is all")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--minutes", type=float, default=60, help="end after so many, with what is known by then")
    parser.add_argument("--out", type=Path, help="a Markdown file for the result")
    parser.add_argument(
        "--tree", type=Path, help="a folder to work in that is kept, with what a first run compiled and noted"
    )
    options = parser.parse_args()
    area = AREAS[options.area]
    if area.plain:  # where integers wrap round, and a division by zero is infinite, NumPy warns
        os.environ |= {"NUMBA_DISABLE_JIT": "1", "PYTEST_ADDOPTS": "-W ignore::RuntimeWarning"}
    with tempfile.TemporaryDirectory(prefix="scanweld-mutation-") as folder:
        tree = (options.tree or Path(folder)).resolve()
        for name in ("src", "tests"):
            shutil.copytree(ROOT / name, tree / name, dirs_exist_ok=True)
        shutil.copy(ROOT / "pyproject.toml", tree)
        os.environ["NUMBA_CACHE_DIR"] = str(tree / "cache")  # of these files
        os.environ["PYTHONPATH"] = os.pathsep.join([str(tree / "src"), str(tree)])
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # a mutant is as long and as old as the source
        knowledge = explore(area, tree, dict(os.environ))
        sys.path[:0] = [str(tree / "src"), str(tree / "tests"), str(tree)]
        sys.dont_write_bytecode = True
        os.chdir(tree)
        for name in ("numpy", "scipy.spatial", "scipy.sparse.linalg", "scipy.optimize", "numba", "cv2"):
            importlib.import_module(name)
        paths = sorted({path for glob in area.sources for path in (tree / "src" / "scanweld").glob(glob)})
        paths = [path for path in paths if not any(part in path.as_posix() for part in area.without)]
        mutants = [mutant for path in paths for mutant in mutants_of(path)]
        sample = random.Random(options.seed).sample(mutants, min(options.sample or len(mutants), len(mutants)))
        some = sorted({test for tests in knowledge.tests.values() for test in tests}, key=knowledge.seconds.__getitem__)
        if not survives(Mutant(paths[0], 1, 0, 0, ""), some[:20], 600):
            raise SystemExit("tests that pass alone fail here without a mutant: nothing could be learned")
        rows, killed, done = [], 0, 0
        end = time.monotonic() + 60 * options.minutes
        for done, mutant in enumerate(sample, 1):
            tests = knowledge.tests_of(mutant, tree)
            usual_s = sum(knowledge.seconds.get(test, 1.0) for test in tests)
            alive = not tests or survives(mutant, tests, 30 + 5 * usual_s)
            killed += not alive
            where = f"{mutant.path.relative_to(tree / 'src' / 'scanweld').as_posix()}:{mutant.line}"
            words = mutant.words(mutant.path.read_bytes()) + ("" if tests else " (no test comes here)")
            rows += [f"| `{where}` | {words} |"] if alive else []
            print(f"{done}/{len(sample)} {'SURVIVED' if alive else 'killed'} {where}: {words}", flush=True)
            if time.monotonic() > end:
                break
        result = f"{options.area}: {killed} of {done} mutants killed ({killed / done:.0%}), of {len(mutants)} possible"
        rows.sort()
        print(result, *rows, sep="\n")
        if options.out:
            options.out.write_text("\n".join([result, "", "| where | survivor |", "|---|---|", *rows, ""]))


if __name__ == "__main__":
    main()
