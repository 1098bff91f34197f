"""The documentation of registration: its programs run, its links lead somewhere, and what it names exists."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from scanweld.geometry import se3

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS / "registration.md", *sorted((DOCS / "registration").glob("*.md"))]
LARGEST_PICTURE = 150_000


def names(page: Path) -> str:
    """Return the path of a page, for the names of tests."""
    return str(page.relative_to(DOCS))


@pytest.fixture(scope="module")
def clouds() -> tuple[sw.PointCloud, sw.PointCloud]:
    """Two painted samples of a corner with a column, a few centimetres apart: what the pages call source and target."""
    rng = np.random.default_rng(0)

    def sample(count: int) -> sw.PointCloud:
        points = rng.uniform(0, 1, (count, 3)) * [4, 3, 2.5]
        for axis in range(3):
            points[axis::4, axis] = 0
        angle = rng.uniform(0, 2 * np.pi, len(points[3::4]))
        points[3::4, :2] = np.column_stack([2.5 + 0.4 * np.cos(angle), 1.8 + 0.4 * np.sin(angle)])
        colors = (128 + 100 * np.sin(3 * points)).astype(np.uint8)
        return sw.PointCloud(points + 0.003 * rng.normal(size=points.shape), colors=colors)

    truth = se3.exp([0.06, -0.05, 0.04, 0.02, -0.03, 0.05])
    return sample(3000).transformed(se3.inverse(truth)), sample(3000)


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_programs_run(page: Path, clouds: tuple[sw.PointCloud, sw.PointCloud]) -> None:
    """Every block of Python runs, in order; most of them align the two clouds, which must succeed."""
    source, target = clouds
    variables: dict[str, object] = {"np": np, "sw": sw, "source": source, "target": target}
    for text in re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        exec(compile(text, page.name, "exec"), variables)
    result = variables.get("result")
    if isinstance(result, sw.RegistrationResult):
        assert result.status.success, result.note


def test_there_are_programs() -> None:
    """Every page has one."""
    assert [page.name for page in PAGES if "```python" not in page.read_text(encoding="utf-8")] == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=names)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#]+?)\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not link.startswith("http") and not (page.parent / link).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_what_is_named_exists(page: Path) -> None:
    """`scanweld.a.b.c` is a module, or something in one."""
    for path in set(re.findall(r"`(scanweld(?:\.\w+)+)[`(]", page.read_text(encoding="utf-8"))):
        module, _, name = path.rpartition(".")
        if module == "scanweld":
            assert hasattr(sw, name), path
            continue
        try:
            import_module(path)
        except ModuleNotFoundError:
            assert hasattr(import_module(module), name), path


def test_settings_are_those_of_the_configuration() -> None:
    """Settings in the overview's table, and in calls of IcpConfig on every page, are fields."""
    fields = set(sw.IcpConfig.__dataclass_fields__)
    table = (DOCS / "registration.md").read_text(encoding="utf-8").split("## Settings")[1].split("##")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} <= fields
    for page in PAGES:
        for call in re.findall(r"IcpConfig\(([^)]*)\)", page.read_text(encoding="utf-8")):
            assert set(re.findall(r"(\w+)=", call)) <= fields, page.name


def test_pictures_are_small_and_used() -> None:
    pictures = sorted((DOCS / "images" / "registration").glob("*.png"))
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert pictures
    assert [picture.name for picture in pictures if picture.stat().st_size > LARGEST_PICTURE] == []
    assert [picture.name for picture in pictures if f"images/registration/{picture.name}" not in text] == []


def test_the_overview_leads_to_every_page() -> None:
    links = set(re.findall(r"\]\(registration/([\w-]+\.md)\)", PAGES[0].read_text(encoding="utf-8")))
    assert links == {page.name for page in PAGES[1:]}
