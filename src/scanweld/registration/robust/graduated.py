"""Graduated non-convexity: from a loss that is convex, or nearly, to the loss that ignores outliers.

Source: H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception: from
non-minimal solvers to global outlier rejection", 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from scanweld.arrays import Float64
from scanweld.errors import ConfigError
from scanweld.registration.robust.losses import GemanMcClure, RobustKernel, TruncatedLeastSquares

GRADUATED_LOSSES = ("truncated", "geman_mcclure")

_SHARP = 100.0  # mu from which the band where weights are neither 0 nor 1 is 1 % wide: the surrogate is the loss


@dataclass(frozen=True, slots=True)
class GraduatedNonConvexity:
    """A schedule of kernels; take one step of the estimate with each, and stay with the last.

    Attributes
    ----------
    loss : "truncated" (outliers end with weight 0) or "geman_mcclure"
    c : largest residual, in units of the noise, of a pair that is no outlier
    rate : factor between steps, above 1. Raising it takes fewer steps, and may follow outliers
    """

    loss: str = "truncated"
    c: float = 3.0
    rate: float = 1.4

    def __post_init__(self) -> None:
        if self.loss not in GRADUATED_LOSSES:
            raise ConfigError(f"loss = {self.loss!r}: expected one of {', '.join(GRADUATED_LOSSES)}")
        if not self.c > 0:
            raise ConfigError(f"c = {self.c!r}: expected a number above 0")
        if not 1 < self.rate < np.inf:
            raise ConfigError(f"rate = {self.rate!r}: expected a number above 1")

    def schedule(self, u: Float64) -> tuple[RobustKernel, ...]:
        """Return the kernels from one that leaves every pair its say to the true loss, which comes last.

        Parameters
        ----------
        u : (N,), residuals of the first estimate in units of the noise
        """
        largest = float(np.abs(u).max(initial=0.0))
        squared = (largest / self.c) ** 2
        if self.loss == "geman_mcclure":
            # Geman-McClure of c sqrt(mu) is convex up to u^2 = mu c^2 / 3, here the largest residual.
            return tuple(GemanMcClure(self.c * sqrt(mu)) for mu in self._falling(3 * squared))
        # The band of falling weights ends at u^2 = c^2 (mu + 1) / mu, here twice the largest (remark 5 of the paper).
        start = 1 / (2 * squared - 1) if 2 * squared > 1 else np.inf
        steps: list[RobustKernel] = []
        while start < _SHARP:
            steps.append(TruncatedLeastSquares(self.c, start))
            start *= self.rate
        return (*steps, TruncatedLeastSquares(self.c))

    def _falling(self, start: float) -> list[float]:
        """Return start, start / rate, .. while above 1, and 1."""
        values = []
        while start > 1:
            values.append(start)
            start /= self.rate
        return [*values, 1.0]
