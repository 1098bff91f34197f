"""Fusion of a frame while the next one is tracked."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from scanweld.arrays import Bool, Float64
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.mapping.fusion import FusionConfig
from scanweld.mapping.mapper import SurfelMapper, shows_the_same
from scanweld.mapping.surfel_map import SurfelMap
from scanweld.parallel import get_num_threads, in_background, limited_threads
from scanweld.state import Stateful


class PipelinedMapper(Stateful):
    """A :class:`SurfelMapper` that fuses each frame on a thread of its own while the next one is tracked.

    That one is tracked against what the fusion before saw, where the camera is still close by: always, also when
    fusion has ended already, so results do not depend on timing. Whatever else needs the map waits for it.
    """

    STATE: ClassVar = {"settled": Stateful, "_seen": ModelView | None}
    MADE = frozenset({"_mapper", "_fusing"})

    def __init__(self, mapper: SurfelMapper) -> None:
        self._mapper = mapper
        self._fusing: Future[None] | None = None
        self._seen: ModelView | None = None

    @property
    def settled(self) -> SurfelMapper:
        """The mapper, with all frames fused; raises what fusion has raised."""
        fusing = self._fusing
        if fusing is not None:
            wait([fusing])  # whoever is interrupted here still has it to wait for
            self._fusing = None
            fusing.result()
        return self._mapper

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_mapper": self.settled, "_fusing": None}  # a copy waits for nothing

    @property
    def config(self) -> FusionConfig:
        """That of fusion."""
        return self._mapper.config

    @property
    def map(self) -> SurfelMap:
        """The map, with all frames fused; to be asked for anew after the next one, which changes it from behind."""
        return self.settled.map

    def look(self, call: Callable[[SurfelMap], object]) -> None:
        """Call with the map once all frames are fused, without waiting for that; what changes the map next waits."""
        fusing, mapper = self._fusing, self._mapper
        if fusing is None:
            call(mapper.map)
            return

        def look() -> None:
            fusing.result()  # has ended: what runs in the background takes turns
            call(mapper.map)

        self._fusing = in_background(look)

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as a camera at `T_world_camera`, or close by, sees it or saw it one frame before the last."""
        if self._seen is not None and shows_the_same(self._seen, T_world_camera, camera):
            return self._seen
        return self.settled.view(T_world_camera, camera)

    def fuse(
        self, pyramid: SurfacePyramid, T_world_camera: Float64, *, keyframe: int = 0, moving: Bool | None = None
    ) -> None:
        """Begin to merge a frame into the map, as :meth:`SurfelMapper.fuse` does; waits for the one before."""
        mapper, frame = self.settled, pyramid.frame
        self._seen = mapper.last_seen if _is_settled(mapper.last_seen) else None
        threads = get_num_threads()
        if threads > 1 and frame.color is not None:  # a camera may fill its buffer with the next picture meanwhile
            pyramid = replace(pyramid, frame=replace(frame, color=frame.color.copy()))

        def fuse() -> None:
            with limited_threads(max(1, threads // 2)):  # tracking needs the others
                mapper.fuse(pyramid, T_world_camera, keyframe=keyframe, moving=moving)

        if threads == 1:
            fuse()
        else:
            self._fusing = in_background(fuse)

    def apply(self, correction: MapCorrection) -> None:
        """Move the map with its keyframes, see :meth:`SurfelMapper.apply`."""
        self._seen = None
        self.settled.apply(correction)

    def finish(self) -> None:
        """Do at once what was put off."""
        self.settled.finish()

    def fresh(self) -> PipelinedMapper:
        """Return a mapper like this one with an empty map."""
        return PipelinedMapper(self.settled.fresh())

    def take_in(self, other: PipelinedMapper, correction: MapCorrection) -> None:
        """Add the map of another mapper, moved with its keyframes."""
        self._seen = None
        self.settled.take_in(other.settled, correction)


def _is_settled(view: ModelView | None) -> bool:
    """Whether most of a view is stable: what is younger changes from frame to frame, and is worth waiting for."""
    return view is not None and bool(2 * np.count_nonzero(view.confidences >= view.stable_confidence) > len(view))
