"""Threads that share work, and the cache of compiled kernels."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scanweld as sw
from scanweld import parallel
from scanweld.parallel import get_num_threads, kernels_are_cached, run_ranges, set_num_threads, split_range

PACKAGE = Path(sw.__file__).parent


@pytest.fixture
def threads() -> Iterator[None]:
    usual = get_num_threads()
    yield
    set_num_threads(usual)


@given(st.integers(0, 500), st.integers(1, 40))
def test_ranges_cover_everything_once_and_evenly(count: int, parts: int) -> None:
    ranges = split_range(count, parts)
    assert [i for start, stop in ranges for i in range(start, stop)] == list(range(count))
    sizes = [stop - start for start, stop in ranges]
    assert len(ranges) <= parts
    if count:
        assert min(sizes) >= 1
        assert max(sizes) - min(sizes) <= 1


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("count", [0, 1, 3, 1000])
def test_every_index_is_visited_once(count: int) -> None:
    for number in (1, 2, 3, 8, 1):
        set_num_threads(number)
        visits, names = np.zeros(count, np.int64), set()

        def body(start: int, stop: int, visits: np.ndarray = visits, names: set[str] = names) -> None:
            visits[start:stop] += 1
            names.add(threading.current_thread().name)

        run_ranges(count, body)
        assert (visits == 1).all()
        assert len(names) <= min(number, count)


@pytest.mark.usefixtures("threads")
def test_error_in_any_thread_reaches_the_caller_after_all_have_ended() -> None:
    """A body that still runs when the caller goes on could write into arrays that are reused."""
    set_num_threads(4)
    ended: list[int] = []
    barrier = threading.Event()

    for failing in range(4):
        ended.clear()
        barrier.clear()

        def body(start: int, stop: int, failing: int = failing) -> None:
            if start == failing:
                barrier.set()
                raise RuntimeError(f"part {start}")
            barrier.wait(5)
            threading.Event().wait(0.02)
            ended.append(start)

        with pytest.raises(RuntimeError, match=f"part {failing}"):
            run_ranges(4, body)
        assert sorted(ended) == [k for k in range(4) if k != failing]


@pytest.mark.usefixtures("threads")
def test_two_callers_at_once() -> None:
    set_num_threads(3)
    totals = [np.zeros(300), np.zeros(300)]

    def work(total: np.ndarray) -> None:
        for _ in range(200):
            run_ranges(300, lambda start, stop: total.__setitem__(slice(start, stop), total[start:stop] + 1))

    callers = [threading.Thread(target=work, args=(total,)) for total in totals]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(30)
    assert all((total == 200).all() for total in totals)


@pytest.mark.usefixtures("threads")
def test_a_busy_worker_is_not_waited_for() -> None:
    set_num_threads(2)
    busy, ended, done = threading.Barrier(3), threading.Event(), np.zeros(2)

    def hold(start: int, stop: int) -> None:
        busy.wait(10)
        ended.wait(10)

    other = threading.Thread(target=lambda: run_ranges(2, hold))
    other.start()
    busy.wait(10)
    mine = threading.Thread(target=lambda: run_ranges(2, lambda start, stop: done.__setitem__(slice(start, stop), 1)))
    mine.start()
    mine.join(5)
    was_waiting = mine.is_alive()
    ended.set()
    other.join(10)
    mine.join(10)
    assert not was_waiting
    assert done.all()


@pytest.mark.usefixtures("threads")
def test_number_of_threads_may_change_while_another_thread_shares_out_work() -> None:
    failures: list[BaseException] = []
    stop = threading.Event()

    def work() -> None:
        try:
            while not stop.is_set():
                run_ranges(8, lambda start, stop: None)
        except BaseException as error:
            failures.append(error)

    caller = threading.Thread(target=work)
    caller.start()
    for k in range(200):
        set_num_threads(2 + k % 2)
    stop.set()
    caller.join(30)
    assert failures == []


@pytest.mark.parametrize("count", [0, -1])
def test_number_of_threads_must_be_positive(count: int) -> None:
    with pytest.raises(sw.InvalidInputError, match="at least one thread"):
        set_num_threads(count)


def test_every_compiled_function_is_in_a_file_that_names_the_cache() -> None:
    """Numba does not see changes in called modules: the cache folder is named by the files `kernels.py`, so nothing
    may be compiled elsewhere."""
    for source in PACKAGE.rglob("*.py"):
        if source.name == "kernels.py" or source == PACKAGE / "parallel.py":
            continue
        tree = ast.parse(source.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                assert not any(alias.name.split(".")[0] == "numba" for alias in node.names), source
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.module.split(".")[0] != "numba", source
                names = {alias.name for alias in node.names}
                assert not (node.module == "scanweld.parallel" and names & {"kernel", "inlined"}), source


def fresh_python(code: str, **environment: str) -> str:
    """Run code in a process of its own and return what it prints."""
    clean = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "OMP_WAIT_POLICY")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean | environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


FOLDER = "import scanweld.parallel, os; print(os.environ['NUMBA_CACHE_DIR'])"


def test_cache_folder_changes_with_any_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    package = tmp_path / "scanweld"
    for name in ("a/kernels.py", "b/c/kernels.py"):
        (package / name).parent.mkdir(parents=True)
        (package / name).write_text("one")
    monkeypatch.setattr(parallel, "PACKAGE", package)
    monkeypatch.setattr(parallel, "__file__", str(package / "parallel.py"))
    (package / "parallel.py").write_text("one")
    folders = {parallel._kernel_cache_folder()}
    assert folders == {parallel._kernel_cache_folder()}
    for name in ("a/kernels.py", "b/c/kernels.py", "parallel.py"):
        (package / name).write_text("two")
        folders.add(parallel._kernel_cache_folder())
    (package / "d").mkdir()
    (package / "a/kernels.py").rename(package / "d/kernels.py")
    folders.add(parallel._kernel_cache_folder())
    assert len(folders) == 5
    assert all(folder.parent == tmp_path / "cache/scanweld" for folder in folders)


def test_cache_folder_of_the_user_is_respected_and_an_unwritable_home_does_not_matter(tmp_path: Path) -> None:
    assert fresh_python(FOLDER, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == str(tmp_path / "mine")
    (tmp_path / "file").write_text("in the way")
    place = fresh_python(FOLDER, XDG_CACHE_HOME=str(tmp_path / "file/below"), TMPDIR=str(tmp_path))
    assert Path(place).is_relative_to(tmp_path)
    assert "file" not in Path(place).relative_to(tmp_path).parts


def test_note_of_what_was_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not kernels_are_cached("stage")
    assert kernels_are_cached("stage", now=True)
    assert kernels_are_cached("stage")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "missing"))
    assert not kernels_are_cached("stage", now=True)  # a cache that cannot be written is no error


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_forked_child_has_threads_of_its_own() -> None:
    """Threads do not survive a fork: a child that waited for its parent's would hang."""
    code = """
import os, signal, time, warnings
warnings.simplefilter("ignore")
from scanweld.parallel import run_ranges, set_num_threads
set_num_threads(3)
for _ in range(50):
    run_ranges(9, lambda start, stop: time.sleep(0.001))
child = os.fork()
if child == 0:
    signal.alarm(20)
    seen = []
    run_ranges(9, lambda start, stop: seen.append(stop - start))
    os._exit(0 if sum(seen) == 9 else 1)
print(os.waitpid(child, 0)[1])
"""
    assert fresh_python(code) == "0"


def test_forked_child_waits_for_nothing_that_its_parent_does() -> None:
    code = """
import os, signal, time, warnings
warnings.simplefilter("ignore")
from scanweld.parallel import in_background
slow = in_background(lambda: time.sleep(0.3) or 7)
child = os.fork()
if child == 0:
    signal.alarm(20)
    os._exit(slow.result() + in_background(lambda: 1).result())
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), slow.result())
"""
    assert fresh_python(code) == "8 7"


def test_import_of_the_package_loads_no_compiler() -> None:
    code = "import sys, scanweld; print([m for m in ('numba', 'cv2', 'scipy', 'matplotlib') if m in sys.modules])"
    assert fresh_python(code) == "[]"


def test_a_body_that_shares_out_work_under_a_lock_does_not_wait_for_its_own_thread() -> None:
    """As a property does that gathers its value on threads when it is first read, within a body, by several threads."""
    lock, done = threading.Lock(), []
    set_num_threads(2)

    def gather() -> None:
        with lock:
            run_ranges(8, lambda start, stop: done.append((start, stop)))

    finished = threading.Thread(target=lambda: run_ranges(2, lambda start, stop: gather()), daemon=True)
    finished.start()
    finished.join(timeout=20)
    assert not finished.is_alive()
    assert done == [(0, 8), (0, 8)]
