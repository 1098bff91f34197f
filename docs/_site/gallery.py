"""The gallery: every example with what it shows, its pictures and its source."""

from __future__ import annotations

import ast
import re
from pathlib import Path


def gallery_page(repository: Path) -> str:
    """Return the Markdown of the page; the pictures are those that the examples draw."""
    parts = [
        "# Gallery",
        "Scripts to read and to run, simplest first. They need no data: what they show is computed or rendered.",
        "```bash\npython examples/03_two_frames.py            # pictures go to examples/output/\n```",
    ]
    for script in sorted((repository / "examples").glob("[0-9][0-9]_*.py")):
        source = script.read_text(encoding="utf-8")
        title, _, rest = (ast.get_docstring(ast.parse(source)) or script.stem).partition("\n\n")
        # The last paragraph may be the command, which is the same for all.
        text = "\n\n".join(part for part in rest.split("\n\n") if not part.startswith("    "))
        parts += [f"## {title.replace(chr(10), ' ').rstrip('.')} {{ #{script.stem} }}", text]
        pictures = sorted((repository / "docs/images").glob(f"{script.stem[:2]}_*.png"))
        parts += [f"![{title.replace(chr(10), ' ')}](images/{picture.name}){{ loading=lazy }}" for picture in pictures]
        code = re.sub(r"^", "    ", source.rstrip(), flags=re.MULTILINE)
        parts.append(f'??? example "examples/{script.name}"\n\n    ```python\n{code}\n    ```')
    return "\n\n".join(part for part in parts if part) + "\n"
