"""Scenes: what they are made of, and how they are put together.

World frame of every scene: x right, y down, z forward, metres, right-handed; the floor is the plane y = 0 and
a height h above it is y = -h. Builders speak of (x, height, z) instead, which is easier to furnish with.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from scanweld.arrays import Float32, Float64, Int32

Vector = tuple[float, float, float]


class Shape(IntEnum):
    """Unit shapes of the ray caster (`kernels.py` draws them)."""

    BOX = 0
    BALL = 1
    FRUSTUM = 2
    QUAD = 3


class Texture(IntEnum):
    """Procedural textures of the ray caster; each blends the two colours of a material."""

    PAINT = 0
    PLASTER = 1
    WOOD = 2
    PARQUET = 3
    FABRIC = 4
    TILES = 5
    BRICK = 6
    RUG = 7
    PICTURE = 8
    LEAF = 9
    STRIPES = 10
    BOOK = 11
    PRINT = 12
    SKY = 13


@dataclass(frozen=True, slots=True)
class Material:
    """Texture, two sRGB colours "#rrggbb", texture scale (1 is life size), and glow (0: lit by lights)."""

    texture: Texture
    first: str
    second: str
    scale: float = 1.0
    glow: float = 0.0


def linear_color(color: str) -> Vector:
    """Return the linear light of an sRGB colour "#rrggbb" (IEC 61966-2-1)."""
    channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return r, g, b


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Primitives, the tree over them, and the lights with their shadows. P primitives, M nodes, L lights.

    Attributes
    ----------
    name : of the scene
    affine : (P, 12), rows of the 3x4 matrices from world to local coordinates
    integers : (P, 3) int32: shape, texture, texture seed
    scalars : (P, 6): half sizes [m], texture scale, taper, glow
    colors : (P, 6): two linear colours
    bounds, links : the tree, see :func:`scanweld.datasets.synthetic.kernels.cast`
    lights : (L, 7): position [m, world], linear colour, radius of influence [m]
    shadow : (L, S, S) float32: distance from a light to the first surface [m], octahedral
    ambient : (3,) linear light that reaches everything
    """

    name: str
    affine: Float64
    integers: Int32
    scalars: Float64
    colors: Float64
    bounds: Float64
    links: Int32
    lights: Float64
    shadow: Float32
    ambient: Float64

    def __len__(self) -> int:
        return len(self.affine)


class Placement:
    """A place to build at: its methods add primitives in its own frame (x, height, z).

    The frame of :meth:`at` is turned about the vertical; `turn_deg` 90 turns what faced +z to face +x.
    """

    def __init__(self, rows: list[tuple[Float64, list[float]]], lights: list[list[float]], frame: Float64) -> None:
        self.rows = rows
        self.lights = lights
        self._frame = frame

    def at(self, x: float, z: float, turn_deg: float = 0.0, height: float = 0.0) -> Placement:
        """Return the place at (x, height, z) of this one, turned by `turn_deg`."""
        c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
        local = np.array([[c, 0, s, x], [0, 1, 0, height], [-s, 0, c, z], [0, 0, 0, 1.0]])
        return Placement(self.rows, self.lights, self._frame @ local)

    def box(self, centre: Vector, size: Vector, material: Material, *, tilt_deg: float = 0.0, seed: int = 0) -> None:
        """Add a box of full `size`; `tilt_deg` leans its upper end towards +z."""
        c, s = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
        axes = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        self._add(Shape.BOX, centre, axes, (size[0] / 2, size[1] / 2, size[2] / 2), material, seed)

    def span(self, low: Vector, high: Vector, material: Material, *, seed: int = 0) -> None:
        """Add the box between two corners."""
        centre = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2)
        self.box(centre, (high[0] - low[0], high[1] - low[1], high[2] - low[2]), material, seed=seed)

    def ball(
        self, centre: Vector, radii: Vector, material: Material, *, axis: Vector = (0, 1, 0), seed: int = 0
    ) -> None:
        """Add an ellipsoid whose own y axis, with `radii[1]`, points along `axis`."""
        self._add(Shape.BALL, centre, _axes_along(axis), radii, material, seed)

    def rod(
        self, start: Vector, end: Vector, radius: float, material: Material,
        *, end_radius: float | None = None, depth: float | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        """Add a capped cylinder, with `end_radius` a frustum; `depth` squeezes it along its z."""
        a, b = np.array(start, float), np.array(end, float)
        half = float(np.linalg.norm(b - a)) / 2
        taper = 1.0 if end_radius is None else end_radius / radius
        mid = (a + b) / 2
        centre, axis = (mid[0], mid[1], mid[2]), (b[0] - a[0], b[1] - a[1], b[2] - a[2])
        sizes = (radius, half, depth or radius)
        self._add(Shape.FRUSTUM, centre, _axes_along(axis), sizes, material, seed, taper)

    def sheet(self, centre: Vector, width: float, height: float, material: Material, *, seed: int = 0) -> None:
        """Add an upright rectangle that faces z."""
        self._add(Shape.QUAD, centre, np.eye(3), (width / 2, height / 2, 1.0), material, seed)

    def light(self, centre: Vector, color: str, power: float, radius_m: float = 7.0) -> None:
        """Add a small light; it has no shape."""
        position = self._frame @ np.array([*centre, 1.0])
        rgb = [power * c for c in linear_color(color)]
        self.lights.append([position[0], -position[1], position[2], *rgb, radius_m])

    def _add(
        self, shape: Shape, centre: Vector, axes: Float64, half: Vector, material: Material, seed: int,
        taper: float = 1.0,
    ) -> None:  # fmt: skip
        forward = self._frame[:3, :3] @ axes * np.array(half)
        T = np.eye(4)
        T[:3, :3] = forward
        T[:3, 3] = self._frame[:3, :3] @ np.array(centre) + self._frame[:3, 3]
        matrix: Float64 = np.linalg.inv(T)[:3] * np.array([1.0, -1.0, 1.0, 1.0])  # height up -> y down
        values = [
            float(shape),
            float(material.texture),
            float(seed),
            *half,
            material.scale,
            taper,
            material.glow,
        ]
        self.rows.append((matrix, [*values, *linear_color(material.first), *linear_color(material.second)]))


def _axes_along(axis: Vector) -> Float64:
    """Columns x, y, z of an orthonormal frame whose y is along `axis`; z is as level as possible."""
    y = np.array(axis, float) / np.linalg.norm(axis)
    helper = np.array([0.0, 0, 1]) if abs(y[1]) > 0.9 else np.array([0.0, 1, 0])
    x = np.cross(y, helper)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def new_placement() -> Placement:
    """Return the root of an empty scene."""
    return Placement([], [], np.eye(4))
