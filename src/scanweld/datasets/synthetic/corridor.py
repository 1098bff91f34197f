"""The corridor loop: four furnished rooms at the corners of a rectangle, joined by four corridors.

Seen from above, x to the right and z up; the camera walks A, B, C, D:

    D bedroom  ---- gallery ----  C kitchen       z = 9.9
       |                             |
    passage                        cloakroom
       |                             |
    A living   ---- hallway ----  B study         z = 2.1
    x = 2.1                       x = 12.9
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from scanweld.arrays import Float64
from scanweld.datasets.synthetic import furniture as f
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.scene import Material, Placement, Scene, Texture, new_placement
from scanweld.datasets.synthetic.spaces import (
    CEILING,
    Style,
    ceiling_lamp,
    pilasters,
    plaster,
    room_lights,
    space,
)

LOW_X, HIGH_X, LOW_Z, HIGH_Z = 2.1, 12.9, 2.1, 9.9
TURN_RADIUS_M = 1.4


def centre_line(phase: Float64) -> tuple[Float64, Float64]:
    """Return where the camera walks: (x, z) positions (N, 2) [m] and headings (N,) [rad, 90 degrees is +x].

    `phase` 0..2 pi is once around the rectangle of the rooms' middles, whose corners are rounded; everything
    is smoothed over half a metre, so that the camera turns in gently.
    """
    count = 1024
    a, b = HIGH_X - LOW_X - 2 * TURN_RADIUS_M, HIGH_Z - LOW_Z - 2 * TURN_RADIUS_M
    quarter = TURN_RADIUS_M * np.pi / 2
    lengths = np.array([a, quarter, b, quarter, a, quarter, b, quarter])
    ends = np.cumsum(lengths)
    # The start is 2.4 m before the hallway, on the way into room A.
    s = (np.arange(count) / count * ends[-1] + ends[-1] - quarter - 0.2) % ends[-1]
    turned = np.zeros(count)
    for leg in (1, 3, 5, 7):
        turned += np.clip((s - ends[leg] + quarter) / quarter, 0, 1) * np.pi / 2
    heading = np.pi / 2 - turned
    step = ends[-1] / count
    velocity = np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    waves = np.fft.rfftfreq(count, step)
    soften = np.exp(-2 * (np.pi * waves * 0.35) ** 2)
    velocity = np.fft.irfft(np.fft.rfft(velocity, axis=0) * soften[:, None], count, axis=0)
    velocity -= velocity.mean(axis=0)  # a closed line
    position = (np.cumsum(velocity, axis=0) - velocity / 2) * step
    middle = np.array([(LOW_X + HIGH_X) / 2, (LOW_Z + HIGH_Z) / 2])
    position += middle - (position.max(axis=0) + position.min(axis=0)) / 2
    grid = np.arange(count + 1) / count * 2 * np.pi
    spline = CubicSpline(grid, np.concatenate([position, position[:1]]), bc_type="periodic")
    tangent = spline(phase, 1)
    return np.asarray(spline(phase)), np.arctan2(tangent[..., 0], tangent[..., 1])


def build_corridor(seed: int) -> Scene:
    """Build the loop; `seed` chooses books, leaves and the like."""
    rng = np.random.default_rng([seed, 2])
    root = new_placement()
    _living(root, rng)
    _study(root, rng)
    _kitchen(root, rng)
    _bedroom(root, rng)
    _hallway(root, rng)
    _cloakroom(root, rng)
    _gallery(root, rng)
    _passage(root, rng)
    return assemble("corridor", root, (0.12, 0.118, 0.115))


PARQUET = Material(Texture.PARQUET, "#cf9f68", "#8c5b30")
DARK_PARQUET = Material(Texture.PARQUET, "#9a6a45", "#5a3820", 0.8)
ROOM_SIZE = 4.0


def _living(root: Placement, rng: np.random.Generator) -> None:
    """Room A: sofa, shelves, rug."""
    walls = (
        Material(Texture.STRIPES, "#7a8fa6", "#a9b9c6"), plaster("#d9b77e", "#c69a5c"),
        plaster("#e6dcc8", "#d3c3a4"), plaster("#e6dcc8", "#d3c3a4"),
    )  # fmt: skip
    s = space(root.at(LOW_X, LOW_Z), ROOM_SIZE, ROOM_SIZE, Style(floor=PARQUET, walls=walls), "fr")
    f.sofa(s.back.at(-0.3, 0.05), 2.0, "#6a8f6b", ("#e0a33e", "#b56576", "#efe3c8"))
    f.framed_picture(s.back.at(-0.75, 0), 0.6, 0.45, 1.55, "#f0b35a", "#264653", seed=51)
    f.framed_picture(s.back.at(0.1, 0), 0.5, 0.65, 1.6, "#dfe8ee", "#7a3b3b", seed=52, frame=f.BRASS)
    f.rug(s.middle.at(-0.5, -0.5), 1.9, 1.3, "#2f5d62", "#e7d7b1", seed=2)
    f.bookshelf(s.left.at(0.35, 0), 1.5, 2.0, rng)
    f.floor_lamp(s.middle.at(1.65, -1.65))
    f.potted_plant(s.middle.at(-1.6, 1.55), 1.1, rng, spread=0.4)
    f.potted_plant(s.middle.at(-1.62, -1.2), 0.9, rng, spread=0.4, pot="#5b6f7a")
    side = s.middle.at(1.65, 1.65)
    f.table(side, 0.5, 0.5, 0.55, f.WALNUT)
    f.vase(side.at(0, 0, height=0.55), "#8c2f2b", flowers="#f2c078")
    f.framed_picture(s.right.at(1.3, 0), 0.5, 0.7, 1.55, "#f6d5b0", "#2f5d62", seed=53)
    f.framed_picture(s.front.at(1.35, 0), 0.6, 0.6, 1.6, "#cfe0dc", "#6d4c6f", seed=54, frame=f.OAK)
    room_lights(s.middle)


def _study(root: Placement, rng: np.random.Generator) -> None:
    """Room B: desk, shelves on two walls, a chest."""
    walls = (
        plaster("#8fa98f", "#6f8f74"), plaster("#e9dfc9", "#d6c6a3"),
        plaster("#e9dfc9", "#d6c6a3"), Material(Texture.BRICK, "#b0634a", "#d3c8b6"),
    )  # fmt: skip
    s = space(root.at(HIGH_X, LOW_Z), ROOM_SIZE, ROOM_SIZE, Style(floor=DARK_PARQUET, walls=walls), "lf")
    desk = s.right.at(0.0, 0.4)
    f.table(desk, 1.5, 0.7, 0.75, f.OAK)
    f.television(desk.at(0.1, -0.25, height=0.75), 0.62)
    f.book_stack(desk.at(-0.55, 0.05, height=0.75), 4, rng)
    f.mug(desk.at(0.55, 0.1, height=0.75), "#c8553d")
    desk.box((0.1, 0.76, 0.16), (0.42, 0.02, 0.14), Material(Texture.PRINT, "#2a2c30", "#6b7078"), seed=3)
    f.chair(s.right.at(0.1, 0.98, 170), f.WALNUT, "#b56576")
    f.bookshelf(s.back.at(0.6, 0), 1.8, 2.1, rng, f.PINE)
    f.framed_picture(s.back.at(-1.2, 0), 0.8, 0.6, 1.55, "#f3efe6", "#385f8f", seed=61, texture=Texture.PRINT)
    f.cupboard(s.back.at(-1.25, 0.0), 1.0, 0.8, 0.38, f.PINE, doors=2)
    s.back.at(-1.25, 0.18, height=0.8).ball(
        (0, 0.2, 0), (0.15, 0.15, 0.15), Material(Texture.LEAF, "#3d6b8e", "#9db17c")
    )
    s.back.at(-1.25, 0.18, height=0.8).rod((0, 0, 0), (0, 0.06, 0), 0.09, f.BRASS, end_radius=0.04)
    f.framed_picture(s.right.at(-0.55, 0), 0.45, 0.6, 1.62, "#efe6cf", "#5b7553", seed=62, frame=f.DARK_METAL)
    f.framed_picture(s.right.at(0.75, 0), 0.6, 0.42, 1.7, "#e9c46a", "#8c3b4a", seed=63, frame=f.OAK)
    f.rug(s.middle.at(0.3, 0.1), 1.8, 1.4, "#27374d", "#d8c4a0", seed=8)
    f.potted_plant(s.middle.at(1.6, 1.55), 1.3, rng, spread=0.4)
    f.cupboard(s.left.at(-1.4, 0), 0.9, 1.1, 0.4, f.WALNUT, doors=2)
    f.vase(s.left.at(-1.4, 0.2, height=1.1), "#e0a33e")
    f.framed_picture(s.front.at(-1.3, 0), 0.6, 0.8, 1.55, "#f0d9b5", "#3b3a3c", seed=64, texture=Texture.PRINT)
    room_lights(s.middle)


def _kitchen(root: Placement, rng: np.random.Generator) -> None:
    """Room C: counters along two walls, a tall fridge, a small table."""
    tiled = Material(Texture.TILES, "#dfe8e4", "#9ec3bd", 0.5)
    walls = (plaster("#f0e2bd", "#e2c98d"), plaster("#f0e2bd", "#e2c98d"), tiled, tiled)
    floor = Material(Texture.TILES, "#d8d2c4", "#77706a", 1.0)
    s = space(root.at(HIGH_X, HIGH_Z), ROOM_SIZE, ROOM_SIZE, Style(floor=floor, walls=walls), "bl")
    front, counter = f.plain("#4f7d7a"), Material(Texture.PLASTER, "#4a4641", "#6b645c")
    for wall, x, width in ((s.right, -0.35, 2.6), (s.front, 0.55, 1.7)):
        f.cupboard(wall.at(x, 0), width, 0.88, 0.58, front, doors=round(width / 0.6))
        wall.at(x, 0).span((-width / 2 - 0.01, 0.88, 0), (width / 2 + 0.01, 0.92, 0.62), counter)
    for k, x in enumerate((-1.2, -0.3, 0.6)):
        upper = s.right.at(x, 0)
        upper.span((-0.42, 1.55, 0), (0.42, 2.2, 0.33), front, seed=k)
        for side in (-1, 1):
            upper.box((side * 0.21, 1.875, 0.335), (0.38, 0.6, 0.014), f.plain("#5c8f8a"), seed=k)
            upper.ball((side * 0.06, 1.62, 0.355), (0.014, 0.014, 0.014), f.BRASS)
    s.front.span((-1.15, 0, 0), (-0.45, 1.85, 0.62), f.STEEL)
    s.front.span((-1.14, 0.62, 0.62), (-0.46, 0.64, 0.626), f.DARK_METAL)
    s.front.rod((-0.52, 0.75, 0.66), (-0.52, 1.2, 0.66), 0.012, f.DARK_METAL)
    for k, (x, height) in enumerate(((-1.0, 1.5), (-0.75, 1.35), (-0.92, 1.2))):
        s.front.box((x, height, 0.622), (0.12, 0.15, 0.003), Material(Texture.PRINT, "#f3efe6", "#c8553d"), seed=k)
    on_top = s.right.at(0, 0.3, height=0.92)
    f.fruit_bowl(on_top.at(-1.2, 0))
    on_top.rod((0.1, 0, 0), (0.1, 0.18, 0), 0.09, f.plain("#b5413a"), end_radius=0.1)
    on_top.rod((0.1, 0.18, 0), (0.1, 0.2, 0), 0.1, f.STEEL)
    f.mug(on_top.at(-0.6, 0.05), "#e0a33e")
    f.mug(on_top.at(-0.45, -0.05), "#385f8f")
    f.vase(s.front.at(0.2, 0.3, height=0.92), "#6d4c6f", flowers="#e8b23a")
    f.books(s.front.at(0.8, 0.02, height=0.92), 0.6, 0.26, 0.2, rng)
    s.front.span((0.0, 1.5, 0), (1.3, 1.53, 0.22), f.OAK)
    for k in range(6):
        f.mug(s.front.at(0.12 + 0.2 * k, 0.11, height=1.53), f.FABRIC_COLORS[k])
    small = s.middle.at(-1.4, -1.45)
    f.table(small, 0.7, 0.7, 0.75, f.PINE)
    f.vase(small.at(0, 0, height=0.75), "#f3efe6", flowers="#d7536a")
    f.chair(s.middle.at(-1.45, -0.9, 178), f.PINE, "#e0a33e")
    f.framed_picture(s.back.at(-1.3, 0), 0.6, 0.5, 1.6, "#e7e0cf", "#c8553d", seed=71, frame=f.PINE)
    f.clock(s.left.at(1.35, 0), 1.8)
    f.potted_plant(s.middle.at(1.55, -1.6), 1.0, rng, spread=0.4)
    room_lights(s.middle, "#f4f6ff")


def _bedroom(root: Placement, rng: np.random.Generator) -> None:
    """Room D: bed, wardrobe, window with curtains."""
    walls = (
        plaster("#c9b3c4", "#b193ab"), Material(Texture.STRIPES, "#c98f7a", "#e3bba4"),
        plaster("#8aa1b8", "#6c87a3"), plaster("#c9b3c4", "#b193ab"),
    )  # fmt: skip
    s = space(root.at(LOW_X, HIGH_Z), ROOM_SIZE, ROOM_SIZE, Style(floor=PARQUET, walls=walls), "br")
    bed = s.left.at(-0.75, 0)
    bed.span((-0.75, 0, 0), (0.75, 1.05, 0.06), f.WALNUT)
    bed.span((-0.7, 0.15, 0.06), (0.7, 0.38, 1.35), f.WALNUT, seed=2)
    bed.span((-0.68, 0.38, 0.06), (0.68, 0.56, 1.33), f.fabric("#efe8da"))
    bed.span((-0.71, 0.34, 0.55), (0.71, 0.585, 1.37), Material(Texture.STRIPES, "#3d6b8e", "#d8c4a0", 1.4))
    for k, x in enumerate((-0.36, 0.36)):
        bed.ball((x, 0.63, 0.3), (0.3, 0.09, 0.18), f.fabric("#f3efe6"), seed=k)
        bed.ball((x, 0.68, 0.42), (0.2, 0.08, 0.13), f.fabric(("#b56576", "#e0a33e")[k]), axis=(0, 1, 0.5), seed=k)
    f.window(s.front.at(-0.1, 0), 1.3, 1.15, 0.95, "#5b7553", CEILING)
    f.radiator(s.front.at(-0.1, 0), 1.0)
    f.cupboard(s.left.at(0.95, 0), 1.1, 2.0, 0.5, f.PINE, doors=2)
    f.framed_picture(s.left.at(-0.75, 0), 0.9, 0.5, 1.6, "#f3d9c9", "#27374d", seed=81, frame=f.OAK)
    f.rug(s.middle.at(-0.1, -0.2), 1.5, 1.1, "#6d4c6f", "#eadfc6", seed=5)
    f.framed_picture(s.right.at(-1.35, 0), 0.55, 0.75, 1.55, "#dfe8ee", "#5c7a4a", seed=82)
    f.framed_picture(s.back.at(1.35, 0), 0.6, 0.6, 1.6, "#f0b35a", "#6d4c6f", seed=83, frame=f.BRASS)
    night = s.middle.at(1.55, -1.6)
    f.table(night, 0.55, 0.5, 0.6, f.WALNUT)
    f.book_stack(night.at(0, 0, height=0.6), 4, rng)
    f.potted_plant(s.middle.at(1.55, 1.55), 1.2, rng, spread=0.4, pot="#8c2f2b")
    room_lights(s.middle, "#ffe6cc")


def _hallway(root: Placement, rng: np.random.Generator) -> None:
    """From A to B: panelled, with console, bench and portraits."""
    green = plaster("#b9c4a3", "#9cab80")
    style = Style(floor=DARK_PARQUET, walls=(green,) * 4, panel=Material(Texture.PAINT, "#e8e1cf", "#d8cdb2"))
    length, width = HIGH_X - LOW_X - ROOM_SIZE - 0.4, 2.0
    s = space(root.at((LOW_X + HIGH_X) / 2, LOW_Z), length, width, style, "lr")
    f.rug(s.middle, length - 1.0, 0.9, "#8f3b37", "#e4cfa5", seed=4)
    pilasters(s.middle, width / 2, f.WHITE_PAINT)
    console = s.back.at(-1.6, 0.17)
    f.table(console, 1.0, 0.3, 0.8, f.WALNUT)
    f.vase(console.at(-0.3, 0, height=0.8), "#3d6b8e", flowers="#d7536a")
    f.book_stack(console.at(0.25, 0, height=0.8), 3, rng)
    f.framed_picture(s.back.at(-1.6, 0), 0.7, 0.5, 1.6, "#f0b35a", "#2c4f5e", seed=91, frame=f.BRASS)
    for k, x in enumerate((-2.65, 0.75, 1.5, 2.4)):
        first, second = (
            ("#e7e0cf", "#40566b"),
            ("#f3d9c9", "#8c3b4a"),
            ("#cfe0dc", "#5b7553"),
            ("#efe6cf", "#704214"),
        )[k]
        f.framed_picture(s.back.at(x, 0), 0.42, 0.55, 1.62, first, second, seed=92 + k, frame=(f.OAK, f.WALNUT)[k % 2])
    s.back.box((1.6, 0.24, 0.18), (1.2, 0.06, 0.34), f.OAK)
    for x in (1.1, 2.1):
        s.back.box((x, 0.11, 0.18), (0.06, 0.22, 0.3), f.OAK)
    s.back.ball((1.35, 0.33, 0.18), (0.2, 0.08, 0.14), f.fabric("#c8553d"))
    f.radiator(s.front.at(-1.7, 0.02), 1.0)
    f.door(s.front.at(1.5, 0.012), "#b98a50")
    for k, x in enumerate((-2.5, -1.7, -0.85, 0.6, 2.5)):
        first, second = f.BOOK_COLORS[(3 * k) % 16], f.BOOK_COLORS[(3 * k + 9) % 16]
        f.framed_picture(s.front.at(x, 0), 0.5, 0.4, 1.6, first, second, seed=97 + k, frame=f.DARK_METAL)
    f.potted_plant(s.back.at(2.85, 0.28), 0.95, rng, spread=0.26)
    f.potted_plant(s.front.at(-2.85, 0.28), 0.8, rng, spread=0.26, pot="#31566b")
    for x in (-2.2, 0.75, 2.4):
        ceiling_lamp(s.middle.at(x, 0))
    ceiling_lamp(s.middle.at(-0.75, 0))


def _cloakroom(root: Placement, rng: np.random.Generator) -> None:
    """From B to C: coats, shoes, posters."""
    walls = (plaster("#d8a67c", "#c08552"), Material(Texture.STRIPES, "#e4d3ae", "#c9a66b"),
             plaster("#d8a67c", "#c08552"), plaster("#d8a67c", "#c08552"))  # fmt: skip
    depth = HIGH_Z - LOW_Z - ROOM_SIZE - 0.4
    floor = Material(Texture.TILES, "#b5654a", "#8f4a36", 0.7)
    s = space(root.at(HIGH_X, (LOW_Z + HIGH_Z) / 2), 2.2, depth, Style(floor=floor, walls=walls), "bf")
    s.right.box((0, 1.75, 0.015), (2.2, 0.1, 0.03), f.WALNUT)
    for k in range(6):
        x = -0.9 + 0.36 * k
        s.right.rod((x, 1.74, 0.03), (x, 1.78, 0.1), 0.012, f.BRASS)
        if k != 3:
            cloth = f.fabric(f.FABRIC_COLORS[k])
            s.right.rod((x, 0.85, 0.11), (x, 1.7, 0.11), 0.15, cloth, end_radius=0.06, depth=0.09, seed=k)
    s.right.box((0, 0.42, 0.17), (1.9, 0.05, 0.32), f.OAK)
    for x in (-0.9, 0.0, 0.9):
        s.right.box((x, 0.2, 0.17), (0.04, 0.4, 0.3), f.OAK)
    for k in range(7):
        color = f.BOOK_COLORS[(5 * k + 2) % 16]
        s.right.ball((-0.75 + 0.24 * k, 0.06, 0.2), (0.05, 0.06, 0.13), f.plain(color), seed=k)
    f.cupboard(s.left.at(-0.6, 0), 1.1, 0.85, 0.34, f.WALNUT, doors=3)
    f.vase(s.left.at(-0.85, 0.16, height=0.85), "#f3efe6", flowers="#b56576")
    f.book_stack(s.left.at(-0.35, 0.16, height=0.85), 3, rng)
    f.framed_picture(s.left.at(-0.6, 0), 0.7, 0.55, 1.6, "#cfe0dc", "#385f8f", seed=110, frame=f.OAK)
    f.framed_picture(s.left.at(0.6, 0), 0.6, 0.85, 1.5, "#f3efe6", "#c8553d", seed=111, texture=Texture.PRINT)
    f.potted_plant(s.left.at(1.35, 0.3), 1.2, rng, spread=0.26)
    f.rug(s.middle, 0.9, 2.2, "#27374d", "#d9cfb8", seed=6)
    for z in (-0.9, 0.9):
        ceiling_lamp(s.middle.at(0, z), 0.6)


def _gallery(root: Placement, rng: np.random.Generator) -> None:
    """From C to D: a brick wall with prints, low shelves, lockers."""
    walls = (Material(Texture.BRICK, "#a8553c", "#cfc4b2"), plaster("#e9e3d3", "#d6cbb0"),
             plaster("#a9bccb", "#87a0b5"), plaster("#e9e3d3", "#d6cbb0"))  # fmt: skip
    length, width = HIGH_X - LOW_X - ROOM_SIZE - 0.4, 2.2
    s = space(root.at((LOW_X + HIGH_X) / 2, HIGH_Z), length, width, Style(floor=PARQUET, walls=walls), "lr")
    pilasters(s.middle.at(-0.2, 0), width / 2, Material(Texture.BRICK, "#b0634a", "#d3c8b6"))
    for k in range(5):
        x = -2.5 + 1.2 * k
        first, second = f.BOOK_COLORS[(4 * k + 1) % 16], f.BOOK_COLORS[(4 * k + 10) % 16]
        kind = Texture.PRINT if k % 2 else Texture.PICTURE
        f.framed_picture(s.back.at(x, 0), 0.62, 0.8, 1.5, first, second, seed=120 + k, texture=kind, frame=f.DARK_METAL)
    for k, color in enumerate(("#c8553d", "#e0a33e", "#2f6f73", "#385f8f", "#6a994e")):
        x = 2.4 - 0.42 * k
        s.front.span((x - 0.2, 0.05, 0), (x + 0.2, 1.75, 0.34), f.plain(color), seed=k)
        s.front.box((x, 1.5, 0.343), (0.24, 0.14, 0.01), f.plain(f.darker(color, 0.6)))
        s.front.box((x + 0.14, 1.0, 0.35), (0.02, 0.12, 0.02), f.STEEL)
    f.bookshelf(s.front.at(-1.6, 0), 1.8, 0.95, rng, f.OAK, shelves=2)
    f.vase(s.front.at(-2.2, 0.15, height=0.95), "#31566b")
    f.vase(s.front.at(-1.0, 0.15, height=0.95), "#c8553d", flowers="#e8b23a")
    f.framed_picture(s.front.at(-1.6, 0), 0.9, 0.55, 1.6, "#f6d5b0", "#6d4c6f", seed=130, frame=f.OAK)
    f.potted_plant(s.back.at(2.85, 0.3), 1.0, rng, spread=0.26)
    f.potted_plant(s.back.at(-1.9, 0.28), 0.7, rng, spread=0.26, pot="#5b6f7a")
    f.potted_plant(s.front.at(-2.85, 0.3), 1.3, rng, spread=0.26)
    for x in (-2.3, -0.9, 0.7, 2.2):
        ceiling_lamp(s.middle.at(x, 0))


def _passage(root: Placement, rng: np.random.Generator) -> None:
    """From D back to A: a window, plants, a chest of drawers."""
    blue = plaster("#d4dde0", "#b6c6cd")
    panel = Material(Texture.WOOD, "#b98a50", "#8a5a2e")
    depth = HIGH_Z - LOW_Z - ROOM_SIZE - 0.4
    s = space(
        root.at(LOW_X, (LOW_Z + HIGH_Z) / 2),
        2.0,
        depth,
        Style(floor=DARK_PARQUET, walls=(blue,) * 4, panel=panel),
        "bf",
    )
    f.window(s.left.at(0.1, 0.02), 1.1, 1.1, 1.02, "#c9765a", CEILING)
    f.potted_plant(s.left.at(-1.35, 0.27), 1.2, rng, spread=0.26)
    f.cupboard(s.right.at(-0.5, 0.02), 1.2, 0.8, 0.34, f.PINE, doors=3)
    f.vase(s.right.at(-0.8, 0.2, height=0.8), "#6a994e", flowers="#f1e9da")
    f.fruit_bowl(s.right.at(-0.3, 0.18, height=0.8))
    f.framed_picture(s.right.at(-0.5, 0), 0.9, 0.6, 1.6, "#e9c46a", "#264653", seed=140)
    f.framed_picture(s.right.at(0.85, 0), 0.5, 0.65, 1.6, "#f3d9c9", "#40566b", seed=141, frame=f.BRASS)
    f.rug(s.middle, 0.85, 2.3, "#5b7553", "#eadfc6", seed=9)
    for z in (-0.9, 0.9):
        ceiling_lamp(s.middle.at(0, z), 0.6)
