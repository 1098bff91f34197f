"""Empty rooms to furnish: floor, ceiling, walls with doorways, skirting, wainscot and lamps."""

from __future__ import annotations

from dataclasses import dataclass

from scanweld.datasets.synthetic import furniture as f
from scanweld.datasets.synthetic.scene import Material, Placement, Texture

CEILING = 2.5
DOOR_WIDTH, DOOR_HEIGHT = 1.25, 2.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """Materials of a space; `panel` is the wainscot's, None for bare walls."""

    floor: Material
    walls: tuple[Material, Material, Material, Material]
    panel: Material | None = None


@dataclass(frozen=True, slots=True)
class Space:
    """The places at the foot of the four walls, facing inwards, and the middle of the floor."""

    middle: Placement
    back: Placement  # at -z, facing +z
    left: Placement  # at -x, facing +x
    front: Placement  # at +z, facing -z
    right: Placement  # at +x, facing -x


def space(p: Placement, width: float, depth: float, style: Style, doors: str) -> Space:
    """Build floor, ceiling and walls around the origin; `doors` names walls with a doorway: b, l, f, r."""
    t = 0.1
    p.box((0, -t / 2, 0), (width + 2 * t, t, depth + 2 * t), style.floor)
    ceiling = Material(Texture.PLASTER, "#f1ede3", "#e0d9c9")
    p.box((0, CEILING + t / 2, 0), (width + 2 * t, t, depth + 2 * t), ceiling)
    feet = (
        (p.at(0, -depth / 2), width, "b"),
        (p.at(-width / 2, 0, 90), depth, "l"),
        (p.at(0, depth / 2, 180), width, "f"),
        (p.at(width / 2, 0, -90), depth, "r"),
    )
    for k, (foot, length, name) in enumerate(feet):
        _wall(foot, length, style.walls[k], style.panel, name in doors, seed=k)
    back, left, front, right = (foot for foot, _, _ in feet)
    return Space(p, back, left, front, right)


def _wall(p: Placement, length: float, wall: Material, panel: Material | None, door: bool, *, seed: int) -> None:
    """Build a wall behind z = 0, with a framed doorway in its middle if asked, skirting, and wainscot."""
    half, gap = length / 2, DOOR_WIDTH / 2
    parts = [(-half, -gap), (gap, half)] if door else [(-half, half)]
    for low, high in parts:
        p.span((low, 0, -0.1), (high, CEILING, 0), wall, seed=seed)
        inner = (low, high - 0.09) if door and high < 0 else (low + 0.09, high) if door else (low, high)
        p.span((inner[0], 0, 0), (inner[1], 0.12, 0.018), f.WHITE_PAINT)
        if panel is not None:
            _wainscot(p, *inner, panel)
    p.span((-half, CEILING - 0.06, 0), (half, CEILING, 0.045), f.WHITE_PAINT)
    if door:
        p.span((-gap, DOOR_HEIGHT, -0.1), (gap, CEILING, 0), wall, seed=seed)
        f.door_frame(p, DOOR_WIDTH, DOOR_HEIGHT, f.OAK, depth=0.03)
        for side in (-1, 1):
            p.box((side * (gap - 0.012), DOOR_HEIGHT / 2, -0.05), (0.024, DOOR_HEIGHT, 0.1), f.OAK)
        p.box((0, DOOR_HEIGHT - 0.012, -0.05), (DOOR_WIDTH, 0.024, 0.1), f.OAK)
        p.box((0, 0.006, -0.05), (DOOR_WIDTH, 0.012, 0.1), f.WALNUT)


def _wainscot(p: Placement, low: float, high: float, panel: Material) -> None:
    """Panel the foot of a wall from x = low to high: boards, stiles and a rail."""
    p.span((low, 0.12, 0), (high, 0.95, 0.01), panel)
    p.span((low, 0.93, 0), (high, 0.98, 0.035), panel, seed=5)
    count = max(1, round((high - low) / 0.55))
    for k in range(count + 1):
        x = low + 0.03 + (high - low - 0.06) * k / count
        p.span((x - 0.03, 0.12, 0.01), (x + 0.03, 0.93, 0.02), panel, seed=k)


def ceiling_lamp(p: Placement, power: float = 0.5) -> None:
    """A round lamp under the ceiling, with its light."""
    p.rod((0, CEILING - 0.07, 0), (0, CEILING, 0), 0.16, f.LAMP_GLOW, end_radius=0.19)
    p.rod((0, CEILING - 0.03, 0), (0, CEILING, 0), 0.2, f.BRASS)
    p.light((0, CEILING - 0.14, 0), "#fff0da", power, 6.0)


def room_lights(p: Placement, color: str = "#fff1df") -> None:
    """Five lights that stand for a lamp and what walls throw back."""
    ceiling_lamp(p, 0.7)
    for x, z in ((-1.2, -1.2), (1.2, -1.2), (1.2, 1.2), (-1.2, 1.2)):
        p.light((x, CEILING - 0.35, z), color, 0.45, 5.0)
    p.light((0.0, 0.7, 0.0), color, 0.16, 4.0)


def plaster(first: str, second: str) -> Material:
    return Material(Texture.PLASTER, first, second)


def pilasters(p: Placement, half_width: float, paint: Material) -> None:
    """A pair of pilasters with a beam between them, across a corridor along x."""
    for side in (-1, 1):
        z = side * (half_width - 0.09)
        p.box((0, CEILING / 2, z), (0.26, CEILING, 0.18), paint)
        p.box((0, 0.12, z), (0.32, 0.24, 0.24), paint)
        p.box((0, CEILING - 0.32, z), (0.32, 0.1, 0.24), paint)
    p.box((0, CEILING - 0.13, 0), (0.26, 0.26, 2 * half_width), paint)
