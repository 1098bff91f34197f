"""What no part of the package may do: run what a file says, in whichever form."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import scanweld
from scanweld.errors import LONGEST_MESSAGE, FileFormatError, ScanweldError

PACKAGE = Path(scanweld.__file__).parent

MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "code", "codeop", "yaml", "xml"}
"""Modules that make objects or code of what they read; XML readers of the standard library expand entities."""

CALLS = {"eval", "exec", "compile", "__import__", "system", "popen", "startfile"}
"""Functions that run text."""

STARTERS = {"run", "Popen", "call", "check_call", "check_output"}

STARTS_PROCESSES = {"slam/warmup.py", "benchmarking/sizes.py"}
"""Files that start programs: Python to compile kernels, and the Python that --peer-python names."""

SOURCES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}


@pytest.mark.parametrize("name", SOURCES)
def test_nothing_that_is_read_is_run(name: str) -> None:
    assert faults(SOURCES[name].read_text(encoding="utf-8"), may_start=name in STARTS_PROCESSES) == []


def faults(source: str, *, may_start: bool) -> list[str]:
    """What a module must not do, with the lines."""
    found = []
    for node in ast.walk(ast.parse(source)):
        line = f"line {getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            roots = {name.partition(".")[0] for name in names}
            found += [f"{line}: imports {root}" for root in sorted(roots & MODULES)]
            if "subprocess" in roots and not may_start:
                found.append(f"{line}: starts a program")
        if isinstance(node, ast.Call):
            called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            # `re.compile` makes no code of it.
            is_pattern = isinstance(node.func, ast.Attribute) and getattr(node.func.value, "id", "") == "re"
            if called in CALLS and not is_pattern:
                found.append(f"{line}: calls {called}")
            for keyword in node.keywords:
                told = keyword.arg == "allow_pickle" or (keyword.arg == "shell" and called in STARTERS)
                if told and not _is_false(keyword.value):
                    found.append(f"{line}: {keyword.arg}")
            if called == "load" and getattr(getattr(node.func, "value", None), "id", "") == "np":
                safe = [keyword for keyword in node.keywords if keyword.arg == "allow_pickle"]
                found += [] if safe else [f"{line}: np.load without allow_pickle=False"]
    return found


def _is_false(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is False


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from xml.etree import ElementTree",
        "import subprocess",
        "eval(text)",
        "os.system('ls')",
        "subprocess.run('ls', shell=True)",
        "np.load(file)",
        "np.load(file, allow_pickle=True)",
    ],
)
def test_what_the_test_finds(source: str) -> None:
    assert len(faults(source, may_start=False)) == 1


def test_what_the_test_lets_pass() -> None:
    source = "import re\nre.compile('a')\nnp.load(file, allow_pickle=False)\njson.load(file)"
    assert faults(source, may_start=False) == []


class TestMessages:
    """What a file holds reaches the terminal in messages."""

    def test_codes_that_a_terminal_obeys(self) -> None:
        error = FileFormatError("a.ply: property 'x\x1b[2J\r\n\ud800\u202e' is unknown")
        assert str(error) == "a.ply: property 'x\ufffd[2J\ufffd\ufffd\ufffd\ufffd' is unknown"
        assert str(error).encode().decode() == str(error)

    def test_length(self) -> None:
        assert str(ScanweldError("x" * 10**6)) == "x" * LONGEST_MESSAGE + ".."

    def test_usual_ones_stay_as_they_are(self) -> None:
        assert str(ScanweldError("größe: 3 µm")) == "größe: 3 µm"
