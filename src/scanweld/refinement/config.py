"""Settings of the refinement."""

from __future__ import annotations

from dataclasses import dataclass

from scanweld.config import check_ranges, section, setting
from scanweld.errors import ConfigError
from scanweld.geometry.depth import SurfaceConfig

_PHOTOMETRY = ("auto", "off")


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementConfig:
    """How keyframes are adjusted, and what else is estimated with their poses."""

    iterations: int = setting(
        12, "most iterations of each stage; too few leave drift, more than needed cost nothing", low=1, high=1000
    )
    photometry: str = setting(
        "auto", "auto uses brightness where what was held out fits better with it; off uses depth alone"
    )
    calibrate_intrinsics: bool = setting(
        False, "estimate fx, fy, cx and cy, too, where the views determine them; the map is to be made again"
    )
    calibrate_depth: bool = setting(
        False,
        "estimate an offset of inverse depth, too, where the views determine it; the map is to be made again",
    )
    max_relative_sigma: float = setting(
        0.005,
        "parameters of the camera that are known less well than this share of a point's depth stay as they are and are "
        "named; raise it to estimate them all the same, lower it to be told sooner",
        low=1e-6, high=1.0,
    )  # fmt: skip
    cell_px: int = setting(
        4, "a keyframe has at most one surfel in so many pixels squared; lower for accuracy, costs time", low=1, high=64
    )
    max_observations: int = setting(
        400_000,
        "surfels are thinned out until they are seen so often, all together; raise for accuracy, costs time and memory",
        low=1000,
    )
    coarse_gate_m: float = setting(
        0.12,
        "largest distance of a surfel from the depth in the first iteration [m]; raise for large drift, lower for "
        "clutter",
        low=1e-3,
    )
    fine_gate_m: float = setting(
        0.05, "the same in the end [m]; too low drops what drifted, too high ties things that are not the same",
        low=1e-3,
    )  # fmt: skip
    min_cosine: float = setting(0.7, "normals agree at least this well; lower for noise", low=0.0, high=1.0)
    robust_sigma: float = setting(
        2.0, "Huber threshold in standard deviations of the depth noise; lower for outliers", low=0.1
    )
    drift: float = setting(
        0.005,
        "standard deviation of the tracked motion between neighbouring keyframes over its length; lower it to keep to "
        "the path, raise it to let it bend where little is seen",
        low=1e-4, high=1.0,
    )  # fmt: skip
    surfaces: SurfaceConfig = section(SurfaceConfig, "how the depth of a keyframe becomes surfaces")

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.photometry not in _PHOTOMETRY:
            raise ConfigError(f"photometry = {self.photometry!r}: expected {' or '.join(_PHOTOMETRY)}")
        if self.fine_gate_m > self.coarse_gate_m:
            raise ConfigError(f"fine_gate_m = {self.fine_gate_m}: expected at most coarse_gate_m, {self.coarse_gate_m}")
