"""The documentation: its programs run, its links lead somewhere, and what it names exists."""

from __future__ import annotations

import pkgutil
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scanweld as sw
from rendered import rendered
from scanweld.geometry import se3

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS / "registration.md", *sorted((DOCS / "registration").glob("*.md"))]
SLAM_PAGES = sorted((DOCS / "slam").glob("*.md"))
LARGEST_PICTURE = 150_000


def names(page: Path) -> str:
    """Return the path of a page, for the names of tests."""
    return str(page.relative_to(DOCS))


def programs(page: Path) -> list[str]:
    """Return the blocks of Python of a page."""
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


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
    for text in programs(page):
        exec(compile(text, page.name, "exec"), variables)
    result = variables.get("result")
    if isinstance(result, sw.RegistrationResult):
        assert result.status.success, result.note


@pytest.mark.parametrize("page", [DOCS / "conventions.md", *SLAM_PAGES], ids=names)
def test_programs_about_slam_run(page: Path) -> None:
    """The same with a rendered sequence; an alignment must succeed."""
    variables: dict[str, object] = {"np": np, "sw": sw, "sequence": rendered(count=6)}
    for text in programs(page):
        exec(compile(text, page.name, "exec"), variables)
    result = variables.get("result")
    if isinstance(result, sw.RegistrationResult):
        assert result.status.success, result.note


def test_the_program_about_losses_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """It prints the frames of frames.csv that were not plainly tracked, and no others."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "frames.csv").write_text(
        "frame,status,alignment,note\n0,tracking,,\n1,tracking,converged,\n2,lost,no_overlap,too fast\n"
        "3,relocalised,converged,keyframe 0\n4,tracking,degenerate,along x\n"
    )
    (text,) = programs(DOCS / "lost.md")
    exec(compile(text, "lost.md", "exec"), {})
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["2", "3", "4"]


@pytest.mark.parametrize("page", [*PAGES[1:], *SLAM_PAGES], ids=names)
def test_every_method_has_its_equation_function_and_figure(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "```python" in text
    assert re.search(r"^!\[[^]]+\]\(\.\./images/", text, re.MULTILINE)
    assert re.search(r"`scanweld\.", text)


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=names)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#]+?)\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not link.startswith("http") and not (page.parent / link).exists()]
    assert missing == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=names)
def test_what_is_named_exists(page: Path) -> None:
    """`scanweld.a.b.c` is a module, or something in one."""
    for path in set(re.findall(r"`(scanweld(?:\.\w+)+)[`(]", page.read_text(encoding="utf-8"))):
        if not hasattr(sw, path.removeprefix("scanweld.")):
            pkgutil.resolve_name(path)


def test_settings_are_those_of_the_configuration() -> None:
    """Settings in the overview's table, and in calls of IcpConfig on every page, are fields."""
    fields = set(sw.IcpConfig.__dataclass_fields__)
    table = (DOCS / "registration.md").read_text(encoding="utf-8").split("## Settings")[1].split("##")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} <= fields
    for page in PAGES:
        for call in re.findall(r"IcpConfig\(([^)]*)\)", page.read_text(encoding="utf-8")):
            assert set(re.findall(r"(\w+)=", call)) <= fields, page.name


@pytest.mark.parametrize("folder", ["registration", "slam"])
def test_pictures_are_small_and_used(folder: str) -> None:
    pictures = sorted((DOCS / "images" / folder).glob("*.png"))
    text = "".join(page.read_text(encoding="utf-8") for page in [*PAGES, *SLAM_PAGES])
    assert pictures
    assert [picture.name for picture in pictures if picture.stat().st_size > LARGEST_PICTURE] == []
    assert [picture.name for picture in pictures if f"images/{folder}/{picture.name}" not in text] == []


def test_the_overview_of_slam_leads_to_every_page() -> None:
    links = set(re.findall(r"\]\(slam/([\w-]+\.md)\)", (DOCS / "slam.md").read_text(encoding="utf-8")))
    assert links == {page.name for page in SLAM_PAGES}


def test_anchors_exist() -> None:
    """A link to a heading names one: the heading in lower case, with dashes for spaces."""
    missing = []
    for page in sorted(DOCS.rglob("*.md")):
        for link, anchor in re.findall(r"\]\(([\w./-]*?)#([^)]+)\)", page.read_text(encoding="utf-8")):
            target = page.parent / link if link else page
            headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            named = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            missing += [f"{names(page)}: {link}#{anchor}"] if anchor not in named else []
    assert missing == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=names)
def test_lists_are_lists(page: Path) -> None:
    """An empty line comes before a list, without which the site runs it into the paragraph; the repository does not."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    item = re.compile(r"(?:[-*]|\d+\.) ")
    paragraphs = [paragraph.strip("\n").split("\n") for paragraph in text.split("\n\n")]
    run_in = [lines for lines in paragraphs if not item.match(lines[0]) and any(map(item.match, lines[1:]))]
    assert run_in == []


def test_every_page_is_in_the_navigation() -> None:
    """Of mkdocs.yml; decisions are added by a hook."""
    pages = {names(page) for page in DOCS.rglob("*.md") if page.parent.name != "decisions"}
    listed = set(re.findall(r"[\w/-]+\.md", (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8").split("nav:")[1]))
    assert pages - listed == set()


def test_the_overview_leads_to_every_page() -> None:
    links = set(re.findall(r"\]\(registration/([\w-]+\.md)\)", PAGES[0].read_text(encoding="utf-8")))
    assert links == {page.name for page in PAGES[1:]}
