"""A sequence as a better calibrated camera would have recorded it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from scanweld.datasets.base import WrappedSequence
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.refinement.calibration import DepthCorrection


@dataclass(frozen=True, slots=True)
class CalibratedSequence(WrappedSequence):
    """The frames of `base` with other intrinsics and corrected depth."""

    calibrated: PinholeCamera
    depth: DepthCorrection

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics that were found."""
        return self.calibrated

    def read(self, index: int) -> Frame:
        """Decode frame `index` and correct its depth."""
        frame = self.base.read(index)
        return replace(frame, camera=self.calibrated, depth_m=self.depth.apply(frame.depth_m))
