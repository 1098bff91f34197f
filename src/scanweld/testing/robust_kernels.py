"""The contracts of a robust kernel and of what decides about a verified pose, as tests."""

from __future__ import annotations

import math

import numpy as np

from scanweld.arrays import Float64
from scanweld.registration.robust.kernels import robust_weights
from scanweld.registration.robust.losses import CompiledWeight, RobustKernel
from scanweld.registration.verification import Agreement, AgreementLimits
from scanweld.testing.promises import described, require, require_array, untouched

_STEP = 1e-6
_SMALL = 1e-3


def check_robust_kernel(kernel: RobustKernel) -> None:
    """Check that a kernel keeps what :class:`~scanweld.registration.robust.losses.RobustKernel` promises.

    `weight` is 1 at 0, never negative, the same on both sides, and the slope of `loss` over the residual; `loss` is
    half the square near 0 and never falls; `compiled` gives the kernels the same weights; residuals stay as they are,
    and there may be none.

    Parameters
    ----------
    kernel : the loss

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    for u in (_residuals(), np.zeros(1), np.zeros(0), np.full(5, 1e6)):
        _check_form(kernel, u)
    u = _residuals()
    weights, losses = kernel.weight(u), kernel.loss(u)
    require(weights[u == 0][0] == 1, f"weight: expected 1 at u = 0, got {weights[u == 0][0]!r}")
    require((weights >= 0).all(), f"weight: negative at u = {u[np.argmin(weights)]:.3g}")
    require(np.array_equal(kernel.weight(-u), weights), "weight: differs between u and -u")
    small = np.abs(u) < _SMALL
    require(np.allclose(losses[small], u[small] ** 2 / 2, rtol=1e-3, atol=0), "loss: expected u^2 / 2 near u = 0")
    rising = losses[np.argsort(np.abs(u), kind="stable")]
    require((np.diff(rising) >= -1e-9 * rising.max()).all(), "loss: a larger residual costs less than a smaller one")
    for k in np.flatnonzero(~small):
        lower, higher = u.copy(), u.copy()  # one at a time: a kernel may rank them
        lower[k] -= _STEP
        higher[k] += _STEP
        slope = (kernel.loss(higher)[k] - kernel.loss(lower)[k]) / (2 * _STEP)
        require(
            math.isclose(slope, weights[k] * u[k], rel_tol=1e-4, abs_tol=1e-6),
            f"weight: expected rho'(u) / u = {slope / u[k]:.6g} at u = {u[k]:.4g}, as the loss has it, "
            f"got {weights[k]:.6g}",
        )


def _residuals() -> Float64:
    """Return 41 residuals of every size, not sorted, whose sizes are no constants of a kernel; 0 is one of them."""
    sizes = np.concatenate([[0.0, 1e-5, 9e-4], np.geomspace(0.0123, 67.8, 38)])
    u = sizes * np.where(np.arange(41) % 3 == 1, -1, 1)
    return np.asarray(np.random.default_rng(5).permutation(u))


def _check_form(kernel: RobustKernel, u: Float64) -> None:
    with untouched("weight, loss or compiled", u):
        weights, losses, compiled = kernel.weight(u), kernel.loss(u), kernel.compiled(u)
    require_array(weights, np.float64, u.shape, "weight")
    require_array(losses, np.float64, u.shape, "loss")
    require(isinstance(compiled, CompiledWeight), f"compiled: expected a CompiledWeight, got {described(compiled)}")
    in_kernels = np.empty(u.shape)
    robust_weights(compiled.code, float(compiled.parameter), float(compiled.parameter2), u, in_kernels)
    wrong = ~np.isclose(in_kernels, weights, rtol=1e-9, atol=1e-12)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise AssertionError(
            f"compiled: the kernels weigh u = {u[k]:.4g} with {in_kernels[k]:.6g}, weight says {weights[k]:.6g}"
        )


def check_agreement_limits(limits: AgreementLimits) -> None:
    """Check that limits keep what :class:`~scanweld.registration.verification.AgreementLimits` promises.

    Both are shares; what agrees everywhere is trusted, what stands in free space everywhere is not.

    Parameters
    ----------
    limits : what has `min_agreement` and `max_conflict`

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    for name in ("min_agreement", "max_conflict"):
        share = getattr(limits, name)
        require(isinstance(share, float | int) and 0 <= share <= 1, f"{name}: expected a share, 0 to 1, got {share!r}")
    require(Agreement(1000, 1.0, 0.0, 0.0).fits(limits), "what agrees everywhere must be trusted")
    require(not Agreement(1000, 0.0, 1.0, 0.0).fits(limits), "what stands in free space must not be trusted")
