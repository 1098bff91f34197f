"""From what was placed to a scene that can be rendered."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from scanweld.datasets.synthetic.lighting import cast_shadows
from scanweld.datasets.synthetic.scene import Placement, Scene
from scanweld.datasets.synthetic.tree import build_tree, primitive_bounds


def assemble(name: str, root: Placement, ambient: Sequence[float]) -> Scene:
    """Sort what was placed below `root` into a tree, and cast the shadows of its lights."""
    affine = np.array([matrix.ravel() for matrix, _ in root.rows])
    values = np.array([row for _, row in root.rows])
    order, bounds, links = build_tree(primitive_bounds(affine, values[:, 0].astype(np.int64), values[:, 7]))
    affine, values = affine[order], values[order]
    lights = np.array(root.lights, dtype=np.float64).reshape(-1, 7)
    unlit = Scene(
        name=name,
        affine=affine,
        integers=values[:, :3].astype(np.int32),
        scalars=np.ascontiguousarray(values[:, 3:9]),
        colors=np.ascontiguousarray(values[:, 9:]),
        bounds=bounds,
        links=links,
        lights=lights,
        shadow=np.zeros((len(lights), 1, 1), np.float32),
        ambient=np.array(ambient, dtype=np.float64),
    )
    return dataclasses.replace(unlit, shadow=cast_shadows(unlit))
