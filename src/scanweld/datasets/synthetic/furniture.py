"""Pieces of furniture.

Every function builds at the place it is given: the piece stands on height 0 and faces +z. What stands against
a wall has its back at z = 0; what stands free is centred on the origin.
"""

from __future__ import annotations

import math

import numpy as np

from scanweld.datasets.synthetic.scene import Material, Placement, Texture

OAK = Material(Texture.WOOD, "#c79a63", "#8a5a2e")
WALNUT = Material(Texture.WOOD, "#7d5233", "#3f2616")
PINE = Material(Texture.WOOD, "#e3c28f", "#b98a50")
WHITE_PAINT = Material(Texture.PAINT, "#efece4", "#dcd8cc")
DARK_METAL = Material(Texture.PAINT, "#33353a", "#1f2023")
BRASS = Material(Texture.PAINT, "#c8a24e", "#9a7730")
STEEL = Material(Texture.PAINT, "#b9bec4", "#8f959c")
CERAMIC = Material(Texture.PAINT, "#f3efe6", "#d9d2c4")
SOIL = Material(Texture.PLASTER, "#3a2a1e", "#241812")
LEAVES = Material(Texture.LEAF, "#3f7a35", "#78b04a")
DARK_LEAVES = Material(Texture.LEAF, "#234f2c", "#4f8a3f")
LAMP_GLOW = Material(Texture.PAINT, "#fff0d0", "#ffe6b8", glow=1.35)

BOOK_COLORS = (
    "#8c2f2b", "#c8553d", "#e0a33e", "#2f5d62", "#3d6b8e", "#27374d", "#5b7553", "#a3b18a", "#6d4c6f",
    "#d9cfb8", "#3b3a3c", "#b5838d", "#1f6f78", "#f2c078", "#704214", "#4f6d7a",
)  # fmt: skip
FABRIC_COLORS = ("#c8553d", "#e0a33e", "#2f6f73", "#8e9aaf", "#6a994e", "#b56576", "#385f8f", "#d8c4a0")


def plain(color: str, *, shade: float = 0.8) -> Material:
    """Return paint of one colour, its second tone darker by `shade`."""
    return Material(Texture.PAINT, color, darker(color, shade))


def darker(color: str, shade: float) -> str:
    """Return "#rrggbb" with every channel multiplied by `shade`."""
    return "#" + "".join(f"{min(255, int(int(color[i : i + 2], 16) * shade)):02x}" for i in (1, 3, 5))


def fabric(color: str, *, shade: float = 0.72, scale: float = 1.0) -> Material:
    """Return woven fabric."""
    return Material(Texture.FABRIC, color, darker(color, shade), scale)


def table(p: Placement, width: float, depth: float, height: float, wood: Material = OAK, *, seed: int = 0) -> None:
    """Add a table: top, apron, four tapered legs and a shelf if it is low."""
    p.span((-width / 2, height - 0.035, -depth / 2), (width / 2, height, depth / 2), wood, seed=seed)
    x, z = width / 2 - 0.06, depth / 2 - 0.06
    for side in (-1, 1):
        p.box((0, height - 0.075, side * z), (2 * x, 0.08, 0.02), wood, seed=seed + 1)
        p.box((side * x, height - 0.075, 0), (0.02, 0.08, 2 * z), wood, seed=seed + 2)
        for end in (-1, 1):
            p.rod(
                (side * x, 0, end * z),
                (side * x, height - 0.035, end * z),
                0.02,
                wood,
                end_radius=0.034,
                seed=seed,
            )
    if height < 0.6:
        p.box((0, 0.14, 0), (2 * x, 0.02, 2 * z), wood, seed=seed + 3)


def chair(p: Placement, wood: Material = OAK, seat: str = "#2f6f73") -> None:
    """Add a chair with a cushion and a back of slats, centred on the origin."""
    for side in (-1, 1):
        p.rod((side * 0.19, 0, 0.19), (side * 0.18, 0.44, 0.18), 0.016, wood, end_radius=0.02)
        p.rod((side * 0.19, 0, -0.2), (side * 0.18, 0.93, -0.25), 0.018, wood)
        p.box((side * 0.185, 0.2, -0.01), (0.018, 0.03, 0.38), wood)
    p.box((0, 0.435, 0), (0.42, 0.03, 0.42), wood)
    p.ball((0, 0.452, 0), (0.2, 0.045, 0.2), fabric(seat))
    for height in (0.6, 0.72, 0.86):
        p.box((0, height, -0.232), (0.36, 0.07, 0.018), wood, tilt_deg=-6)


def sofa(p: Placement, width: float, color: str, cushions: tuple[str, ...], *, seats: int = 3) -> None:
    """Add a sofa with rounded arms and back, puffed seats and loose cushions; its back is at z = 0."""
    cloth, inner = fabric(color), width - 0.4
    p.span((-width / 2 + 0.05, 0.1, 0.04), (width / 2 - 0.05, 0.3, 0.88), cloth)
    p.span((-width / 2 + 0.1, 0.25, 0.02), (width / 2 - 0.1, 0.74, 0.24), cloth)
    p.rod((-width / 2 + 0.1, 0.74, 0.13), (width / 2 - 0.1, 0.74, 0.13), 0.11, cloth)
    for side in (-1, 1):
        x = side * (width / 2 - 0.1)
        p.span((x - 0.09, 0.1, 0.04), (x + 0.09, 0.55, 0.9), cloth, seed=3)
        p.rod((x, 0.55, 0.03), (x, 0.55, 0.92), 0.11, cloth, seed=4)
        for z in (0.1, 0.82):
            p.rod((x, 0, z), (x, 0.11, z), 0.02, WALNUT, end_radius=0.03)
    each = inner / seats
    for k in range(seats):
        x = -inner / 2 + each * (k + 0.5)
        p.box((x, 0.37, 0.55), (each - 0.015, 0.13, 0.66), cloth, seed=10 + k)
        p.ball((x, 0.41, 0.55), (each * 0.6, 0.07, 0.4), cloth, seed=20 + k)
        p.box((x, 0.6, 0.27), (each - 0.02, 0.36, 0.13), cloth, tilt_deg=-10, seed=30 + k)
        p.ball((x, 0.6, 0.3), (each * 0.55, 0.22, 0.1), cloth, seed=40 + k)
    for k, tint in enumerate(cushions):
        x = -inner / 2 + 0.2 + k * (inner - 0.4) / max(len(cushions) - 1, 1)
        cushion(p.at(x, 0.48, turn_deg=18 * math.sin(5 * k + 1)), tint, seed=k)


def cushion(p: Placement, color: str, *, seed: int = 0) -> None:
    """Add a loose cushion that leans back, on a seat 0.45 m high."""
    cloth = fabric(color, scale=1.6) if seed % 2 else Material(Texture.STRIPES, color, "#f1e9da", 0.35)
    p.box((0, 0.63, 0), (0.38, 0.36, 0.06), cloth, tilt_deg=-20, seed=seed)
    p.ball((0, 0.63, 0.0), (0.2, 0.19, 0.09), cloth, seed=seed, axis=(0, 1, -0.36))


def armchair(p: Placement, color: str, cushion_color: str) -> None:
    """Add an armchair, centred on the origin."""
    sofa(p.at(0, -0.45), 0.95, color, (cushion_color,), seats=1)


def rug(p: Placement, width: float, depth: float, first: str, second: str, *, seed: int = 0) -> None:
    """Add a rug with borders and fringes."""
    p.box((0, 0.006, 0), (width, 0.012, depth), Material(Texture.RUG, first, second), seed=seed)
    for side in (-1, 1):
        p.box((side * (width / 2 + 0.03), 0.003, 0), (0.06, 0.006, depth - 0.02), fabric(second))


def books(p: Placement, width: float, height: float, depth: float, rng: np.random.Generator) -> None:
    """Fill a shelf of the given clear size with books; its back is at z = 0, its middle at x = 0."""
    x = -width / 2 + 0.005
    while x < width / 2 - 0.03:
        kind = rng.random()
        tint = BOOK_COLORS[rng.integers(len(BOOK_COLORS))]
        title = "#f0e3c0" if rng.random() < 0.7 else "#2a2a2e"
        seed = int(rng.integers(1000))
        if kind < 0.05 and width / 2 - x > 0.2:  # a vase in a gap
            p.rod((x + 0.09, 0, depth / 2), (x + 0.09, 0.13, depth / 2), 0.045, plain(tint), end_radius=0.07)
            p.rod((x + 0.09, 0.13, depth / 2), (x + 0.09, 0.2, depth / 2), 0.07, plain(tint), end_radius=0.03)
            x += 0.19
        elif kind < 0.12 and width / 2 - x > 0.26:  # a lying stack
            level = 0.0
            for _ in range(int(rng.integers(2, 5))):
                thick = float(rng.uniform(0.02, 0.045))
                cover = Material(Texture.BOOK, BOOK_COLORS[rng.integers(len(BOOK_COLORS))], title)
                size = (float(rng.uniform(0.17, 0.23)), thick, depth * 0.8)
                p.box((x + 0.12, level + thick / 2, depth * 0.45), size, cover, seed=seed)
                level += thick
            x += 0.25
        elif kind < 0.16:
            x += float(rng.uniform(0.03, 0.1))
        else:
            thick = float(rng.uniform(0.02, 0.05))
            tall = height * float(rng.uniform(0.66, 0.95))
            deep = depth * float(rng.uniform(0.68, 0.92))
            cover = Material(Texture.BOOK, tint, title)
            p.box((x + thick / 2, tall / 2, deep / 2), (thick - 0.002, tall, deep), cover, seed=seed)
            x += thick


def bookshelf(
    p: Placement,
    width: float,
    height: float,
    rng: np.random.Generator,
    wood: Material = WALNUT,
    *,
    shelves: int = 5,
) -> None:
    """Add a bookshelf full of books."""
    depth = 0.3
    for side in (-1, 1):
        p.span((side * width / 2 - 0.015, 0, 0), (side * width / 2 + 0.015, height, depth), wood)
    p.span((-width / 2, 0, 0), (width / 2, height, 0.012), wood, seed=5)
    clear = (height - 0.08 - 0.02) / shelves
    for k in range(shelves + 1):
        level = 0.08 + k * clear
        p.span((-width / 2, level - 0.022, 0), (width / 2, level, depth), wood, seed=k)
        if k < shelves:
            books(p.at(0, 0.02, height=level), width - 0.04, clear - 0.03, depth - 0.03, rng)
    p.span((-width / 2, 0, 0.03), (width / 2, 0.06, depth - 0.02), wood, seed=9)


def floor_lamp(p: Placement, shade_color: str = "#fff0d0") -> None:
    """Add a standing lamp, centred on the origin, with a light."""
    p.rod((0, 0, 0), (0, 0.03, 0), 0.15, DARK_METAL, end_radius=0.13)
    p.rod((0, 0.03, 0), (0, 1.5, 0), 0.012, BRASS)
    p.rod(
        (0, 1.42, 0),
        (0, 1.68, 0),
        0.2,
        Material(Texture.PAINT, shade_color, "#ffdfa6", glow=1.2),
        end_radius=0.13,
    )


def pendant(p: Placement, ceiling: float, height: float, color: str) -> None:
    """Add a lamp that hangs from the ceiling down to `height`."""
    p.rod((0, height + 0.2, 0), (0, ceiling, 0), 0.006, DARK_METAL)
    p.rod((0, height, 0), (0, height + 0.2, 0), 0.22, plain(color), end_radius=0.05)
    p.ball((0, height + 0.01, 0), (0.07, 0.05, 0.07), LAMP_GLOW)


def potted_plant(
    p: Placement, size: float, rng: np.random.Generator, pot: str = "#b5653f", *, spread: float = 0.6
) -> None:
    """Add a plant about `size` tall: a pot, stems, and broad leaves that arch out to `spread` at most."""
    radius = 0.13 + 0.05 * size
    p.rod(
        (0, 0, 0),
        (0, 0.28, 0),
        radius * 0.75,
        Material(Texture.PLASTER, pot, darker(pot, 0.7)),
        end_radius=radius,
    )
    p.rod((0, 0.265, 0), (0, 0.285, 0), radius * 1.04, plain(pot))
    p.rod((0, 0.28, 0), (0, 0.287, 0), radius * 0.95, SOIL)
    for k in range(14):
        angle, rise = 2.4 * k + rng.uniform(-0.3, 0.3), rng.uniform(0.35, 1.0)
        leaf = min(0.2 * size + 0.07, 0.45 * spread)
        reach = min(size * (0.42 - 0.22 * rise) + 0.06, spread - 1.6 * leaf)
        c, s = math.cos(angle), math.sin(angle)
        tip = (reach * c, 0.3 + (size - 0.35) * rise, reach * s)
        p.rod((0.03 * c, 0.27, 0.03 * s), tip, 0.008, DARK_LEAVES, end_radius=0.004)
        droop = rng.uniform(-0.5, 0.5)
        axis = (c, droop, s)
        centre = (tip[0] + 0.6 * leaf * c, tip[1] + 0.6 * leaf * droop, tip[2] + 0.6 * leaf * s)
        material = LEAVES if k % 3 else DARK_LEAVES
        p.ball(centre, (leaf * 0.38, leaf, 0.012), material, axis=axis, seed=k)


def framed_picture(
    p: Placement, width: float, height: float, centre: float, first: str, second: str,
    *, frame: Material = WALNUT, seed: int = 1, texture: Texture = Texture.PICTURE, mount: bool = True,
) -> None:  # fmt: skip
    """Hang a picture on the wall at z = 0, its middle at height `centre`."""
    rim = 0.035
    for side in (-1, 1):
        p.box((0, centre + side * (height / 2 + rim / 2), 0.018), (width + 2 * rim, rim, 0.036), frame)
        p.box((side * (width / 2 + rim / 2), centre, 0.018), (rim, height, 0.036), frame)
    inner = 0.05 if mount else 0.0
    if mount:
        p.sheet((0, centre, 0.008), width, height, CERAMIC)
    art = Material(texture, first, second)
    p.sheet((0, centre, 0.012), width - 2 * inner, height - 2 * inner, art, seed=seed)


def window(p: Placement, width: float, height: float, sill: float, curtain: str | None, ceiling: float) -> None:
    """Add a window with frame, sill, sky behind, and curtains with folds, on the wall at z = 0."""
    p.sheet(
        (0, sill + height / 2, 0.004),
        width,
        height,
        Material(Texture.SKY, "#a9d3ff", "#5d7f52", glow=1.25),
        seed=4,
    )
    for side in (-1, 1):
        p.box((side * width / 2, sill + height / 2, 0.03), (0.07, height + 0.07, 0.06), WHITE_PAINT)
        p.box((0, sill + height / 2 + side * height / 2, 0.03), (width + 0.07, 0.07, 0.06), WHITE_PAINT)
    p.box((0, sill + height / 2, 0.025), (0.05, height, 0.05), WHITE_PAINT)
    p.box((0, sill + 0.68 * height, 0.025), (width, 0.04, 0.05), WHITE_PAINT)
    p.box((0, sill - 0.03, 0.09), (width + 0.16, 0.03, 0.18), WHITE_PAINT)
    if curtain is None:
        return
    rail = min(sill + height + 0.16, ceiling - 0.06)
    p.rod((-width / 2 - 0.5, rail, 0.13), (width / 2 + 0.5, rail, 0.13), 0.014, BRASS)
    for side in (-1, 1):
        p.ball((side * (width / 2 + 0.52), rail, 0.13), (0.03, 0.03, 0.03), BRASS)
        for k in range(7):
            x = side * (width / 2 - 0.06 + k * 0.075)
            fold = 0.05 + 0.014 * math.sin(2.2 * k)
            p.rod((x, 0.05, 0.13), (x, rail - 0.01, 0.13), 0.047, fabric(curtain, scale=2), depth=fold, seed=k)


def radiator(p: Placement, width: float) -> None:
    """Add a ribbed radiator under a window, against the wall at z = 0."""
    count = int(width / 0.075)
    for k in range(count):
        p.box(((k - (count - 1) / 2) * 0.075, 0.4, 0.09), (0.05, 0.56, 0.085), WHITE_PAINT, seed=k)
    for height in (0.17, 0.63):
        p.rod((-width / 2, height, 0.09), (width / 2, height, 0.09), 0.022, WHITE_PAINT)
    p.rod((width / 2, 0, 0.09), (width / 2, 0.17, 0.09), 0.015, STEEL)


def door(p: Placement, color: str, *, width: float = 0.86, height: float = 2.05) -> None:
    """Add a closed panelled door with its frame on the wall at z = 0."""
    leaf = plain(color, shade=0.9)
    p.box((0, height / 2, 0.02), (width, height, 0.04), leaf)
    for x in (-0.2, 0.2):
        for low, high in ((0.15, 0.85), (1.0, 1.85)):
            p.box((x, (low + high) / 2, 0.045), (0.27, high - low, 0.012), plain(darker(color, 0.88)))
            p.box((x, (low + high) / 2, 0.05), (0.2, high - low - 0.08, 0.014), leaf)
    door_frame(p, width, height, WHITE_PAINT, depth=0.06)
    p.rod((width / 2 - 0.07, 1.02, 0.04), (width / 2 - 0.07, 1.02, 0.1), 0.011, BRASS)
    p.rod((width / 2 - 0.18, 1.02, 0.1), (width / 2 - 0.06, 1.02, 0.1), 0.011, BRASS)
    p.box((width / 2 - 0.07, 1.0, 0.044), (0.05, 0.2, 0.01), BRASS)


def door_frame(p: Placement, width: float, height: float, paint: Material, *, depth: float) -> None:
    """Add the frame around an opening."""
    for side in (-1, 1):
        p.box((side * (width / 2 + 0.045), height / 2, depth / 2), (0.09, height, depth), paint)
    p.box((0, height + 0.05, depth / 2), (width + 0.22, 0.1, depth + 0.02), paint)


def cupboard(p: Placement, width: float, height: float, depth: float, wood: Material = OAK, *, doors: int = 3) -> None:
    """Add a cupboard with doors and knobs, its back at z = 0."""
    p.span((-width / 2, 0.08, 0), (width / 2, height - 0.03, depth), wood)
    p.span((-width / 2 - 0.02, height - 0.03, 0), (width / 2 + 0.02, height, depth + 0.02), wood, seed=2)
    p.span((-width / 2 + 0.03, 0, 0.03), (width / 2 - 0.03, 0.08, depth - 0.05), DARK_METAL)
    each = width / doors
    for k in range(doors):
        x = -width / 2 + each * (k + 0.5)
        p.box((x, height / 2 + 0.02, depth + 0.009), (each - 0.02, height - 0.17, 0.018), wood, seed=4 + k)
        knob = x + (0.4 if k % 2 == 0 else -0.4) * (each - 0.06)
        p.ball((knob, 0.58 * height, depth + 0.03), (0.016, 0.016, 0.018), BRASS)


def television(p: Placement, width: float) -> None:
    """Add a television on its foot, standing on height 0 and facing +z."""
    height = width * 0.57
    p.box((0, 0.012, 0.14), (0.4, 0.024, 0.2), DARK_METAL)
    p.box((0, 0.07, 0.12), (0.08, 0.12, 0.04), DARK_METAL)
    p.box((0, 0.09 + height / 2, 0.13), (width, height, 0.04), DARK_METAL)
    screen = Material(Texture.PICTURE, "#3a6ea5", "#10243f", glow=0.5)
    p.sheet((0, 0.09 + height / 2, 0.152), width - 0.03, height - 0.03, screen, seed=12)


def vase(p: Placement, color: str, *, flowers: str | None = None) -> None:
    """Add a vase, with flowers of one colour if asked."""
    glaze = plain(color)
    p.rod((0, 0, 0), (0, 0.1, 0), 0.045, glaze, end_radius=0.075)
    p.rod((0, 0.1, 0), (0, 0.2, 0), 0.075, glaze, end_radius=0.032)
    p.rod((0, 0.2, 0), (0, 0.23, 0), 0.032, glaze, end_radius=0.045)
    if flowers is None:
        return
    for k in range(6):
        angle = 2.4 * k
        tip = (0.09 * math.cos(angle), 0.38 + 0.05 * (k % 3), 0.09 * math.sin(angle))
        p.rod((0, 0.2, 0), tip, 0.004, DARK_LEAVES)
        p.ball(tip, (0.038, 0.028, 0.038), plain(flowers), seed=k)


def fruit_bowl(p: Placement) -> None:
    """Add a bowl of fruit."""
    p.rod((0, 0, 0), (0, 0.07, 0), 0.06, Material(Texture.WOOD, "#8a5a2e", "#55341a"), end_radius=0.14)
    for k, color in enumerate(("#d94f30", "#e8b23a", "#7aa23f", "#e07a2d", "#c23b3b")):
        angle = 1.26 * k
        p.ball(
            (0.065 * math.cos(angle), 0.085, 0.065 * math.sin(angle)),
            (0.04, 0.038, 0.04),
            plain(color),
            seed=k,
        )


def mug(p: Placement, color: str) -> None:
    """Add a mug with a handle."""
    p.rod((0, 0, 0), (0, 0.095, 0), 0.038, plain(color), end_radius=0.041)
    p.rod((0, 0.085, 0), (0, 0.0955, 0), 0.035, SOIL)
    p.box((0.052, 0.05, 0), (0.03, 0.05, 0.012), plain(color))


def book_stack(p: Placement, count: int, rng: np.random.Generator) -> None:
    """Add lying books."""
    level = 0.0
    for _ in range(count):
        thick, turn = float(rng.uniform(0.018, 0.04)), float(rng.uniform(-25, 25))
        cover = Material(Texture.BOOK, BOOK_COLORS[rng.integers(len(BOOK_COLORS))], "#f0e3c0")
        size = (float(rng.uniform(0.16, 0.22)), thick, float(rng.uniform(0.22, 0.28)))
        p.at(0, 0, turn).box((0, level + thick / 2, 0), size, cover, seed=int(rng.integers(1000)))
        level += thick


def clock(p: Placement, centre: float) -> None:
    """Hang a round clock on the wall at z = 0."""
    p.rod((0, centre, 0), (0, centre, 0.03), 0.15, DARK_METAL)
    p.rod((0, centre, 0.03), (0, centre, 0.032), 0.135, CERAMIC)
    p.box((0.0, centre + 0.035, 0.036), (0.012, 0.08, 0.004), DARK_METAL)
    p.box((0.045, centre, 0.036), (0.1, 0.01, 0.004), DARK_METAL)
    for k in range(12):
        angle = math.pi * k / 6
        p.box(
            (0.115 * math.sin(angle), centre + 0.115 * math.cos(angle), 0.035),
            (0.012, 0.012, 0.003),
            DARK_METAL,
        )
