"""Shadows: every light holds an octahedral map of the distance to the first surface.

Maps are small and filtered when read, so shadows are soft and cost no rays while rendering. Many weak lights
in place of one give the soft light of a room ("instant radiosity", A. Keller, SIGGRAPH 1997).
"""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.datasets.synthetic.casting import cast_rays
from scanweld.datasets.synthetic.scene import Scene

SHADOW_SIZE = 112


def octahedral_directions(size: int) -> Float64:
    """Directions (size, size, 3), not unit, of the texels of an octahedral map whose centre looks down (+y).

    Source: Z. Cigolle et al., "A survey of efficient representations for independent unit vectors", JCGT
    2014.
    """
    coordinate = (np.arange(size) + 0.5) / size * 2 - 1
    a, b = np.meshgrid(coordinate, coordinate)
    y = 1 - np.abs(a) - np.abs(b)
    folded_a = np.where(a >= 0, 1.0, -1.0) * (1 - np.abs(b))
    folded_b = np.where(b >= 0, 1.0, -1.0) * (1 - np.abs(a))
    return np.stack([np.where(y < 0, folded_a, a), y, np.where(y < 0, folded_b, b)], axis=-1)


def cast_shadows(scene: Scene) -> Float32:
    """Return the shadow maps (L, S, S) [m] of the lights of a scene."""
    directions = octahedral_directions(SHADOW_SIZE).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shadow = np.empty((len(scene.lights), SHADOW_SIZE, SHADOW_SIZE), np.float32)
    for index, light in enumerate(scene.lights):
        distance_m, _ = cast_rays(scene, light[:3], directions)
        shadow[index] = np.minimum(distance_m, 1e6).reshape(SHADOW_SIZE, SHADOW_SIZE)
    return shadow
