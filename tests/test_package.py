"""The package as it is installed: what importing it costs, what it offers, and what the wheel holds."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import time
import tomllib
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import scanweld

REPOSITORY = Path(__file__).parents[1]
SOURCE = Path(scanweld.__file__)
HEAVY = {"numba", "cv2", "scipy", "matplotlib", "plyfile", "typer", "rich"}


def run_python(*arguments: str) -> str:
    """Return what a fresh process printed; it must succeed."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_is_quick_and_loads_nothing_heavy() -> None:
    """`import scanweld` alone stays under half a second; the best of three, since other processes share the machine."""
    code = "import time; t = time.perf_counter(); import scanweld, sys, json; "
    code += "print(json.dumps([time.perf_counter() - t, sorted({m.partition('.')[0] for m in sys.modules})]))"
    runs = [json.loads(run_python("-c", code)) for _ in range(3)]
    assert min(seconds for seconds, _ in runs) < 0.5
    assert HEAVY.isdisjoint(runs[0][1])


def test_errors_and_configuration_need_no_compiler() -> None:
    """A program can catch errors and prepare settings without waiting for Numba."""
    code = "import scanweld as sw, sys; sw.ScanweldError; sw.RegistrationResult; sw.PinholeCamera; "
    code += "print(sorted({m.partition('.')[0] for m in sys.modules} & {'numba', 'cv2', 'matplotlib'}))"
    assert run_python("-c", code).strip() == "[]"


def names_for_type_checkers() -> list[str]:
    """Return the names under `if TYPE_CHECKING:`, as they are written."""
    for node in ast.parse(SOURCE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            imports = [statement for statement in node.body if isinstance(statement, ast.ImportFrom)]
            return [alias.asname or alias.name for statement in imports for alias in statement.names]
    raise AssertionError("no TYPE_CHECKING block")


def test_public_names_agree() -> None:
    """`__all__` is sorted, and the same names are served lazily, imported for type checkers, and listed by dir()."""
    assert list(scanweld.__all__) == sorted(set(scanweld.__all__))
    assert sorted(names_for_type_checkers()) == scanweld.__all__
    assert sorted(scanweld._MODULE_OF) == scanweld.__all__
    assert dir(scanweld) == scanweld.__all__


@pytest.mark.parametrize("name", scanweld.__all__)
def test_public_name_is_there(name: str) -> None:
    """Every public name resolves, and is documented where it is ours."""
    assert getattr(scanweld, name).__doc__


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'scanweld' has no attribute 'icpp'"):
        scanweld.icpp  # noqa: B018


def test_version_is_that_of_the_project() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version("scanweld") == project["version"]
    assert run_python("-m", "scanweld", "--version").strip() == project["version"]


def test_changelog_names_the_version() -> None:
    """The newest section of the changelog is the unreleased one or this version."""
    text = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = next(line for line in text.splitlines() if line.startswith("## "))
    assert newest.startswith(("## [Unreleased]", f"## [{version('scanweld')}]"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built as for publishing."""
    folder = tmp_path_factory.mktemp("wheel")
    pip("build", [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(REPOSITORY)])
    (built,) = folder.glob("*.whl")
    return built


def pip(what: str, command: list[str]) -> None:
    """Run a command that fetches packages. Without a package index it is no fault of the package, except in CI."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    output = done.stdout + done.stderr
    offline = any(sign in output for sign in ("NewConnectionError", "NameResolutionError", "ConnectTimeoutError"))
    if done.returncode and offline and not os.environ.get("CI"):
        pytest.skip(f"{what}: the package index cannot be reached")
    assert done.returncode == 0, output


@pytest.mark.slow
def test_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    folders = {name.partition("/")[0] for name in names}
    assert "scanweld/py.typed" in names
    assert {folder.partition("-")[0] for folder in folders} == {"scanweld"}  # the package and its .dist-info
    suffixes = {Path(name).suffix for name in names if name.startswith("scanweld/")}
    assert suffixes == {".py", ".typed", ".html", ".css", ".js"}
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert wheel.name.endswith("-py3-none-any.whl")
    for suffix in (".py", ".html", ".css", ".js"):
        in_source = {path.relative_to(SOURCE.parents[1]).as_posix() for path in SOURCE.parent.rglob(f"*{suffix}")}
        assert {name for name in names if name.endswith(suffix)} == in_source


@pytest.mark.slow
def test_wheel_runs_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    """Install the wheel and what it asks for into an empty environment; run it elsewhere, with cold kernels."""
    home = tmp_path / "environment"
    venv.create(home, with_pip=True, symlinks=os.name != "nt")
    scripts = home / ("Scripts" if os.name == "nt" else "bin")
    pip("install", [str(scripts / "python"), "-m", "pip", "install", "--disable-pip-version-check", "-q", str(wheel)])

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "NUMBA", "SCANWELD"))}
    clean["XDG_CACHE_HOME"] = str(tmp_path / "cache")

    def scanweld_command(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [str(scripts / "scanweld"), *arguments]
        return subprocess.run(command, cwd=elsewhere, env=clean, capture_output=True, text=True, check=False)

    assert scanweld_command("--version").stdout.strip() == version("scanweld")
    started = time.perf_counter()
    demo = scanweld_command("demo", "--frames", "3", "--json")
    assert demo.returncode == 0, demo.stderr
    assert "Traceback" not in demo.stderr
    assert "compiling" in demo.stderr  # a first run says what takes so long
    metrics = json.loads(demo.stdout)
    assert (metrics["frames"], metrics["frames_tracked"]) == (3, 3)
    assert 0 < metrics["ate_rmse_m"] < 0.02
    assert (elsewhere / "scanweld-demo" / "map.ply").stat().st_size > 100_000
    assert time.perf_counter() - started < 300  # it does end, on a busy machine too
