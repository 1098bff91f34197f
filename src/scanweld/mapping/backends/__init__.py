"""The hot operations on the map: arrays in, arrays out; see docs/decisions/0016-backends.md.

The map is given as its pages; operations read and write `pool` (`whole` as int32), `counts` and `dirty` of them.
"""

from __future__ import annotations

from typing import Protocol

from scanweld.arrays import Float32, Float64, Int32, UInt8
from scanweld.backends import get_backend
from scanweld.geometry.camera import PinholeCamera
from scanweld.mapping.backends import compiled, reference
from scanweld.mapping.backends.arrays import DepthBuffers, IndexMap, Measurement
from scanweld.mapping.storage.pages import PagePool


class MapBackend(Protocol):
    """What an implementation has to offer.

    A view is rows (H, W) int32, which row of the values is seen at a pixel, -1 where none is, and values (8, N)
    float32: position, normal, confidence, and luminance (ITU-R BT.601) of each surfel that is seen, in the order of
    the pages and of the places in them. `limits` (6,) float32: the gate of fusion in standard deviations, its floor
    [m], the least cosine of normals that agree, the margin of free space [m], how near to a pixel's centre a surfel
    covers it [pixels], the largest confidence.
    """

    def index_map(
        self,
        pages: PagePool,
        slots: Int32,
        T_world_camera: Float64,
        camera: PinholeCamera,
        stable_confidence: float,
        buffers: DepthBuffers,
    ) -> IndexMap:
        """Find the nearest surfel of pages `slots` (P,) at each pixel; each surfel lands in the pixel of its centre.

        A depth is compared in whole micrometres, and of equal ones the surfel of the lower number wins, so there is one
        answer. A surfel below `stable_confidence` counts as further away by two percent. Those at less than a hundredth
        of a metre, seen from behind, or at an angle with a cosine below 0.1 are not seen. `buffers` are for a z-buffer.
        """
        ...

    def show(self, pages: PagePool, seen: IndexMap) -> tuple[Int32, Float32]:
        """Return the view (rows, values) of an index map."""
        ...

    def merge(
        self, pages: PagePool, seen: IndexMap, frame: Measurement, limits: Float32
    ) -> tuple[UInt8, Int32, Float32]:
        """Merge the surfels that are seen with what their pixels measure, in place (Keller et al. 2013, eq. 5-8).

        A surfel that agrees with its pixel becomes the mean of both, weighted by confidence; where something moves it
        is demoted to the confidence of one measurement instead. One that its pixel and all neighbours look through
        loses the pixel's weight. Pages in which a surfel lost confidence are marked `dirty`.

        Returns
        -------
        merged : (H, W) uint8, 1 where the surfel of the pixel agrees with what it measures
        rows, values : the view of what the surfels have become
        """
        ...

    def new_surfels(
        self, rows: Int32, values: Float32, merged: UInt8, frame: Measurement, limits: Float32, anchor: int
    ) -> Float32:
        """Make surfels of the pixels whose measurement is not in the map: neither merged, nor covered by the surfel of
        one of the eight neighbours, nor moving.

        Parameters
        ----------
        rows, values, merged : what :meth:`merge` returned
        anchor : keyframe that the new surfels move with

        Returns
        -------
        surfels : (ROWS, N) float32, in the order of the pixels; the last three rows are int32
        """
        ...


_IMPLEMENTATIONS: dict[str, MapBackend] = {"numba": compiled, "numpy": reference}


def backend() -> MapBackend:
    """Return the implementation that is used."""
    return _IMPLEMENTATIONS[get_backend()]
