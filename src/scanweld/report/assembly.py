"""A page put together from its template, style and script, so that it can run nothing else."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping


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
