"""How results show themselves in a notebook: one small card, without scripts, for light and dark pages.

Colours of text and page are the notebook's own; lines and marks are half transparent, so that they show on both.
"""

from __future__ import annotations

import base64
import html
import struct
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, UInt8

GOOD, DOUBTFUL, BAD = "#2a9d64", "#d08a1d", "#d1495b"
"""Colours of the mark before a title."""

PICTURE_PX = 200
"""Longer side of a picture."""

_LINE = "1px solid rgba(128,128,128,.4)"


def card(
    title: str, rows: Sequence[tuple[str, str]], *, mark: str = "", matrix: Float64 | None = None, picture: bytes = b""
) -> str:
    """Return HTML: a title, names with values, a small matrix, a picture; rows without a value are left out.

    Parameters
    ----------
    title, rows : plain text
    mark : colour of a mark before the title
    matrix : (D, D)
    picture : PNG
    """
    dot = f'<span style="color:{mark}" aria-hidden="true">&#9679;</span> ' if mark else ""
    cell = "padding:.1em .8em .1em 0;text-align:left;vertical-align:top;background:none"
    table = "".join(
        f'<tr style="background:none"><td style="{cell};opacity:.7;white-space:nowrap">{html.escape(name)}</td>'
        f'<td style="{cell}">{html.escape(value)}</td></tr>'
        for name, value in rows
        if value
    )
    parts = [f'<table style="border:0;border-collapse:collapse;margin:0">{table}</table>']
    if matrix is not None:
        numbers = "\n".join(" ".join(f"{value + 0.0:9.5f}" for value in row) for row in matrix.round(9))
        style = f"margin:0;padding-left:.6em;border:0;border-left:{_LINE};background:none;color:inherit;line-height:1.4"
        parts.append(f'<pre style="{style}">{numbers}</pre>')
    if picture:
        data = base64.b64encode(picture).decode()
        parts.append(f'<img alt="seen from above" style="max-width:100%" src="data:image/png;base64,{data}">')
    return (
        f'<div style="display:inline-block;max-width:100%;border:{_LINE};border-radius:6px;padding:.6em .9em;'
        f'font-size:13px;color:inherit"><div style="font-weight:600;margin-bottom:.3em">{dot}{html.escape(title)}</div>'
        f'<div style="display:flex;flex-wrap:wrap;gap:.6em 1.4em;align-items:flex-start">{"".join(parts)}</div></div>'
    )


def seen_from_above(points_m: npt.ArrayLike, normals: npt.ArrayLike, colors: npt.ArrayLike) -> bytes:
    """Return a PNG of oriented points (N, 3) with colours (N, 3) uint8, seen along y, which points down.

    What faces away is left out, as a ceiling does, and so is one point in a hundred at each end, as stray. It is
    transparent where there are no points.
    """
    points, paint = np.asarray(points_m, np.float64), np.asarray(colors, np.uint8)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    shown = np.all((points >= low) & (points <= high), axis=1) & (np.asarray(normals)[:, 1] < 0)
    order = np.flatnonzero(shown)[np.argsort(-points[shown, 1], kind="stable")]  # the highest is drawn last
    extent = np.maximum((high - low)[[0, 2]], 1e-9)
    width, height = np.maximum(np.rint(PICTURE_PX * extent / extent.max()), 1).astype(int)
    place = (points[order][:, [0, 2]] - low[[0, 2]]) / extent * [width - 1, height - 1]
    columns, rows = np.rint(place).astype(np.int64).T
    image = np.zeros((height, width, 4), np.uint8)
    image[height - 1 - rows, columns] = np.column_stack([paint[order], np.full(len(order), 255, np.uint8)])
    return _png(image)


def _png(image: UInt8) -> bytes:
    """Return an image (H, W, 4) RGBA as a PNG file."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    height, width = image.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    unfiltered = b"".join(b"\0" + row.tobytes() for row in image)
    return b"".join(
        [b"\x89PNG\r\n\x1a\n", chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(unfiltered)), chunk(b"IEND", b"")]
    )
