"""Alignment of pairs most of which are wrong, and the cliques behind it."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.parallel import limited_threads
from scanweld.registration.consistency.clique import largest_clique
from scanweld.registration.consistency.graph import consistency_graph
from scanweld.registration.result import Status
from scanweld.registration.robust_pairs import align_pairs_robustly, clique_by_chance

SIGMA, BOUND = 0.01, 0.05  # noise of each coordinate, and what the aligner is told: five of it


def packed(joined: np.ndarray) -> np.ndarray:
    """Bit matrix of a boolean one."""
    padded = np.zeros((len(joined), -(-len(joined) // 64) * 64), dtype=bool)
    padded[:, : len(joined)] = joined
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)


def unpacked(bits: np.ndarray) -> np.ndarray:
    return np.unpackbits(bits.astype("<u8").view(np.uint8), axis=1, bitorder="little")[:, : len(bits)].astype(bool)


def brute_force_clique_number(joined: np.ndarray) -> int:
    def grow(candidates: list[int], size: int) -> int:
        best = size
        while candidates:
            v = candidates.pop()
            best = max(best, grow([u for u in candidates if joined[v, u]], size + 1))
        return best

    return grow(list(range(len(joined))), 0)


def matches(
    seed: int, count: int, wrong: float, *, dimension: int = 3, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs in a box of 4 m, the last ones right: source, target, rotation, translation, which are right."""
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.standard_normal((dimension, dimension)))
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    translation = rng.uniform(-3, 3, dimension)
    source = rng.uniform(-2, 2, (count, dimension))
    target = scale * source @ rotation.T + translation + rng.normal(0, SIGMA, source.shape)
    right = np.arange(count) >= round(wrong * count)
    low, high = target.min(axis=0), target.max(axis=0)
    target[~right] = rng.uniform(low, high, ((~right).sum(), dimension))
    return source, target, rotation, translation, right


def test_clique_equals_brute_force_on_small_graphs() -> None:
    rng = np.random.default_rng(0)
    for _ in range(150):
        count = int(rng.integers(1, 22))
        joined = np.triu(rng.random((count, count)) < rng.uniform(0, 0.8), 1)
        joined |= joined.T
        clique = largest_clique(packed(joined))
        v = clique.vertices
        assert clique.proven
        assert len(clique) == brute_force_clique_number(joined)
        assert joined[np.ix_(v, v)].sum() == len(v) * (len(v) - 1)


def test_planted_clique_across_words_is_found_and_proven() -> None:
    """30 of 700 vertices joined with each other in a graph of density 0.1, whose own largest clique has about
    2 ln 700 / ln 10 = 6 vertices."""
    rng = np.random.default_rng(1)
    joined = np.triu(rng.random((700, 700)) < 0.1, 1)
    members = np.sort(rng.permutation(700)[:30])
    joined[np.ix_(members, members)] = True
    joined = np.triu(joined, 1)
    joined |= joined.T
    clique = largest_clique(packed(joined))
    assert clique.proven
    np.testing.assert_array_equal(clique.vertices, members)
    without = np.ones(700, dtype=bool)
    without[members] = False
    assert len(largest_clique(packed(joined), alive=without)) < 10


def test_budget_is_kept_and_said() -> None:
    rng = np.random.default_rng(2)
    joined = np.triu(rng.random((150, 150)) < 0.7, 1)
    joined |= joined.T
    short, long = (largest_clique(packed(joined), max_nodes=n) for n in (20, 500_000))
    assert not short.proven
    assert long.proven
    assert 5 < len(short) <= len(long)
    assert len(largest_clique(np.zeros((3, 1), np.uint64))) == 1


def test_graph_equals_its_definition() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.uniform(-1, 1, (2, 130, 3))
    bounds = rng.uniform(0.02, 0.1, 130)
    p, q = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in (1.3 * a, b))
    expected = np.abs(p - q) <= bounds[:, None] + bounds[None] + 0.1 * p
    expected &= np.maximum(p, q) >= 0.3
    np.fill_diagonal(expected, False)
    computed = consistency_graph(a, b, bounds, scale=1.3, slack=0.1, min_length_m=0.3)
    np.testing.assert_array_equal(unpacked(computed), expected)


def test_normals_make_the_graph_sparser_and_keep_the_right_pairs() -> None:
    rng = np.random.default_rng(4)
    a, b, rotation, _, right = matches(4, 200, 0.5)
    n = rng.standard_normal((200, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    m = n @ rotation.T
    m[~right] = m[~right][::-1]
    bounds = np.full(200, BOUND)
    plain = unpacked(consistency_graph(a, b, bounds))
    for oriented, signs in ((True, 1.0), (False, rng.choice([-1.0, 1.0], (200, 1)))):
        strict = unpacked(consistency_graph(a, b, bounds, normals=(n, signs * m), oriented=oriented, max_turn=0.2))
        assert (strict <= plain).all()
        assert strict.sum() < 0.9 * plain.sum()
        np.testing.assert_array_equal(strict[np.ix_(right, right)], plain[np.ix_(right, right)])


@pytest.mark.parametrize(
    ("count", "wrong", "dimension"), [(1000, 0.95, 3), (1000, 0.99, 3), (600, 0.9, 2), (60, 0.8, 3), (8, 0.0, 3)]
)
def test_wrong_matches_are_survived(count: int, wrong: float, dimension: int) -> None:
    """The error of a motion from n right pairs: about SIGMA / sqrt(n) in translation and SIGMA / (1.15 m sqrt(n)) in
    rotation, 1.15 m being the spread of a coordinate in the box; n >= 8. Four times that is allowed."""
    for seed in range(8):
        source, target, rotation, translation, right = matches(seed, count, wrong, dimension=dimension)
        fit = align_pairs_robustly(source, target, BOUND)
        T = fit.result.T_target_source
        assert fit.result.status is Status.CONVERGED, (seed, fit.result.note)
        allowed = 4 * SIGMA / np.sqrt(right.sum())
        assert np.linalg.norm(T[:dimension, :dimension] - rotation) < 2 * allowed
        assert np.linalg.norm(T[:dimension, dimension] - translation) < 2 * allowed
        assert fit.inliers[right].mean() > 0.9
        assert fit.inliers[~right].sum() <= max(2, 0.01 * count)
        assert fit.consistent > fit.chance


def test_scale_is_found_among_wrong_matches() -> None:
    for seed, scale in ((0, 0.4), (1, 1.0), (2, 2.5)):
        source, target, rotation, _, right = matches(seed, 300, 0.85, scale=scale)
        fit = align_pairs_robustly(source, target, BOUND, scale=True)
        assert fit.result.status is Status.CONVERGED, fit.result.note
        assert abs(fit.result.scale / scale - 1) < 0.03
        assert np.linalg.norm(fit.result.T_target_source[:3, :3] - rotation) < 0.05
        assert fit.inliers[right].mean() > 0.9


@pytest.mark.parametrize("dimension", [2, 3])
def test_random_matches_are_no_success(dimension: int) -> None:
    for seed in range(25):
        count = (5, 20, 80, 300)[seed % 4]
        source, target, *_ = matches(seed, count, 1.0, dimension=dimension)
        fit = align_pairs_robustly(source, target, BOUND)
        assert fit.result.status is Status.NO_OVERLAP, (seed, count)
        assert not fit.inliers.any()


def test_random_matches_in_clusters_are_no_success() -> None:
    """Points in a few spots agree in many ways: what chance gives is learnt from the same spots."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        spots = rng.uniform(-2, 2, (2, 3, 3))
        source, target = (side[rng.integers(0, 3, 150)] + rng.normal(0, 0.02, (150, 3)) for side in spots)
        assert not align_pairs_robustly(source, target, BOUND).result.status.success


def test_mirrored_pairs_are_no_success() -> None:
    source, target, *_ = matches(0, 200, 0.0)
    fit = align_pairs_robustly(source * [-1, 1, 1], target, BOUND)
    assert fit.result.status is Status.DEGENERATE
    assert "mirrored" in fit.result.note
    assert not fit.inliers.any()


def test_pairs_on_a_line_are_degenerate_and_say_so() -> None:
    source, target, rotation, translation, _ = matches(0, 100, 0.5)
    source[50:] = np.linspace(-2, 2, 50)[:, None] * [0.6, 0.8, 0.0]
    target[50:] = source[50:] @ rotation.T + translation
    fit = align_pairs_robustly(source, target, BOUND)
    assert fit.result.status is Status.DEGENERATE
    assert "leave free" in fit.result.note


def test_coordinates_at_utm_lose_nothing() -> None:
    source, target, rotation, _, right = matches(0, 300, 0.9)
    fit = align_pairs_robustly(source + [5e5, 4e6, 100], target - [5e5, 4e6, 100], BOUND)
    assert fit.result.status.success
    assert np.linalg.norm(fit.result.T_target_source[:3, :3] - rotation) < 0.05
    assert fit.inliers[right].mean() > 0.9


def test_bad_rows_are_dropped_and_counted_and_the_mask_keeps_its_length() -> None:
    source, target, *_, right = matches(0, 300, 0.5)
    source[0], target[-1] = np.nan, np.inf
    fit = align_pairs_robustly(source, target, np.full(300, BOUND))
    assert fit.result.status.success
    assert "2 pairs were not finite" in fit.result.note
    assert fit.inliers.shape == (300,)
    assert not fit.inliers[-1]
    assert fit.inliers[right][:-1].mean() > 0.9


def test_too_few_pairs() -> None:
    for count in (0, 1, 2):
        fit = align_pairs_robustly(np.zeros((count, 3)), np.zeros((count, 3)), BOUND)
        assert fit.result.status is Status.TOO_FEW_CORRESPONDENCES
    fit = align_pairs_robustly(np.ones((50, 3)), np.ones((50, 3)), BOUND)
    assert not fit.result.status.success


def test_same_bytes_at_any_thread_count() -> None:
    source, target, *_ = matches(0, 700, 0.97)
    results = []
    for threads in (1, 2, 8):
        with limited_threads(threads):
            fit = align_pairs_robustly(source, target, BOUND)
        results.append(fit.result.T_target_source.tobytes() + fit.inliers.tobytes())
    assert len(set(results)) == 1


def test_arguments_are_not_modified() -> None:
    source, target, *_ = matches(0, 100, 0.5)
    before = source.copy(), target.copy()
    align_pairs_robustly(source, target, BOUND)
    np.testing.assert_array_equal(source, before[0])
    np.testing.assert_array_equal(target, before[1])


@pytest.mark.parametrize(
    ("source", "target", "bound", "message"),
    [
        (np.zeros((4, 3)), np.zeros((5, 3)), 0.1, "got 4 and 5 rows"),
        (np.zeros((4, 3)), np.zeros((4, 2)), 0.1, "target: expected shape"),
        (np.zeros((4, 3)), np.zeros((4, 3)), 0.0, "positive finite"),
        (np.zeros((4, 3)), np.zeros((4, 3)), np.ones(3), "noise_bound_m: expected a number"),
    ],
)
def test_bad_input(source: np.ndarray, target: np.ndarray, bound: object, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        align_pairs_robustly(source, target, bound)  # type: ignore[arg-type]


def test_clique_by_chance_of_known_graphs() -> None:
    """1000 vertices, density 0.04: C(1000, 5) 0.04^10 = 8.25e12 * 1.05e-14 = 0.09 cliques of five are expected, and
    C(1000, 6) 0.04^15 = 1.37e15 * 1.07e-21 = 1.5e-6 of six: five is the largest that has a chance of 1 in 1000."""
    assert clique_by_chance(1000, 0.04) == 5
    assert clique_by_chance(10, 1.0) == 10
    assert clique_by_chance(10, 0.0) == 1
