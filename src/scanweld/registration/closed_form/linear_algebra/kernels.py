"""Kernels for small matrices of any size: singular values, handedness, inverse."""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

TINY = 1e-100  # squared length of a column, of a matrix with entries up to 1, that counts as zero
EPSILON = 2.220446049250313e-16


@kernel
def decompose(A, left, sizes, right):
    """Write A (n, n), entries up to about 1, as left diag(sizes) right^T, sizes descending, both orthogonal.

    One-sided Jacobi (M. R. Hestenes 1958): columns of A are turned against each other until all are orthogonal.
    """
    n = len(A)
    for i in range(n):
        for j in range(n):
            left[i, j] = A[i, j]
            right[i, j] = 1.0 if i == j else 0.0
    for sweep in range(40):
        turned = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                alpha, beta, gamma = 0.0, 0.0, 0.0
                for k in range(n):
                    alpha += left[k, p] * left[k, p]
                    beta += left[k, q] * left[k, q]
                    gamma += left[k, p] * left[k, q]
                if alpha < TINY or beta < TINY or abs(gamma) <= n * EPSILON * np.sqrt(alpha) * np.sqrt(beta):
                    continue
                turned = True
                zeta = (beta - alpha) / (2 * gamma)
                tangent = 1 / (abs(zeta) + np.sqrt(1 + zeta * zeta))
                tangent = tangent if zeta >= 0 else -tangent
                c = 1 / np.sqrt(1 + tangent * tangent)
                s = c * tangent
                for k in range(n):
                    a, b = left[k, p], left[k, q]
                    left[k, p], left[k, q] = c * a - s * b, s * a + c * b
                    a, b = right[k, p], right[k, q]
                    right[k, p], right[k, q] = c * a - s * b, s * a + c * b
        if not turned:
            break
    for j in range(n):
        sizes[j] = 0.0
        for k in range(n):
            sizes[j] += left[k, j] * left[k, j]
    for j in range(n):
        best = j
        for k in range(j + 1, n):
            best = k if sizes[k] > sizes[best] else best
        sizes[j], sizes[best] = sizes[best], sizes[j]
        for k in range(n):
            left[k, j], left[k, best] = left[k, best], left[k, j]
            right[k, j], right[k, best] = right[k, best], right[k, j]
        sizes[j] = np.sqrt(sizes[j]) if sizes[j] >= TINY else 0.0
        if sizes[j] > 0:
            for k in range(n):
                left[k, j] /= sizes[j]
        else:
            complete(left, j)


@kernel
def complete(basis, j):
    """Make column j a unit vector orthogonal to those before it: the axis that they cover least, cleared of them."""
    n = len(basis)
    axis, least = 0, 2.0
    for k in range(n):
        covered = 0.0
        for i in range(j):
            covered += basis[k, i] * basis[k, i]
        if covered < least - 1e-9:
            axis, least = k, covered
    basis[:, j] = 0.0
    basis[axis, j] = 1.0
    for again in range(2):
        for i in range(j):
            share = 0.0
            for k in range(n):
                share += basis[k, i] * basis[k, j]
            for k in range(n):
                basis[k, j] -= share * basis[k, i]
        length = 0.0
        for k in range(n):
            length += basis[k, j] * basis[k, j]
        length = np.sqrt(length)
        for k in range(n):
            basis[k, j] /= length


@kernel
def handedness(left, right):
    """Sign of the determinant of left right^T, both orthogonal, by elimination with pivots."""
    n = len(left)
    A = np.empty((n, n))
    multiply_transposed(left, right, A)
    sign = 1.0
    for p in range(n):
        best = p
        for k in range(p + 1, n):
            best = k if abs(A[k, p]) > abs(A[best, p]) else best
        if best != p:
            sign = -sign
            for k in range(n):
                A[p, k], A[best, k] = A[best, k], A[p, k]
        sign = sign if A[p, p] > 0 else -sign
        for i in range(p + 1, n):
            factor = A[i, p] / A[p, p]
            for k in range(p, n):
                A[i, k] -= factor * A[p, k]
    return sign


@kernel
def spread_along(scatter, axis):
    """axis^T scatter axis."""
    total = 0.0
    for i in range(len(axis)):
        for j in range(len(axis)):
            total += axis[i] * scatter[i, j] * axis[j]
    return total


@kernel
def multiply_transposed(A, B, C):
    """C = A B^T, for small matrices."""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[j, k]
            C[i, j] = total


@kernel
def invert(A, inverse):
    """Inverse of a positive definite matrix (n, n), by Gauss-Jordan; A is used up."""
    n = len(A)
    inverse[:] = 0.0
    for k in range(n):
        inverse[k, k] = 1.0
    for p in range(n):
        pivot = A[p, p]
        for k in range(n):
            A[p, k] /= pivot
            inverse[p, k] /= pivot
        for i in range(n):
            if i != p:
                factor = A[i, p]
                for k in range(n):
                    A[i, k] -= factor * A[p, k]
                    inverse[i, k] -= factor * inverse[p, k]
