"""Anderson acceleration of a fixed-point iteration on motions (Pavlov, Ovchinnikov et al. 2018, "AA-ICP")."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.registration.local.problem import Motion

_LARGEST = 10.0  # sizes of the plain step that an accelerated one may reach


class Anderson:
    """Extrapolates from the last `depth` steps; depth 0 leaves every step as it is.

    The iterates are twists from the start (and the logarithm of the scale). A window whose steps grow instead of
    shrinking is forgotten: extrapolation is only sound near the fixed point.
    """

    def __init__(self, start: Motion, depth: int) -> None:
        self._start = start
        self._depth = depth
        self._places: list[Float64] = []
        self._steps: list[Float64] = []

    def accelerate(self, before: Motion, after: Motion) -> Motion:
        """Return the motion to go on from, given a plain step from `before` to `after`."""
        if self._depth == 0:
            return after
        x, g = self._coordinates(before), self._coordinates(after)
        step = g - x
        if self._steps and np.linalg.norm(step) > np.linalg.norm(self._steps[-1]):
            self._places.clear()
            self._steps.clear()
        self._places.append(g)
        self._steps.append(step)
        del self._places[: -self._depth - 1], self._steps[: -self._depth - 1]
        if len(self._steps) < 2:
            return after
        differences = np.diff(np.array(self._steps), axis=0).T
        gamma = np.linalg.lstsq(differences, step, rcond=1e-9)[0]
        ahead = g - np.diff(np.array(self._places), axis=0).T @ gamma
        if np.linalg.norm(ahead - x) > _LARGEST * np.linalg.norm(step):
            return after
        return self._motion(ahead)

    def _coordinates(self, motion: Motion) -> Float64:
        xi = se3.log(motion.T @ se3.inverse(self._start.T))
        return np.append(xi, np.log(motion.scale / self._start.scale))

    def _motion(self, y: Float64) -> Motion:
        return Motion(se3.exp(y[:6]) @ self._start.T, float(self._start.scale * np.exp(y[6])))
