"""Feed one parser spoilt inputs until the time is up; in a process of its own, which may be killed or crash."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import logging
import os
import re
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random

from inputs import Files, lay_out, load_case, save_case
from mutation import mutate
from targets import TARGETS, Target, check_message

from scanweld.errors import ScanweldError

MEMORY_BYTES = 1 << 30
"""What a parser may take beyond what the process has when it begins; inputs are smaller than 1 MiB."""

KEPT_INPUTS = 200
"""Inputs that led somewhere new are spoilt further, so many of them."""

MINIMISE_S = 20.0
"""What making a finding smaller may take."""

TURNS = itertools.count()
"""Inputs that were read so far, for the parent to see that it goes on."""


def main() -> None:
    """worker.py PARSER SEED SECONDS FOLDER CASES: writes FOLDER/state.json now and then, findings as archives.

    Seconds are those that it computes: what else runs on the machine takes none away.
    """
    name, seed, seconds, place, cases = sys.argv[1:]
    target, folder, random = TARGETS[name], Path(place), Random(f"{name} {seed}")
    logging.disable()
    warnings.simplefilter("error")
    os.environ["OPENCV_LOG_LEVEL"] = "SILENT"
    with tempfile.TemporaryDirectory(dir=folder) as aside:
        seeds = target.seeds(Path(aside) / "seeds")
    for files in seeds:  # loads what is loaded on first use, too
        if fault := failure(target, files, folder / "input"):
            raise SystemExit(f"{name}: a good input fails: {fault}")
    limit_memory()
    pool = [*seeds, *(load_case(path) for path in sorted(Path(cases).glob(f"{name}/*.zip")))]
    feed(target, pool, random, float(seconds), folder)


def feed(target: Target, pool: list[Files], random: Random, seconds: float, folder: Path) -> None:
    """Spoil and read until the time is up."""
    known, found, count = set(), set(), 0
    fixed = len(pool)
    begun = told = time.process_time()
    while time.process_time() - begun < seconds:
        files = mutate(random.choice(pool), pool, random)
        words: list[str] = []
        fault = failure(target, files, folder / "input", words)
        count += 1
        if fault and fault not in found:
            found.add(fault)
            smallest = minimised(target, files, fault, folder / "input")
            case = f"{hashlib.sha1(fault.encode()).hexdigest()[:12]}.zip"
            save_case(smallest, folder / "found" / case)
            print(json.dumps({"fault": fault, "case": case}), flush=True)
        elif not fault and (new := "; ".join(words)) not in known:
            known.add(new)
            pool.append(files)
            if len(pool) > fixed + KEPT_INPUTS:
                del pool[fixed + random.randrange(KEPT_INPUTS)]
        if count < 5 or time.process_time() - told > 1:
            told = time.process_time()
            state = {"inputs": count, "seconds": told - begun, "answers": len(known)}
            (folder / "state.json").write_text(json.dumps(state))
    state = {"inputs": count, "seconds": time.process_time() - begun, "answers": len(known), "done": True}
    (folder / "state.json").write_text(json.dumps(state))


def failure(target: Target, files: Files, folder: Path, words: list[str] | None = None) -> str:
    """Return what an input breaks, "" where it is read or refused; `words` gets what it is refused with.

    The parent kills a process that stays with one input for too long, and finds the input in the folder.
    """
    lay_out(files, folder)
    (folder.parent / "turns").write_text(str(next(TURNS)))
    try:
        with collected_messages(words):
            target.read(folder)
    except ScanweldError as error:
        try:
            check_message(error)
        except AssertionError as fault:
            return f"AssertionError {fault}"[:300]
        if words is not None:
            words.append(shape_of(f"{type(error).__name__}: {error}", folder))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return f"{type(error).__name__} in {place_of(error)}: {shape_of(str(error), folder)[:160]}"
    return ""


@contextlib.contextmanager
def collected_messages(words: list[str] | None) -> Iterator[None]:
    """Collect the shapes of errors that a target has tolerated."""
    import targets

    check = targets.check_message

    def checked(error: ScanweldError) -> None:
        check(error)
        if words is not None and len(words) < 8:
            words.append(shape_of(f"{type(error).__name__}: {error}", Path()))

    targets.check_message = checked
    try:
        yield
    finally:
        targets.check_message = check


def shape_of(message: str, folder: Path) -> str:
    """Return a message without what differs from input to input."""
    message = re.sub(r"'[^']*'|\"[^\"]*\"|/\S+", "_", message.replace(str(folder), "")[:400])
    return re.sub(r"\S*\d\S*", "#", message)


def place_of(error: BaseException) -> str:
    """Return the innermost place of the package that an error came through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "scanweld" in Path(f.filename).parts]
    return f"{Path(frames[-1].filename).name}:{frames[-1].name}" if frames else "no place of the package"


def minimised(target: Target, files: Files, fault: str, folder: Path) -> dict[str, bytes]:
    """Return a smaller input that breaks the same: without files, and files without parts."""
    end = time.process_time() + MINIMISE_S
    smallest = dict(files)

    def still(candidate: Files) -> bool:
        return time.process_time() < end and failure(target, candidate, folder) == fault

    for name in sorted(smallest):
        if still(fewer := {n: c for n, c in smallest.items() if n != name}):
            smallest = fewer
    for name in sorted(smallest):
        size = max(1, len(smallest[name]) // 2)
        while size >= 1:
            at = 0
            while at < len(smallest[name]) and time.process_time() < end:
                content = smallest[name]
                if still(shorter := {**smallest, name: content[:at] + content[at + size :]}):
                    smallest = shorter
                else:
                    at += size
            size //= 2
    return smallest


def limit_memory() -> None:
    """Let allocations fail that no input so small can need."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


if __name__ == "__main__":
    main()
