"""A sequence as a better calibrated camera would have recorded it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from scanweld.arrays import Float64
from scanweld.datasets.base import RgbdSequence, readable_frames
from scanweld.datasets.gyroscope import Gyroscope, gyroscope_of
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.refinement.calibration import DepthCorrection
from scanweld.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class CalibratedSequence:
    """The frames of `base` with other intrinsics and corrected depth."""

    base: RgbdSequence
    camera: PinholeCamera
    depth: DepthCorrection

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return self.base.name

    @property
    def depth_scale(self) -> float:
        """Units per metre of the stored depth."""
        return self.base.depth_scale

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth; it does not depend on the camera."""
        return self.base.ground_truth

    @property
    def timestamps_s(self) -> Float64:
        """Time of every frame (N,) [s]."""
        return self.base.timestamps_s

    @property
    def gyroscope(self) -> Gyroscope | None:
        """Readings of a gyroscope, where there is one."""
        return gyroscope_of(self.base)

    def __len__(self) -> int:
        return len(self.base)

    def read(self, index: int) -> Frame:
        """Decode a frame."""
        frame = self.base.read(index)
        return replace(frame, camera=self.camera, depth_m=self.depth.apply(frame.depth_m))

    def __iter__(self) -> Iterator[Frame]:
        return readable_frames(self)
