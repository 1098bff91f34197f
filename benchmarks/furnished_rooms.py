"""Rooms that differ by seed: size, doorways, and furniture drawn and placed at random, in `scanweld`'s own renderer.

World frame as in every synthetic scene: x right, y down, z forward, the floor is y = 0. There are no lights: these
rooms are for geometry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanweld.datasets.synthetic import Scene, build_scene, rooms
from scanweld.datasets.synthetic import furniture as f
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.casting import cast_rays
from scanweld.datasets.synthetic.scene import Placement, new_placement
from scanweld.datasets.synthetic.spaces import CEILING, DOOR_WIDTH, Style, pilasters, plaster, space

Generator = np.random.Generator
WALL_GAP_M = 0.15


@dataclass(frozen=True, slots=True)
class FurnishedRoom:
    """A room and its clear space: the lowest and the highest (x, height, z) [m]."""

    scene: Scene
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def on_shell(self, points_m: np.ndarray, distance_m: float = 0.06) -> np.ndarray:
        """Whether points (N, 3) [m, world] lie on floor, walls or ceiling, or outside: (N,) bool."""
        at = points_m * (1.0, -1.0, 1.0)
        inside = (at > np.add(self.low_m, distance_m)) & (at < np.subtract(self.high_m, distance_m))
        return np.asarray(~inside.all(axis=1))


def furnished_room(seed: int) -> FurnishedRoom:
    """Build the room of a seed: 3.4 to 6 m wide and deep, two to four pieces a wall, one to three in the middle."""
    rng = np.random.default_rng([seed, 3])
    root = new_placement()
    width, depth = (float(side) for side in rng.uniform(3.4, 6.0, 2))
    build_room(root, width, depth, rng)
    scene = assemble(f"furnished-{seed}", root, (0.5, 0.5, 0.5))
    return FurnishedRoom(scene, (-width / 2, 0.0, -depth / 2), (width / 2, CEILING, depth / 2))


def sample_surfaces(room: FurnishedRoom, count: int, noise_m: float, rng: Generator) -> np.ndarray:
    """Return (count, 3) points [m, world] on everything in the room, at about the same density everywhere.

    Rays leave from many places in all directions; a hit at distance r is kept with probability (r / 4 m)^2, which
    undoes the thinning out with distance. Surfaces seen at grazing angles stay thinner.
    """
    low, high = np.add(room.low_m, 0.3), np.subtract(room.high_m, 0.3)
    origins: list[np.ndarray] = []
    while len(origins) < 24:
        origin = rng.uniform(low, high) * (1, -1, 1)
        distance, hit = cast_rays(room.scene, origin, rng.standard_normal((200, 3)))
        if (hit >= 0).mean() > 0.9 and distance.min() > 0.05:
            origins.append(origin)
    parts: list[np.ndarray] = []
    found = 0
    while found < count:
        for origin in origins:
            rays = rng.standard_normal((max(count // 20, 2000), 3))
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            distance, hit = cast_rays(room.scene, origin, rays)
            kept = (hit >= 0) & (distance < 8) & (rng.random(len(rays)) < (distance / 4) ** 2)
            parts.append(origin + distance[kept, None] * rays[kept])
            found += int(kept.sum())
    points = np.concatenate(parts)
    points = points[rng.permutation(len(points))[:count]]
    return points + noise_m * rng.standard_normal(points.shape)


def living_room() -> FurnishedRoom:
    """Return the room of `scanweld render --scene room`, designed by hand."""
    return FurnishedRoom(
        build_scene("room"), (rooms.LOW_X, 0.0, rooms.LOW_Z), (rooms.HIGH_X, rooms.CEILING, rooms.HIGH_Z)
    )


def build_room(root: Placement, width: float, depth: float, rng: Generator) -> None:
    """Build and furnish one room around the origin of `root`."""
    paint = plaster("#e6dcc8", "#d3c3a4")
    panel = f.WHITE_PAINT if rng.random() < 0.4 else None
    doors = "".join(name for name in "blfr" if rng.random() < 0.3)
    style = Style(floor=paint, walls=(paint, paint, paint, paint), panel=panel)
    room = space(root, width, depth, style, doors)
    walls = ((room.back, width, "b"), (room.left, depth, "l"), (room.front, width, "f"), (room.right, depth, "r"))
    for foot, length, name in walls:
        _furnish_wall(foot, length, name in doors, rng)
    _furnish_middle(root, width, depth, rng)
    if rng.random() < 0.3:
        pilasters(root.at(float(rng.uniform(-0.3, 0.3)) * width, 0), depth / 2, paint)


def _furnish_wall(wall: Placement, length: float, door: bool, rng: Generator) -> None:
    """Put pieces side by side along a wall, leaving a doorway in its middle free."""
    reach = length / 2 - 0.75  # the corners belong to both walls: keep them free of deep pieces
    gap = DOOR_WIDTH / 2 + 0.2
    for low, high in ((-reach, -gap), (gap, reach)) if door else ((-reach, reach),):
        x = low
        while True:
            width, build = WALL_PIECES[rng.integers(len(WALL_PIECES))]
            if x + width > high:
                break
            build(wall.at(x + width / 2, 0), rng)
            x += width + WALL_GAP_M + float(rng.uniform(0, 0.5))


def _furnish_middle(root: Placement, width: float, depth: float, rng: Generator) -> None:
    """Put one to three pieces, turned anyhow, where they neither touch each other nor what stands along the walls."""
    taken: list[tuple[float, float]] = []
    for _ in range(int(rng.integers(1, 4))):
        x, z = float(rng.uniform(-1, 1)) * (width / 2 - 1.4), float(rng.uniform(-1, 1)) * (depth / 2 - 1.4)
        if all(np.hypot(x - a, z - b) > 1.5 for a, b in taken):
            taken.append((x, z))
            build = MIDDLE_PIECES[rng.integers(len(MIDDLE_PIECES))]
            build(root.at(x, z, float(rng.uniform(0, 360))), rng)


def _things(top: Placement, reach: float, rng: Generator) -> None:
    """Put two to four small things on a table or a chest."""
    for x in np.linspace(-reach, reach, int(rng.integers(2, 5))):
        place = top.at(float(x), float(rng.uniform(-0.06, 0.06)), float(rng.uniform(0, 360)))
        kind = rng.integers(4)
        if kind == 0:
            f.book_stack(place, int(rng.integers(2, 6)), rng)
        elif kind == 1:
            f.vase(place, "#8c2f2b", flowers="#e8b23a" if rng.random() < 0.5 else None)
        elif kind == 2:
            f.fruit_bowl(place)
        else:
            f.mug(place, "#2f6f73")


def _sofa(p: Placement, rng: Generator) -> None:
    f.sofa(p, 2.0, "#6a8f6b", ("#e0a33e", "#b56576", "#efe3c8"))
    f.framed_picture(p.at(float(rng.uniform(-0.5, 0.5)), 0), 0.7, 0.5, 1.6, "#f0b35a", "#264653")


def _bookshelf(p: Placement, rng: Generator) -> None:
    f.bookshelf(p, 1.1, float(rng.uniform(1.2, 2.1)), rng)


def _cupboard(p: Placement, rng: Generator) -> None:
    height = float(rng.uniform(0.55, 1.1))
    f.cupboard(p, 1.3, height, float(rng.uniform(0.35, 0.55)), doors=int(rng.integers(2, 5)))
    if rng.random() < 0.4:
        f.television(p.at(0, 0.05, height=height), float(rng.uniform(0.7, 1.1)))
    else:
        _things(p.at(0, 0.18, height=height), 0.5, rng)


def _plant(p: Placement, rng: Generator) -> None:
    f.potted_plant(p.at(0, 0.35), float(rng.uniform(0.6, 1.3)), rng, spread=0.35)


def _window(p: Placement, rng: Generator) -> None:
    f.window(p, 1.3, 1.2, 0.95, "#c9765a", CEILING)
    f.radiator(p, 1.0)


def _desk(p: Placement, rng: Generator) -> None:
    place = p.at(0, 0.32)
    f.table(place, 1.2, 0.6, 0.74)
    _things(place.at(0, 0, height=0.74), 0.45, rng)
    f.chair(place.at(float(rng.uniform(-0.3, 0.3)), 0.5, 180 + float(rng.uniform(-30, 30))))


def _crates(p: Placement, rng: Generator) -> None:
    level = 0.0
    for _ in range(int(rng.integers(1, 4))):
        size = tuple(float(s) for s in rng.uniform(0.25, 0.55, 3))
        turned = p.at(float(rng.uniform(-0.08, 0.08)), 0.42, float(rng.uniform(-25, 25)))
        turned.box((0, level + size[1] / 2, 0), (size[0], size[1], size[2]), f.PINE)
        level += size[1]


def _pictures(p: Placement, rng: Generator) -> None:
    f.framed_picture(p, float(rng.uniform(0.4, 0.9)), float(rng.uniform(0.4, 0.7)), 1.6, "#dfe8ee", "#5c7a4a")


def _shelf_board(p: Placement, rng: Generator) -> None:
    height = float(rng.uniform(1.1, 1.6))
    p.span((-0.5, height - 0.025, 0), (0.5, height, 0.22), f.OAK)
    f.books(p.at(-0.15, 0, height=height), 0.6, 0.27, 0.18, rng)
    f.vase(p.at(0.36, 0.1, height=height), "#6a994e")


def _dining(p: Placement, rng: Generator) -> None:
    f.table(p, 0.9, 1.1, 0.75)
    for x, turn in ((0.45, -90), (-0.45, 90)):
        for z in (-0.25, 0.28)[: int(rng.integers(1, 3))]:
            f.chair(p.at(x, z, turn + float(rng.uniform(-25, 25))))
    _things(p.at(0, 0, 90, height=0.75), 0.4, rng)


def _low_table(p: Placement, rng: Generator) -> None:
    f.rug(p, 1.9, 1.3, "#2f5d62", "#e7d7b1")
    f.table(p, 1.0, 0.55, 0.42)
    _things(p.at(0, 0, height=0.42), 0.4, rng)
    f.armchair(p.at(0.2, 0.95, 180), "#b4613f", "#efe3c8")


def _armchair(p: Placement, rng: Generator) -> None:
    f.armchair(p, "#b4613f", "#efe3c8")
    f.floor_lamp(p.at(0.75, 0.1))


def _solids(p: Placement, rng: Generator) -> None:
    """A leaning slab, a ball and a cone: shapes that no furniture has."""
    p.box((0, 0.4, 0), (float(rng.uniform(0.4, 0.9)), 0.9, 0.08), f.OAK, tilt_deg=float(rng.uniform(10, 40)))
    radius = float(rng.uniform(0.18, 0.35))
    p.ball((0.7, radius, 0.2), (radius, radius, radius * float(rng.uniform(0.6, 1.0))), f.CERAMIC)
    p.rod((-0.6, 0, 0.3), (-0.6, float(rng.uniform(0.4, 1.0)), 0.3), 0.25, f.BRASS, end_radius=0.06)


WALL_PIECES: tuple[tuple[float, Callable[[Placement, Generator], None]], ...] = (
    (2.0, _sofa),
    (1.2, _bookshelf),
    (1.4, _cupboard),
    (0.8, _plant),
    (1.4, _window),
    (1.3, _desk),
    (0.7, _crates),
    (1.0, _pictures),
    (1.1, _shelf_board),
)
"""Width along the wall [m] and builder."""

MIDDLE_PIECES: tuple[Callable[[Placement, Generator], None], ...] = (_dining, _low_table, _armchair, _solids, _crates)
