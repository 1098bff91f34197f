"""How a mesh is made."""

from __future__ import annotations

from dataclasses import dataclass

from scanweld.config import check_ranges, section, setting
from scanweld.geometry.depth import SurfaceConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshConfig:
    """How depth becomes a grid of distances, and that a mesh."""

    voxel_m: float = setting(
        0.0,
        "spacing of the grid [m]; 0: chosen by the spacing of pixels and the noise at the usual depth",
        low=0.0,
        high=10.0,
    )
    truncation_sigmas: float = setting(
        3.0, "distances are kept within so many standard deviations of the depth noise; raise for noise", low=0.5
    )
    least_truncation_voxels: float = setting(3.0, "and at least within so many voxels", low=2.0, high=16.0)
    most_truncation_voxels: float = setting(
        8.0, "and at most; raise for noise, lower for thin things and speed", low=2.0, high=64.0
    )
    surfaces: SurfaceConfig = section(
        lambda: SurfaceConfig(levels=1), "how depth becomes surfaces; max_depth_m leaves out what is further away"
    )
    deepest: float = setting(
        0.5,
        "no surface beside a sample that is further behind than this share of the truncation; lower leaves out more at "
        "outlines, raise for noise",
        low=0.1,
    )
    least_component: int = setting(
        200, "pieces of fewer triangles are left out; lower for detail, raise for noise", low=0
    )
    fill_holes_m: float = setting(0.0, "holes with a border up to this long are closed [m]; 0 closes none", low=0.0)
    max_memory_mb: float = setting(2000.0, "memory that the grid may take [MB]; it ends with an error beyond", low=1.0)

    def __post_init__(self) -> None:
        check_ranges(self)
