"""The table of licences has every dependency, with what the installed package states."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "licences.py"


@pytest.fixture(scope="module")
def licences() -> ModuleType:
    spec = importlib.util.spec_from_file_location("licences", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_table_is_that_of_the_dependencies(licences: ModuleType) -> None:
    wrong = licences.faults(licences.PAGE.read_text(encoding="utf-8"))
    if "PIP_CONSTRAINT" in os.environ:  # earlier versions have other licences, or other words for them
        wrong = [fault for fault in wrong if " is under " not in fault]
    assert wrong == []


def test_what_is_missing_or_another_one_is_told(licences: ModuleType) -> None:
    page = licences.PAGE.read_text(encoding="utf-8")
    without = "".join(line for line in page.splitlines(keepends=True) if not line.startswith("| rich "))
    assert "rich has no row" in licences.faults(without)
    assert any(
        "pytest is under MIT, not WTFPL" in fault for fault in licences.faults(page + "| pytest | WTFPL | always |\n")
    )
    assert "numpy is needed always, not extra `x`" in licences.faults(page.replace("| always |", "| extra `x` |", 1))


def test_rows_of_what_is_not_installed_are_kept(licences: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    page = licences.PAGE.read_text(encoding="utf-8")
    monkeypatch.setattr(licences, "licence_of", lambda name: "")
    rows = licences.rows_of(licences.written(page))
    assert {name: rows[name] for name in licences.dependencies()} == {
        name: row for name, row in licences.rows_of(page).items() if name in licences.dependencies()
    }
