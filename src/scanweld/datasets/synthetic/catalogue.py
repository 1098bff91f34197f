"""The table of scenes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from scanweld.datasets.synthetic.corridor import build_corridor
from scanweld.datasets.synthetic.rooms import build_room
from scanweld.datasets.synthetic.scene import Scene
from scanweld.datasets.synthetic.twin_rooms import build_twin_rooms
from scanweld.datasets.synthetic.wall import build_wall
from scanweld.errors import ConfigError

SCENES: dict[str, Callable[[int], Scene]] = {
    "room": build_room,
    "corridor": build_corridor,
    "twin-rooms": build_twin_rooms,
    "wall": build_wall,
}
"""Builders of the scenes by name; they take a seed."""


@lru_cache(maxsize=2)
def build_scene(name: str, seed: int = 0) -> Scene:
    """Return a scene; the last two are kept.

    Raises
    ------
    ConfigError
        When there is no scene of that name.
    """
    if name not in SCENES:
        raise ConfigError(f"scene = '{name}': expected one of {', '.join(SCENES)}")
    return SCENES[name](seed)
