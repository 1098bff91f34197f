"""Residuals of a pair, and their derivatives with respect to the motion; the NumPy reference of every kernel.

The motion is the left perturbation T <- exp(xi) T, xi = (rho, phi), so that dp'/d(xi) = [I | -[p']_x] for a
moved source point p'. In 2-D phi is one angle and -[p']_x becomes (-y, x).
"""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np

from scanweld.arrays import Float64
from scanweld.registration.gauss_newton import NormalEquations


@cache
def rotation_generators(dimension: int) -> Float64:
    """Return G (K, D, D) with d(exp(phi) p)/d(phi_k) = G_k p at phi = 0.

    In 3-D G_k = [e_k]_x; in 2-D one quarter turn; beyond, one for each pair of axes i < j, turning i to j.
    """
    planes = [(1, 2), (2, 0), (0, 1)] if dimension == 3 else list(itertools.combinations(range(dimension), 2))
    generators = np.zeros((len(planes), dimension, dimension))
    for generator, (i, j) in zip(generators, planes, strict=True):
        generator[j, i], generator[i, j] = 1, -1
    generators.flags.writeable = False
    return generators


def point_jacobian(moved: Float64) -> Float64:
    """Return dp'/d(xi) (N, D, K) = [I | -[p']_x] of moved points (N, D)."""
    count, dimension = moved.shape
    turns = np.einsum("kab,nb->nak", rotation_generators(dimension), moved)
    identity = np.broadcast_to(np.eye(dimension), (count, dimension, dimension))
    return np.concatenate([identity, turns], axis=2)


def point_to_point(moved: Float64, target: Float64) -> tuple[Float64, Float64]:
    """Return the residuals p' - q (N, D) and their Jacobians (N, D, K)."""
    return moved - target, point_jacobian(moved)


def point_to_plane(moved: Float64, target: Float64, normals: Float64) -> tuple[Float64, Float64]:
    """Return the residuals n . (p' - q) (N,) and their Jacobians n^T [I | -[p']_x] (N, K).

    Parameters
    ----------
    moved, target : (N, D), source points in the target frame and their partners [m]
    normals : (N, D), unit normals of the partners
    """
    residuals = np.einsum("nd,nd->n", normals, moved - target)
    turns = np.einsum("na,kab,nb->nk", normals, rotation_generators(moved.shape[1]), moved)
    return residuals, np.concatenate([normals, turns], axis=1)


def normal_equations(moved: Float64, residuals: Float64, jacobian: Float64, weights: Float64) -> NormalEquations:
    """Sum rows (N,), (N, K) with weights (N,) into H = sum w J^T J and g = sum w J^T r."""
    weighted = weights[:, None] * jacobian
    total = float(weights.sum())
    share = weights / total if total > 0 else weights
    centroid = share @ moved
    return NormalEquations(
        information=weighted.T @ jacobian,
        gradient=weighted.T @ residuals,
        total_weight=total,
        centroid_m=centroid,
        radius_m=float(np.sqrt(share @ ((moved - centroid) ** 2).sum(axis=1))),
    )


def point_equations(moved: Float64, target: Float64, weights: Float64) -> NormalEquations:
    """Sum the point-to-point rows p' - q of all coordinates with weights (N,); `total_weight` is that of the
    points.

    The moments of the points are enough, the (N, D, K) Jacobian is never formed.
    """
    dimension = moved.shape[1]
    generators = rotation_generators(dimension)
    total = float(weights.sum())
    share = weights / total if total > 0 else weights
    centroid = share @ moved
    second = (weights[:, None] * moved).T @ moved
    shifts = generators @ (total * centroid)
    turns = np.einsum("kab,bc,lac->kl", generators, second, generators)
    difference = weights[:, None] * (moved - target)
    return NormalEquations(
        information=np.block([[total * np.eye(dimension), shifts.T], [shifts, turns]]),
        gradient=np.concatenate([difference.sum(axis=0), np.einsum("kab,ab->k", generators, difference.T @ moved)]),
        total_weight=total,
        centroid_m=centroid,
        radius_m=float(np.sqrt(share @ ((moved - centroid) ** 2).sum(axis=1))),
    )


def symmetric(moved: Float64, target: Float64, normals: Float64, source_normals: Float64) -> tuple[Float64, Float64]:
    """Return the residuals (n + m) / 2 . (p' - q) (N,) and their Jacobians (N, K), both sides turned by half.

    Rusinkiewicz 2019, eq. 9: the rotation's arm is the middle of the pair. Normals have no sign: m is turned to n.

    Parameters
    ----------
    source_normals : (N, D), moved with the points
    """
    sign = np.where(np.einsum("nd,nd->n", normals, source_normals) >= 0, 1.0, -1.0)
    middle = (normals + sign[:, None] * source_normals) / 2
    residuals = np.einsum("nd,nd->n", middle, moved - target)
    arms = (moved + target) / 2
    turns = np.einsum("na,kab,nb->nk", middle, rotation_generators(moved.shape[1]), arms)
    return residuals, np.concatenate([middle, turns], axis=1)


def generalised_information(normals: Float64, source_normals: Float64, thickness: float) -> Float64:
    """Return 2 thickness (C_q + C_p)^-1 (N, D, D) with discs C = I - (1 - thickness) n n^T (Segal et al. 2009, eq. 2).

    The factor makes a residual along two equal normals count 1, as in point-to-plane.
    """
    flat = 1 - thickness
    identity = np.eye(normals.shape[1])
    discs = [identity - flat * n[:, :, None] * n[:, None, :] for n in (normals, source_normals)]
    return np.asarray(2 * thickness * np.linalg.inv(discs[0] + discs[1]))


def coloured(
    moved: Float64, target: Float64, normals: Float64, gradients: Float64, difference: Float64
) -> tuple[Float64, Float64]:
    """Return the residuals of intensity (N,) and their Jacobians (N, K) (Park et al. 2017, eq. 12 to 15).

    Parameters
    ----------
    gradients : (N, 3), of the target's intensity in its tangent planes [1/m]
    difference : (N,), the target's minus the source's intensity, at the points
    """
    along = np.einsum("nd,nd->n", gradients, normals)
    tangent = gradients - along[:, None] * normals
    residuals = difference + np.einsum("nd,nd->n", gradients, moved - target)
    turns = np.einsum("na,kab,nb->nk", tangent, rotation_generators(3), moved)
    return residuals, np.concatenate([tangent, turns], axis=1)
