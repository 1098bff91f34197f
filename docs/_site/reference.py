"""The pages of the public names: what `scanweld.__all__` lists, by the package that it is from."""

from __future__ import annotations

from functools import cache

import scanweld as sw

TITLES = {
    "registration": "Registration",
    "slam": "SLAM",
    "tracking": "Tracking",
    "mapping": "Map",
    "loop_closure": "Loop closure",
    "refinement": "Refinement",
    "runs": "Runs",
    "viewer": "Viewer",
    "meshing": "Meshes",
    "datasets": "Sequences",
    "checkup": "Checking sequences",
    "trajectory": "Trajectories",
    "evaluation": "Evaluation",
    "geometry": "Geometry",
    "io": "Files",
    "interop": "Other programs",
    "testing": "Testing",
    "config": "Configuration",
    "parallel": "Threads",
    "backends": "Backends",
    "errors": "Errors",
}
"""The packages in the order of the navigation."""


@cache
def reference_pages() -> dict[str, tuple[str, str]]:
    """Return for the path of each page its title and its Markdown."""
    names: dict[str, list[str]] = {}
    for name in sw.__all__:
        names.setdefault(_home(name).split(".")[1], []).append(name)
    order = sorted(names, key=lambda package: list(TITLES).index(package) if package in TITLES else len(TITLES))
    pages = {}
    for package in order:
        title = TITLES.get(package, package.replace("_", " ").capitalize())
        entries = "\n\n".join(_entry(name) for name in sorted(names[package], key=lambda name: (name.lower(), name)))
        use = "`import scanweld as sw` has these names; what else is in the package may change."
        text = f"# {title}\n\n{use}\n\n{entries}\n"
        pages[f"api/{package}.md"] = (title, text)
    return pages


def _home(name: str) -> str:
    """Return the module that a public name is from."""
    return "scanweld.geometry.se3" if name == "se3" else f"scanweld.{sw._MODULE_OF[name]}"


def _entry(name: str) -> str:
    path = _home(name) if name == "se3" else f"{_home(name)}.{name}"
    return f"::: {path}"
