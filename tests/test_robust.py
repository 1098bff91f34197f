"""Robust kernels: their weights are the slope of their losses, and outliers lose theirs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.errors import ConfigError
from scanweld.geometry import se3
from scanweld.registration.closed_form import fit_pairs
from scanweld.registration.robust import (
    KERNELS,
    Barron,
    Cauchy,
    GemanMcClure,
    GraduatedNonConvexity,
    Huber,
    LeastSquares,
    Trimmed,
    TruncatedLeastSquares,
    Tukey,
    Welsch,
    mad_scale,
    robust_kernel,
)
from scanweld.registration.robust.kernels import robust_weights

U = np.linspace(-12, 12, 481)
FAMILY = [
    LeastSquares(), Huber(1.5), Cauchy(2.0), GemanMcClure(3.0), Tukey(4.0), Welsch(2.0), Trimmed(0.7),
    *(Barron(alpha, 1.3) for alpha in (2, 1.999, 1, 0.5, 1e-9, 0, -1e-9, -1, -2, -10, -1e3, -np.inf)),
    *(TruncatedLeastSquares(3.0, mu) for mu in (1e-3, 0.1, 1, 10, np.inf)),
]  # fmt: skip


@pytest.mark.parametrize("kernel", [*FAMILY, *(robust_kernel(name) for name in KERNELS)], ids=repr)
def test_weights_are_one_at_zero_even_and_never_rise(kernel):
    weight = kernel.weight(U)
    assert kernel.weight(np.zeros(1)) == 1
    assert kernel.loss(np.zeros(1)) == 0
    np.testing.assert_allclose(weight, weight[::-1])
    assert (np.diff(weight[U >= 0]) <= 1e-15).all()
    assert (np.diff(kernel.loss(U)[U >= 0]) >= -1e-12).all()
    assert (weight >= 0).all()


@pytest.mark.parametrize("kernel", FAMILY, ids=repr)
def test_the_weight_is_the_slope_of_the_loss_over_the_residual(kernel):
    """rho'(u) = w(u) u, by central differences; a corner of the loss has no slope and is left out."""
    h = 1e-5
    slope = (kernel.loss(U + h) - kernel.loss(U - h)) / (2 * h)
    expected = kernel.weight(U) * U
    if isinstance(kernel, Trimmed):  # which residuals count is a matter of all of them: hold the threshold
        kernel = TruncatedLeastSquares(kernel.threshold(U))
        slope = (kernel.loss(U + h) - kernel.loss(U - h)) / (2 * h)
    corner = np.zeros(len(U), bool)
    if isinstance(kernel, TruncatedLeastSquares) and np.isinf(kernel.mu):
        corner = np.abs(np.abs(U) - kernel.c) < 2 * h
    assert corner.sum() <= 2
    np.testing.assert_allclose(slope[~corner], expected[~corner], atol=2e-5)


@pytest.mark.parametrize(
    ("kernel", "loss"),
    [
        (Huber(1.5), lambda u: np.where(np.abs(u) < 1.5, u**2 / 2, 1.5 * np.abs(u) - 1.5**2 / 2)),
        (Cauchy(2.0), lambda u: 2 * np.log1p((u / 2) ** 2)),
        (GemanMcClure(3.0), lambda u: u**2 / 2 / (1 + (u / 3) ** 2)),
        (Tukey(4.0), lambda u: 16 / 6 * (1 - np.maximum(1 - (u / 4) ** 2, 0) ** 3)),
        (Welsch(2.0), lambda u: 2 * (1 - np.exp(-((u / 2) ** 2)))),
        (Barron(1.0, 2.0), lambda u: 4 * (np.sqrt((u / 2) ** 2 + 1) - 1)),
        (TruncatedLeastSquares(3.0), lambda u: np.minimum(u**2, 9) / 2),
    ],
)
def test_losses_by_their_published_formulas(kernel, loss):
    np.testing.assert_allclose(kernel.loss(U), loss(U), atol=1e-12)


@pytest.mark.parametrize(
    ("alpha", "same"),
    [
        (2, LeastSquares()), (2 - 1e-7, LeastSquares()), (0, Cauchy(1.5 * np.sqrt(2))),
        (1e-7, Cauchy(1.5 * np.sqrt(2))), (-1e-7, Cauchy(1.5 * np.sqrt(2))), (-2, GemanMcClure(3.0)),
        (-np.inf, Welsch(1.5 * np.sqrt(2))), (-1e8, Welsch(1.5 * np.sqrt(2))),
    ],
)  # fmt: skip
def test_barrons_family_holds_the_others(alpha, same):
    """With x = (u / c)^2: alpha = 0 has the weight 1 / (x / 2 + 1), -2 has (x / 4 + 1)^-2, -inf has exp(-x / 2)."""
    np.testing.assert_allclose(Barron(alpha, 1.5).weight(U), same.weight(U), atol=1e-5)
    np.testing.assert_allclose(Barron(alpha, 1.5).loss(U), same.loss(U), rtol=1e-5, atol=1e-12)


def test_constants_keep_95_percent_of_the_efficiency_on_gaussian_noise():
    """Efficiency of an M-estimator of location: E[psi']^2 / E[psi^2] with psi = w(u) u and unit Gaussian noise."""
    u = np.linspace(-9, 9, 200_001)
    density = np.exp(-(u**2) / 2) / np.sqrt(2 * np.pi)
    du = u[1] - u[0]
    for kernel in (Huber(), Cauchy(), Tukey(), Welsch()):
        psi = kernel.weight(u) * u
        efficiency = (np.gradient(psi, du) * density).sum() ** 2 * du / (psi**2 * density).sum()
        assert efficiency == pytest.approx(0.95, abs=1e-3)


@pytest.mark.parametrize("kernel", FAMILY, ids=repr)
def test_compiled_weights_are_those_of_the_classes(kernel):
    weights = np.empty(len(U))
    robust_weights(*kernel.compiled(U), U, weights)
    np.testing.assert_allclose(weights, kernel.weight(U), atol=1e-13)


class TestTrimmed:
    def test_the_best_share_counts(self):
        """Of ten residuals 60 % are six: the sixth smallest is 0.6."""
        u = np.array([5, -0.1, 0.3, 0.2, -7, 0.6, 9, -0.5, 0.4, 1])
        assert Trimmed(0.6).threshold(u) == 0.6
        np.testing.assert_array_equal(Trimmed(0.6).weight(u), [0, 1, 1, 1, 0, 1, 0, 1, 1, 0])

    def test_all_none_and_few(self):
        assert Trimmed(1.0).weight(U).all()
        assert Trimmed(0.5).threshold(np.zeros(0)) == 0
        assert Trimmed(0.01).weight(np.array([3.0, 1.0, 2.0])).tolist() == [0, 1, 0]

    @pytest.mark.parametrize("share", [0, -1, 1.1, np.nan])
    def test_a_share_is_a_share(self, share):
        with pytest.raises(ConfigError, match="share"):
            Trimmed(share)


class TestGraduated:
    def test_truncated_weights_by_hand(self):
        """c = 3, mu = 1: 1 up to 3 sqrt(1/2) = 2.1213, 0 from 3 sqrt 2 = 4.2426; at u = 3, sqrt 2 - 1 = 0.41421."""
        weight = TruncatedLeastSquares(3.0, 1.0).weight(np.array([0, 2.12, 3, -3, 4.25]))
        np.testing.assert_allclose(weight, [1, 1, np.sqrt(2) - 1, np.sqrt(2) - 1, 0], atol=1e-15)

    @pytest.mark.parametrize(
        ("loss", "last"), [("truncated", TruncatedLeastSquares(2.0)), ("geman_mcclure", GemanMcClure(2.0))]
    )
    def test_schedules_start_wide_and_end_with_the_loss_itself(self, loss, last):
        kernels = GraduatedNonConvexity(loss, c=2.0).schedule(50 * U)
        assert 5 < len(kernels) < 80
        assert kernels[-1] == last
        assert (kernels[0].weight(50 * U) > 0).all()
        inlier_outlier = [kernel.weight(np.array([1.0, 20.0])) for kernel in kernels]
        trust = [outlier / inlier for inlier, outlier in inlier_outlier]
        assert trust == sorted(trust, reverse=True)
        assert trust[0] > 0.04
        assert trust[-1] < 1e-3

    def test_geman_mcclure_starts_convex(self):
        """The slope w(u) u of the first loss rises over all residuals."""
        first = GraduatedNonConvexity("geman_mcclure", c=2.0).schedule(U)[0]
        assert (np.diff(first.weight(U) * U) >= 0).all()

    @pytest.mark.parametrize("loss", ["truncated", "geman_mcclure"])
    def test_nothing_beyond_c_needs_no_graduation(self, loss):
        """Truncated: 2 max u^2 <= c^2. Geman-McClure: 3 max u^2 <= c^2."""
        for u in (np.zeros(0), np.zeros(3), np.full(4, 0.5)):
            assert len(GraduatedNonConvexity(loss, c=1.0).schedule(u)) == 1

    @pytest.mark.parametrize("options", [{"loss": "tukey"}, {"c": 0}, {"rate": 1.0}, {"rate": np.inf}])
    def test_wrong_options_raise(self, options):
        with pytest.raises(ConfigError, match=next(iter(options))):
            GraduatedNonConvexity(**options)

    @pytest.mark.parametrize("loss", ["truncated", "geman_mcclure"])
    def test_pairs_with_most_of_them_wrong(self, loss):
        """Graduated steps find the motion with 80 % of the partners anywhere in the box, and at 85 % more often than
        the true loss from the start, whose weights at the first estimate hold on to what is near by chance."""
        solved = [outlier_trial(seed, 0.8, loss)[0] for seed in range(10)]
        assert all(solved)
        trials = np.array([outlier_trial(seed, 0.85, loss) for seed in range(20)])
        assert trials[:, 0].sum() >= trials[:, 1].sum() + 5


def outlier_trial(seed, share, loss):
    """Whether the motion is found to one sigma, by the schedule and by as many steps with its last kernel."""
    rng = np.random.default_rng(seed)
    a, sigma, T = rng.uniform(-1, 1, (300, 3)), 0.01, se3.exp([0.3, -0.2, 0.5, 0.4, -0.8, 1.1])
    b = se3.transform_points(T, a) + sigma * rng.normal(size=a.shape)
    wrong = int(share * 300)
    b[:wrong] = rng.uniform(-1.5, 1.5, (wrong, 3))

    def residuals(fit):
        return np.linalg.norm(se3.transform_points(fit.T, a) - b, axis=1) / sigma

    kernels = GraduatedNonConvexity(loss, c=4.0).schedule(residuals(fit_pairs(a, b)))
    found = []
    for steps in ([*kernels, *[kernels[-1]] * 5], [kernels[-1]] * len(kernels)):
        fit = fit_pairs(a, b)
        for kernel in steps:
            fit = fit_pairs(a, b, weights=kernel.weight(residuals(fit)))
        error = se3.transform_points(fit.T, a) - se3.transform_points(T, a)
        found.append(np.linalg.norm(error, axis=1).max() < sigma)
    return found


def test_mad_scale_ignores_outliers():
    rng = np.random.default_rng(0)
    residuals = np.concatenate([0.02 * rng.normal(size=10_000), np.full(1000, 50.0)])
    assert mad_scale(residuals) == pytest.approx(0.02, rel=0.2)
    assert mad_scale(np.zeros(0)) == 0
    assert mad_scale(np.array([-2.0])) == pytest.approx(2.9652)


@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_mad_scale_of_many_is_that_of_a_sample(seed, sigma):
    """The median of 20,000 has the error 1.25 sqrt(..) / sqrt(20000), below 1 % of sigma at one standard deviation."""
    residuals = sigma * np.random.default_rng(seed).normal(size=150_001)
    assert mad_scale(residuals) == pytest.approx(sigma, rel=0.05)
    assert mad_scale(residuals) == mad_scale(residuals.copy())


@pytest.mark.parametrize("make", [Huber, Cauchy, GemanMcClure, Tukey, Welsch, TruncatedLeastSquares])
@pytest.mark.parametrize("constant", [0, -1, np.nan])
def test_a_constant_is_positive(make, constant):
    with pytest.raises(ConfigError, match="expected a number above 0"):
        make(constant)


def test_barron_above_two_is_no_robust_kernel():
    with pytest.raises(ConfigError, match="alpha"):
        Barron(3.0)


def test_an_unknown_kernel_names_the_known_ones():
    with pytest.raises(ConfigError, match="huber"):
        robust_kernel("hubber")
