"""What is kept of every iteration, where asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64
from scanweld.registration.closed_form import HornFit
from scanweld.registration.correspondences import Correspondences
from scanweld.registration.local.config import IcpConfig
from scanweld.registration.local.linearisation import Noise
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import Motion, Problem
from scanweld.registration.local.steps import explained_fit, weighted_pairs
from scanweld.registration.robust import RobustKernel


@dataclass(frozen=True, slots=True)
class IcpStep:
    """One iteration; `pairs` were found at `T_before`, and led to `T_after`.

    Attributes
    ----------
    T_before, T_after : (D + 1, D + 1), T_target_source
    scale_before, scale_after : 1 unless the scale is estimated
    pairs : rows of source and target, and their distances [m]
    fit : closed form of the step in the source's frame, T_after = T_before T_step; of point-to-point only
    rmse_m : root mean square residual of the pairs before the step [m]
    displacement_m : how far the step moved the points
    """

    T_before: Float64
    T_after: Float64
    scale_before: float
    scale_after: float
    pairs: Correspondences
    fit: HornFit | None
    rmse_m: float
    displacement_m: float


def record(
    problem: Problem,
    config: IcpConfig,
    before: Motion,
    after: Motion,
    pairs: Pairing,
    noise: Noise,
    kernel: RobustKernel,
    rmse_m: float,
    displacement: float,
) -> IcpStep:
    """Write down a step: pairs in rows of the clouds as given, ascending in the source."""
    rows = np.flatnonzero(pairs.partner >= 0)
    source, target = problem.source_rows[rows], problem.target_rows[pairs.partner[rows]]
    order = np.argsort(source, kind="stable")
    found = Correspondences(source[order], target[order], np.sqrt(pairs.squared[rows])[order])
    fit = None
    if config.method == "point-to-point":
        _, weights = weighted_pairs(problem, pairs, noise, kernel)
        fit = explained_fit(problem, config, before, pairs, weights)
    return IcpStep(
        T_before=problem.uncentred(before),
        T_after=problem.uncentred(after),
        scale_before=before.scale,
        scale_after=after.scale,
        pairs=found,
        fit=fit,
        rmse_m=rmse_m,
        displacement_m=displacement,
    )
