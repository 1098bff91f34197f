"""Docstrings as the source has them, `name : what it is` in one line, turned into those that the parser reads."""

from __future__ import annotations

import re

SECTION = re.compile(r"^(Parameters|Attributes|Returns)\n-+\n(.*?)(?=\n\n\S[^\n]*\n---|\Z)", re.MULTILINE | re.DOTALL)
ENTRY = re.compile(r"^([*\w][\w*, ]*?) : (.*)$")
ROLE = re.compile(r":\w+:`(~?)([\w.]+)`")


def rewritten(text: str, returns: str = "") -> str:
    """Return a docstring with descriptions on lines of their own, and without Sphinx's roles.

    Where "Returns" has a sentence and no list of names, the parser gets it with the type that is returned.
    """

    def section(match: re.Match[str]) -> str:
        lines, body = [f"{match[1]}\n{'-' * len(match[1])}"], match[2].split("\n")
        if match[1] == "Returns" and not ENTRY.match(body[0]):
            return "\n".join([*lines, returns or "object", *(f"    {line}" for line in body)])
        for line in body:
            entry = ENTRY.match(line)
            lines += [entry[1], f"    {entry[2]}"] if entry else [line]
        return "\n".join(lines)

    return ROLE.sub(_link, SECTION.sub(section, text))


def _link(match: re.Match[str]) -> str:
    """Return a role as code: `~a.b.C` is shown as `C`."""
    path = match[2].lstrip(".")
    return f"`{path.rpartition('.')[2] if match[1] else path}`"
