"""The furnished room, built around the camera path kt0 of ICL-NUIM's living room.

In that path's own frame, where the heights are up, the camera stays in x 1.04..1.54 m, height 0.54..1.75 m,
z -0.25..1.60 m. Heights up and (x, z) are what builders use here, so the path fits as it is.
"""

from __future__ import annotations

import numpy as np

from scanweld.datasets.synthetic import furniture as f
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.scene import Material, Placement, Scene, Texture, new_placement

LOW_X, HIGH_X, LOW_Z, HIGH_Z, CEILING = -1.4, 3.8, -2.7, 3.0, 2.6


def build_room(seed: int) -> Scene:
    """Build the furnished room; `seed` chooses books, leaves and the like."""
    rng = np.random.default_rng([seed, 1])
    root = new_placement()
    _shell(root)
    _seating(root, rng)
    _east(root.at(HIGH_X, 0.0, -90), rng)
    _west(root.at(LOW_X, 0.0, 90), rng)
    _south(root.at(1.2, HIGH_Z, 180), rng)
    _dining(root, rng)
    _lights(root)
    return assemble("room", root, (0.10, 0.098, 0.1))


def _shell(p: Placement) -> None:
    """Floor, walls, ceiling with beams, skirting, cornice."""
    width, depth = HIGH_X - LOW_X, HIGH_Z - LOW_Z
    x, z, t = (LOW_X + HIGH_X) / 2, (LOW_Z + HIGH_Z) / 2, 0.1
    floor = Material(Texture.PARQUET, "#cf9f68", "#8c5b30")
    p.box((x, -t / 2, z), (width + 2 * t, t, depth + 2 * t), floor)
    p.box(
        (x, CEILING + t / 2, z),
        (width + 2 * t, t, depth + 2 * t),
        Material(Texture.PLASTER, "#f2eee4", "#e2dccd"),
    )
    teal = Material(Texture.STRIPES, "#5f8f8b", "#87b0a6")
    brick = Material(Texture.BRICK, "#a8553c", "#cfc4b2")
    cream = Material(Texture.PLASTER, "#ecd9ad", "#dcc189")
    blue = Material(Texture.PLASTER, "#b9c7d6", "#97abc2")
    p.box((x, CEILING / 2, LOW_Z - t / 2), (width, CEILING, t), teal, seed=1)
    p.box((x, CEILING / 2, HIGH_Z + t / 2), (width, CEILING, t), cream, seed=2)
    p.box((HIGH_X + t / 2, CEILING / 2, z), (t, CEILING, depth), brick, seed=3)
    p.box((LOW_X - t / 2, CEILING / 2, z), (t, CEILING, depth), blue, seed=4)
    for low, high, thick, deep in ((0.0, 0.1, 0.018, 0.018), (CEILING - 0.07, CEILING, 0.05, 0.05)):
        p.span((LOW_X, low, LOW_Z), (HIGH_X, high, LOW_Z + deep), f.WHITE_PAINT)
        p.span((LOW_X, low, HIGH_Z - deep), (HIGH_X, high, HIGH_Z), f.WHITE_PAINT)
        p.span((LOW_X, low, LOW_Z), (LOW_X + thick, high, HIGH_Z), f.WHITE_PAINT)
        p.span((HIGH_X - thick, low, LOW_Z), (HIGH_X, high, HIGH_Z), f.WHITE_PAINT)
    for k, at in enumerate((-1.75, -0.55, 0.65, 1.85)):
        p.box((x, CEILING - 0.06, at), (width, 0.12, 0.12), f.WALNUT, seed=k)
    for at in (-1.15, 0.05, 1.25):
        for across in (0.1, 1.3, 2.5):
            p.rod((across, CEILING - 0.02, at), (across, CEILING, at), 0.06, f.STEEL)
            p.rod((across, CEILING - 0.024, at), (across, CEILING - 0.02, at), 0.045, f.LAMP_GLOW)


def _seating(p: Placement, rng: np.random.Generator) -> None:
    """Sofa, low table, armchair and pictures before the striped wall."""
    f.sofa(p.at(1.1, LOW_Z + 0.06), 2.2, "#59718f", ("#e0a33e", "#c8553d", "#d8c4a0", "#2f6f73"))
    f.rug(p.at(1.2, -1.0), 2.5, 1.7, "#8f3b37", "#e4cfa5", seed=3)
    low = p.at(1.2, -1.15)
    f.table(low, 1.1, 0.6, 0.42, f.OAK)
    top = low.at(0, 0, height=0.42)
    f.fruit_bowl(top.at(0.28, 0.05))
    f.book_stack(top.at(-0.3, 0.08), 3, rng)
    f.mug(top.at(0.02, 0.17), "#2f6f73")
    f.mug(top.at(-0.1, -0.12, 70), "#e0a33e")
    f.vase(top.at(0.02, -0.1), "#d8d2c6", flowers="#d7536a")
    f.book_stack(low.at(0.2, 0, height=0.15), 4, rng)
    f.armchair(p.at(3.0, -1.15, -72), "#b4613f", "#efe3c8")
    f.floor_lamp(p.at(3.4, -2.3))
    side = p.at(-0.55, -2.25)
    f.table(side, 0.5, 0.45, 0.5, f.WALNUT)
    f.vase(side.at(0.1, 0.02, height=0.5), "#31566b")
    f.book_stack(side.at(-0.1, 0, height=0.5), 3, rng)
    f.potted_plant(p.at(-0.95, -1.55), 1.25, rng, spread=0.44)
    wall = p.at(0, LOW_Z)
    f.framed_picture(wall.at(0.45, 0), 0.7, 0.5, 1.6, "#f0b35a", "#2c4f5e", seed=3)
    f.framed_picture(wall.at(1.3, 0), 0.5, 0.66, 1.64, "#dfe8ee", "#5c7a4a", seed=8, frame=f.BRASS)
    f.framed_picture(wall.at(1.98, 0), 0.42, 0.42, 1.72, "#f3d9c9", "#8c3b4a", seed=5, frame=f.OAK)
    f.framed_picture(wall.at(1.98, 0), 0.42, 0.28, 1.27, "#e7e0cf", "#40566b", seed=14, frame=f.OAK)
    wall.span((-1.25, 1.35, 0), (-0.2, 1.375, 0.2), f.OAK)
    wall.span((-1.25, 1.75, 0), (-0.2, 1.775, 0.2), f.OAK)
    f.books(wall.at(-0.85, 0, height=1.375), 0.7, 0.28, 0.18, rng)
    f.vase(wall.at(-0.35, 0.1, height=1.375), "#b5653f")
    f.books(wall.at(-0.6, 0, height=1.775), 0.6, 0.26, 0.18, rng)
    f.vase(wall.at(-1.08, 0.1, height=1.775), "#6a994e", flowers="#e8b23a")


def _east(p: Placement, rng: np.random.Generator) -> None:
    """The brick wall, seen with its left at negative x: shelves, picture, chest."""
    f.bookshelf(p.at(0.35, 0), 1.7, 2.05, rng)
    f.potted_plant(p.at(1.6, 0.34), 1.0, rng, pot="#5b6f7a", spread=0.32)
    f.framed_picture(p.at(1.62, 0), 0.55, 0.75, 1.6, "#f2e2c4", "#3d6b8e", seed=21, frame=f.DARK_METAL)
    chest = p.at(-1.45, 0)
    f.framed_picture(chest.at(-0.1, 0), 0.75, 0.55, 1.65, "#e9c46a", "#264653", seed=30)
    f.vase(p.at(0.9, 0.15, height=2.05), "#2f6f73")
    f.book_stack(p.at(0.0, 0.15, height=2.05), 5, rng)
    p.box((0.45, 2.15, 0.15), (0.34, 0.2, 0.24), Material(Texture.FABRIC, "#c9a66b", "#8f6a38", 2.0))


def _west(p: Placement, rng: np.random.Generator) -> None:
    """The window wall: curtains, radiator, reading desk."""
    f.window(p.at(-0.35, 0), 1.7, 1.25, 0.95, "#c9765a", CEILING)
    f.radiator(p.at(-0.35, 0), 1.2)
    f.vase(p.at(-0.85, 0.09, height=0.935), "#e0a33e", flowers="#f1e9da")
    f.potted_plant(p.at(0.05, 0.09, height=0.935).at(0, 0.02), 0.42, rng, spread=0.25)
    f.framed_picture(p.at(1.75, 0), 0.6, 0.45, 1.62, "#f6d5b0", "#6d4c6f", seed=17, frame=f.BRASS)
    f.framed_picture(p.at(-1.95, 0), 0.5, 0.7, 1.6, "#cfe0dc", "#2f5d62", seed=26, frame=f.OAK)


def _south(p: Placement, rng: np.random.Generator) -> None:
    """The cream wall: sideboard with television, door, clock, hooks with coats."""
    f.cupboard(p, 1.8, 0.62, 0.42, f.OAK, doors=4)
    f.television(p.at(0.1, 0.1, height=0.62), 1.15)
    f.vase(p.at(-0.72, 0.2, height=0.62), "#8c2f2b", flowers="#e8b23a")
    f.book_stack(p.at(0.78, 0.2, height=0.62), 3, rng)
    f.clock(p.at(0.1, 0), 1.85)
    f.door(p.at(-1.85, 0), "#d9cdb4")
    f.framed_picture(p.at(-1.02, 0), 0.35, 0.5, 1.6, "#f3efe6", "#b5838d", seed=41, texture=Texture.PRINT)
    f.framed_picture(p.at(1.2, 0), 0.4, 0.55, 1.62, "#f0d9b5", "#385f8f", seed=44, frame=f.OAK)
    p.box((2.0, 1.72, 0.012), (0.9, 0.09, 0.024), f.WALNUT)
    for k, color in enumerate(("#385f8f", "#b56576", "#5b7553")):
        x = 1.7 + 0.3 * k
        p.rod((x, 1.7, 0.02), (x, 1.74, 0.09), 0.012, f.BRASS)
        p.rod((x, 0.95, 0.09), (x, 1.66, 0.09), 0.14, f.fabric(color), end_radius=0.07, depth=0.08, seed=k)


def _dining(p: Placement, rng: np.random.Generator) -> None:
    """Table with chairs under a hanging lamp."""
    place = p.at(-0.45, 1.75)
    f.table(place, 0.9, 1.1, 0.75, f.PINE)
    for x, z, turn, seat in (
        (0.42, -0.25, -80, "#c8553d"),
        (0.4, 0.28, -98, "#2f6f73"),
        (-0.42, -0.2, 85, "#e0a33e"),
        (-0.4, 0.3, 100, "#385f8f"),
    ):
        f.chair(place.at(x, z, turn), f.PINE, seat)
    f.pendant(place, CEILING, 1.55, "#2f5d62")
    top = place.at(0, 0, height=0.75)
    top.box((0, 0.003, 0), (0.35, 0.006, 1.0), Material(Texture.RUG, "#e9dfc8", "#5b7553"))
    f.vase(top, "#f3efe6", flowers="#b56576")
    f.fruit_bowl(top.at(0.05, 0.32))
    f.mug(top.at(-0.22, 0.15), "#c8553d")
    f.mug(top.at(0.25, -0.3), "#385f8f")
    f.book_stack(top.at(-0.2, -0.3, 20), 2, rng)


def _lights(p: Placement) -> None:
    """Nine spots, the lamps, and the window: many weak lights make soft shadows."""
    for x in (0.1, 1.3, 2.5):
        for z in (-1.15, 0.05, 1.25):
            p.light((x, CEILING - 0.1, z), "#fff1dc", 0.42, 8.0)
    for height, along in ((1.25, -0.3), (1.9, -0.3), (1.55, 0.2), (1.55, 0.75)):
        p.light((LOW_X + 0.25, height, along), "#cfe2ff", 0.55, 8.0)
    p.light((3.4, 1.3, -2.3), "#ffcf8a", 0.3, 4.0)
    p.light((3.4, 1.8, -2.3), "#ffcf8a", 0.3, 4.0)
    p.light((-0.45, 1.52, 1.75), "#ffd9a0", 0.35, 3.5)
    p.light((1.3, 0.9, 0.6), "#ffe9cf", 0.22, 6.0)  # bounced by the floor
