"""Write docs/licences.md: the licence of every dependency, as the installed packages state it.

python scripts/licences.py            # write; rows of packages that are not installed are kept
python scripts/licences.py --check    # exit code 1 when a dependency has no row, or another licence by now
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "licences.md"

INTRODUCTION = """# Licences of the dependencies

scanweld is under the [MIT licence](https://opensource.org/license/mit). It contains no code of others; what it needs is
installed beside it, under licences of its own. This page is written by `python scripts/licences.py` from what the
packages state, and a test compares it.

The converter to evo is an extra that nothing else needs: evo is under the GPL, which matters to whoever passes on a
program that contains it.

| package | licence | needed |
|---|---|---|
"""

TOOLS = ("docs", "dev")
"""Extras that nobody who uses the package installs."""

CLASSIFIERS = {
    "OSI Approved :: BSD License": "BSD",
    "OSI Approved :: MIT License": "MIT",
    "OSI Approved :: Apache Software License": "Apache-2.0",
    "OSI Approved :: Python Software Foundation License": "PSF-based",
    "OSI Approved :: GNU General Public License v3 (GPLv3)": "GPL-3.0",
}


def dependencies() -> dict[str, str]:
    """Return what each dependency is needed for: those that are always, of extras, and what the first bring along."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {name_of(requirement): "always" for requirement in project["dependencies"]}
    for extra, requirements in project["optional-dependencies"].items():
        for requirement in requirements if extra not in TOOLS else ():
            needed.setdefault(name_of(requirement), f"extra `{extra}`")
    return needed


def brought_along(names: list[str]) -> dict[str, str]:
    """Return what packages depend on in turn, and the first that brings it, as far as they are installed."""
    found: dict[str, str] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop(0)
        for other in requirements_of(name):
            if other not in found and other not in names:
                found[other] = f"by {name}"
                waiting.append(other)
    return found


def requirements_of(name: str) -> Iterator[str]:
    """Yield what an installed package needs here, without its extras."""
    from packaging.requirements import Requirement

    try:
        stated = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return
    for text in stated:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield canonical(requirement.name)


def licence_of(name: str) -> str:
    """Return what an installed package states, "" where it is not installed."""
    try:
        stated = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return ""
    if stated.get("License-Expression"):
        return str(stated["License-Expression"])
    for classifier in stated.get_all("Classifier", []):
        kind = classifier.removeprefix("License :: ")
        if kind != classifier and kind in CLASSIFIERS:
            return CLASSIFIERS[kind]
    return (stated.get("License") or "not stated").strip().splitlines()[0][:40]


def name_of(requirement: str) -> str:
    """Return the name of the package that a requirement begins with."""
    return canonical(re.split(r"[\s\[<>=!~;(]", requirement, maxsplit=1)[0])


def canonical(name: str) -> str:
    """Return a name as the index spells it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def rows_of(page: str) -> dict[str, tuple[str, str]]:
    """Return licence and need by package, as a page has them."""
    return {name: (licence, need) for name, licence, need in re.findall(r"^\| (\S+) \| (.+?) \| (.+?) \|$", page, re.M)}


def faults(page: str) -> list[str]:
    """Return what of a page is not so: dependencies without a row, and other licences."""
    rows, found = rows_of(page), []
    for name, need in dependencies().items():
        if name not in rows:
            found.append(f"{name} has no row")
        elif rows[name][1] != need:
            found.append(f"{name} is needed {need}, not {rows[name][1]}")
    for name, (licence, _) in rows.items():
        if licence_of(name) and licence_of(name) != licence and name != "package":
            found.append(f"{name} is under {licence_of(name)}, not {licence}")
    return found


def written(before: str) -> str:
    """Return the page; what is not installed here has the licence that was there before."""
    needed = dependencies()
    always = [name for name, need in needed.items() if need == "always"]
    needed |= {name: need for name, need in sorted(brought_along(always).items()) if name not in needed}
    known = {name: licence for name, (licence, _) in rows_of(before).items()}
    rows = [f"| {name} | {licence_of(name) or known.get(name, '?')} | {need} |" for name, need in needed.items()]
    return INTRODUCTION + "\n".join(rows) + "\n"


def main() -> int:
    """Write or check."""
    page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    if "--check" in sys.argv:
        wrong = faults(page)
        print(*wrong, sep="\n", end="\n" if wrong else "")
        return 1 if wrong else 0
    PAGE.write_text(written(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
