"""Whether what took no part in the adjustment fits better after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.refinement.config import RefinementConfig
from scanweld.refinement.observations import Views, fit_surfels, fitted_surfels, observe
from scanweld.refinement.surfels import Cameras, Surfels

SIGNIFICANCE = 3.0
"""Standard errors by which the loss must fall."""

CAPPED = 8.0
"""Largest loss of a sighting: four standard deviations with Huber's threshold at two."""


FITS = 4
"""Times that held-out surfels are fitted: their normals begin as noisy as one image gives them."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How well surfels that took no part fit a state.

    Attributes
    ----------
    sighting : (M,) surfel times keyframes plus keyframe, increasing
    depth : (M,) losses of the distances
    keyframes : K
    """

    sighting: Int64
    depth: Float64
    keyframes: int

    @property
    def mean(self) -> float:
        """Mean loss of the distances."""
        return float(self.depth.mean()) if len(self.depth) else 0.0


@dataclass(frozen=True, slots=True)
class Gain:
    """By how much a loss fell: mean over the sightings, and how many standard errors that is."""

    mean: float
    errors: float

    @property
    def significant(self) -> bool:
        """Whether chance does not explain it."""
        return self.mean > 0 and self.errors > SIGNIFICANCE


def measure(views: Views, surfels: Surfels, sampled: Cameras, cameras: Cameras, config: RefinementConfig) -> HeldOut:
    """Let held-out surfels find their places, and return the losses that are left.

    They begin as they were measured in their hosts, for every answer alike: surfels that were fitted for longer would
    speak for the answer that they were fitted with.

    Parameters
    ----------
    surfels, sampled : as they were sampled, and with what
    cameras : the answer
    """
    surfels = surfels.carried(sampled, cameras)
    count = len(surfels)
    for _ in range(FITS):
        found = observe(views, cameras, surfels, config.fine_gate_m, config.min_cosine, lit=False)
        fit = fit_surfels(found, count, config.robust_sigma)
        surfels = fitted_surfels(surfels, fit)
    o = fit.observations
    sighting = o.surfel.astype(np.int64) * len(views) + o.keyframe
    order = np.argsort(sighting)
    losses = np.minimum(fit.losses[:, 0], CAPPED)[order]
    return HeldOut(sighting[order], losses, len(views))


def gain(before: HeldOut, after: HeldOut) -> Gain:
    """Compare the losses of the same sightings; one that is there in one state only has the largest loss in the other.

    The standard error is that of the means of the keyframes, which do not share noise; sightings of one keyframe do.
    """
    both = np.union1d(before.sighting, after.sighting)
    if len(both) == 0:
        return Gain(0.0, 0.0)
    losses = []
    for side in (before, after):
        loss = np.full(len(both), CAPPED)
        loss[np.searchsorted(both, side.sighting)] = side.depth
        losses.append(loss)
    fall = losses[0] - losses[1]
    keyframe = both % before.keyframes
    counts = np.bincount(keyframe, minlength=before.keyframes)
    sums = np.bincount(keyframe, fall, before.keyframes)
    mean = float(fall.mean())
    # Standard error of a ratio of sums: residuals of the keyframes' sums about their share.
    seen = counts > 0
    scatter = float(np.sqrt(((sums - mean * counts)[seen] ** 2).sum()) / counts.sum())
    return Gain(mean, mean / max(scatter, 1e-12))
