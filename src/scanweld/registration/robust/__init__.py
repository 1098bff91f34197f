"""Robust kernels: losses that stand outliers, their weights, and the way from a convex loss to them."""

from scanweld.registration.robust.graduated import GRADUATED_LOSSES, GraduatedNonConvexity
from scanweld.registration.robust.losses import (
    KERNELS,
    Barron,
    Cauchy,
    CompiledWeight,
    GemanMcClure,
    Huber,
    LeastSquares,
    RobustKernel,
    Trimmed,
    TruncatedLeastSquares,
    Tukey,
    Welsch,
    mad_scale,
    robust_kernel,
)

__all__ = [
    "GRADUATED_LOSSES",
    "KERNELS",
    "Barron",
    "Cauchy",
    "CompiledWeight",
    "GemanMcClure",
    "GraduatedNonConvexity",
    "Huber",
    "LeastSquares",
    "RobustKernel",
    "Trimmed",
    "TruncatedLeastSquares",
    "Tukey",
    "Welsch",
    "mad_scale",
    "robust_kernel",
]
