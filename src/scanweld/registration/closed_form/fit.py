"""The closed form of pairs that are known to be sound: the kernels, and what they found under its names."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64
from scanweld.parallel import run_ranges
from scanweld.registration.closed_form import kernels as k
from scanweld.registration.closed_form.moments import kernels as m

SCALES = ("none", "symmetric", "least_squares")
METHODS = ("svd", "quaternion")

_Number = TypeVar("_Number", np.float64, np.int64)


class Solution(NamedTuple):
    """What the kernels write, rows and entries as named in ``closed_form.kernels``."""

    scalars: Float64
    vectors: Float64
    matrices: Float64


@dataclass(frozen=True, slots=True)
class HornFit:
    """The closed form with all that leads to it; D is the dimension.

    Attributes
    ----------
    mean_source, mean_target : (D,), weighted means [m]
    W : (D, D), sum w_i b'_i a'_i^T of the centred points [m^2]
    U, singular_values, Vt : (D, D), (D,), (D, D); W = U diag(singular_values) Vt, descending
    curvatures : {(i, j): value [m^2]}, how sharply E rises when the target turns in the plane of columns i
        and j of U: s_i + s_j, with the last singular value negative where U Vt is a reflection
    free_planes : the planes in which nothing holds the rotation
    rotation, translation_m, scale : the answer, b = scale R a + t; scale 0 says that it cannot be found
    source_spread, target_spread : sum w |a'|^2, sum w |b'|^2 [m^2]
    error : E [m^2]
    """

    mean_source: Float64
    mean_target: Float64
    W: Float64
    U: Float64
    singular_values: Float64
    Vt: Float64
    curvatures: dict[tuple[int, int], float]
    free_planes: tuple[tuple[int, int], ...]
    rotation: Float64
    translation_m: Float64
    scale: float
    source_spread: float
    target_spread: float
    error: float

    @property
    def rank(self) -> int:
        """Number of singular values of W that are not zero."""
        bound = np.sqrt(self.source_spread) * np.sqrt(self.target_spread)
        return int((self.singular_values > k.RANK_TOLERANCE * bound).sum())

    @property
    def transform(self) -> Float64:
        """T (D + 1, D + 1) of R and t, without the scale."""
        return _transform(self.rotation, self.translation_m)

    @property
    def reflection_error(self) -> float:
        """E of the best orthogonal matrix, a reflection allowed: E - 4 s sigma_D where U Vt reflects."""
        reflects = np.linalg.det(self.U @ self.Vt) < 0
        return self.error - 4 * self.scale * float(self.singular_values[-1]) if reflects else self.error


class PairFit(NamedTuple):
    """The motion that aligns pairs, b = scale R a + t, and what it rests on.

    Attributes
    ----------
    rotation, translation_m, scale : (D, D), (D,) [m], 1 where it was not asked for or cannot be found
    rank : number of singular values of W that are not zero, 0..D
    num_free : number of planes in which nothing holds the rotation; there it is the one nearest to I
    num_pairs, total_weight : pairs of positive weight, and the sum of the weights
    error : E [m^2], from the moments: to 1e-15 of the spread of the points, so exact pairs do not give 0 exactly
    mean_source, mean_target : (D,), weighted means [m]
    scale_found : whether the scale was asked for, and both sets have the extent to tell it
    """

    rotation: Float64
    translation_m: Float64
    scale: float
    rank: int
    num_free: int
    num_pairs: int
    total_weight: float
    error: float
    mean_source: Float64
    mean_target: Float64
    scale_found: bool

    @property
    def T(self) -> Float64:
        """T (D + 1, D + 1) of R and t, without the scale."""
        return _transform(self.rotation, self.translation_m)


def fit_horn(
    source: Float64,
    target: Float64,
    weights: Float64 | None = None,
    *,
    scale: str = "none",
    method: str = "svd",
    doubt_noise: bool = False,
) -> HornFit:
    """Compute the closed form of validated, finite pairs (N, D), N >= 1, and keep every quantity on the way.

    A rotation that W leaves free is not invented: of all optimal rotations the one nearest to I is returned.

    Parameters
    ----------
    doubt_noise : treat a rotation whose evidence could be noise as free, too (see ``MAX_ANGLE_STD_RAD``)
    """
    found = solve_pairs(source, target, weights, SCALES.index(scale), method=method, doubt_noise=doubt_noise)
    scalars, vectors, matrices = found
    mean_a, mean_b = vectors[k.ORIGIN_A : k.ORIGIN_B + 1] + vectors[k.OFFSET_A : k.OFFSET_B + 1]
    lost = scale != "none" and not scalars[k.SCALE_FOUND]
    planes = list(itertools.combinations(range(len(mean_a)), 2))
    return HornFit(
        mean_source=mean_a,
        mean_target=mean_b,
        W=matrices[k.W],
        U=matrices[k.U],
        singular_values=vectors[k.SINGULAR_VALUES],
        Vt=matrices[k.V].T,
        curvatures={plane: float(matrices[k.CURVATURES][plane]) for plane in planes},
        free_planes=free_planes(found),
        rotation=matrices[k.ROTATION],
        translation_m=mean_b if lost else vectors[k.TRANSLATION],
        scale=0.0 if lost else float(scalars[k.SCALE]),
        source_spread=float(scalars[k.SPREAD_A]),
        target_spread=float(scalars[k.SPREAD_B]),
        error=float(scalars[k.SPREAD_B if lost else k.ERROR]),
    )


def fit_pairs(
    source: Float64,
    target: Float64,
    *,
    source_rows: Int64 | None = None,
    target_rows: Int64 | None = None,
    weights: Float64 | None = None,
    scale: str = "none",
) -> PairFit:
    """Find the motion that aligns pairs of validated, finite points, for the inner loop of an iteration.

    Parameters
    ----------
    source, target : (N, D), (M, D) [m], contiguous
    source_rows, target_rows : (P,) int64, the rows that make a pair; row i with row i when None
    weights : (P,), not negative, 0 for no pair; None counts all alike
    scale : as in :func:`align_closed_form`
    """
    kind = SCALES.index(scale)
    scalars, vectors, matrices = moment_solution(source, target, source_rows, target_rows, weights, kind, False)
    values = scalars.tolist()
    return PairFit(
        rotation=matrices[k.ROTATION],
        translation_m=vectors[k.TRANSLATION],
        scale=values[k.SCALE],
        rank=int(values[k.RANK]),
        num_free=int(values[k.NUM_FREE]),
        num_pairs=int(values[m.COUNT]),
        total_weight=values[m.WEIGHT],
        error=values[k.ERROR],
        mean_source=vectors[k.ORIGIN_A] + vectors[k.OFFSET_A],
        mean_target=vectors[k.ORIGIN_B] + vectors[k.OFFSET_B],
        scale_found=bool(values[k.SCALE_FOUND]),
    )


def solve_pairs(
    source: Float64,
    target: Float64,
    weights: Float64 | None,
    kind: int,
    *,
    method: str = "svd",
    doubt_noise: bool = True,
) -> Solution:
    """Solve pairs (N, D), row i with row i, and sum what the motion leaves of them.

    Rows that are not finite are dropped and weights that are no weights left out; the scalars count both.
    """
    found = moment_solution(source, target, None, None, weights, kind, doubt_noise)
    scalars, vectors, matrices = found
    if scalars[m.COUNT] == 0:
        return found
    if method == "quaternion":
        _turn_by_quaternion(found, kind)
    errors = np.empty(_num_chunks(len(source)))
    a, b = frozen(source, np.float64), frozen(target, np.float64)
    w = _NO_WEIGHTS if weights is None else frozen(weights, np.float64)

    def body(start: int, stop: int) -> None:
        k.pair_errors(start, stop, a, b, k.NO_ROWS, k.NO_ROWS, w, scalars, vectors, matrices, errors)

    _run_chunks(len(errors), body)
    k.judge_motion(errors, scalars, vectors)
    return found


def moment_solution(
    source: Float64,
    target: Float64,
    source_rows: Int64 | None,
    target_rows: Int64 | None,
    weights: Float64 | None,
    kind: int,
    doubt_noise: bool,
) -> Solution:
    """Solve pairs in one pass over them: their moments are all that the motion depends on."""
    d = source.shape[1]
    a, b = frozen(source, np.float64), frozen(target, np.float64)
    w = _NO_WEIGHTS if weights is None else frozen(weights, np.float64)
    rows_a, rows_b = k.NO_ROWS, k.NO_ROWS
    if source_rows is not None and target_rows is not None:
        if len(source_rows) == 0:  # an empty list of pairs is no list that was left out
            a, b = a[:0], b[:0]
        rows_a, rows_b = frozen(source_rows, np.int64), frozen(target_rows, np.int64)
    num_pairs = len(a) if len(rows_a) == 0 else len(rows_a)
    partials = moment_rows(num_pairs, d)

    def body(start: int, stop: int) -> None:
        m.pair_moments(start, stop, a, b, rows_a, rows_b, w, partials)

    _run_chunks(len(partials), body)
    found = Solution(np.empty(k.NUM_SCALARS), np.zeros((k.NUM_VECTORS, d)), np.zeros((k.NUM_MATRICES, d, d)))
    k.solve_moments(partials, kind, doubt_noise, *found)
    return found


def free_planes(found: Solution) -> tuple[tuple[int, int], ...]:
    """Planes (i, j), i < j, of columns of U in which nothing holds the rotation."""
    if not found.scalars[k.NUM_FREE]:
        return ()
    rows, columns = np.nonzero(np.triu(found.matrices[k.FREE]))
    return tuple(zip(rows.tolist(), columns.tolist(), strict=True))


def moment_rows(num_pairs: int, dimension: int) -> Float64:
    """Return room for the moments of every chunk of the pairs."""
    return np.empty((_num_chunks(num_pairs), m.HEAD + 4 * dimension + 4 * dimension * dimension))


def _num_chunks(num_pairs: int) -> int:
    return max(1, -(-num_pairs // m.CHUNK))


def _run_chunks(count: int, body: Any) -> None:
    if count == 1:
        body(0, 1)
    else:
        run_ranges(count, body)


def frozen(array: npt.ArrayLike, dtype: type[_Number]) -> npt.NDArray[_Number]:
    """Return a contiguous read-only view: kernels are compiled once for it, whatever the caller's array is."""
    view = np.ascontiguousarray(array, dtype=dtype).view()
    view.setflags(write=False)
    return view


_NO_WEIGHTS = frozen(np.empty(0), np.float64)


def _transform(rotation: Float64, translation_m: Float64) -> Float64:
    d = len(translation_m)
    T = np.eye(d + 1)
    T[:d, :d], T[:d, d] = rotation, translation_m
    return T


def _turn_by_quaternion(found: Solution, kind: int) -> None:
    """Replace the rotation that was found by singular values, and what depends on it."""
    scalars, vectors, matrices = found
    largest = max(float(np.abs(matrices[k.W]).max()), 1e-300)
    loose = int(scalars[k.NUM_LOOSE])
    R = _rotation_by_quaternion(matrices[k.W] / largest, loose * (loose - 1) // 2)
    if kind == k.LEAST_SQUARES and scalars[k.SCALE_FOUND]:
        scalars[k.SCALE] = np.sum(R * matrices[k.W]) / scalars[k.SPREAD_A]
    mean_a, mean_b = vectors[k.ORIGIN_A : k.ORIGIN_B + 1] + vectors[k.OFFSET_A : k.OFFSET_B + 1]
    matrices[k.ROTATION] = R
    vectors[k.TRANSLATION] = mean_b - scalars[k.SCALE] * R @ mean_a


def _rotation_by_quaternion(W: Float64, num_free: int) -> Float64:
    """Rotation whose unit quaternion maximises q^T N q (Horn section 4.A); (w, x, y, z) order inside.

    The eigenvalues of N differ by twice the curvatures, so planes that turn freely tie as many eigenvectors
    with the best one, `num_free`; the quaternion nearest to the identity is taken from their span.
    """
    S = W.T  # Horn's S_xy = sum a'_x b'_y
    N = np.empty((4, 4))
    N[0, 0] = np.trace(S)
    N[0, 1:] = N[1:, 0] = S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]
    N[1:, 1:] = S + S.T - np.trace(S) * np.eye(3)
    _, vectors = np.linalg.eigh(N)
    best = vectors[:, 3 - num_free :]
    q = best @ best[0] if np.abs(best[0]).max() > 1e-12 else best[:, -1]
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
