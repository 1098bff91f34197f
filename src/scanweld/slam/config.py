"""Everything that a run depends on besides its input."""

from __future__ import annotations

from dataclasses import dataclass

from scanweld.config import check_ranges, section, setting
from scanweld.errors import ConfigError
from scanweld.geometry.depth import SurfaceConfig
from scanweld.loop_closure.loop_closer import LoopClosingConfig
from scanweld.mapping.fusion import FusionConfig
from scanweld.mapping.storage.pages import MapConfig
from scanweld.refinement.config import RefinementConfig
from scanweld.slam.health import HealthConfig
from scanweld.slam.parts import FragmentConfig
from scanweld.slam.submaps import SubmapConfig
from scanweld.tracking.dynamics import DynamicsConfig
from scanweld.tracking.tracker import TrackingConfig

_LOOP_CLOSERS = ("keyframes", "none")


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamConfig:
    """Everything that a run depends on besides its input."""

    seed: int = setting(0, "seed of whatever is random", low=0)
    surfaces: SurfaceConfig = section(SurfaceConfig, "how depth becomes surfaces")
    tracking: TrackingConfig = section(TrackingConfig, "how a frame is aligned with the map")
    fusion: FusionConfig = section(FusionConfig, "how a frame is merged into the map")
    map: MapConfig = section(MapConfig, "where the map is kept")
    health: HealthConfig = section(HealthConfig, "when a tracked pose is not believed")
    submaps: SubmapConfig = section(SubmapConfig, "when a lost camera begins a new map")
    dynamics: DynamicsConfig = section(DynamicsConfig, "what counts as moving, and is kept out of the map")
    loop_closer: str = setting(
        "keyframes",
        "keyframes remembers places, finds a lost camera and closes loops; none does without: odometry alone",
    )
    refinement: RefinementConfig = section(RefinementConfig, "how keyframes are adjusted after a run, if asked for")
    loop_closing: LoopClosingConfig = section(LoopClosingConfig, "how places are remembered, and loops closed")
    fragments: FragmentConfig = section(FragmentConfig, "how a recording is cut into fragments, if asked for")

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.loop_closer not in _LOOP_CLOSERS:
            raise ConfigError(f"loop_closer = {self.loop_closer!r}: expected {' or '.join(_LOOP_CLOSERS)}")
