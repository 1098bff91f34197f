"""Kernels of the closed form, for pairs of any dimension D: the motion of their moments, and what it is worth.

Where an argument `source_rows` is empty, row i belongs to row i; where `weights` is, all pairs count alike.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import inlined, kernel
from scanweld.registration.closed_form.linear_algebra.kernels import (
    decompose,
    handedness,
    invert,
    multiply_transposed,
    spread_along,
)
from scanweld.registration.closed_form.moments.kernels import (
    BLOCK,
    CHUNK,
    COUNT,
    HEAD,
    WEIGHT,
    load_points,
    load_weights,
    merge_moments,
    pair_moments,
)

RANK_TOLERANCE = 1e-9
"""A rotation whose curvature is below this share of the largest possible one is free: a line 3e-5 thin."""

MAX_ANGLE_STD_RAD = 0.2
"""A rotation that the pairs determine no better than this (11 degrees) is free: its evidence is noise."""

MIRROR_GAIN = 0.5
"""Pairs count as mirrored when a reflection would bring the rmse below this share of the rotation's."""

# Scalars of a fit; the first four head a row of moments, too.
SPREAD_A, SPREAD_B, SCALE, SCALE_FOUND = range(4, 8)
ERROR, RANK, NUM_FREE, NUM_LOOSE, REFLECTS, MIRRORED, SCALE_VARIANCE, FREEDOM = range(8, 16)
NUM_SCALARS = 16

# Vectors (D,) and matrices (D, D) of a fit. OFFSETs are means minus ORIGINs; W, CURVATURES are in m^2.
ORIGIN_A, ORIGIN_B, OFFSET_A, OFFSET_B, TRANSLATION, SINGULAR_VALUES = range(6)
NUM_VECTORS = 6
W, U, V, ROTATION, SCATTER_A, SCATTER_B, CURVATURES, FREE = range(8)
NUM_MATRICES = 8

NO_SCALE, SYMMETRIC, LEAST_SQUARES = range(3)

NO_ROWS = np.empty(0, np.int64)
NO_ROWS.flags.writeable = False
"""Stands for "row i belongs to row i"."""


@kernel
def find_free_planes(doubt_noise, scalars, matrices):
    """Mark in FREE the planes of columns of U in which nothing holds the rotation; CURVATURES are still normalised.

    With the correlation rho = curvature / sqrt(spread_a spread_b) of the points' components within a plane, the angle
    of the best rotation has the variance (1 / rho^2 - 1) / (2 N): zero for exact pairs, about 1 for noise.
    """
    d = matrices.shape[1]
    curvatures, free = matrices[CURVATURES], matrices[FREE]
    spread_u, spread_v = np.empty(d), np.empty(d)
    for j in range(d):
        spread_u[j] = spread_along(matrices[SCATTER_B], matrices[U, :, j]) / max(scalars[SPREAD_B], 1e-300)
        spread_v[j] = spread_along(matrices[SCATTER_A], matrices[V, :, j]) / max(scalars[SPREAD_A], 1e-300)
    bound = 1 + 2 * scalars[COUNT] * MAX_ANGLE_STD_RAD**2
    for i in range(d):
        for j in range(i + 1, d):
            curvature = curvatures[i, j]
            product = (spread_v[i] + spread_v[j]) * (spread_u[i] + spread_u[j])
            loose = curvature <= RANK_TOLERANCE or (doubt_noise and product > bound * curvature * curvature)
            free[i, j] = free[j, i] = 1.0 if loose else 0.0
            scalars[NUM_FREE] += free[i, j]


@kernel
def find_rotation(matrices, sign):
    """R = U diag(I, Q) V^T (Umeyama eq. 40), Q = diag(1, .., det(U V^T)) on the part that W does not determine.

    Where the last m >= 2 columns may turn freely against each other, Q is the orthogonal matrix that makes R nearest to
    I: W = 0 gives R = I, a line gives the smallest rotation that aligns it. Returns m.
    """
    d = matrices.shape[1]
    free = matrices[FREE]
    first = d - 1
    while first > 0:
        loose = True
        for j in range(first, d):
            loose = loose and free[first - 1, j] > 0
        if not loose:
            break
        first -= 1
    m = d - first
    A, p, q, sizes = np.zeros((m, m)), np.empty((m, m)), np.empty((m, m)), np.empty(m)
    for i in range(m):
        for j in range(m):
            for k in range(d):
                A[i, j] += matrices[U, k, first + i] * matrices[V, k, first + j]
    decompose(A, p, sizes, q)
    flip = sign * handedness(p, q)
    for k in range(m):
        p[k, m - 1] *= flip
    block = np.zeros((d, d))
    for k in range(first):
        block[k, k] = 1.0
    for i in range(m):
        for j in range(m):
            for k in range(m):
                block[first + i, first + j] += p[i, k] * q[j, k]
    turned = np.empty((d, d))
    multiply_transposed(block, matrices[V], turned)
    for i in range(d):
        for j in range(d):
            total = 0.0
            for k in range(d):
                total += matrices[U, i, k] * turned[k, j]
            matrices[ROTATION, i, j] = total
    return m


@kernel
def solve_moments(partials, kind, doubt_noise, scalars, vectors, matrices):
    """Merge rows of moments in their order, and find the motion; the ERROR is that of the moments.

    kind : NO_SCALE, SYMMETRIC, LEAST_SQUARES; SCALE is 1, and SCALE_FOUND 0, where a set has no extent. vectors and
    matrices come as zeros.
    """
    d = matrices.shape[1]
    moments = np.zeros(partials.shape[1])
    for chunk in range(len(partials)):
        merge_moments(moments, partials[chunk], 2 * d)
    scalars[:] = 0.0
    for j in range(HEAD):
        scalars[j] = moments[j]
    if scalars[COUNT] == 0:
        scalars[SCALE] = 1.0
        for j in range(d):
            matrices[ROTATION, j, j] = 1.0
        return
    for j in range(d):
        vectors[ORIGIN_A, j], vectors[ORIGIN_B, j] = moments[HEAD + j], moments[HEAD + d + j]
        vectors[OFFSET_A, j], vectors[OFFSET_B, j] = moments[HEAD + 2 * d + j], moments[HEAD + 3 * d + j]
    second = moments[HEAD + 4 * d :].reshape(2 * d, 2 * d)
    for i in range(d):
        scalars[SPREAD_A] += second[i, i]
        scalars[SPREAD_B] += second[d + i, d + i]
        for j in range(d):
            matrices[SCATTER_A, i, j] = second[i, j]
            matrices[SCATTER_B, i, j] = second[d + i, d + j]
            matrices[W, i, j] = second[d + i, j]
    spread_a, spread_b = scalars[SPREAD_A], scalars[SPREAD_B]
    root_a, root_b = np.sqrt(spread_a), np.sqrt(spread_b)  # their product may underflow
    bound = root_a * root_b
    # Unit spread: clouds of 1e-6 m neither underflow nor look like rank zero.
    unit = np.zeros((d, d))
    if bound > 0:
        for i in range(d):
            for j in range(d):
                unit[i, j] = matrices[W, i, j] / bound
    sizes = vectors[SINGULAR_VALUES]
    decompose(unit, matrices[U], sizes, matrices[V])
    sign = handedness(matrices[U], matrices[V])
    for i in range(d):
        scalars[RANK] += 1.0 if sizes[i] > RANK_TOLERANCE else 0.0
        matrices[CURVATURES, i, i] = matrices[FREE, i, i] = 0.0
        for j in range(i):
            last = sign * sizes[i] if i == d - 1 else sizes[i]
            matrices[CURVATURES, i, j] = matrices[CURVATURES, j, i] = sizes[j] + last
    find_free_planes(doubt_noise and bound > 0, scalars, matrices)
    scalars[NUM_LOOSE] = find_rotation(matrices, sign)
    correlation = 0.0  # trace(R^T W) = trace(D S)
    for i in range(d):
        sizes[i] *= bound
        for j in range(d):
            correlation += matrices[ROTATION, i, j] * matrices[W, i, j]
            matrices[CURVATURES, i, j] *= bound
    scale = 1.0
    if kind != NO_SCALE:
        scale = 0.0
        if spread_a > 0:
            scale = root_b / root_a if kind == SYMMETRIC else max(correlation / spread_a, 0.0)
        scalars[SCALE_FOUND] = 1.0 if scale > 0 else 0.0
        scale = scale if scale > 0 else 1.0
    scalars[SCALE] = scale
    scalars[REFLECTS] = 1.0 if sign < 0 else 0.0
    scalars[ERROR] = max(spread_b + scale * (scale * spread_a - 2 * correlation), 0.0)
    for i in range(d):
        vectors[TRANSLATION, i] = vectors[ORIGIN_B, i] + vectors[OFFSET_B, i]
        for j in range(d):
            mean = vectors[ORIGIN_A, j] + vectors[OFFSET_A, j]
            vectors[TRANSLATION, i] -= scale * matrices[ROTATION, i, j] * mean


@kernel
def pair_errors(start, stop, source, target, source_rows, target_rows, weights, scalars, vectors, matrices, errors):
    """Sums of w |b - s R a - t|^2 of the chunks start..stop into errors (chunks,)."""
    d = source.shape[1]
    num_pairs = len(source_rows) if len(source_rows) > 0 else len(source)
    x, w, head = np.empty((2 * d, BLOCK)), np.empty(BLOCK), np.empty(HEAD)
    origin, offset = vectors[ORIGIN_A : ORIGIN_B + 1], vectors[OFFSET_A : OFFSET_B + 1]
    turned, scale = matrices[ROTATION], scalars[SCALE]
    for chunk in range(start, stop):
        error = 0.0
        last = min((chunk + 1) * CHUNK, num_pairs)
        for first in range(chunk * CHUNK, last, BLOCK):
            count = min(BLOCK, last - first)
            load_weights(first, count, source, target, source_rows, weights, w, head)
            load_points(first, count, source, source_rows, w, origin[0], x[:d])
            load_points(first, count, target, target_rows, w, origin[1], x[d:])
            for i in range(d):
                constant = offset[1, i]
                for j in range(d):
                    constant -= scale * turned[i, j] * offset[0, j]
                for k in range(count):
                    x[d + i, k] -= constant
                for j in range(d):
                    factor = scale * turned[i, j]
                    for k in range(count):
                        x[d + i, k] -= factor * x[j, k]
                total = 0.0
                for k in range(count):
                    total += w[k] * x[d + i, k] * x[d + i, k]
                error += total
        errors[chunk] = error


@kernel
def judge_motion(errors, scalars, vectors):
    """Sum E, and see whether a reflection, of error E - 4 s sigma_D where U V^T reflects, would fit far better."""
    error = 0.0
    for chunk in range(len(errors)):
        error += errors[chunk]
    scalars[ERROR] = error
    d = vectors.shape[1]
    reflection = error - 4 * scalars[SCALE] * vectors[SINGULAR_VALUES, d - 1]
    mirrored = scalars[REFLECTS] > 0 and scalars[RANK] == d and error > 0 and reflection < MIRROR_GAIN**2 * error
    scalars[MIRRORED] = 1.0 if mirrored else 0.0


@kernel
def turn_products(scatter, planes, turns):
    """sum w (G_k p) . (G_l p) into turns, from sum w p p^T; G_k turns axis i towards axis j, (i, j) = planes[k]."""
    for k in range(len(planes)):
        i, j = planes[k, 0], planes[k, 1]
        for m in range(len(planes)):
            n, o = planes[m, 0], planes[m, 1]
            # G_k p = p_i e_j - p_j e_i
            total = scatter[i, n] if j == o else 0.0
            total += scatter[j, o] if i == n else 0.0
            total -= scatter[i, o] if j == n else 0.0
            total -= scatter[j, n] if i == o else 0.0
            turns[k, m] = total


@inlined
def write_transform(vectors, matrices, T):
    d = vectors.shape[1]
    for i in range(d):
        for j in range(d):
            T[i, j] = matrices[ROTATION, i, j]
            T[d, j] = 0.0
        T[i, d] = vectors[TRANSLATION, i]
    T[d, d] = 1.0


@kernel
def describe_motion(planes, scalars, vectors, matrices, T, information, covariance):
    """T, the information of the point-to-point metric, and the covariance; about the target's origin.

    planes : (K - D, 2), axes of the rotations phi_k, see `turn_products`.

    The variance of the noise is E / FREEDOM, the number of coordinates minus that of the parameters. About the centroid
    translation, rotation and the logarithm of the scale are independent; moving to the origin mixes them.
    """
    d = vectors.shape[1]
    write_transform(vectors, matrices, T)
    total, scale, turns = scalars[WEIGHT], scalars[SCALE], len(planes)
    centroid = np.empty(d)
    for i in range(d):
        centroid[i] = vectors[ORIGIN_B, i] + vectors[OFFSET_B, i]
    part, scatter, about_origin = np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    multiply_transposed(matrices[ROTATION], matrices[SCATTER_A], part)
    multiply_transposed(part, matrices[ROTATION], scatter)
    for i in range(d):
        for j in range(d):
            scatter[i, j] *= scale * scale
            about_origin[i, j] = scatter[i, j] + total * centroid[i] * centroid[j]
    # shift[:, k] = G_k centroid
    shift = np.zeros((d, turns))
    for k in range(turns):
        i, j = planes[k, 0], planes[k, 1]
        shift[j, k] = centroid[i]
        shift[i, k] = -centroid[j]
    information[:] = 0.0
    rotations = np.zeros((turns, turns))
    turn_products(about_origin, planes, rotations)
    for k in range(turns):
        for m in range(turns):
            information[d + k, d + m] = rotations[k, m]
    for i in range(d):
        information[i, i] = total
        for k in range(turns):
            information[i, d + k] = information[d + k, i] = total * shift[i, k]

    estimated = d + turns - scalars[NUM_FREE] + scalars[SCALE_FOUND]
    scalars[FREEDOM] = d * scalars[COUNT] - estimated
    covariance[:] = 0.0
    if scalars[FREEDOM] <= 0:
        return
    variance = scalars[ERROR] / scalars[FREEDOM]
    turn_covariance(variance, scatter, scale * scale * scalars[SPREAD_A], planes, matrices, rotations)
    for i in range(d):
        covariance[i, i] = variance / total
    for k in range(turns):
        for m in range(turns):
            covariance[d + k, d + m] = rotations[k, m]
    # A rotation phi about the centroid is the twist (rho - G(phi) centroid, phi) at the origin.
    for i in range(d):
        for k in range(turns):
            for m in range(turns):
                covariance[i, d + k] -= shift[i, m] * covariance[d + m, d + k]
            covariance[d + k, i] = covariance[i, d + k]
    for i in range(d):
        for j in range(d):
            for k in range(turns):
                covariance[i, j] -= covariance[i, d + k] * shift[j, k]
    if scalars[SCALE_FOUND] > 0:
        # t = mean_b - s R mean_a: a relative change of the scale moves it along t - centroid.
        relative = variance / (scale * scale * scalars[SPREAD_A])
        scalars[SCALE_VARIANCE] = scale * scale * relative
        for i in range(d):
            for j in range(d):
                lever_i, lever_j = vectors[TRANSLATION, i] - centroid[i], vectors[TRANSLATION, j] - centroid[j]
                covariance[i, j] += relative * lever_i * lever_j


@kernel
def turn_covariance(variance, scatter, spread, planes, matrices, covariance):
    """Covariance (K - D, K - D) of the rotation about the centroid: zero in the FREE planes of columns of U."""
    d = len(scatter)
    turns = len(planes)
    covariance[:] = 0.0
    held = np.empty((turns, 2), np.int64)
    count = 0
    for i in range(d):
        for j in range(i + 1, d):
            if matrices[FREE, i, j] == 0:
                held[count, 0], held[count, 1] = i, j
                count += 1
    if count == 0 or spread <= 0:
        return
    within = np.zeros((d, d))  # scatter in the axes of U, of unit spread
    for i in range(d):
        for j in range(d):
            for k in range(d):
                for m in range(d):
                    within[i, j] += matrices[U, k, i] * scatter[k, m] * matrices[U, m, j] / spread
    products, inverse = np.empty((count, count)), np.empty((count, count))
    turn_products(within, held[:count], products)
    invert(products, inverse)
    axes = np.empty((turns, count))
    for k in range(turns):
        a, b = planes[k, 0], planes[k, 1]
        for m in range(count):
            i, j = held[m, 0], held[m, 1]
            axes[k, m] = matrices[U, a, i] * matrices[U, b, j] - matrices[U, b, i] * matrices[U, a, j]
    for k in range(turns):
        for m in range(turns):
            for i in range(count):
                for j in range(count):
                    covariance[k, m] += axes[k, i] * inverse[i, j] * axes[m, j] * variance / spread


# --------------------------------------------------------------------------------------------- many small problems


@kernel
def align_problems(start, stop, source, target, weights, kind, doubt_noise, partials, scalars, transforms):
    """Solve the problems start..stop of (B, N, D) pairs one after another; partials (chunks, ..) is scratch."""
    d = source.shape[2]
    chunks = len(partials)
    vectors, matrices, errors = np.zeros((NUM_VECTORS, d)), np.zeros((NUM_MATRICES, d, d)), np.empty(chunks)
    for problem in range(start, stop):
        a, b, w = source[problem], target[problem], weights[problem]
        for chunk in range(chunks):
            pair_moments(chunk, chunk + 1, a, b, NO_ROWS, NO_ROWS, w, partials)
        solve_moments(partials, kind, doubt_noise, scalars[problem], vectors, matrices)
        if scalars[problem, COUNT] > 0:
            for chunk in range(chunks):
                pair_errors(chunk, chunk + 1, a, b, NO_ROWS, NO_ROWS, w, scalars[problem], vectors, matrices, errors)
            judge_motion(errors, scalars[problem], vectors)
            write_transform(vectors, matrices, transforms[problem])
