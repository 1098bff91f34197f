"""Two identical rooms joined by a corridor: what looks like a loop is none.

Seen from above, x to the right and z up; room B is room A turned by half a turn about the middle of the corridor, and
so is the path through it, so the same views come again 8.4 m apart:

    A ---- corridor ---- B
    x = -4.2           x = 4.2
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from scanweld.arrays import Float64
from scanweld.datasets.synthetic import furniture as f
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.scene import Material, Placement, Scene, Texture, new_placement
from scanweld.datasets.synthetic.spaces import Style, ceiling_lamp, plaster, room_lights, space

ROOM_SIZE, CORRIDOR_LENGTH, CORRIDOR_WIDTH = 4.0, 4.0, 2.0
WALLS = 0.2
"""Thickness of the wall of a room and of the corridor's beside it [m]."""
MIDDLE_X = CORRIDOR_LENGTH / 2 + WALLS + ROOM_SIZE / 2
"""The rooms' middles are at x = -MIDDLE_X and MIDDLE_X [m]."""

_HALF_ROUND = (
    (1.7, 0.06), (2.75, 0.32), (3.6, 0.8), (4.4, 0.98), (5.1, 0.66), (5.36, 0.0),
    (5.1, -0.66), (4.4, -0.98), (3.6, -0.8), (2.75, -0.32), (1.7, -0.06),
)  # fmt: skip


def centre_line(phase: Float64) -> tuple[Float64, Float64]:
    """Return where the camera walks: (x, z) positions (N, 2) [m] and headings (N,) [rad, 90 degrees is +x].

    A dumbbell: from the corridor around room A, back through the corridor, around room B. Half a round later the
    camera is at the same place of the other room.
    """
    half = np.array([(0, 0.05), *_HALF_ROUND, (0, -0.05)])
    points = np.concatenate([half[:-1], -half])  # the other room by half a turn about the middle
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(along / along[-1] * 2 * np.pi, points, bc_type="periodic")
    at = (phase + np.pi + 0.35) % (2 * np.pi)  # begins on the way into room A
    tangent = spline(at, 1)
    return np.asarray(spline(at)), np.arctan2(tangent[..., 0], tangent[..., 1])


def build_twin_rooms(seed: int) -> Scene:
    """Build the rooms and their corridor; `seed` chooses books, leaves and the like, alike in both rooms."""
    root = new_placement()
    _room(root.at(-MIDDLE_X, 0), np.random.default_rng([seed, 3]))
    _room(root.at(MIDDLE_X, 0, 180), np.random.default_rng([seed, 3]))
    _corridor(root)
    return assemble("twin-rooms", root, (0.12, 0.118, 0.115))


def _room(p: Placement, rng: np.random.Generator) -> None:
    """A room with its doorway at +x."""
    walls = (
        plaster("#d9b77e", "#c69a5c"), Material(Texture.BRICK, "#a8553c", "#cfc4b2"),
        Material(Texture.STRIPES, "#5f8f8b", "#87b0a6"), plaster("#b9c7d6", "#97abc2"),
    )  # fmt: skip
    floor = Material(Texture.PARQUET, "#cf9f68", "#8c5b30")
    s = space(p, ROOM_SIZE, ROOM_SIZE, Style(floor=floor, walls=walls), "r")
    f.rug(s.middle, 1.9, 1.4, "#2f5d62", "#e7d7b1", seed=4)
    f.bookshelf(s.front.at(0.5, 0), 1.5, 1.9, rng)
    f.framed_picture(s.front.at(-1.2, 0), 0.6, 0.75, 1.5, "#f2e2c4", "#3d6b8e", seed=201)
    f.cupboard(s.back.at(-0.2, 0), 1.6, 0.7, 0.4, f.OAK, doors=3)
    f.television(s.back.at(-0.2, 0.12, height=0.7), 0.9)
    f.vase(s.back.at(0.45, 0.2, height=0.7), "#8c2f2b", flowers="#e8b23a")
    f.framed_picture(s.back.at(1.3, 0), 0.5, 0.7, 1.55, "#e9c46a", "#264653", seed=202, frame=f.OAK)
    f.table(s.left.at(-0.3, 0.32), 1.3, 0.55, 0.75, f.PINE)
    f.book_stack(s.left.at(-0.7, 0.3, height=0.75), 4, rng)
    f.mug(s.left.at(0.1, 0.3, height=0.75), "#c8553d")
    f.framed_picture(s.left.at(-0.3, 0), 0.9, 0.6, 1.6, "#cfe0dc", "#8c3b4a", seed=203, frame=f.BRASS)
    f.radiator(s.left.at(1.2, 0.02), 0.8)
    f.framed_picture(s.right.at(1.35, 0), 0.45, 0.6, 1.55, "#dfe8ee", "#5c7a4a", seed=204)
    f.potted_plant(s.middle.at(-1.65, 1.65), 1.2, rng, spread=0.3)
    f.potted_plant(s.middle.at(1.65, -1.65), 0.9, rng, spread=0.3, pot="#5b6f7a")
    room_lights(s.middle)


def _corridor(root: Placement) -> None:
    """Panelled, the same at both ends but for its pictures."""
    green = plaster("#b9c4a3", "#9cab80")
    panel = Material(Texture.PAINT, "#e8e1cf", "#d8cdb2")
    floor = Material(Texture.TILES, "#d8d2c4", "#77706a", 1.0)
    s = space(root, CORRIDOR_LENGTH, CORRIDOR_WIDTH, Style(floor=floor, walls=(green,) * 4, panel=panel), "lr")
    f.rug(s.middle, CORRIDOR_LENGTH - 1.0, 0.8, "#8f3b37", "#e4cfa5", seed=7)
    for k, x in enumerate((-1.2, 0.1, 1.3)):
        first, second = f.BOOK_COLORS[(4 * k + 1) % 16], f.BOOK_COLORS[(4 * k + 10) % 16]
        f.framed_picture(s.back.at(x, 0), 0.55, 0.7, 1.55, first, second, seed=210 + k, frame=f.DARK_METAL)
        f.framed_picture(s.front.at(x + 0.2, 0), 0.6, 0.45, 1.6, second, first, seed=220 + k, frame=f.OAK)
    f.cupboard(s.back.at(0.4, 0.02), 0.9, 0.8, 0.25, f.WALNUT, doors=2)
    for x in (-1.2, 1.2):
        ceiling_lamp(s.middle.at(x, 0))
