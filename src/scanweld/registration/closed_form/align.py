"""Align pairs from anywhere: check them, solve them, and say what the answer is worth."""

from __future__ import annotations

from functools import cache
from math import sqrt

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64, as_points, refuse_giants
from scanweld.errors import InvalidInputError
from scanweld.registration.closed_form import kernels as k
from scanweld.registration.closed_form.fit import METHODS, SCALES, free_planes, solve_pairs
from scanweld.registration.closed_form.moments import kernels as m
from scanweld.registration.residuals import rotation_generators
from scanweld.registration.result import FreeDirection, RegistrationResult, Status


def align_closed_form(
    source: npt.ArrayLike,
    target: npt.ArrayLike,
    *,
    weights: npt.ArrayLike | None = None,
    scale: str = "none",
    method: str = "svd",
) -> RegistrationResult:
    """Align points whose partners are known: row i of `source` belongs to row i of `target`.

    Parameters
    ----------
    source, target : (N, D) [m], D >= 2. Rows with a value that is not finite are dropped in pairs, and
        counted
    weights : (N,), not negative; None counts all pairs alike. For the covariance they are inverse variances of
        the pairs' residuals, up to a common factor
    scale : "none"; "symmetric", sqrt(sum w|b'|^2 / sum w|a'|^2), the same in both directions (Horn eq. 2.D);
        or "least_squares", trace(D S) / sum w|a'|^2 (Umeyama eq. 42)
    method : "svd" in any dimension, or "quaternion" in 3-D

    Returns
    -------
    CONVERGED when the pairs determine the motion. TOO_FEW_CORRESPONDENCES with fewer than D pairs. DEGENERATE
    when a rotation is free (it is named, and stays zero), when the scale is, or when the pairs are mirror
    images of each other, which no motion can align. `rmse_m` is sqrt(E / sum w).

    `covariance` is sigma^2 times the inverse of `information`, sigma^2 = E / (D N - number of parameters), for noise
    that is alike in all coordinates and small against the extent of the points. With a scale it includes what the
    uncertainty of the scale, `scale_std`, does to the translation; both scales have the same, to first order. None
    where nothing is left to tell sigma.

    Raises
    ------
    InvalidInputError
        When shapes do not match, weights are negative, or an option is unknown.
    """
    a, b, w, kind = _validated(source, target, weights, scale, method)
    d = a.shape[1]
    size = d * (d + 1) // 2
    found = solve_pairs(a, b, w, kind, method=method)
    values = found.scalars.tolist()
    count, dropped = int(values[m.COUNT]), int(values[m.DROPPED])
    if values[m.INVALID]:
        raise InvalidInputError("weights: expected finite values that are not negative")
    notes = [f"{dropped} pairs were not finite and were dropped"] if dropped else []
    if count == 0:
        return RegistrationResult(
            T_target_source=np.eye(d + 1),
            status=Status.TOO_FEW_CORRESPONDENCES,
            information=np.zeros((size, size)),
            note="; ".join(["there are no pairs", *notes]),
        )
    T, information, covariance = np.empty((d + 1, d + 1)), np.empty((size, size)), np.empty((size, size))
    k.describe_motion(_rotation_planes(d), *found, T, information, covariance)
    free = [_free_rotation(found.matrices[k.U], plane) for plane in free_planes(found)]
    status = Status.CONVERGED
    if count < d:
        status = Status.TOO_FEW_CORRESPONDENCES
        notes.insert(0, f"{count} pair{'s' * (count != 1)}, {d} are needed in {d}-D")
    elif free:
        status = Status.DEGENERATE
        notes.insert(0, f"the pairs leave free: {', '.join(direction.words for direction in free)}")
    if values[k.MIRRORED]:
        status = Status.DEGENERATE if status is Status.CONVERGED else status
        notes.insert(0, "the pairs are mirrored, no rotation aligns them; is an axis flipped or are two swapped?")
    if kind != k.NO_SCALE and not values[k.SCALE_FOUND]:
        free.append(FreeDirection("scale", np.zeros(size)))
        status = Status.DEGENERATE if status is Status.CONVERGED else status
        notes.insert(0, "the scale cannot be found, one of the sets has no extent; 1 is used")
    known = count >= d and found.scalars[k.FREEDOM] > 0
    return RegistrationResult(
        T_target_source=T,
        status=status,
        information=information,
        scale=values[k.SCALE],
        num_iterations=1,
        num_inliers=count,
        overlap=count / (count + dropped),
        rmse_m=sqrt(values[k.ERROR] / values[m.WEIGHT]),
        covariance=covariance if known else None,
        scale_std=sqrt(found.scalars[k.SCALE_VARIANCE]) if known else 0.0,
        unobservable=tuple(free),
        note="; ".join(notes),
    )


def pair_residuals(result: RegistrationResult, source: npt.ArrayLike, target: npt.ArrayLike) -> Float64:
    """Return what an alignment leaves of each pair, scale R a + t - b (N, D) [m], in the target's frame.

    Parameters
    ----------
    result : of :func:`align_closed_form`, or of any other aligner
    source, target : (N, D) [m], row i with row i; a row with a value that is not finite has residuals that are not
        finite either

    Raises
    ------
    InvalidInputError
        When shapes do not match each other or the result.
    """
    d = len(result.T_target_source) - 1
    a = as_points(source, "source", dimensions=(d,))
    b = as_points(target, "target", dimensions=(d,))
    refuse_giants(a, "source")
    refuse_giants(b, "target")
    _check_partners(a, b)
    with np.errstate(invalid="ignore"):  # inf - inf, in a row that is not finite anyway
        moved: Float64 = result.scale * a @ result.T_target_source[:d, :d].T
        return moved + (result.T_target_source[:d, d] - b)


def _validated(
    source: npt.ArrayLike, target: npt.ArrayLike, weights: npt.ArrayLike | None, scale: str, method: str
) -> tuple[Float64, Float64, Float64 | None, int]:
    shape = np.shape(source)
    allowed = (shape[1],) if len(shape) == 2 and 2 <= shape[1] <= 64 else (2, 3)
    a = as_points(source, "source", dimensions=allowed)
    b = as_points(target, "target", dimensions=(a.shape[1],))
    refuse_giants(a, "source")
    refuse_giants(b, "target")
    _check_partners(a, b)
    kind = scale_kind(scale)
    if method not in METHODS:
        raise InvalidInputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if method == "quaternion" and a.shape[1] != 3:
        raise InvalidInputError(f"method 'quaternion' needs 3-D points, got {a.shape[1]}-D; use 'svd'")
    return a, b, None if weights is None else as_weights(weights, (len(a),)), kind


def _check_partners(a: Float64, b: Float64) -> None:
    if a.shape != b.shape:
        raise InvalidInputError(
            f"closed form pairs row i with row i: expected equal lengths, got {len(a)} and {len(b)} points; "
            "use icp() where the pairs are unknown"
        )


def scale_kind(scale: str) -> int:
    """Return the number by which the kernels know a kind of scale."""
    if scale not in SCALES:
        raise InvalidInputError(f"scale: expected one of {', '.join(SCALES)}, got {scale!r}")
    return SCALES.index(scale)


def as_weights(weights: npt.ArrayLike, shape: tuple[int, ...]) -> Float64:
    """Return weights as contiguous float64 of that shape; their values are checked by the kernels."""
    try:
        w = np.ascontiguousarray(weights, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"weights: expected numbers ({error})") from None
    if w.shape != shape:
        raise InvalidInputError(f"weights: expected shape {shape}, got {w.shape}")
    return w


@cache
def _rotation_planes(dimension: int) -> Int64:
    """Axes (i, j) of every rotation generator, which turns i towards j."""
    return np.array([np.argwhere(generator == 1)[0][::-1] for generator in rotation_generators(dimension)])


def _free_rotation(U: Float64, plane: tuple[int, int]) -> FreeDirection:
    dimension = len(U)
    e_i, e_j = U[:, plane[0]], U[:, plane[1]]
    turn = np.outer(e_j, e_i) - np.outer(e_i, e_j)
    phi = np.array([np.sum(turn * generator) / 2 for generator in rotation_generators(dimension)])
    vector = np.concatenate([np.zeros(dimension), phi])
    if dimension == 2:
        words = "rotation"
    elif dimension == 3:
        words = f"rotation about {_words(phi)}"
    else:
        words = f"rotation in the plane of {_words(e_i)} and {_words(e_j)}"
    return FreeDirection(words, vector)


def _words(axis: Float64) -> str:
    turned = -axis if axis[np.argmax(np.abs(axis))] < 0 else axis
    return "(" + ", ".join(f"{value:.2f}" for value in np.round(turned, 2) + 0.0) + ")"
