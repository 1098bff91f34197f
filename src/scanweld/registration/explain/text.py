"""Numbers, vectors and matrices as plain text of 80 columns."""

from __future__ import annotations

import textwrap

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.geometry import se3

ROWS, COLUMNS = 12, 9
"""What is printed of a table; the rest is counted."""


def number_text(value: float) -> str:
    """A number as people write it: four decimals, or three digits where that says nothing."""
    rounded = round(float(value), 4) + 0.0
    return f"{rounded:.4f}" if value == 0 or 1e-3 <= abs(value) < 1e6 or abs(value) < 1e-12 else f"{value:.2e}"


def vector_text(values: Float64) -> str:
    """A vector in brackets."""
    return "(" + ", ".join(number_text(v) for v in values) + ")"


def count_text(number: int) -> str:
    """A number of things in words, up to ten."""
    names = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    return names[number] if number < len(names) else str(number)


def sentence(text: str) -> str:
    """The words with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def wrapped(text: str) -> list[str]:
    """Indented lines of at most 78 columns."""
    return textwrap.wrap(text, 78, initial_indent="  ", subsequent_indent="  ")


def angle_deg(T: Float64) -> float:
    """Rotation angle of a transform; signed in the plane."""
    if len(T) == 3:
        return float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    return float(np.degrees(se3.rotation_angle_rad(T))) if len(T) == 4 else float("nan")


def side_by_side(matrices: dict[str, Float64]) -> list[str]:
    """Named matrices beside each other."""
    blocks = []
    for name, matrix in matrices.items():
        rows = ["".join(f"{number_text(v):>10}" for v in row) for row in matrix]
        width = max(len(name) + 2, *(len(row) for row in rows))
        blocks.append([("  " + name).ljust(width), *(row.ljust(width) for row in rows)])
    return ["  " + "    ".join(parts).rstrip() for parts in zip(*blocks, strict=True)]


def pair_lines(pairs: Int64) -> list[str]:
    """The pairs (P, 2) by name."""
    listed = [f"a{i + 1}-b{j + 1}" for i, j in pairs[: 2 * ROWS]]
    more = f" and {len(pairs) - len(listed)} more" if len(pairs) > len(listed) else ""
    return wrapped(f"pairs: {'  '.join(listed)}{more}")


def distance_lines(distances: Float64, pairs: Int64) -> list[str]:
    """The table of distances (N, M), pairs marked."""
    chosen = {(int(i), int(j)) for i, j in pairs}
    rows, columns = min(len(distances), ROWS), min(distances.shape[1], COLUMNS)
    lines = ["      " + "".join(f"{'b' + str(j + 1):>8} " for j in range(columns)).rstrip()]
    for i in range(rows):
        cells = (f"{distances[i, j]:>8.3f}{'*' if (i, j) in chosen else ' '}" for j in range(columns))
        lines.append(f"  {'a' + str(i + 1):>4}{''.join(cells)}".rstrip())
    if rows < len(distances) or columns < distances.shape[1]:
        lines.append(f"      (the first {rows} x {columns} of {len(distances)} x {distances.shape[1]})")
    return lines
