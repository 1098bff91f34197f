"""What the documentation site generates from the package: nothing is left out. The site itself is built by CI."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import scanweld as sw

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture
def generator(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module of docs/_site/, which only the site has on its path."""
    from importlib import import_module

    monkeypatch.syspath_prepend(str(REPOSITORY / "docs" / "_site"))
    module = import_module(request.param)
    monkeypatch.delitem(sys.modules, request.param)
    return module


def keys(config: Any, prefix: str = "") -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Yield section and field of every setting, also of nested ones."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from keys(value, f"{prefix}.{item.name}".lstrip("."))
        else:
            yield prefix, item


@pytest.mark.parametrize("generator", ["parameters"], indirect=True)
@pytest.mark.parametrize("kind", [sw.SlamConfig, sw.IcpConfig, sw.GlobalConfig, sw.MeshConfig, sw.RenderConfig])
def test_every_parameter_is_listed(generator: ModuleType, kind: type) -> None:
    """Each in its section, with default and meaning; ranges where there are any."""
    part = generator.parameters_page().split(f"\n## {kind.__name__}\n")[1].split("\n## ")[0]
    sections = {text.split(" ")[0] if text else "": text for text in ("\n" + part).split("\n### ")}
    sections[""] = part.split("\n### ")[0]
    for prefix, item in keys(kind()):
        row = next(line for line in sections[prefix].splitlines() if line.startswith(f"| `{item.name}` |"))
        assert item.metadata["doc"].split("|")[0][:60] in row
        low = item.metadata["low"]
        assert low is None or f"{low:g}" in row.split("|")[3]


@pytest.mark.parametrize("generator", ["parameters"], indirect=True)
def test_a_row_of_parameters(generator: ModuleType) -> None:
    """`iterations: int = setting(10, "most iterations on each pyramid level; ...", low=1, high=1000)`."""
    row = next(line for line in generator.parameters_page().splitlines() if line.startswith("| `iterations` | `10` |"))
    assert row.startswith("| `iterations` | `10` | 1 to 1000 | most iterations on each pyramid level;")


@pytest.mark.parametrize("generator", ["reference"], indirect=True)
def test_every_public_name_has_an_entry(generator: ModuleType) -> None:
    """One each, below a title that somebody chose."""
    pages = generator.reference_pages()
    entries = [
        line.split(".")[-1] for _, text in pages.values() for line in text.splitlines() if line.startswith(":::")
    ]
    assert sorted(entries) == sorted(sw.__all__)
    assert {path.removeprefix("api/").removesuffix(".md") for path in pages} <= set(generator.TITLES)


@pytest.mark.parametrize("generator", ["gallery"], indirect=True)
def test_every_example_is_in_the_gallery_with_a_picture(generator: ModuleType) -> None:
    page = generator.gallery_page(REPOSITORY)
    parts = page.split("\n## ")[1:]
    scripts = sorted((REPOSITORY / "examples").glob("[0-9][0-9]_*.py"))
    assert len(parts) == len(scripts)
    for part, script in zip(parts, scripts, strict=True):
        assert f"images/{script.stem[:2]}_" in part
        assert f'"examples/{script.name}"' in part


@pytest.mark.parametrize("generator", ["docstring_text"], indirect=True)
def test_docstrings_are_rewritten_for_the_parser(generator: ModuleType) -> None:
    """One line for a parameter becomes two, a sentence about what is returned gets its type, roles become code."""
    text = generator.rewritten(
        "Do it; see :func:`~scanweld.registration.icp.icp`.\n\nParameters\n----------\nsource, target : (N, 3) [m],\n"
        "    more\nconfig : how\n\nReturns\n-------\nThe result.\n\nRaises\n------\nDatasetError\n    When not.",
        "Answer",
    )
    assert text == (
        "Do it; see `icp`.\n\nParameters\n----------\nsource, target\n    (N, 3) [m],\n    more\nconfig\n    how\n\n"
        "Returns\n-------\nAnswer\n    The result.\n\nRaises\n------\nDatasetError\n    When not."
    )
