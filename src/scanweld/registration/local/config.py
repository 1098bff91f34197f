"""Settings of the local aligners."""

from __future__ import annotations

from dataclasses import dataclass

from scanweld.config import check_ranges, setting
from scanweld.errors import ConfigError
from scanweld.geometry.normals import NEIGHBOURS
from scanweld.registration.closed_form import SCALES
from scanweld.registration.prior import parse_locks
from scanweld.registration.robust import RobustKernel, robust_kernel

METHODS = ("point-to-point", "point-to-plane", "symmetric", "gicp", "coloured")
PAIRINGS = ("nearest", "one-to-one", "mutual")


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpConfig:
    """Settings of :func:`~scanweld.registration.icp.icp`."""

    method: str = setting(
        "point-to-plane",
        "point-to-plane (surfaces, fast), symmetric (curved surfaces, further from the truth), gicp (plane to plane, "
        "noisy or uneven scans), coloured (flat surfaces with texture) or point-to-point (any points)",
    )
    max_correspondence_distance_m: float = setting(
        0.0,
        "pairs further apart do not count [m]; 0 takes 10 times the median spacing of the target's points, or "
        "a tenth of their median distance from their centre if that is more. Raising it reaches further, and "
        "lets in more wrong pairs",
        low=0.0,
    )
    voxel_m: float = setting(
        0.0, "average the points within cubes of this side first [m]; 0 uses all; raising it is faster", low=0.0
    )
    max_iterations: int = setting(100, "steps before giving up; more help slow point-to-point runs", low=1)
    tolerance: float = setting(
        1e-4,
        "done when a step moves the points by less than this share of the target's median spacing; "
        "raising it stops earlier",
        low=0.0,
    )
    coarse_to_fine: bool = setting(
        True, "begin with a part of a large source, which finds the same valley in a fraction of the time"
    )
    attempts: int = setting(
        24,
        "when the first answer does not fit, how many other starts around the first guess are tried; raising it "
        "reaches further, 0 trusts the guess",
        low=0,
    )
    kernel: str = setting(
        "auto",
        "robust kernel: none, huber, cauchy, geman_mcclure, tukey, welsch, barron or trimmed; auto takes cauchy for "
        "surfaces, whose residuals show the noise, and none for point-to-point, whose distances show the sampling",
    )
    kernel_scale_m: float = setting(
        0.0, "standard deviation of the noise of a residual [m]; 0 estimates it from the residuals' median", low=0.0
    )
    graduated: bool = setting(
        False, "graduated non-convexity: the kernel starts wide and narrows step by step; helps against many outliers"
    )
    scale: str = setting("none", "none, symmetric (point-to-point only) or least_squares")
    locks: str = setting(
        "",
        "directions of the target's axes that stay at the first guess: x, y, z, roll, pitch, yaw, separated by commas, "
        "or planar (z, roll, pitch) or gravity (roll, pitch)",
    )
    pairing: str = setting(
        "nearest",
        "nearest, one-to-one (a target serves its nearest source only) or mutual (each is the other's nearest)",
    )
    min_normal_cosine: float = setting(
        -1.0,
        "pairs whose normals agree less than this do not count, whatever their sign; -1 asks for nothing",
        low=-1.0,
        high=1.0,
    )
    reject_boundary: bool = setting(
        False, "pairs with the rim of the target do not count: points beyond it pull towards it"
    )
    anderson: int = setting(
        0, "steps that Anderson acceleration looks back; 0 is off, 5 helps slow point-to-point runs", low=0, high=20
    )
    min_overlap: float = setting(
        0.25,
        "share of the source that must find a partner; lower it for scans that share less",
        low=0.0,
        high=1.0,
    )
    neighbours: int = setting(NEIGHBOURS, "points for one normal; more smooth over noise and edges", low=3)

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, allowed in (("method", METHODS), ("scale", SCALES), ("pairing", PAIRINGS)):
            if getattr(self, name) not in allowed:
                raise ConfigError(f"{name} = {getattr(self, name)!r}: expected one of {', '.join(allowed)}")
        if self.scale == "symmetric" and self.method != "point-to-point":
            raise ConfigError("scale = 'symmetric' works with method point-to-point only; others take least_squares")
        parse_locks(self.locks)
        kernel_of(self)

    @property
    def needs_normals(self) -> bool:
        """Whether the method uses the target's normals."""
        return self.method != "point-to-point" or self.min_normal_cosine > 0 or self.reject_boundary

    @property
    def needs_source_normals(self) -> bool:
        """Whether the source's normals are used, too."""
        return self.method in ("symmetric", "gicp") or self.min_normal_cosine > 0


def kernel_of(config: IcpConfig) -> RobustKernel:
    """Return the robust kernel that the settings name."""
    if config.kernel == "auto":
        return robust_kernel("none" if config.method == "point-to-point" else "cauchy")
    return robust_kernel(config.kernel)
