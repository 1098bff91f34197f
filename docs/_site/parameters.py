"""The page of all parameters, from the dataclasses that hold them: name, default, range, meaning."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

from docstring_text import rewritten

import scanweld as sw

CONFIGURATIONS = (
    (
        sw.SlamConfig,
        "`scanweld slam --set KEY=VALUE` or a file for `--config`; in Python `sw.build_slam(camera, config)`. "
        "`scanweld config show` prints them as TOML.",
    ),
    (sw.IcpConfig, "`scanweld register --set KEY=VALUE`; in Python `sw.icp(source, target, config=...)`."),
    (sw.GlobalConfig, "`scanweld register --global --set global.KEY=VALUE`; in Python `sw.register_global`."),
    (sw.ManyConfig, "In Python `sw.register_many`."),
    (sw.PoseGraphConfig, "In Python `sw.PoseGraph`."),
    (sw.TwoFrameConfig, "In Python `sw.align_frames`."),
    (sw.MeshConfig, "In Python `sw.mesh_run` and `sw.mesh_from_frames`; `scanweld mesh` has options for most."),
    (sw.RenderConfig, "`scanweld render`, where each is an option; in Python `sw.SyntheticSequence`."),
)


def parameters_page() -> str:
    """Return the Markdown of the page."""
    parts = [
        "# Parameters",
        "Every setting with its default, the values it may have, and what raising it does. An unknown key is an error "
        "that names the nearest one. On the command line defaults give way to a file, a file to `--set`, that to an "
        "option of its own. This page is made from the dataclasses themselves.\n\n"
        "A key is the heading and the name with a dot in between: `tracking.stable_fraction`.",
    ]
    for kind, use in CONFIGURATIONS:
        parts += [f"## {kind.__name__}", f"{_summary(kind)} {use}"]
        for prefix, doc, config in _sections(kind()):
            if prefix:
                parts.append(f"### {prefix} {{ #{kind.__name__}.{prefix} }}")
                parts.append(f"{_sentence(doc)} (`{type(config).__name__}`)")
            rows = list(_rows(config))
            if rows:
                parts.append("\n".join(["| key | default | values | meaning |", "|---|---|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def _sections(config: Any, prefix: str = "", doc: str = "") -> Iterator[tuple[str, str, Any]]:
    """Yield a configuration and all that are nested in it: prefix of the keys, what it is for, itself."""
    yield prefix, doc, config
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _sections(value, f"{prefix}.{item.name}".lstrip("."), item.metadata.get("doc", ""))


def _rows(config: Any) -> Iterator[str]:
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            continue
        cells = (f"`{item.name}`", _value(value), _range(item), item.metadata.get("doc", ""))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "`true`" if value else "`false`"
    if value is None:
        return "none"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value!r}`".replace("'", '"')


def _range(item: dataclasses.Field[Any]) -> str:
    low, high = item.metadata.get("low"), item.metadata.get("high")
    bounds = [bound for bound in (low, high) if bound is not None and not math.isinf(bound)]
    if not bounds:
        return ""
    if low is None or high is None:
        return f"≥ {low:g}" if high is None else f"≤ {high:g}"
    return f"{low:g} to {high:g}"


def _summary(kind: type) -> str:
    first = (kind.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
    return rewritten(first)


def _sentence(text: str) -> str:
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") or not text else ".")
