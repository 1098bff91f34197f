"""Rendered RGB-D sequences with exact ground truth: a furnished room, and a loop of rooms and corridors.

World frame of every scene: x right, y down, z forward; the floor is y = 0.
"""

from __future__ import annotations

from scanweld.datasets.synthetic.catalogue import SCENES, build_scene
from scanweld.datasets.synthetic.noise import NOISE_MODELS, NoiseModel, degrade_color, degrade_depth
from scanweld.datasets.synthetic.paths import PATHS
from scanweld.datasets.synthetic.rendering import render_frame
from scanweld.datasets.synthetic.scene import Scene
from scanweld.datasets.synthetic.sequence import RenderConfig, SyntheticSequence
from scanweld.datasets.synthetic.writer import render_sequence

__all__ = [
    "NOISE_MODELS",
    "PATHS",
    "SCENES",
    "NoiseModel",
    "RenderConfig",
    "Scene",
    "SyntheticSequence",
    "build_scene",
    "degrade_color",
    "degrade_depth",
    "render_frame",
    "render_sequence",
]
