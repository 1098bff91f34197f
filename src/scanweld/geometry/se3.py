"""Rigid motions as plain (..., 4, 4) float64 arrays.

Twists are (..., 6) = (rho [m], phi [rad]), translation first; perturbations act from the left,
T <- exp(xi) T. Every function accepts leading batch dimensions.

Source: J. Solà et al., "A micro Lie theory for state estimation in robotics", 2018 (equations in the code).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64

_SMALL = 1e-4  # below this angle the Taylor series is exact to 1e-16 and the closed form is not


def hat(phi: npt.ArrayLike) -> Float64:
    """Return the skew-symmetric matrices (..., 3, 3) with hat(a) b = a x b of vectors (..., 3)."""
    v = np.asarray(phi, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def _coefficients(phi: Float64) -> tuple[Float64 | float, Float64 | float, Float64 | float]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 with t = |phi|, shaped (..., 1, 1)."""
    if phi.ndim == 1:  # arrays of one number would take most of a tracker's time
        return _coefficients_of_one(*phi.tolist())
    t = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = t < _SMALL
    s = np.where(small, 1.0, t)
    half = np.sin(s / 2) / s
    a = np.where(small, 1 - t**2 / 6, np.sin(s) / s)
    b = np.where(small, 0.5 - t**2 / 24, 2 * half**2)
    # t - sin t cancels below about 0.01 rad: two more terms of the series there.
    series = 1 / 6 - t**2 / 120 + t**4 / 5040
    c = np.where(t < 0.02, series, (s - np.sin(s)) / s**3)
    return a, b, c


def _coefficients_of_one(x: float, y: float, z: float) -> tuple[float, float, float]:
    t = math.sqrt(x * x + y * y + z * z)
    if not t < 1e100:  # where `math` would raise
        return math.nan, math.nan, math.nan
    c = 1 / 6 - t**2 / 120 + t**4 / 5040 if t < 0.02 else (t - math.sin(t)) / t**3
    if t < _SMALL:
        return 1 - t**2 / 6, 0.5 - t**2 / 24, c
    return math.sin(t) / t, 2 * (math.sin(t / 2) / t) ** 2, c


def exp_so3(phi: npt.ArrayLike) -> Float64:
    """Return the rotations (..., 3, 3) about vectors (..., 3) by their length [rad] (Rodrigues)."""
    v = np.asarray(phi, dtype=np.float64)
    a, b, _ = _coefficients(v)
    matrix = hat(v)
    return np.asarray(np.eye(3) + a * matrix + b * (matrix @ matrix))


def log_so3(rotation: npt.ArrayLike) -> Float64:
    """Return the rotation vectors (..., 3) [rad], angle in [0, pi], of rotations (..., 3, 3)."""
    if np.ndim(rotation) == 2:
        x, y, z, real = _quaternion_of_one(np.asarray(rotation, dtype=np.float64).tolist())
        length = math.hypot(x, y, z)
        scale = 2 + length**2 / 3 if length < _SMALL else 2 * math.atan2(length, real) / length
        return scale * np.array([x, y, z])
    q = quaternion_xyzw_from_rotation(rotation)
    vector, w = q[..., :3], q[..., 3:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, w)
    small = sine < _SMALL
    factor = np.where(small, 2 + sine**2 / 3, angle / np.where(small, 1.0, sine))
    return np.asarray(factor * vector)


def exp(xi: npt.ArrayLike) -> Float64:
    """Return the transforms (..., 4, 4) of twists (..., 6) (Solà eq. 172, 174)."""
    twist = np.asarray(xi, dtype=np.float64)
    rho, phi = twist[..., :3], twist[..., 3:]
    a, b, c = _coefficients(phi)
    matrix = hat(phi)
    square = matrix @ matrix
    transform = np.zeros((*twist.shape[:-1], 4, 4))
    transform[..., :3, :3] = np.eye(3) + a * matrix + b * square
    transform[..., :3, 3] = ((np.eye(3) + b * matrix + c * square) @ rho[..., None])[..., 0]
    transform[..., 3, 3] = 1
    return transform


def log(transform: npt.ArrayLike) -> Float64:
    """Return the twists (..., 6) of transforms (..., 4, 4) (Solà eq. 173); rotation angle in [0, pi]."""
    T = np.asarray(transform, dtype=np.float64)
    phi = log_so3(T[..., :3, :3])
    rho = _left_jacobian_so3_inverse(phi) @ T[..., :3, 3, None]
    return np.concatenate([rho[..., 0], phi], axis=-1)


def inverse(transform: npt.ArrayLike) -> Float64:
    """Return T^-1 of rigid transforms (..., D + 1, D + 1), any D, by transposing the rotation."""
    T = np.asarray(transform, dtype=np.float64)
    d = T.shape[-1] - 1
    result = np.zeros_like(T)
    rotation = np.swapaxes(T[..., :d, :d], -1, -2)
    result[..., :d, :d] = rotation
    result[..., :d, d] = -(rotation @ T[..., :d, d, None])[..., 0]
    result[..., d, d] = 1
    return result


def adjoint(transform: npt.ArrayLike) -> Float64:
    """Return Ad (..., 6, 6) with T exp(xi) = exp(Ad xi) T (Solà eq. 175)."""
    T = np.asarray(transform, dtype=np.float64)
    rotation = T[..., :3, :3]
    result = np.zeros((*T.shape[:-2], 6, 6))
    result[..., :3, :3] = rotation
    result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = hat(T[..., :3, 3]) @ rotation
    return result


def left_jacobian_so3(phi: npt.ArrayLike) -> Float64:
    """Return J (..., 3, 3) with exp(phi + d) = exp(J d) exp(phi) to first order in d (Solà eq. 145)."""
    v = np.asarray(phi, dtype=np.float64)
    _, b, c = _coefficients(v)
    matrix = hat(v)
    return np.asarray(np.eye(3) + b * matrix + c * (matrix @ matrix))


def left_jacobian_inverse(xi: npt.ArrayLike) -> Float64:
    """Return J^-1 (..., 6, 6) with log(exp(d) exp(xi)) = xi + J^-1 d to first order in d, |phi| < 2 pi.

    J = [[A, Q], [0, A]] with A of :func:`left_jacobian_so3`, so J^-1 = [[A^-1, -A^-1 Q A^-1], [0, A^-1]]
    (Solà eq. 179, 180; the coefficients are those of T. D. Barfoot, "State estimation for robotics", 2017, eq. 7.86).
    """
    twist = np.asarray(xi, dtype=np.float64)
    rho, phi = twist[..., :3], twist[..., 3:]
    inverse_so3 = _left_jacobian_so3_inverse(phi)
    c1, c2, c3 = _second_coefficients(phi)
    r, p = hat(rho), hat(phi)
    pr, rp = p @ r, r @ p
    prp = pr @ p
    q = r / 2 + c1 * (pr + rp + prp) + c2 * (p @ pr + rp @ p - 3 * prp) + c3 * (prp @ p + p @ prp)
    result = np.zeros((*twist.shape[:-1], 6, 6))
    result[..., :3, :3] = inverse_so3
    result[..., 3:, 3:] = inverse_so3
    result[..., :3, 3:] = -inverse_so3 @ q @ inverse_so3
    return result


def _left_jacobian_so3_inverse(phi: Float64) -> Float64:
    """I - hat/2 + k hat^2, k = (1 - (t/2) cot(t/2)) / t^2 (Solà eq. 146)."""
    matrix = hat(phi)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < 0.02
    s = np.where(small, 1.0, angle)
    with np.errstate(divide="ignore"):
        cotangent = 1 / np.tan(s / 2)
    k = np.where(small, 1 / 12 + angle**2 / 720 + angle**4 / 30240, (1 - s / 2 * cotangent) / s**2)
    return np.asarray(np.eye(3) - matrix / 2 + k * (matrix @ matrix))


def _second_coefficients(phi: Float64) -> tuple[Float64, Float64, Float64]:
    """c1 = (t - sin t) / t^3, c2 = (t^2 / 2 + cos t - 1) / t^4 and
    c3 = (c2 + 3 (t - sin t - t^3 / 6) / t^5) / 2 with t = |phi|, shaped (..., 1, 1)."""
    t = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = t < 0.5  # the closed forms cancel below; seven terms of the series are exact to 1e-16 there
    s = np.where(small, 1.0, t)
    square = np.where(small, t, 0.0) ** 2

    def series(first: int) -> Float64:
        """sum over k of (-t^2)^k / (2 k + first)!"""
        total = np.zeros_like(square)
        for k in reversed(range(7)):
            total = total * -square + 1 / math.factorial(2 * k + first)
        return total

    c1 = np.where(small, series(3), (s - np.sin(s)) / s**3)
    c2 = np.where(small, series(4), (s**2 / 2 + np.cos(s) - 1) / s**4)
    d = np.where(small, -series(5), (s - np.sin(s) - s**3 / 6) / s**5)
    return c1, c2, (c2 + 3 * d) / 2


def interpolate(T_a: npt.ArrayLike, T_b: npt.ArrayLike, fraction: npt.ArrayLike) -> Float64:
    """Move from T_a (fraction 0) to T_b (fraction 1) at constant twist; other fractions extrapolate.

    Shapes (..., 4, 4), (..., 4, 4) and (...) broadcast.
    """
    a, b = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    s = np.asarray(fraction, dtype=np.float64)
    return np.asarray(exp(s[..., None] * log(b @ inverse(a))) @ a)


def transform_points(transform: npt.ArrayLike, points: npt.ArrayLike) -> Float64:
    """Apply one rigid transform (D + 1, D + 1) to points (..., D)."""
    T, p = np.asarray(transform, dtype=np.float64), np.asarray(points, dtype=np.float64)
    d = T.shape[-1] - 1
    return np.asarray(p @ T[:d, :d].T + T[:d, d])


def rotation_angle_rad(transform: npt.ArrayLike) -> Float64:
    """Return the rotation angles (...) [rad] of transforms (..., 4, 4) or rotations (..., 3, 3)."""
    T = np.asarray(transform, dtype=np.float64)
    return np.asarray(np.linalg.norm(log_so3(T[..., :3, :3]), axis=-1))


def from_quaternion_xyzw(quaternion_xyzw: npt.ArrayLike, translation_m: npt.ArrayLike = (0, 0, 0)) -> Float64:
    """Return transforms (..., 4, 4) from quaternions (..., 4), normalised here, and translations (..., 3)."""
    q = np.asarray(quaternion_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    T = np.zeros((*q.shape[:-1], 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    T[..., :3, 3] = translation_m
    T[..., 3, 3] = 1
    return T


def quaternion_xyzw_from_rotation(rotation: npt.ArrayLike) -> Float64:
    """Return unit quaternions (..., 4) with w >= 0 of rotations (..., 3, 3) (Shepperd: largest component first)."""
    R = np.asarray(rotation, dtype=np.float64)
    if R.ndim == 2:
        return np.array(_quaternion_of_one(R.tolist()))
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Row k is 4 q_k q: all four are the same quaternion, the one with the largest q_k is well conditioned.
    sum_01, sum_02, sum_12 = (R[..., i, j] + R[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    rows = np.stack(
        [
            np.stack([1 + m00 - m11 - m22, sum_01, sum_02, x], axis=-1),
            np.stack([sum_01, 1 - m00 + m11 - m22, sum_12, y], axis=-1),
            np.stack([sum_02, sum_12, 1 - m00 - m11 + m22, z], axis=-1),
            np.stack([x, y, z, 1 + m00 + m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def _quaternion_of_one(rotation: list[list[float]]) -> tuple[float, float, float, float]:
    (a, b, c), (d, e, f), (g, h, i) = rotation
    x, y, z = h - f, c - g, d - b
    rows = (
        (1 + a - e - i, b + d, c + g, x), (b + d, 1 - a + e - i, f + h, y), (c + g, f + h, 1 - a - e + i, z),
        (x, y, z, 1 + a + e + i),
    )  # fmt: skip
    row = rows[max(range(4), key=lambda k: rows[k][k])]
    scale = math.copysign(1 / math.hypot(*row), row[3])
    return row[0] * scale, row[1] * scale, row[2] * scale, row[3] * scale
