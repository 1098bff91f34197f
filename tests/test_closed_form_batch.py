"""Many closed forms at once: each entry is what the single form says."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.parallel import limited_threads
from scanweld.registration.closed_form import align_closed_form, align_closed_form_batch
from scanweld.registration.closed_form.moments.kernels import CHUNK
from scanweld.registration.result import Status


def problems(dimension: int, num_pairs: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sound, noisy, collinear, coincident, mirrored, partly missing and empty problems."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=(40, num_pairs, dimension)) + 5
    b = np.empty_like(a)
    for p in range(40):
        Q = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
        Q[:, 0] *= np.linalg.det(Q)
        b[p] = 1.3 * a[p] @ Q.T + rng.normal(size=dimension) + (0.02 * rng.normal(size=a[p].shape) if p % 2 else 0)
    a[3] = np.linspace(0, 1, num_pairs)[:, None] * np.arange(1, dimension + 1)
    a[4] = b[5] = 2.0
    b[6] = a[6] * [*[1] * (dimension - 1), -1]
    a[7, ::2] = np.nan
    b[8, 2:, 0] = np.inf
    a[9] = np.nan
    w = rng.uniform(0.1, 2, a.shape[:2])
    w[10, 1:] = 0
    w[11] = 0
    return a, b, w


@pytest.mark.parametrize("dimension", [2, 3, 4])
@pytest.mark.parametrize("scale", ["none", "symmetric", "least_squares"])
@pytest.mark.parametrize("weighted", [False, True])
def test_every_entry_is_that_of_the_single_form(dimension, scale, weighted):
    a, b, w = problems(dimension)
    batch = align_closed_form_batch(a, b, weights=w if weighted else None, scale=scale)
    assert len(batch) == 40
    assert batch.T_target_source.shape == (40, dimension + 1, dimension + 1)
    for p in range(40):
        single = align_closed_form(a[p], b[p], weights=w[p] if weighted else None, scale=scale)
        assert batch.statuses[p] is single.status
        # Two compilations of the same sums, which may round differently.
        np.testing.assert_allclose(batch.T_target_source[p], single.T_target_source, rtol=0, atol=1e-12)
        assert batch.scale[p] == pytest.approx(single.scale, rel=1e-12)
        assert batch.rmse_m[p] == pytest.approx(single.rmse_m, rel=1e-9, abs=1e-12)
        assert batch.num_inliers[p] == single.num_inliers
        assert batch.converged[p] == single.status.success
    assert set(batch.statuses) == {Status.CONVERGED, Status.DEGENERATE, Status.TOO_FEW_CORRESPONDENCES}
    assert (batch.num_dropped[7], batch.num_dropped[8], batch.num_dropped[9]) == (3, 4, 6)
    assert batch.rank[4] == batch.rank[5] == 0
    assert batch.rank[3] == 1
    assert batch.rank[0] == dimension


def test_problems_of_more_than_one_chunk():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(2, CHUNK + 100, 3))
    b = a + 0.1 * rng.normal(size=a.shape)
    batch = align_closed_form_batch(a, b)
    for p in range(2):
        single = align_closed_form(a[p], b[p])
        np.testing.assert_allclose(batch.T_target_source[p], single.T_target_source, rtol=0, atol=1e-12)
        assert batch.rmse_m[p] == pytest.approx(single.rmse_m, rel=1e-12)


def test_the_same_bytes_at_any_number_of_threads():
    a, b, w = problems(3)
    batches = []
    for count in (1, 2, 8):
        with limited_threads(count):
            batches.append(align_closed_form_batch(a, b, weights=w, scale="symmetric"))
    for other in batches[1:]:
        for name in ("T_target_source", "scale", "rmse_m"):
            assert getattr(batches[0], name).tobytes() == getattr(other, name).tobytes()


@pytest.mark.parametrize("shape", [(0, 5, 3), (4, 0, 3)])
def test_no_problems_and_no_pairs(shape):
    batch = align_closed_form_batch(np.zeros(shape), np.zeros(shape))
    assert len(batch) == shape[0]
    assert all(status is Status.TOO_FEW_CORRESPONDENCES for status in batch.statuses)
    np.testing.assert_array_equal(batch.T_target_source, np.tile(np.eye(4), (shape[0], 1, 1)))
    assert (batch.scale == 1).all()


def test_read_only_integers_and_lists_are_taken():
    a = np.array([[(0, 0), (1, 0), (0, 1)]])
    a.flags.writeable = False
    for source in (a, a.tolist(), a.astype(np.float32)):
        np.testing.assert_allclose(align_closed_form_batch(source, a + 2).T_target_source[0, :2, 2], 2)


@pytest.mark.parametrize(
    ("source", "target", "options", "words"),
    [
        (np.ones((5, 3)), np.ones((5, 3)), {}, r"source: expected shape \(B, N, D\)"),
        (np.ones((2, 5, 3)), np.ones((2, 4, 3)), {}, "target: expected the shape of source"),
        (np.ones((2, 5, 1)), np.ones((2, 5, 1)), {}, "D >= 2"),
        (np.full((2, 5, 3), "a"), np.ones((2, 5, 3)), {}, "numbers"),
        ([[[1, 2], [3]]], np.ones((1, 2, 2)), {}, "rectangular"),
        (np.ones((2, 5, 3)), np.ones((2, 5, 3)), {"weights": np.ones(5)}, r"weights: expected shape \(2, 5\)"),
        (np.ones((2, 5, 3)), np.ones((2, 5, 3)), {"weights": -np.ones((2, 5))}, "weights: expected finite"),
        (np.ones((2, 5, 3)), np.ones((2, 5, 3)), {"weights": np.full((2, 5), np.nan)}, "weights: expected finite"),
        (np.ones((2, 5, 3)), np.ones((2, 5, 3)), {"scale": "both"}, "scale"),
    ],
)
def test_wrong_input_raises(source, target, options, words):
    with pytest.raises(InvalidInputError, match=words):
        align_closed_form_batch(source, target, **options)
