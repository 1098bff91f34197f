"""A hall with two walls that are blank for some metres, one painted in a single colour, one of brick.

From 1.4 m a camera sees nothing but the wall for 2 s of a walk along it: a plane, which three directions of the motion
leave unmoved. On the brick wall (flat: its bricks are colour only) the picture still tells them.
"""

from __future__ import annotations

import numpy as np

from scanweld.datasets.synthetic import furniture as f
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.scene import Material, Placement, Scene, Texture, new_placement
from scanweld.datasets.synthetic.spaces import Space, Style, plaster, room_lights, space

LENGTH, WIDTH = 7.0, 3.6
BLANK_HALF_LENGTH = 1.55
"""The walls at z = -WIDTH / 2 (brick) and WIDTH / 2 (plain) are blank for |x| below this [m]."""
DISTANCE = 1.4
"""From the camera to the wall it looks at [m]."""


def build_wall(seed: int) -> Scene:
    """Build the hall; `seed` chooses books, leaves and the like."""
    rng = np.random.default_rng([seed, 4])
    root = new_placement()
    blank = Material(Texture.PAINT, "#d8d4c8", "#d8d4c8")
    brick = Material(Texture.BRICK, "#a8553c", "#cfc4b2")
    cream = plaster("#ecd9ad", "#dcc189")
    floor = Material(Texture.PARQUET, "#cf9f68", "#8c5b30")
    hall = space(root, LENGTH, WIDTH, Style(floor=floor, walls=(brick, cream, blank, cream)), "")
    _ends(hall, rng)
    for x in (-2.0, 0.0, 2.0):
        room_lights(hall.middle.at(x, 0))
    return assemble("wall", root, (0.12, 0.118, 0.115))


def _ends(hall: Space, rng: np.random.Generator) -> None:
    """Things at both ends of both walls, none alike."""
    for wall, k in ((hall.back, 0), (hall.front, 1)):
        _shelves(wall.at(-2.45, 0), rng, 230 + 10 * k)
        _sideboard(wall.at(2.45, 0), rng, 240 + 10 * k)


def _shelves(p: Placement, rng: np.random.Generator, seed: int) -> None:
    f.bookshelf(p, 1.5, 1.85, rng)
    f.framed_picture(p.at(-0.9, 0), 0.25, 0.6, 1.5, "#f0b35a", "#2c4f5e", seed=seed)


def _sideboard(p: Placement, rng: np.random.Generator, seed: int) -> None:
    f.cupboard(p, 1.5, 0.95, 0.4, f.OAK, doors=3)
    f.vase(p.at(-0.45, 0.2, height=0.95), "#31566b", flowers="#d7536a")
    f.book_stack(p.at(0.1, 0.2, height=0.95), 5, rng)
    f.fruit_bowl(p.at(0.5, 0.2, height=0.95))
    f.framed_picture(p.at(-0.35, 0), 0.5, 0.6, 1.6, "#e9c46a", "#264653", seed=seed)
    f.framed_picture(p.at(0.4, 0), 0.5, 0.5, 1.65, "#dfe8ee", "#8c3b4a", seed=seed + 1, frame=f.BRASS)
