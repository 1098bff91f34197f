"""Robust kernels: their weights are the slope of their losses, and outliers lose theirs."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import ConfigError
from scanweld.registration.robust import KERNELS, Cauchy, GemanMcClure, Huber, Tukey, mad_scale, robust_kernel

U = np.linspace(-12, 12, 481)


@pytest.mark.parametrize("name", KERNELS)
def test_weights_are_one_at_zero_even_and_never_rise(name):
    weight = robust_kernel(name).weight(U)
    assert robust_kernel(name).weight(np.zeros(1)) == 1
    np.testing.assert_allclose(weight, weight[::-1])
    assert (np.diff(weight[U >= 0]) <= 1e-15).all()
    assert (weight >= 0).all()


@pytest.mark.parametrize(
    ("kernel", "loss"),
    [
        (Huber(1.5), lambda u: np.where(np.abs(u) < 1.5, u**2 / 2, 1.5 * np.abs(u) - 1.5**2 / 2)),
        (Cauchy(2.0), lambda u: 2 * np.log1p((u / 2) ** 2)),
        (GemanMcClure(3.0), lambda u: u**2 / 2 / (1 + (u / 3) ** 2)),
        (Tukey(4.0), lambda u: 16 / 6 * (1 - np.maximum(1 - (u / 4) ** 2, 0) ** 3)),
    ],
)
def test_the_weight_is_the_slope_of_the_loss_over_the_residual(kernel, loss):
    u, h = U[np.abs(np.abs(U) - 1.5) > 0.01], 1e-6
    slope = (loss(u + h) - loss(u - h)) / (2 * h)
    np.testing.assert_allclose(kernel.weight(u) * u, slope, atol=1e-7)


def test_constants_keep_95_percent_of_the_efficiency_on_gaussian_noise():
    """Efficiency of an M-estimator of location: E[psi']^2 / E[psi^2] with psi = w(u) u and unit Gaussian noise."""
    u = np.linspace(-9, 9, 200_001)
    density = np.exp(-(u**2) / 2) / np.sqrt(2 * np.pi)
    du = u[1] - u[0]
    for kernel in (Huber(), Cauchy(), Tukey()):
        psi = kernel.weight(u) * u
        efficiency = (np.gradient(psi, du) * density).sum() ** 2 * du / (psi**2 * density).sum()
        assert efficiency == pytest.approx(0.95, abs=1e-3)


def test_mad_scale_ignores_outliers():
    rng = np.random.default_rng(0)
    residuals = np.concatenate([0.02 * rng.normal(size=10_000), np.full(1000, 50.0)])
    assert mad_scale(residuals) == pytest.approx(0.02, rel=0.2)
    assert mad_scale(np.zeros(0)) == 0


def test_an_unknown_kernel_names_the_known_ones():
    with pytest.raises(ConfigError, match="huber"):
        robust_kernel("hubber")
