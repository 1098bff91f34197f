"""Robust kernels: how much a correspondence counts, given its residual in units of the noise.

Iteratively reweighted least squares with w(u) = rho'(u) / u, u = r / sigma, scaled so that w(0) = 1. Constants give
95 % efficiency on Gaussian noise where a docstring names no other reason.

Sources: Z. Zhang, "Parameter estimation techniques", 1997, table 1. J. T. Barron, "A general and adaptive robust loss
function", 2019. H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception",
2020. D. Chetverikov, D. Stepanov, P. Krsek, "Robust Euclidean alignment of 3D point sets: the trimmed iterative closest
point algorithm", 2005.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isinf, sqrt
from typing import NamedTuple, Protocol

import numpy as np

from scanweld.arrays import Float64
from scanweld.errors import ConfigError
from scanweld.registration.robust import kernels as k

SCALE_SAMPLE = 20_000
"""At most so many residuals, evenly spaced in their order, tell the scale: the error of their median is below 1 %."""


class CompiledWeight(NamedTuple):
    """A weight as the kernels take it, see the table in ``robust.kernels``."""

    code: int
    parameter: float = 1.0
    parameter2: float = 0.0


class RobustKernel(Protocol):
    """A loss by its weight; anything with these methods can be used."""

    def weight(self, u: Float64) -> Float64:
        """Return rho'(u) / u for residuals u in units of the noise; 1 at u = 0, never negative."""

    def loss(self, u: Float64) -> Float64:
        """Return rho(u); u^2 / 2 near 0."""

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels; `u` are all residuals, for a kernel that ranks them."""


@dataclass(frozen=True, slots=True)
class LeastSquares:
    """rho = u^2 / 2: every pair counts alike."""

    def weight(self, u: Float64) -> Float64:
        """Return ones."""
        return np.ones_like(u)

    def loss(self, u: Float64) -> Float64:
        """Return u^2 / 2."""
        return np.asarray(u * u / 2)

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return CompiledWeight(k.NONE)


@dataclass(frozen=True, slots=True)
class Huber:
    """Quadratic near zero, linear beyond k: convex, outliers pull with a constant force."""

    k: float = 1.345

    def __post_init__(self) -> None:
        _check_positive(k=self.k)

    def weight(self, u: Float64) -> Float64:
        """Return min(1, k / |u|)."""
        return np.asarray(self.k / np.maximum(np.abs(u), self.k))

    def loss(self, u: Float64) -> Float64:
        """Return u^2 / 2 within k, k (|u| - k / 2) beyond."""
        size = np.abs(u)
        return np.where(size <= self.k, size * size / 2, self.k * (size - self.k / 2))

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return CompiledWeight(k.HUBER, self.k)


@dataclass(frozen=True, slots=True)
class Cauchy:
    """rho = c^2 / 2 log(1 + (u / c)^2): outliers fade, but never quite."""

    c: float = 2.3849

    def __post_init__(self) -> None:
        _check_positive(c=self.c)

    def weight(self, u: Float64) -> Float64:
        """Return 1 / (1 + (u / c)^2)."""
        return np.asarray(1 / (1 + (u / self.c) ** 2))

    def loss(self, u: Float64) -> Float64:
        """Return c^2 / 2 log(1 + (u / c)^2)."""
        return np.asarray(self.c**2 / 2 * np.log1p((u / self.c) ** 2))

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return CompiledWeight(k.CAUCHY, self.c)


@dataclass(frozen=True, slots=True)
class GemanMcClure:
    """rho = (u^2 / 2) / (1 + (u / c)^2): outliers beyond a few c hardly count. c = 3 keeps 3 sigma at a quarter."""

    c: float = 3.0

    def __post_init__(self) -> None:
        _check_positive(c=self.c)

    def weight(self, u: Float64) -> Float64:
        """Return 1 / (1 + (u / c)^2)^2."""
        return np.asarray(1 / (1 + (u / self.c) ** 2) ** 2)

    def loss(self, u: Float64) -> Float64:
        """Return (u^2 / 2) / (1 + (u / c)^2); at most c^2 / 2."""
        return np.asarray(u * u / 2 / (1 + (u / self.c) ** 2))

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return CompiledWeight(k.GEMAN_MCCLURE, self.c)


@dataclass(frozen=True, slots=True)
class Tukey:
    """Biweight: residuals beyond c do not count at all."""

    c: float = 4.6851

    def __post_init__(self) -> None:
        _check_positive(c=self.c)

    def weight(self, u: Float64) -> Float64:
        """Return (1 - (u / c)^2)^2 within c, 0 beyond."""
        return np.asarray(np.maximum(1 - (u / self.c) ** 2, 0.0) ** 2)

    def loss(self, u: Float64) -> Float64:
        """Return c^2 / 6 (1 - (1 - (u / c)^2)^3) within c, c^2 / 6 beyond."""
        return np.asarray(self.c**2 / 6 * (1 - np.maximum(1 - (u / self.c) ** 2, 0.0) ** 3))

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return CompiledWeight(k.TUKEY, self.c)


@dataclass(frozen=True, slots=True)
class Welsch:
    """rho = c^2 / 2 (1 - exp(-(u / c)^2)): outliers fade exponentially."""

    c: float = 2.9846

    def __post_init__(self) -> None:
        _check_positive(c=self.c)

    def weight(self, u: Float64) -> Float64:
        """Return exp(-(u / c)^2)."""
        return np.exp(-((u / self.c) ** 2))

    def loss(self, u: Float64) -> Float64:
        """Return c^2 / 2 (1 - exp(-(u / c)^2)); at most c^2 / 2."""
        return np.asarray(-(self.c**2) / 2 * np.expm1(-((u / self.c) ** 2)))

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return CompiledWeight(k.WELSCH, self.c)


@dataclass(frozen=True, slots=True)
class Barron:
    """One family for most others (Barron 2019, eq. 8), times c^2 so that rho = u^2 / 2 near 0.

    Attributes
    ----------
    alpha : shape. 2 is least squares, 1 a smooth Huber (Charbonnier), 0 Cauchy of c sqrt 2, -2 Geman-McClure of 2 c,
        -inf Welsch of c sqrt 2; lowering it trusts large residuals less. Above 2 they would count more than small ones
    c : size of residual where the loss stops being quadratic
    """

    alpha: float = -2.0
    c: float = 1.5

    def __post_init__(self) -> None:
        _check_positive(c=self.c)
        if not self.alpha <= 2:
            raise ConfigError(f"alpha = {self.alpha!r}: expected a number up to 2, or -inf")

    def weight(self, u: Float64) -> Float64:
        """Return ((u / c)^2 / |alpha - 2| + 1)^(alpha / 2 - 1), and its limits."""
        special = self._special()
        if special is not None:
            return special.weight(u)
        return np.asarray(((u / self.c) ** 2 / (2 - self.alpha) + 1) ** (self.alpha / 2 - 1))

    def loss(self, u: Float64) -> Float64:
        """Return c^2 |alpha - 2| / alpha (((u / c)^2 / |alpha - 2| + 1)^(alpha / 2) - 1), and its limits."""
        special = self._special()
        if special is not None:
            return special.loss(u)
        gap = 2 - self.alpha
        # expm1 and log1p: near alpha = 0 the difference from 1 is all there is.
        grown = np.expm1(self.alpha / 2 * np.log1p((u / self.c) ** 2 / gap))
        return np.asarray(self.c**2 * gap / self.alpha * grown)

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels, a limit by the code of the kernel that it is."""
        special = self._special()
        return CompiledWeight(k.BARRON, self.c, self.alpha) if special is None else special.compiled(u)

    def _special(self) -> RobustKernel | None:
        """Return the kernel that this one is in the limit, where the formula has none."""
        if self.alpha == 2:
            return LeastSquares()
        if self.alpha == 0:
            return Cauchy(self.c * sqrt(2))
        return Welsch(self.c * sqrt(2)) if isinf(self.alpha) else None


@dataclass(frozen=True, slots=True)
class Trimmed:
    """Least trimmed squares: the pairs with the smallest residuals count, whatever the noise; the rest do not.

    Attributes
    ----------
    share : of the pairs that count, above 0 to 1. Lowering it stands more outliers, and uses less of the data
    """

    share: float = 0.8

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise ConfigError(f"share = {self.share!r}: expected a number above 0, up to 1")

    def threshold(self, u: Float64) -> float:
        """Return the largest |u| that counts: that of rank ceil(share N)."""
        if len(u) == 0:
            return 0.0
        rank = min(max(int(np.ceil(self.share * len(u))), 1), len(u)) - 1
        return float(np.partition(np.abs(u), rank)[rank])

    def weight(self, u: Float64) -> Float64:
        """Return 1 for the best share of these residuals and what equals the last of them, 0 for the others."""
        return (np.abs(u) <= self.threshold(u)).astype(np.float64)

    def loss(self, u: Float64) -> Float64:
        """Return u^2 / 2 for the best share, its largest value for the others."""
        return np.minimum(np.abs(u), self.threshold(u)) ** 2 / 2

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels, with the threshold of these residuals."""
        return CompiledWeight(k.TRUNCATED, self.threshold(u))


@dataclass(frozen=True, slots=True)
class TruncatedLeastSquares:
    """rho = min(u^2, c^2) / 2, or its surrogate of graduated non-convexity (Yang et al. 2020, eq. 6 and 14).

    Attributes
    ----------
    c : largest residual of a pair that counts
    mu : inf is the truth; towards 0 the surrogate becomes convex, and counts what lies beyond c ever more
    """

    c: float = 3.0
    mu: float = inf

    def __post_init__(self) -> None:
        _check_positive(c=self.c, mu=self.mu)

    def weight(self, u: Float64) -> Float64:
        """Return 1 to c sqrt(mu / (mu + 1)), 0 from c sqrt((mu + 1) / mu), c / |u| sqrt(mu (mu + 1)) - mu between."""
        size = np.abs(u)
        if isinf(self.mu):
            return (size <= self.c).astype(np.float64)
        between = self.c / np.maximum(size, 1e-300) * sqrt(self.mu * (self.mu + 1)) - self.mu
        return np.clip(between, 0.0, 1.0)

    def loss(self, u: Float64) -> Float64:
        """Return u^2 / 2, c^2 / 2, or c |u| sqrt(mu (mu + 1)) - mu (c^2 + u^2) / 2 between."""
        size = np.abs(u)
        if isinf(self.mu):
            return np.minimum(size, self.c) ** 2 / 2
        low, high = self.c * sqrt(self.mu / (self.mu + 1)), self.c * sqrt((self.mu + 1) / self.mu)
        between = self.c * size * sqrt(self.mu * (self.mu + 1)) - self.mu * (self.c**2 + size * size) / 2
        return np.where(size <= low, size * size / 2, np.where(size >= high, self.c**2 / 2, between))

    def compiled(self, u: Float64) -> CompiledWeight:
        """Return the weight for kernels."""
        return (
            CompiledWeight(k.TRUNCATED, self.c) if isinf(self.mu) else CompiledWeight(k.GNC_TRUNCATED, self.c, self.mu)
        )


KERNELS: dict[str, Callable[[], RobustKernel]] = {
    "none": LeastSquares,
    "huber": Huber,
    "cauchy": Cauchy,
    "geman_mcclure": GemanMcClure,
    "tukey": Tukey,
    "welsch": Welsch,
    "barron": Barron,
    "trimmed": Trimmed,
}


def robust_kernel(name: str) -> RobustKernel:
    """Return the kernel of that name with its standard constants."""
    if name not in KERNELS:
        raise ConfigError(f"kernel = {name!r}: expected one of {', '.join(KERNELS)}")
    return KERNELS[name]()


def mad_scale(residuals: Float64) -> float:
    """Return the standard deviation of the noise, 1.4826 median |r|, whatever the outliers; 0 when empty.

    Of more than ``SCALE_SAMPLE`` residuals every second, third, ... counts, so that a million cost no more.
    """
    stride = -(-len(residuals) // SCALE_SAMPLE)
    if stride == 0:
        return 0.0
    sizes = np.abs(residuals[::stride])
    # np.median without its checks: this runs in every iteration.
    low, high = (len(sizes) - 1) // 2, len(sizes) // 2
    sizes.partition((low, high))
    return float(1.4826 * (sizes[low] + sizes[high]) / 2)


def _check_positive(**constants: float) -> None:
    for name, value in constants.items():
        if not value > 0:
            raise ConfigError(f"{name} = {value!r}: expected a number above 0")
