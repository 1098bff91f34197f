"""What the site has beyond the pages in docs/: pages that are generated, and links that lead out of the folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from gallery import gallery_page
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from parameters import parameters_page
from reference import reference_pages

REPOSITORY = Path(__file__).parents[2]

ELSEWHERE = {
    "README.md": "introduction.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "examples": "gallery.md",
    "examples/README.md": "gallery.md",
    "docs/decisions": "decisions/index.md",
}
"""Files and folders of the repository, and the pages of the site that stand for them."""

COPIED = ("introduction.md", "changelog.md", "contributing.md", "security.md")
"""Pages whose links start at the root of the repository."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the generated pages to the navigation."""
    sections: dict[str, list[Any]] = {title: rows for entry in config.nav or () for title, rows in entry.items()}
    sections["Reference"].append({"Public names": [{title: path} for path, (title, _) in reference_pages().items()]})
    decisions = sorted(path.name for path in (REPOSITORY / "docs/decisions").glob("[0-9]*.md"))
    rows: list[Any] = ["decisions/index.md", *(f"decisions/{name}" for name in decisions)]
    sections["About"].insert(1, {"Decisions": rows})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {
        "introduction.md": (REPOSITORY / "README.md").read_text(encoding="utf-8"),
        "parameters.md": parameters_page(),
        "gallery.md": gallery_page(REPOSITORY),
        "decisions/index.md": decisions_page(REPOSITORY / "docs/decisions"),
        "changelog.md": (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8"),
        "contributing.md": (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8"),
        "security.md": (REPOSITORY / "SECURITY.md").read_text(encoding="utf-8"),
    } | {path: text for path, (_, text) in reference_pages().items()}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def decisions_page(folder: Path) -> str:
    """Return the list of decisions: their titles are their first lines."""
    rows = []
    for path in sorted(folder.glob("[0-9]*.md")):
        title = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        rows.append(f"- [{title}]({path.name})")
    return "\n".join(["# Decisions", "", "Why things are as they are, one page each.", "", *rows, ""])


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links that leave docs/, as they must in the repository, to the pages that stand for them here."""
    copied = page.file.src_uri in COPIED
    folder = REPOSITORY if copied else REPOSITORY / "docs" / Path(page.file.src_uri).parent
    up = "../" * page.file.src_uri.count("/")

    def replaced(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        place = (folder / target).resolve()
        if not place.is_relative_to(REPOSITORY):
            return match[0]
        inside = place.relative_to(REPOSITORY).as_posix()
        if inside in ELSEWHERE:
            return f"]({up}{ELSEWHERE[inside]}{anchor})"
        return f"]({up}{inside.removeprefix('docs/')}{anchor})" if copied else match[0]

    return re.sub(r"\]\((?!\w+:)([^)#\s]+)(#[^)]*)?\)", replaced, markdown)
