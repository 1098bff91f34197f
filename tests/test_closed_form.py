"""Closed form: the worked example by hand, properties, and every way in which pairs can fail to determine a motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.parallel import limited_threads
from scanweld.registration.closed_form import align_closed_form, fit_horn, fit_pairs, pair_residuals
from scanweld.registration.closed_form.moments.kernels import CHUNK
from scanweld.registration.residuals import point_to_point
from scanweld.registration.result import RegistrationResult, Status

A = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (2, 0.5)])
B_NOISY = np.array([(2.10, 2.71), (3.01, 3.72), (1.24, 3.79), (1.79, 4.56), (3.04, 4.63)])
C = np.sqrt(0.5)
R_45 = np.array([[C, -C], [C, C]])
B_EXACT = A @ R_45.T + [2, 3]


def random_motion(rng: np.random.Generator, dimension: int) -> np.ndarray:
    Q, upper = np.linalg.qr(rng.normal(size=(dimension, dimension)))
    Q *= np.sign(np.diag(upper))
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    T = np.eye(dimension + 1)
    T[:dimension, :dimension], T[:dimension, dimension] = Q, rng.normal(size=dimension)
    return T


class TestWorkedExample:
    """Horn's method, 2-D, five pairs. mean(a) = (4, 2.5) / 5 and sum|a'|^2 = (.64+.25) + (.04+.25) + (.64+.25) +
    (.04+.25) + 1.44 = 3.8; sum a' a'^T = diag(2.8, 1), because sum x'y' = .4 - .1 - .4 + .1 + 0 = 0."""

    def test_exact(self):
        """b = R a + t: W = R diag(2.8, 1), so the singular values are 2.8 and 1, and E = 3.8 + 3.8 - 2 * 3.8 = 0."""
        fit = fit_horn(A, B_EXACT)
        np.testing.assert_allclose(fit.mean_source, [0.8, 0.5], atol=1e-15)
        np.testing.assert_allclose(fit.mean_target, [2 + 0.3 * C, 3 + 1.3 * C], atol=1e-15)
        np.testing.assert_allclose(fit.mean_target, [2.2121, 3.9192], atol=5e-5)
        np.testing.assert_allclose(fit.W, R_45 * [2.8, 1], atol=1e-14)
        np.testing.assert_allclose(fit.W, [[1.9799, -0.7071], [1.9799, 0.7071]], atol=5e-5)
        np.testing.assert_allclose(fit.singular_values, [2.8, 1], atol=1e-14)
        np.testing.assert_allclose(fit.rotation, R_45, atol=1e-15)
        np.testing.assert_allclose(fit.translation_m, [2, 3], atol=1e-14)
        assert fit.source_spread == pytest.approx(3.8)
        assert fit.error == pytest.approx(0, abs=1e-28)
        assert fit.rank == 2

    def test_noisy(self):
        """mean(b) = (11.18, 19.41) / 5; W_11 = sum x'_b x'_a = .1088 + .1548 + .7968 - .0892 + .9648 = 1.936 etc.

        In the plane tan(angle) = (W_21 - W_12) / (W_11 + W_22) = 3.052 / 2.896, and the sum of the singular values
        is sqrt(3.052^2 + 2.896^2) = 4.20732; det W = 3.95104 splits it into 2.7924 and 1.4149. E = 3.8 + 4.8824 -
        2 * 4.20732 = 0.26777.
        """
        fit = fit_horn(A, B_NOISY)
        np.testing.assert_allclose(fit.mean_target, [2.236, 3.882], atol=1e-12)
        np.testing.assert_allclose(fit.W, [[1.936, -1.040], [2.012, 0.960]], atol=1e-12)
        total = np.hypot(3.052, 2.896)
        difference = np.sqrt(total**2 - 4 * 3.95104)
        np.testing.assert_allclose(fit.singular_values, [(total + difference) / 2, (total - difference) / 2])
        np.testing.assert_allclose(fit.singular_values, [2.7924, 1.4149], atol=5e-5)
        c, s = 2.896 / total, 3.052 / total
        np.testing.assert_allclose(fit.rotation, [[c, -s], [s, c]], atol=1e-12)
        np.testing.assert_allclose(fit.rotation, [[0.6883, -0.7254], [0.7254, 0.6883]], atol=5e-5)
        np.testing.assert_allclose(fit.translation_m, [2.048, 2.9575], atol=5e-5)
        assert fit.error == pytest.approx(8.6824 - 2 * total, abs=1e-12)
        assert fit.error == pytest.approx(0.26777, abs=5e-6)
        result = align_closed_form(A, B_NOISY)
        assert result.status is Status.CONVERGED
        assert result.rmse_m == pytest.approx(np.sqrt(fit.error / 5))
        np.testing.assert_array_equal(result.T_target_source, fit.transform)

    @pytest.mark.parametrize("scale", ["symmetric", "least_squares"])
    def test_scale_exact(self, scale):
        """b = 2.7 R a + t: W is 2.7 times, sum|b'|^2 = 2.7^2 * 3.8 = 27.702, both scales are 2.7.

        mean(b) = 2.7 R (0.8, 0.5) + t = (2 + 2.7 * 0.3 / sqrt 2, 3 + 2.7 * 1.3 / sqrt 2) = (2.5728, 5.4819).
        """
        B = 2.7 * A @ R_45.T + [2, 3]
        fit = fit_horn(A, B, scale=scale)
        np.testing.assert_allclose(fit.mean_target, [2 + 0.81 * C, 3 + 3.51 * C], atol=1e-14)
        np.testing.assert_allclose(fit.W, [[5.3457, -1.9092], [5.3457, 1.9092]], atol=5e-5)
        np.testing.assert_allclose(fit.singular_values, [7.56, 2.7])
        assert fit.target_spread == pytest.approx(27.702)
        assert fit.scale == pytest.approx(2.7)
        np.testing.assert_allclose(fit.translation_m, [2, 3], atol=1e-13)

    def test_the_two_scales_differ_with_noise(self):
        """sqrt(4.8824 / 3.8) = 1.1335 and 4.20732 / 3.8 = 1.1072."""
        scales = [align_closed_form(A, B_NOISY, scale=s).scale for s in ("symmetric", "least_squares", "none")]
        np.testing.assert_allclose(scales, [np.sqrt(4.8824 / 3.8), np.hypot(3.052, 2.896) / 3.8, 1], atol=1e-12)
        np.testing.assert_allclose(scales, [1.1335, 1.1072, 1], atol=5e-5)


class TestRankDeficient:
    def test_w_zero_gives_no_rotation(self):
        """First ICP step of the worked example: all partners are b_1, W = 0, R = I, t = b_1 - mean(a)."""
        fit = fit_horn(A, np.tile(B_NOISY[0], (5, 1)))
        np.testing.assert_array_equal(fit.rotation, np.eye(2))
        np.testing.assert_allclose(fit.translation_m, [1.30, 2.21], atol=1e-15)
        assert fit.rank == 0
        assert fit.free_planes == ((0, 1),)
        result = align_closed_form(A, np.tile(B_NOISY[0], (5, 1)))
        assert result.status is Status.DEGENERATE
        assert [d.words for d in result.unobservable] == ["rotation"]

    @pytest.mark.parametrize("method", ["svd", "quaternion"])
    def test_a_line_turns_no_more_than_it_must(self, method):
        """A line along x becomes one along y: the smallest rotation is 90 degrees about z, the turn about y is free."""
        s = np.linspace(-1, 1, 7)[:, None]
        result = align_closed_form(s * [1, 0, 0], s * [0, 1, 0] + [5, 6, 7], method=method)
        expected = [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
        np.testing.assert_allclose(result.T_target_source, expected, atol=1e-12)
        assert result.status is Status.DEGENERATE
        assert [d.words for d in result.unobservable] == ["rotation about (0.00, 1.00, 0.00)"]
        np.testing.assert_allclose(np.abs(result.unobservable[0].vector), [0, 0, 0, 0, 1, 0], atol=1e-12)

    @pytest.mark.parametrize("method", ["svd", "quaternion"])
    def test_a_noisy_line_is_still_a_line(self, method):
        """The turn about the line is decided by noise alone: it is named, not invented."""
        rng = np.random.default_rng(0)
        s = rng.uniform(-1, 1, (200, 1))
        a, b = (s * [1, 0, 0] + 0.01 * rng.normal(size=(200, 3)) for _ in range(2))
        result = align_closed_form(a, b, method=method)
        assert result.status is Status.DEGENERATE
        assert [d.words for d in result.unobservable] == ["rotation about (1.00, 0.00, 0.00)"]
        assert np.degrees(se3.rotation_angle_rad(result.T_target_source)) < 1

    @pytest.mark.parametrize("method", ["svd", "quaternion"])
    def test_one_place(self, method):
        result = align_closed_form(np.ones((10, 3)), np.full((10, 3), 4.0), method=method)
        assert result.status is Status.DEGENERATE
        assert len(result.unobservable) == 3
        np.testing.assert_allclose(result.T_target_source, [[1, 0, 0, 3], [0, 1, 0, 3], [0, 0, 1, 3], [0, 0, 0, 1]])

    def test_a_plane_determines_the_rotation(self):
        rng = np.random.default_rng(0)
        a = rng.normal(size=(20, 3)) * [1, 1, 0]
        T = random_motion(rng, 3)
        result = align_closed_form(a, se3.transform_points(T, a))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, T, atol=1e-13)

    @pytest.mark.parametrize("scale", ["symmetric", "least_squares"])
    def test_no_extent_has_no_scale(self, scale):
        for a, b in ((np.ones((5, 3)), np.random.default_rng(0).normal(size=(5, 3))), (np.eye(3), np.ones((3, 3)))):
            result = align_closed_form(a, b, scale=scale)
            assert result.status is Status.DEGENERATE
            assert result.scale == 1
            assert "scale" in [d.words for d in result.unobservable]
            assert np.isfinite(result.T_target_source).all()

    def test_unrelated_pairs_determine_nothing(self):
        rng = np.random.default_rng(0)
        result = align_closed_form(rng.normal(size=(300, 3)), rng.normal(size=(300, 3)))
        assert result.status is Status.DEGENERATE


class TestMirrored:
    @pytest.mark.parametrize("method", ["svd", "quaternion"])
    @pytest.mark.parametrize("stretch", [(1, 1, 1), (3, 2, 1)])
    def test_a_reflection_is_never_returned_nor_trusted(self, method, stretch):
        a = np.random.default_rng(0).normal(size=(100, 3)) * stretch
        result = align_closed_form(a, a * [1, 1, -1], method=method)
        assert np.linalg.det(result.T_target_source[:3, :3]) == pytest.approx(1)
        assert result.status is Status.DEGENERATE
        assert "mirrored" in result.note

    def test_noisy_planes_keep_a_proper_rotation_and_scale_one(self):
        """Golden case 2: on near-planar pairs noise makes U V^T a reflection about half of the time."""
        reflections = 0
        for seed in range(40):
            rng = np.random.default_rng(seed)
            a = rng.normal(size=(30, 3)) * [1, 1, 1e-3]
            T = random_motion(rng, 3)
            b = se3.transform_points(T, a) + 0.01 * rng.normal(size=a.shape)
            fit = fit_horn(a, b)
            reflections += np.linalg.det(fit.U @ fit.Vt) < 0
            result = align_closed_form(a, b)
            assert np.linalg.det(result.T_target_source[:3, :3]) == pytest.approx(1)
            assert result.scale == 1
            assert result.status is Status.CONVERGED
            assert np.degrees(se3.rotation_angle_rad(result.T_target_source @ se3.inverse(T))) < 2
        assert reflections > 5


@given(st.integers(0, 10**6), st.integers(2, 6), st.floats(0.2, 5))
def test_the_motion_comes_back_in_any_dimension(seed, dimension, scale):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(dimension + 5, dimension))
    T = random_motion(rng, dimension)
    b = scale * a @ T[:-1, :-1].T + T[:-1, -1]
    for kind in ("symmetric", "least_squares"):
        result = align_closed_form(a, b, scale=kind)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, T, atol=1e-10)
        assert result.scale == pytest.approx(scale)


@given(
    st.integers(0, 10**6),
    st.floats(0, 0.2),
    st.sampled_from(["solid", "planar", "mirrored"]),
    st.sampled_from([1e-6, 1.0, 1e6]),
    st.sampled_from(["none", "symmetric", "least_squares"]),
)
def test_svd_and_quaternion_agree(seed, noise, kind, unit, scale):
    """To 1e-12 of the size of the points, wherever the pairs determine the rotation to a hundredth."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(12, 3)) * ([1, 1, 0] if kind == "planar" else [3, 2, 1])
    b = a * [1, 1, -1] if kind == "mirrored" else a
    b = se3.transform_points(random_motion(rng, 3), b) + noise * rng.normal(size=a.shape)
    w = rng.uniform(0.1, 3, 12)
    fit = fit_horn(a, b, w)
    assume(min(fit.curvatures.values()) > 0.01 * sum(fit.singular_values))
    one, other = (
        align_closed_form(unit * a, unit * b, weights=w, method=m, scale=scale) for m in ("svd", "quaternion")
    )
    np.testing.assert_allclose(one.T_target_source[:3, :3], other.T_target_source[:3, :3], atol=1e-12)
    np.testing.assert_allclose(one.T_target_source[:3, 3] / unit, other.T_target_source[:3, 3] / unit, atol=1e-12)
    assert one.scale == pytest.approx(other.scale, rel=1e-12)
    assert one.status is other.status


@given(st.integers(0, 10**6), st.integers(2, 7), st.integers(0, 7))
def test_the_decomposition_is_that_of_lapack(seed, dimension, rank):
    """W = U S V^T with orthogonal factors and the singular values of LAPACK, whatever the rank."""
    rng = np.random.default_rng(seed)
    rank = min(rank, dimension)
    a = rng.normal(size=(20, rank)) @ rng.normal(size=(rank, dimension)) * 10.0 ** rng.integers(-3, 4)
    b = rng.normal(size=(20, dimension))
    fit = fit_horn(a, b)
    W = (b - b.mean(axis=0)).T @ (a - a.mean(axis=0))
    size = max(np.abs(W).max(), 1e-300)
    np.testing.assert_allclose(fit.W / size, W / size, atol=1e-13)
    np.testing.assert_allclose(fit.U * fit.singular_values @ fit.Vt / size, W / size, atol=1e-13)
    np.testing.assert_allclose(fit.singular_values / size, np.linalg.svd(W)[1] / size, atol=1e-13)
    np.testing.assert_allclose(fit.U.T @ fit.U, np.eye(dimension), atol=1e-13)
    np.testing.assert_allclose(fit.Vt @ fit.Vt.T, np.eye(dimension), atol=1e-13)
    assert fit.rank == rank
    assert np.linalg.det(fit.rotation) == pytest.approx(1)


@given(st.integers(0, 10**6))
def test_nothing_nearby_is_better(seed):
    """The optimum: no small rotation or translation lowers E."""
    rng = np.random.default_rng(seed)
    a, w = rng.normal(size=(15, 3)), rng.uniform(0.1, 2, 15)
    b = se3.transform_points(random_motion(rng, 3), a) + 0.2 * rng.normal(size=a.shape)
    result = align_closed_form(a, b, weights=w)

    def error(T):
        return w @ ((b - se3.transform_points(T, a)) ** 2).sum(axis=1)

    best = error(result.T_target_source)
    assert result.rmse_m == pytest.approx(np.sqrt(best / w.sum()))
    for xi in 1e-3 * rng.normal(size=(20, 6)):
        assert error(se3.exp(xi) @ result.T_target_source) >= best - 1e-12


@given(st.integers(0, 10**6))
def test_moving_both_sets_moves_the_answer(seed):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(10, 3))
    b = se3.transform_points(random_motion(rng, 3), a) + 0.05 * rng.normal(size=a.shape)
    F, G = random_motion(rng, 3), random_motion(rng, 3)
    moved = align_closed_form(se3.transform_points(F, a), se3.transform_points(G, b)).T_target_source
    np.testing.assert_allclose(moved, G @ align_closed_form(a, b).T_target_source @ se3.inverse(F), atol=1e-10)


@pytest.mark.parametrize(("size", "weight"), [(1.0, 1e-200), (1.0, 1e200), (1e-100, 1.0)])
def test_tiny_and_huge_units_and_weights_change_nothing(size, weight):
    """sum w |a|^2 of the two sets may fit a float64 though its product does not."""
    rng = np.random.default_rng(4)
    a, T = rng.normal(size=(20, 3)), se3.exp([1, 2, 3, 0.5, -1, 0.3])
    b = se3.transform_points(T, a)
    result = align_closed_form(size * a, size * b, weights=np.full(20, weight))
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.T_target_source[:3, :3], T[:3, :3], atol=1e-12)
    np.testing.assert_allclose(result.T_target_source[:3, 3], size * T[:3, 3], atol=1e-12 * size)


def test_weights_count_pairs():
    """A weight of 3 is the pair three times, a weight of 0 is no pair."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 8, 3))
    b = a + 0.1 * b
    w = np.array([3, 0, 1, 2, 1, 1, 0, 1])
    one = align_closed_form(a, b, weights=w)
    other = align_closed_form(np.repeat(a, w, axis=0), np.repeat(b, w, axis=0))
    np.testing.assert_allclose(one.T_target_source, other.T_target_source, atol=1e-14)
    np.testing.assert_allclose(one.information, other.information)
    assert one.num_inliers == 6


def test_information_is_that_of_the_rows():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 9, 3))
    result = align_closed_form(a, a + 0.01 * b)
    _, jacobian = point_to_point(se3.transform_points(result.T_target_source, a), b)
    rows = jacobian.reshape(-1, 6)
    np.testing.assert_allclose(result.information, rows.T @ rows, atol=1e-12)


@pytest.mark.parametrize(("unit", "offset"), [(1, 1e6), (1e-6, 0), (1e-6, 1e-3), (1e6, 0)])
def test_far_and_tiny_sets_lose_nothing(unit, offset):
    rng = np.random.default_rng(0)
    a = rng.normal(size=(50, 3))
    R = random_motion(rng, 3)[:3, :3]
    result = align_closed_form(unit * a + offset, unit * a @ R.T - offset)
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.T_target_source[:3, :3], R, atol=1e-9)
    assert result.rmse_m < 1e-9 * unit + 1e-15 * offset * 10


def test_pairs_that_are_not_finite_are_dropped_and_counted():
    a, b = A.copy(), B_EXACT.copy()
    a = np.vstack([a, [np.nan, 0], [1, 1]])
    b = np.vstack([b, [0, 0], [np.inf, 1]])
    result = align_closed_form(a, b)
    np.testing.assert_allclose(result.T_target_source[:2, :2], R_45, atol=1e-14)
    assert result.note == "2 pairs were not finite and were dropped"
    assert result.overlap == pytest.approx(5 / 7)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_pairs(count):
    result = align_closed_form(np.eye(3)[:count], np.eye(3)[:count] + 1)
    assert result.status is Status.TOO_FEW_CORRESPONDENCES
    assert result.note
    assert np.isfinite(result.T_target_source).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((A, B_NOISY[:4]), "equal lengths"),
        ((A, np.ones((5, 3))), r"shape \(N, 2\)"),
        ((A.T, A.T), None),
        ((np.ones(5), np.ones(5)), "shape"),
        ((A.astype(str), A), "numbers"),
    ],
)
def test_wrong_shapes_raise(arguments, words):
    if words is None:  # (2, 5) is two points of a five-dimensional space
        assert align_closed_form(*arguments).status is Status.TOO_FEW_CORRESPONDENCES
        return
    with pytest.raises(InvalidInputError, match=words):
        align_closed_form(*arguments)


@pytest.mark.parametrize(
    "options",
    [
        {"weights": [1, 1]}, {"weights": [-1, 1, 1, 1, 1]}, {"weights": [np.nan, 1, 1, 1, 1]},
        {"scale": "both"}, {"method": "guess"}, {"method": "quaternion"},
    ],
)  # fmt: skip
def test_wrong_options_raise(options):
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        align_closed_form(A, B_NOISY, **options)


class TestManyPairs:
    """More than one chunk of the kernels, and blocks without a single pair in use."""

    @staticmethod
    def pairs(count=2 * CHUNK + 700, offset=0.0):
        rng = np.random.default_rng(5)
        a = rng.normal(size=(count, 3)) * [3, 2, 1] + offset
        T = se3.exp([0.1, 0.2, -0.3, 0.5, -0.4, 0.3])
        b = (a - offset) @ T[:3, :3].T + T[:3, 3] - offset + 0.05 * rng.normal(size=a.shape)
        a[:1500] = np.nan  # the first blocks are empty
        b[CHUNK : CHUNK + 40, 1] = np.inf
        w = rng.uniform(0.5, 2, count)
        w[5000:6200] = 0
        return a, b, w

    @pytest.mark.parametrize("offset", [0, 1e6])
    def test_the_answer_is_that_of_the_formulas(self, offset):
        """Umeyama's eqs. 34 to 43 in NumPy, of the centred points."""
        a, b, w = self.pairs(offset=offset)
        result = align_closed_form(a, b, weights=w, scale="least_squares")
        used = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1) & (w > 0)
        p, q, v = a[used] - offset, b[used] + offset, w[used]
        mean_p, mean_q = v @ p / v.sum(), v @ q / v.sum()
        U, D, Vt = np.linalg.svd(((q - mean_q) * v[:, None]).T @ (p - mean_p))
        R = U @ Vt
        s = D.sum() / (v @ ((p - mean_p) ** 2).sum(axis=1))
        residuals = q - mean_q - s * (p - mean_p) @ R.T
        assert np.linalg.det(R) > 0
        assert result.status is Status.CONVERGED
        precision = 1e-12 if offset == 0 else 1e-9
        np.testing.assert_allclose(result.T_target_source[:3, :3], R, atol=precision)
        assert result.scale == pytest.approx(s, abs=precision)
        assert result.rmse_m == pytest.approx(np.sqrt(v @ (residuals**2).sum(axis=1) / v.sum()), rel=1e-9)
        assert result.num_inliers == used.sum()
        assert result.note == "1540 pairs were not finite and were dropped"

    def test_the_same_bytes_at_any_number_of_threads(self):
        a, b, w = self.pairs()
        results = []
        for count in (1, 2, 8):
            with limited_threads(count):
                results.append(align_closed_form(a, b, weights=w, scale="symmetric"))
        for other in results[1:]:
            for name in ("T_target_source", "information", "covariance"):
                assert getattr(results[0], name).tobytes() == getattr(other, name).tobytes()
            assert (results[0].scale, results[0].rmse_m) == (other.scale, other.rmse_m)

    def test_an_outlier_in_the_first_row_costs_no_digits(self):
        """The first point is the origin of the first block: from 1e8 away, moments about it would lose all digits."""
        a = np.random.default_rng(0).normal(size=(1000, 3))
        a[0] = 1e8
        T = random_motion(np.random.default_rng(1), 3)
        w = np.ones(1000)
        w[0] = 1e-30
        result = align_closed_form(a, se3.transform_points(T, a), weights=w)
        np.testing.assert_allclose(result.T_target_source, T, atol=1e-12)


class TestFitPairs:
    def test_rows_name_the_pairs(self):
        rng = np.random.default_rng(0)
        a, b = rng.normal(size=(50, 3)), rng.normal(size=(40, 3))
        i, j, w = rng.integers(0, 50, 30), rng.integers(0, 40, 30), rng.uniform(0, 1, 30)
        fit = fit_pairs(a, b, source_rows=i, target_rows=j, weights=w, scale="symmetric")
        horn = fit_horn(a[i], b[j], w, scale="symmetric")
        np.testing.assert_array_equal(fit.T, horn.transform)
        assert fit.scale == horn.scale
        assert fit.rank == horn.rank == 3
        assert fit.error == pytest.approx(horn.error)
        assert (fit.num_pairs, fit.num_free, fit.scale_found) == (30, 0, True)
        assert fit.total_weight == pytest.approx(w.sum())
        np.testing.assert_array_equal(fit.mean_target, horn.mean_target)

    def test_no_pairs(self):
        none = np.zeros(0, np.int64)
        for fit in (
            fit_pairs(np.eye(3), np.eye(3), source_rows=none, target_rows=none),
            fit_pairs(np.eye(3), np.eye(3), weights=np.zeros(3)),
            fit_pairs(np.zeros((0, 3)), np.zeros((0, 3))),
        ):
            assert (fit.num_pairs, fit.rank, fit.scale) == (0, 0, 1)
            np.testing.assert_array_equal(fit.T, np.eye(4))

    def test_w_zero_leaves_all_planes_free(self):
        fit = fit_pairs(A, np.tile(B_NOISY[0], (5, 1)), scale="symmetric")
        np.testing.assert_array_equal(fit.rotation, np.eye(2))
        assert (fit.num_free, fit.rank, fit.scale_found, fit.scale) == (1, 0, False, 1)


class TestPairResiduals:
    def test_by_hand(self):
        """R = I, t = (1, 0), s = 2: (1, 2) goes to (3, 4), which is (-1, 1) from (4, 3)."""
        T = np.array([[1, 0, 1], [0, 1, 0], [0, 0, 1.0]])
        result = RegistrationResult(T_target_source=T, status=Status.CONVERGED, information=np.eye(3), scale=2.0)
        np.testing.assert_allclose(pair_residuals(result, [(1, 2)], [(4, 3)]), [(-1, 1)])

    def test_they_make_up_the_rmse(self):
        w = np.array([1, 2, 3, 4, 5.0])
        result = align_closed_form(A, B_NOISY, weights=w, scale="least_squares")
        residuals = pair_residuals(result, A, B_NOISY)
        assert result.rmse_m == pytest.approx(np.sqrt(w @ (residuals**2).sum(axis=1) / w.sum()))
        np.testing.assert_allclose(w @ residuals, 0, atol=1e-12)

    def test_rows_without_a_partner_have_no_residual(self):
        result = align_closed_form(A, B_EXACT)
        residuals = pair_residuals(result, [(0, 0), (np.nan, 1), (np.inf, 0)], [(2, 3), (0, 0), (np.inf, 0)])
        np.testing.assert_allclose(residuals[0], 0, atol=1e-12)
        assert not np.isfinite(residuals[1:]).all(axis=1).any()

    def test_wrong_shapes_raise(self):
        result = align_closed_form(A, B_NOISY)
        with pytest.raises(InvalidInputError, match="equal lengths"):
            pair_residuals(result, A, B_NOISY[:3])
        with pytest.raises(InvalidInputError, match="source"):
            pair_residuals(result, np.ones((5, 3)), B_NOISY)


def test_any_layout_and_number_type_gives_the_same_bytes():
    rng = np.random.default_rng(0)
    a, b = rng.integers(-9, 9, (2, 30, 3))
    expected = align_closed_form(a.astype(float), b.astype(float)).T_target_source.tobytes()
    frozen = a.astype(float)
    frozen.flags.writeable = False
    for one in (a, a.astype(np.float32), np.asfortranarray(a), a.tolist(), frozen, np.repeat(a, 2, axis=0)[::2]):
        assert align_closed_form(one, b).T_target_source.tobytes() == expected


def test_weights_that_are_no_numbers_raise():
    with pytest.raises(InvalidInputError, match="weights"):
        align_closed_form(A, B_NOISY, weights=["a", "b", "c", "d", "e"])


def test_integers_are_points_and_arguments_stay_as_they_are():
    a = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    keep = a.copy()
    result = align_closed_form(a, a + 2)
    np.testing.assert_allclose(result.T_target_source[:3, 3], 2)
    np.testing.assert_array_equal(a, keep)
