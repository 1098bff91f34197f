"""Print the lowest versions that pyproject.toml allows, as constraints for pip; with --names, what it depends on."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

NOT_USED_BY_THE_PACKAGE = ("docs", "dev")
"""Extras of tools: any version that works will do."""

OF_THEIR_TIME = ("pyparsing<3.3",)
"""What dependencies depend on in turn, where their lowest versions call what later ones warn of (Matplotlib 3.10.0)."""

_BOUND = re.compile(r"([A-Za-z0-9_.-]+)(\[[^]]*\])?\s*>=\s*([0-9][^,;\s]*)")


def lowest(pyproject: Path) -> dict[str, str]:
    """Return the lower bound of every dependency, also of those of extras."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [
        *project["dependencies"],
        *(r for name in extras if name not in NOT_USED_BY_THE_PACKAGE for r in extras[name]),
    ]
    bounds = {}
    for requirement in wanted:
        match = _BOUND.match(requirement)
        if match is None:
            raise SystemExit(f"pyproject.toml: '{requirement}' has no lower bound")
        bounds[match[1]] = match[3]
    return bounds


if __name__ == "__main__":
    root = Path(__file__).parents[1]
    if "--names" in sys.argv:
        print(*tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"])
    else:
        bounds = lowest(root / "pyproject.toml")
        print(*(f"{name}=={version}" for name, version in bounds.items()), *OF_THEIR_TIME, sep="\n")
