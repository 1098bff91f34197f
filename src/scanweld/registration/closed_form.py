"""Closed-form alignment of paired points: Kabsch and Umeyama by SVD, Horn by unit quaternion.

Minimises E = sum w_i |b_i - s R a_i - t|^2 over proper rotations R, det R = +1, and, where asked for, the
scale s.

Sources: B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987.
S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
K. S. Arun, T. S. Huang, S. D. Blostein, "Least-squares fitting of two 3-D point sets", 1987.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Float64, as_points, finite_rows
from scanweld.errors import InvalidInputError
from scanweld.registration.residuals import point_equations, rotation_generators
from scanweld.registration.result import FreeDirection, RegistrationResult, Status

SCALES = ("none", "symmetric", "least_squares")
METHODS = ("svd", "quaternion")

RANK_TOLERANCE = 1e-9
"""A rotation whose curvature is below this share of the largest possible one is free: a line 3e-5 thin."""

MAX_ANGLE_STD_RAD = 0.2
"""A rotation that the pairs determine no better than this (11 degrees) is free: its evidence is noise."""

_MIRROR_GAIN = 0.5
"""Pairs count as mirrored when a reflection would bring the rmse below this share of the rotation's."""


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
    rotation, translation_m, scale : the answer, b = scale R a + t
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
        return int((self.singular_values > RANK_TOLERANCE * bound).sum())

    @property
    def transform(self) -> Float64:
        """T (D + 1, D + 1) of R and t, without the scale."""
        d = len(self.mean_source)
        T = np.eye(d + 1)
        T[:d, :d], T[:d, d] = self.rotation, self.translation_m
        return T

    @property
    def reflection_error(self) -> float:
        """E of the best orthogonal matrix, a reflection allowed: E - 4 s sigma_D where U Vt reflects."""
        reflects = np.linalg.det(self.U @ self.Vt) < 0
        return self.error - 4 * self.scale * float(self.singular_values[-1]) if reflects else self.error


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
    weights : (N,), not negative; None counts all pairs alike
    scale : "none"; "symmetric", sqrt(sum w|b'|^2 / sum w|a'|^2), the same in both directions (Horn eq. 2.D);
        or "least_squares", trace(D S) / sum w|a'|^2 (Umeyama eq. 42)
    method : "svd" in any dimension, or "quaternion" in 3-D

    Returns
    -------
    CONVERGED when the pairs determine the motion. TOO_FEW_CORRESPONDENCES with fewer than D pairs. DEGENERATE
    when a rotation is free (it is named, and stays zero), when the scale is, or when the pairs are mirror
    images of each other, which no motion can align. `rmse_m` is sqrt(E / sum w).

    Raises
    ------
    InvalidInputError
        When shapes do not match, weights are negative, or an option is unknown.
    """
    a, b, w, dropped = _validated(source, target, weights, scale, method)
    dimension = a.shape[1]
    notes = [f"{dropped} pairs were not finite and were dropped"] if dropped else []
    if len(a) == 0:
        size = dimension * (dimension + 1) // 2
        return RegistrationResult(
            T_target_source=np.eye(dimension + 1),
            status=Status.TOO_FEW_CORRESPONDENCES,
            information=np.zeros((size, size)),
            note="; ".join(["there are no pairs", *notes]),
        )
    fit = fit_horn(a, b, w, scale=scale, method=method, doubt_noise=True)
    free = [_free_rotation(fit, plane) for plane in fit.free_planes]
    status = Status.CONVERGED
    if len(a) < dimension:
        status = Status.TOO_FEW_CORRESPONDENCES
        notes.insert(0, f"{len(a)} pair{'s' * (len(a) != 1)}, {dimension} are needed in {dimension}-D")
    elif free:
        status = Status.DEGENERATE
        notes.insert(0, f"the pairs leave free: {', '.join(direction.words for direction in free)}")
    if _looks_mirrored(fit):
        status = Status.DEGENERATE if status is Status.CONVERGED else status
        notes.insert(0, "the pairs are mirrored, no rotation aligns them; is an axis flipped or are two swapped?")
    if scale != "none" and not fit.scale > 0:
        fit = fit_horn(a, b, w, scale="none", method=method, doubt_noise=True)
        free.append(FreeDirection("scale", np.zeros(dimension * (dimension + 1) // 2)))
        status = Status.DEGENERATE if status is Status.CONVERGED else status
        notes.insert(0, "the scale cannot be found, one of the sets has no extent; 1 is used")
    moved = fit.scale * a @ fit.rotation.T + fit.translation_m
    return RegistrationResult(
        T_target_source=fit.transform,
        status=status,
        information=point_equations(moved, b, w).information,
        scale=fit.scale,
        num_iterations=1,
        num_inliers=len(a),
        overlap=len(a) / (len(a) + dropped),
        rmse_m=float(np.sqrt(fit.error / w.sum())),
        unobservable=tuple(free),
        note="; ".join(notes),
    )


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
    w = np.ones(len(source)) if weights is None else weights
    total = w.sum()
    # Subtracting a row first keeps the means exact at coordinates of 1e6.
    mean_a = source[0] + w @ (source - source[0]) / total
    mean_b = target[0] + w @ (target - target[0]) / total
    a, b = source - mean_a, target - mean_b
    # Unit spread: clouds of 1e-6 m neither underflow nor look like rank zero.
    W = (w[:, None] * b).T @ a
    scatter_a, scatter_b = (w[:, None] * a).T @ a, (w[:, None] * b).T @ b
    spread_a, spread_b = float(np.trace(scatter_a)), float(np.trace(scatter_b))
    bound = np.sqrt(spread_a) * np.sqrt(spread_b)  # their product may underflow
    U, sigma, Vt = np.linalg.svd(W / bound if bound > 0 else np.zeros_like(W))
    signed = sigma.copy()
    signed[-1] *= np.sign(np.linalg.det(U @ Vt))
    dimension = len(mean_a)
    curvatures = {(i, j): float(signed[i] + signed[j]) for i, j in itertools.combinations(range(dimension), 2)}
    free = {plane for plane, value in curvatures.items() if value <= RANK_TOLERANCE}
    if doubt_noise and bound > 0:
        spread_u = np.einsum("ij,ik,kj->j", U, scatter_b / spread_b, U)
        spread_v = np.einsum("ji,ik,jk->j", Vt, scatter_a / spread_a, Vt)
        free |= {
            (i, j)
            for (i, j), value in curvatures.items()
            if _angle_variance(value, spread_v[i] + spread_v[j], spread_u[i] + spread_u[j], len(a))
            > MAX_ANGLE_STD_RAD**2
        }
    if method == "quaternion":
        R = _rotation_by_quaternion(W / bound if bound > 0 else W, len(free))
    else:
        R = _rotation_by_svd(U, Vt, free)
    s = _scale(scale, float(np.sum(R * W)), spread_a, spread_b)
    residuals = b - s * a @ R.T
    return HornFit(
        mean_source=mean_a,
        mean_target=mean_b,
        W=W,
        U=U,
        singular_values=sigma * bound,
        Vt=Vt,
        curvatures={plane: value * bound for plane, value in curvatures.items()},
        free_planes=tuple(sorted(free)),
        rotation=R,
        translation_m=mean_b - s * R @ mean_a,
        scale=s,
        source_spread=spread_a,
        target_spread=spread_b,
        error=float(w @ (residuals * residuals).sum(axis=1)),
    )


def _angle_variance(curvature: float, spread_a: float, spread_b: float, count: int) -> float:
    """Variance [rad^2] of the angle in a plane, from how well the points correlate within that plane.

    With the correlation rho = curvature / sqrt(spread_a spread_b) of the points' components in the plane, the
    angle of the best rotation has the variance (1 / rho^2 - 1) / (2 N): zero for exact pairs, about 1 for
    noise.
    """
    product = spread_a * spread_b
    if curvature <= 0 or product <= 0:
        return np.inf
    rho_squared = min(curvature * curvature / product, 1.0)
    return (1 / rho_squared - 1) / (2 * count)


def _rotation_by_svd(U: Float64, Vt: Float64, free: set[tuple[int, int]]) -> Float64:
    """R = U diag(I, Q) V^T (Umeyama eq. 40), Q = diag(1, .., det(U V^T)) on the part that W does not
    determine.

    Where the last m >= 2 columns may turn freely against each other, Q is the orthogonal matrix that makes R
    nearest to I: W = 0 gives R = I, a line gives the smallest rotation that aligns it.
    """
    dimension = len(U)
    first = dimension - 1
    while first > 0 and all((first - 1, j) in free for j in range(first, dimension)):
        first -= 1
    sign = np.sign(np.linalg.det(U @ Vt))
    p, _, qt = np.linalg.svd(U[:, first:].T @ Vt[first:].T)
    flip = np.ones(dimension - first)
    flip[-1] = sign * np.sign(np.linalg.det(p @ qt))
    block = np.eye(dimension)
    block[first:, first:] = (p * flip) @ qt
    R: Float64 = U @ block @ Vt
    return R


def _rotation_by_quaternion(W: Float64, num_free: int) -> Float64:
    """Rotation whose unit quaternion maximises q^T N q (Horn section 4.A); (w, x, y, z) order inside.

    The eigenvalues of N differ by twice the curvatures, so `num_free` free planes tie as many eigenvectors
    with the best one; the quaternion nearest to the identity is taken from their span.
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


def _scale(kind: str, correlation: float, spread_a: float, spread_b: float) -> float:
    """Return the scale; `correlation` is trace(R^T W) = trace(D S). 0 says that it cannot be found."""
    if kind == "none":
        return 1.0
    if spread_a <= 0:
        return 0.0
    return float(np.sqrt(spread_b / spread_a)) if kind == "symmetric" else max(correlation / spread_a, 0.0)


def _looks_mirrored(fit: HornFit) -> bool:
    if fit.error <= 0 or fit.rank < len(fit.mean_source):
        return False
    return bool(fit.reflection_error < _MIRROR_GAIN**2 * fit.error)


def _free_rotation(fit: HornFit, plane: tuple[int, int]) -> FreeDirection:
    dimension = len(fit.mean_source)
    e_i, e_j = fit.U[:, plane[0]], fit.U[:, plane[1]]
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


def _validated(
    source: npt.ArrayLike, target: npt.ArrayLike, weights: npt.ArrayLike | None, scale: str, method: str
) -> tuple[Float64, Float64, Float64, int]:
    shape = np.shape(source)
    allowed = (shape[1],) if len(shape) == 2 and 2 <= shape[1] <= 64 else (2, 3)
    a = as_points(source, "source", dimensions=allowed)
    b = as_points(target, "target", dimensions=(a.shape[1],))
    if a.shape != b.shape:
        raise InvalidInputError(
            f"closed form pairs row i with row i: expected equal lengths, got {len(a)} and {len(b)} points; "
            "use icp() where the pairs are unknown"
        )
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(a),):
        raise InvalidInputError(f"weights: expected shape ({len(a)},), got {w.shape}")
    if scale not in SCALES:
        raise InvalidInputError(f"scale: expected one of {', '.join(SCALES)}, got {scale!r}")
    if method not in METHODS:
        raise InvalidInputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if method == "quaternion" and a.shape[1] != 3:
        raise InvalidInputError(f"method 'quaternion' needs 3-D points, got {a.shape[1]}-D; use 'svd'")
    if not np.isfinite(w).all() or (w < 0).any():
        raise InvalidInputError("weights: expected finite values that are not negative")
    finite: Bool = finite_rows(a, b)
    used = finite & (w > 0)
    return a[used], b[used], w[used], int((~finite).sum())
