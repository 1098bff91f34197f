"""The surfel map behind the mapper's Protocol."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Bool, Float32, Float64, Int32
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.mapping.fusion import FusionConfig, FusionCounts, fuse
from scanweld.mapping.merging import merge_doubled
from scanweld.mapping.rendering import VIEW_MARGIN_PIXELS, DepthBuffers, SurfelView, find_candidates, render_model_view
from scanweld.mapping.surfel_map import SurfelMap


class SurfelMapper:
    """Point-based fusion into a :class:`SurfelMap`.

    `view` remembers which surfels were near the view, so that `fuse` at a pose close by need not look at the whole
    map again.
    """

    def __init__(self, config: FusionConfig | None = None) -> None:
        self.config = config or FusionConfig()
        self.map = SurfelMap()
        self._frames_fused = 0
        self._candidates: Int32 | None = None
        self._depth_buffers = DepthBuffers()
        self._view: SurfelView | None = None
        self._reach_m = REACH_M
        self._viewed_from: tuple[Float64, PinholeCamera] | None = None

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as a camera at `T_world_camera` sees it."""
        self._candidates = find_candidates(self.map, T_world_camera, camera, far_m=self._reach_m)
        self._viewed_from = T_world_camera, camera
        seen = render_model_view(
            self.map, self._candidates, T_world_camera, camera, self.config.stable_confidence, self._depth_buffers
        )
        self._view = seen
        return seen

    def fuse(
        self, pyramid: SurfacePyramid, T_world_camera: Float64, *, keyframe: int = 0, moving: Bool | None = None
    ) -> FusionCounts:
        """Merge a frame seen from `T_world_camera` into the map, but for the pixels (H, W) that are `moving`.

        New surfels move with `keyframe`.
        """
        self.map.anchor = keyframe
        self._reach_m = max(self._reach_m, FURTHER * float(pyramid.levels[0].depth_m.max(initial=0.0)))
        camera, candidates, view = pyramid.levels[0].camera, self._candidates, None
        if candidates is None or self._moved_pixels(T_world_camera, camera, NEAREST_M) > VIEW_MARGIN_PIXELS:
            candidates = find_candidates(self.map, T_world_camera, camera, far_m=self._reach_m)
        elif self._moved_pixels(T_world_camera, camera, TYPICAL_M) < SAME_VIEW_PIXELS:
            view = self._view
        counts = fuse(
            self.map, candidates, pyramid, T_world_camera, self._frames_fused, self.config, view, moving,
            self._depth_buffers,
        )  # fmt: skip
        self._frames_fused += 1
        self._candidates = self._view = None
        return counts

    def apply(self, correction: MapCorrection) -> None:
        """Move surfels with their keyframes, and fuse the layers that this brings together."""
        self._merge(_moved(self.map, correction))

    def fresh(self) -> SurfelMapper:
        """Return a mapper like this one with an empty map; its frames are numbered on from those of this one."""
        other = SurfelMapper(self.config)
        other._frames_fused, other._reach_m = self._frames_fused, self._reach_m
        return other

    def take_in(self, other: SurfelMapper, correction: MapCorrection) -> None:
        """Add the map of another mapper, moved with its keyframes, and fuse the layers that this brings together."""
        moved = _moved(other.map, correction)
        places = self.map.take_in(other.map)
        self._frames_fused = max(self._frames_fused, other._frames_fused)
        moved_m = np.zeros((3, len(self.map)), np.float32)
        moved_m[:, places] = moved
        self._merge(moved_m)

    def _merge(self, moved_m: Float32) -> None:
        merge_doubled(self.map, moved_m, self.config.max_confidence, self.config.merging)
        self._candidates = self._view = None

    def _moved_pixels(self, T_world_camera: Float64, camera: PinholeCamera, depth_m: float) -> float:
        """How far the image has moved since the last view, at most, where surfaces are no nearer than `depth_m`."""
        if self._viewed_from is None or self._viewed_from[1] != camera:
            return np.inf
        motion = se3.inverse(self._viewed_from[0]) @ T_world_camera
        shift, turn = float(np.linalg.norm(motion[:3, 3])), float(se3.rotation_angle_rad(motion))
        # At the corners of the image a turn moves pixels by half as much again as in the middle.
        return max(camera.fx, camera.fy) * (1.5 * turn + shift / depth_m)


def _moved(surfels: SurfelMap, correction: MapCorrection) -> Float32:
    """Apply a correction; returns how far each surfel moved (3, N) [m]."""
    before = surfels.positions_m
    surfels.apply_correction(correction)
    return np.asarray(surfels.positions_m - before)


REACH_M, FURTHER = 12.0, 1.5
"""Surfels are looked at as far as this, and this much further than anything was measured so far."""

NEAREST_M, TYPICAL_M = 0.3, 1.0
"""Surfaces are not expected to be nearer than the first, and mostly beyond the second."""

SAME_VIEW_PIXELS = 0.5
"""A surfel that moved less than this since the prediction stays in the pixel where it was seen."""
