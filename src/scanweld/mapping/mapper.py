"""The surfel map behind the mapper's Protocol."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from scanweld.arrays import Bool, Float64
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.mapping.backends.arrays import DepthBuffers
from scanweld.mapping.fusion import FusionConfig, FusionCounts, fuse
from scanweld.mapping.merging import merge_doubled, thin_crowded
from scanweld.mapping.rendering import find_candidates, render_model_view
from scanweld.mapping.storage.pages import MapConfig
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.state import Stateful


class SurfelMapper(Stateful):
    """Point-based fusion into a :class:`SurfelMap`.

    Fusion looks at the map from the frame's pose anyway; what it saw, `last_seen`, is the view for the next frame, if
    that is expected close by; None when much was new.
    """

    STATE: ClassVar = {"map": Stateful, "_frames_fused": int, "last_seen": ModelView | None, "_reach_m": float}
    MADE = frozenset({"config", "_depth_buffers"})

    def __init__(self, config: FusionConfig | None = None, storage: MapConfig | None = None) -> None:
        self.config = config or FusionConfig()
        self.map = SurfelMap(config=storage)
        self._frames_fused = 0
        self._depth_buffers = DepthBuffers()
        self.last_seen: ModelView | None = None
        self._reach_m = REACH_M

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as a camera at `T_world_camera`, or within a few pixels of there, sees it."""
        if self.last_seen is not None and shows_the_same(self.last_seen, T_world_camera, camera):
            return self.last_seen
        candidates = find_candidates(self.map, T_world_camera, camera, far_m=self._reach_m)
        return render_model_view(
            self.map, candidates, T_world_camera, camera, self.config.stable_confidence, self._depth_buffers
        )

    def fuse(
        self, pyramid: SurfacePyramid, T_world_camera: Float64, *, keyframe: int = 0, moving: Bool | None = None
    ) -> FusionCounts:
        """Merge a frame seen from `T_world_camera` into the map, but for the pixels (H, W) that are `moving`.

        New surfels move with `keyframe`.
        """
        self.map.anchor = keyframe
        self._follow_up()
        level = pyramid.levels[0]
        self._reach_m = max(self._reach_m, FURTHER * float(level.depth_m.max(initial=0.0)))
        candidates = find_candidates(self.map, T_world_camera, level.camera, far_m=self._reach_m)
        counts, seen = fuse(
            self.map, candidates, pyramid, T_world_camera, self._frames_fused, self.config, moving, self._depth_buffers
        )
        self._frames_fused += 1
        self.last_seen = seen if counts.appended < MOSTLY_NEW * len(seen) else None
        return counts

    def apply(self, correction: MapCorrection) -> None:
        """Move surfels with their keyframes; those out of view, and layers that this brings together, follow later."""
        self.map.apply_correction(correction)
        self.last_seen = None

    def finish(self) -> None:
        """Do at once what was put off: after the last frame, or before the whole map is looked at."""
        self._follow_up(everything=True)

    def fresh(self) -> SurfelMapper:
        """Return a mapper like this one with an empty map; its frames are numbered on from those of this one."""
        other = SurfelMapper(self.config, self.map.pages.config)
        other._frames_fused, other._reach_m = self._frames_fused, self._reach_m
        return other

    def take_in(self, other: SurfelMapper, correction: MapCorrection) -> None:
        """Add the map of another mapper, moved with its keyframes, and fuse the layers that this brings together."""
        other.map.apply_correction(correction)
        self.map.take_in(other.map)
        self._frames_fused = max(self._frames_fused, other._frames_fused)
        self._reach_m = max(self._reach_m, other._reach_m)
        self.last_seen = None

    def _follow_up(self, everything: bool = False) -> None:
        """Let some of the map follow the last corrections, or all of it, and fuse layers that this brings together."""
        pages = self.map.pages
        pages.follow(pages.capacity if everything else PAGES_A_FRAME)
        at_most, most = 0 if everything else PAGES_A_FRAME, self.config.max_confidence
        merge_doubled(self.map, most, self.config.merging, at_most=at_most)
        if not everything and self._frames_fused % THINNING_INTERVAL == 0:
            thin_crowded(self.map, most)


def shows_the_same(view: ModelView, T_world_camera: Float64, camera: PinholeCamera) -> bool:
    """Whether a camera at `T_world_camera` sees nearly what a view shows: the image has moved by a small share."""
    if view.camera != camera:
        return False
    motion = se3.inverse(view.T_world_camera) @ T_world_camera
    shift, turn = float(np.linalg.norm(motion[:3, 3])), float(se3.rotation_angle_rad(motion))
    # At the corners of the image a turn moves pixels by half as much again as in the middle.
    moved_px = max(camera.fx, camera.fy) * (1.5 * turn + shift / TYPICAL_M)
    return moved_px < SAME_VIEW_SHARE * camera.width


REACH_M, FURTHER = 12.0, 1.5
"""Surfels are looked at as far as this, and this much further than anything was measured so far."""

TYPICAL_M = 1.0
"""Surfaces are mostly beyond this."""

SAME_VIEW_SHARE = 0.1
"""A view that moved by less than this share of the image's width shows nearly the same of the map: what has come into
sight since is missing on one side, and that has shown no loss of accuracy (docs/decisions/0015-pipeline.md)."""

PAGES_A_FRAME = 32
"""Pages that follow a correction with each frame though they are out of view, and that are looked at for layers."""

THINNING_INTERVAL = 4
"""Frames from one crowded cell that is thinned to the next."""

MOSTLY_NEW = 0.05
"""Where so many surfels were added, as a share of those seen, the map has to be looked at again."""
