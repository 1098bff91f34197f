"""The surfel map behind the mapper's Protocol."""

from __future__ import annotations

from scanweld.arrays import Float64
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.mapping.fusion import FusionConfig, FusionCounts, fuse
from scanweld.mapping.rendering import Candidates, find_candidates, render_model_view
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
        self._candidates: Candidates | None = None

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as a camera at `T_world_camera` sees it."""
        self._candidates = find_candidates(self.map, T_world_camera, camera)
        return render_model_view(self.map, self._candidates, T_world_camera, camera)

    def fuse(self, pyramid: SurfacePyramid, T_world_camera: Float64) -> FusionCounts:
        """Merge a frame seen from `T_world_camera` into the map."""
        candidates = self._candidates
        if candidates is None:
            candidates = find_candidates(self.map, T_world_camera, pyramid.levels[0].camera)
        counts = fuse(self.map, candidates, pyramid, T_world_camera, self._frames_fused, self.config)
        self._frames_fused += 1
        self._candidates = None
        return counts

    def apply(self, correction: MapCorrection) -> None:
        """Move surfels with their keyframes."""
        self.map.apply_correction(correction)
        self._candidates = None
