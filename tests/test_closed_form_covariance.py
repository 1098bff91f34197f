"""Covariance of the closed form: calibrated against draws, and zero where nothing is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from scanweld.geometry import se3
from scanweld.registration.closed_form import align_closed_form
from scanweld.registration.result import RegistrationResult, Status

DRAWS = 400
NUM_PAIRS = 60


def motion(dimension: int) -> np.ndarray:
    T = se3.exp([1.0, -2.0, 0.5, 0.7, -0.4, 0.9] if dimension == 3 else [1.0, -2.0, 0, 0, 0, 0.7])
    return T if dimension == 3 else T[np.ix_([0, 1, 3], [0, 1, 3])]


def error_of(result: RegistrationResult, T: np.ndarray) -> np.ndarray:
    """xi of T_estimated = exp(xi) T."""
    delta = result.T_target_source @ np.linalg.inv(T)
    if len(T) == 4:
        return se3.log(delta)
    space = np.eye(4)
    space[np.ix_([0, 1, 3], [0, 1, 3])] = delta
    return se3.log(space)[[0, 1, 5]]


def draw(seed: int, dimension: int, weighted: bool, scale: str) -> tuple[np.ndarray, float, RegistrationResult]:
    """Errors of motion and log scale, of points away from the origin, with noise of 1 cm of which the aligner knows
    nothing but, where weighted, how it differs among the pairs."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(-1, 1, (NUM_PAIRS, dimension)) * [2, 1, 0.5][:dimension] + 3
    true_scale = 1.0 if scale == "none" else 1.7
    T = motion(dimension)
    sigma = 0.01 * (rng.uniform(0.3, 3, NUM_PAIRS) if weighted else np.ones(NUM_PAIRS))
    b = true_scale * a @ T[:-1, :-1].T + T[:-1, -1] + sigma[:, None] * rng.normal(size=a.shape)
    result = align_closed_form(a, b, weights=7 / sigma**2 if weighted else None, scale=scale)
    return error_of(result, T), np.log(result.scale / true_scale), result


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("scale", ["none", "symmetric", "least_squares"])
def test_normalised_errors_keep_to_chi_square(dimension, weighted, scale):
    """The sum of xi^T C^-1 xi over M draws is chi-square with K M degrees of freedom; bounds of 99.9 %.

    With sigma from the data the mean of one is K nu / (nu - 2), nu = D N - K - 1 = 116 or more: 2 % above K.
    """
    total, scale_total = 0.0, 0.0
    for seed in range(DRAWS):
        xi, log_scale, result = draw(seed, dimension, weighted, scale)
        assert result.status is Status.CONVERGED
        total += xi @ np.linalg.solve(result.covariance, xi)
        if scale != "none":
            scale_total += (log_scale / (result.scale_std / result.scale)) ** 2
    size = len(xi)
    freedom = dimension * NUM_PAIRS - size - (scale != "none")
    inflation = freedom / (freedom - 2)
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], size * DRAWS)
    assert low < total / inflation < high
    if scale != "none":
        low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], DRAWS)
        assert low < scale_total / inflation < high


@pytest.mark.parametrize("dimension", [2, 3])
def test_with_hardly_more_pairs_than_needed_the_errors_follow_f(dimension):
    """xi^T C^-1 xi / K has the F distribution of K and nu = D N - K degrees of freedom, wide where nu is small."""
    T, values = motion(dimension), []
    a = np.random.default_rng(1).uniform(-1, 1, (4, dimension))
    size = dimension * (dimension + 1) // 2
    for seed in range(DRAWS):
        noise = 1e-3 * np.random.default_rng(seed).normal(size=a.shape)
        result = align_closed_form(a, a @ T[:-1, :-1].T + T[:-1, -1] + noise)
        xi = error_of(result, T)
        values.append(xi @ np.linalg.solve(result.covariance, xi) / size)
    assert stats.kstest(values, stats.f(size, 4 * dimension - size).cdf).pvalue > 0.01


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_it_is_the_inverse_of_the_information(dimension):
    """sigma^2 H^-1, where sigma^2 = rmse^2 sum w / (D N - K)."""
    rng = np.random.default_rng(0)
    a, w = rng.normal(size=(20, dimension)) + 1, rng.uniform(0.5, 2, 20)
    result = align_closed_form(a, a + 0.01 * rng.normal(size=a.shape), weights=w)
    size = dimension * (dimension + 1) // 2
    variance = result.rmse_m**2 * w.sum() / (20 * dimension - size)
    np.testing.assert_allclose(result.covariance, variance * np.linalg.inv(result.information), rtol=1e-9, atol=1e-20)
    assert result.scale_std == 0


def test_a_scale_makes_the_translation_less_certain():
    """t = mean(b) - s R mean(a): with mean(a) = (10, 0, 0), R = I, t_x takes on 100 var(s), and nothing else changes
    but the degree of freedom that the scale costs."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=(40, 3))
    a += [10, 0, 0] - a.mean(axis=0)
    noise = 0.01 * rng.normal(size=a.shape)
    centred, motions = a - [10, 0, 0], []
    # Noise that no motion and no scale can take up: the estimates are exact and have the same residuals.
    for G in (
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ):
        motions.append((centred @ np.array(G).T).ravel())
    for axis in np.eye(3):
        motions.append(np.tile(axis, (40, 1)).ravel())
    basis = np.linalg.qr(np.array([*motions, centred.ravel()]).T)[0]
    noise = (noise.ravel() - basis @ (basis.T @ noise.ravel())).reshape(40, 3)
    plain, scaled = (align_closed_form(a, a + noise, scale=s) for s in ("none", "least_squares"))
    np.testing.assert_allclose(scaled.T_target_source, np.eye(4), atol=1e-3)
    expected = plain.covariance * (120 - 6) / (120 - 7)
    expected[0, 0] += 100 * scaled.scale_std**2
    np.testing.assert_allclose(scaled.covariance, expected, atol=1e-3 * expected.max(), rtol=1e-3)
    variance = scaled.rmse_m**2 * 40 / (120 - 7)
    assert scaled.scale_std == pytest.approx(np.sqrt(variance / (centred**2).sum()), rel=1e-3)


def test_free_directions_are_zero_and_cost_no_degree_of_freedom():
    """A line along x about the origin, noise of 1 cm along x only: phi_x is free, phi_y and phi_z have the variance
    sigma^2 / sum x^2, translations sigma^2 / N, with nu = 3 * 9 - 5."""
    x = np.linspace(-1, 1, 9)
    noise = 0.01 * np.array([1, -1, 0, 0, 0, 0, 0, -1, 1.0])
    result = align_closed_form(np.outer(x, [1, 0, 0]), np.outer(x + noise, [1, 0, 0]))
    assert result.status is Status.DEGENERATE
    variance = 4e-4 / (27 - 5)
    turn = variance / (x**2).sum()
    np.testing.assert_allclose(result.covariance, np.diag([*[variance / 9] * 3, 0, turn, turn]), atol=1e-12 * turn)


def test_all_in_one_place_leaves_the_translation():
    result = align_closed_form(np.ones((10, 3)), np.ones((10, 3)))
    assert result.status is Status.DEGENERATE
    np.testing.assert_array_equal(result.covariance, np.zeros((6, 6)))


@pytest.mark.parametrize(
    ("pairs", "dimension", "scale"),
    [(0, 3, "none"), (1, 3, "none"), (2, 3, "none"), (1, 2, "none"), (2, 2, "symmetric")],
)
def test_where_nothing_tells_the_noise_there_is_no_covariance(pairs, dimension, scale):
    """Two pairs of the plane determine a similarity, four numbers of four: no residual is left."""
    a = np.eye(dimension)[:pairs]
    result = align_closed_form(a, a + 1, scale=scale)
    assert result.covariance is None
    assert result.scale_std == 0
