"""Whether an alignment found by nearest neighbours is better than what unrelated clouds would give.

Nearest neighbours always exist and their distances always shrink, so small steps alone prove nothing. The
evidence is gathered at the final motion, on a sample:

- *Points that coincide* (far closer than the target's own spacing) are evidence enough.
- *Surfaces* (the neighbourhoods are flat): where the clouds show the same surface, what remains between a
  point and its partner runs along the surface, from sampling. Distances that run along the normals, or that
  fill the gate, mean that the surfaces do not meet.
- *Clouds without surfaces*: a point dropped at random among the target's points has a nearest neighbour at
  about the target's own spacing. Pairs that are no closer than that could be chance.

The bounds were set on rendered rooms, LiDAR, laser and depth-camera scans, aligned and misaligned, and on
random clouds (docs/registration.md, "How far to trust it").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry.neighbours import NeighbourIndex
from scanweld.geometry.normals import SurfaceFit, fit_surfaces, flatness

COINCIDENT = 0.1
"""Pairs closer than this share of the spacing are the same points."""

SAMPLE = 700
"""Pairs that are looked at: their median is known to about 4 %."""

_WIDE = 64  # neighbours that tell a noisy surface from a cloud without surfaces
_NO_SURFACE = 0.3  # smallest over largest eigenvalue of such a neighbourhood: a ball has about 0.5, a surface 0 to 0.2
_FILLS_GATE = 0.15  # median plane distance over the reach; evenly spread distances have 0.5, aligned scans 0 to 0.06
_ALONG_NORMAL = 0.55  # median plane distance over median distance; isotropic noise has 0.47
_APART = 1.2  # spacings between the points of a pair, beyond which the direction above means something
_CHANCE, _CHANCE_SMALL = (
    0.8,
    1.2,
)  # spacings: 0.8 - 1.2 / sqrt(N); few points are brought together by the fit itself


@dataclass(frozen=True, slots=True)
class Evidence:
    """A sample of pairs at the final motion.

    Attributes
    ----------
    moved, partners : (M, D), source points in the target frame and their nearest targets [m]
    distances_m : (M,)
    normals : (M, D), of the target at the partners; zero where unknown
    normal_variance : median angular variance of the normals [rad^2]
    surfaces : whether the target's neighbourhoods are flat
    spacing_m : median spacing of the target
    reach_m : distance up to which pairs were looked for
    """

    moved: Float64
    partners: Float64
    distances_m: Float64
    normals: Float64
    normal_variance: float
    surfaces: bool
    spacing_m: float
    reach_m: float

    @property
    def num_targets(self) -> int:
        """Number of different partners."""
        return len(np.unique(self.partners, axis=0))

    @property
    def coincident(self) -> bool:
        """Whether the pairs are the same points."""
        return bool(np.median(self.distances_m) <= COINCIDENT * self.spacing_m)


def has_surfaces(target: Float64, places: Float64, index: NeighbourIndex) -> bool:
    """Whether the target (M, D) looks flat around most places; noise hides a surface from few neighbours."""
    return bool(np.median(flatness(target, at=places, index=index, neighbours=_WIDE)) <= _NO_SURFACE)


def gather_evidence(
    moved: Float64,
    target: Float64,
    index: NeighbourIndex,
    spacing_m: float,
    reach_m: float,
    neighbours: int,
    surfaces: bool,
    fit: SurfaceFit | None = None,
) -> Evidence:
    """Pair a sample of the moved source points (N, D) and look at the target around their partners.

    At least one point must have a partner within the reach. `surfaces`: see :func:`has_surfaces`.
    `fit`: that of the whole target, where it is there.
    """
    distances, partner = index.nearest(moved, reach_m)
    near = np.flatnonzero(np.isfinite(distances))
    near = near[:: max(1, len(near) // SAMPLE)]
    partners = target[partner[near]]
    if fit is None:
        fit = fit_surfaces(target, at=partners, index=index, neighbours=neighbours)
    else:
        fit = SurfaceFit(fit.normals[partner[near]], fit.angular_variance[partner[near]])
    return Evidence(
        moved=moved[near],
        partners=partners,
        distances_m=distances[near],
        normals=fit.normals,
        normal_variance=float(np.median(fit.angular_variance)),
        surfaces=surfaces,
        spacing_m=spacing_m,
        reach_m=reach_m,
    )


def doubt(evidence: Evidence) -> str:
    """Say why the fit could be chance, or "" when it could not."""
    if evidence.coincident:
        return ""
    distance = float(np.median(evidence.distances_m))
    spacings = distance / evidence.spacing_m
    if not evidence.surfaces:
        if spacings > _CHANCE - _CHANCE_SMALL / np.sqrt(len(evidence.distances_m)):
            return (
                f"the clouds show no common structure: nearest points are {distance:.3g} m apart, "
                f"{spacings:.2g} times the target's spacing, as for unrelated points"
            )
        return ""
    across = np.abs(np.einsum("nd,nd->n", evidence.normals, evidence.moved - evidence.partners))
    plane = float(np.median(across))
    if plane > _FILLS_GATE * evidence.reach_m or (plane > _ALONG_NORMAL * distance and spacings > _APART):
        return (
            f"the surfaces do not meet: half of the points are more than {plane:.3g} m off the target's "
            f"surface (its spacing is {evidence.spacing_m:.3g} m); a wrong minimum, or different scenes"
        )
    return ""
