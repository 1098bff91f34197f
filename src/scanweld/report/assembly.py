"""A page put together from its template, style and script, so that it can run nothing else."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files as package_files


def make_document(
    kind: str,
    values: Mapping[str, str],
    *,
    body: str,
    styles: Sequence[str],
    scripts: Sequence[str],
    images: str = "data:",
) -> str:
    """Return a whole page: what all pages have in common, around the template `body`.

    Parameters
    ----------
    kind : of page, as its reader is told
    values : by the names that the template has for them, with "name" and "subtitle" of the page; as HTML
    body, styles, scripts : files of this package
    images : where pictures may be from
    """
    texts = {
        name: package_files("scanweld.report").joinpath(name).read_text(encoding="utf-8")
        for name in ("frame.html", body, *styles, *scripts)
    }
    style, script = ("\n".join(texts[name] for name in names) for names in (styles, scripts))
    common = {
        "kind": kind,
        "name": values["name"],
        "subtitle": values["subtitle"],
        "policy": policy(style, script, images),
        "style": style,
        "script": script,
        "body": fill(texts[body], values),
    }
    return fill(texts["frame.html"], common)


def fill(template: str, values: Mapping[str, str]) -> str:
    """Put values into a template, each once: what a value contains is never looked at again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match.group(1)], template)


def policy(style: str, script: str, images: str = "data:") -> str:
    """Return a content security policy that allows exactly this script and this style, and no connection.

    Parameters
    ----------
    style, script : what the page holds
    images : where pictures may be from
    """

    def digest(text: str) -> str:
        return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")

    return (
        f"default-src 'none'; script-src 'sha256-{digest(script)}'; style-src 'sha256-{digest(style)}'; "
        f"img-src {images}; base-uri 'none'; form-action 'none'"
    )
