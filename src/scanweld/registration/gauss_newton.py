"""One Gauss-Newton step on a motion, shared by every aligner: which directions the data constrains, and the
step.

The normal equations are H xi = -g with H = sum w J^T J and g = sum w J^T r, xi = (rho, phi), left
perturbation T <- exp(xi) T. In 3-D xi has six entries, in 2-D three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Bool, Float64
from scanweld.registration.result import FreeDirection

MIN_MEAN_CONSTRAINT = 1e-3
"""A direction is free when the mean squared slope of the residuals along it is below this (dimensionless).

Along a direction that every point constrains fully the value is 1, along a plane's own directions it is the
variance of the normals; 1e-3 stands for normals that scatter by 1.8 degrees.
"""


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Sums over the accepted correspondences.

    Attributes
    ----------
    information : (K, K), H; K = 6 in 3-D, 3 in 2-D
    gradient : (K,), g
    total_weight : sum of the weights
    centroid_m : (D,), weighted mean of the moved source points: the natural pivot of a rotation
    radius_m : root mean square distance of the points from it
    """

    information: Float64
    gradient: Float64
    total_weight: float
    centroid_m: Float64
    radius_m: float


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Eigenvectors of the normal equations in units where translation and rotation can be compared.

    Attributes
    ----------
    values : (K,) ascending; mean squared slope along each direction, 0..1 for point-to-plane
    basis : (K, K), columns are twists at the origin, xi = basis @ y
    observable : (K,) bool
    """

    values: Float64
    basis: Float64
    observable: Bool


def spectrum(
    equations: NormalEquations, min_mean_constraint: float = MIN_MEAN_CONSTRAINT, held: Float64 | None = None
) -> Spectrum:
    """Split the motion into directions that the data constrains and directions that it leaves free.

    The information is moved to the points' centroid and rotations are measured by the displacement of a point
    at the root mean square radius, so that all eigenvalues have one unit and do not depend on the origin or
    scale.

    Directions that are known to be free for another reason can be `held`: (K, M), orthonormal columns, twists about the
    centroid with rotations times the radius.
    """
    dimension = len(equations.centroid_m)
    size = len(equations.gradient)
    to_origin = np.eye(size)
    c = equations.centroid_m
    # A rotation phi about c is the twist (rho - phi x c, phi) at the origin.
    if dimension == 3:
        to_origin[:3, 3:] = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    else:
        to_origin[:2, 2] = (c[1], -c[0])
    radius = equations.radius_m if equations.radius_m > 0 else 1.0
    to_origin[:, dimension:] /= radius
    scaled = to_origin.T @ equations.information @ to_origin / max(equations.total_weight, 1e-300)
    if held is None:
        values, vectors = np.linalg.eigh(scaled)
        return Spectrum(values, to_origin @ vectors, values > min_mean_constraint)
    count = held.shape[1]
    others = np.linalg.svd(held)[0][:, count:]
    values, vectors = np.linalg.eigh(others.T @ scaled @ others)
    observable = np.concatenate([np.zeros(count, np.bool_), values > min_mean_constraint])
    vectors = np.concatenate([held, others @ vectors], axis=1)
    return Spectrum(np.concatenate([np.zeros(count), values]), to_origin @ vectors, observable)


def solve(equations: NormalEquations, parts: Spectrum) -> Float64:
    """Return the step xi (K,): the Gauss-Newton step in the observable directions, zero in the free ones."""
    y = np.zeros(len(parts.values))
    slopes = parts.basis.T @ equations.gradient / max(equations.total_weight, 1e-300)
    y[parts.observable] = -slopes[parts.observable] / parts.values[parts.observable]
    step: Float64 = parts.basis @ y
    return step


def standard_deviation(equations: NormalEquations, parts: Spectrum) -> float:
    """Return how far the observable part of the estimate is off, as a root mean square displacement [m].

    Weights must be inverse variances, so that the inverse of the information is the covariance.
    """
    if not parts.observable.any() or equations.total_weight <= 0:
        return 0.0
    return float(np.sqrt((1 / parts.values[parts.observable]).sum() / equations.total_weight))


def free_directions(equations: NormalEquations, parts: Spectrum) -> tuple[FreeDirection, ...]:
    """Name the unobservable directions, translations first where the two can be told apart."""
    free = ~parts.observable
    if not free.any():
        return ()
    dimension = len(equations.centroid_m)
    # Back to the centroid, rotations times the radius: an orthonormal set that spans the free motions.
    radius = equations.radius_m if equations.radius_m > 0 else 1.0
    at_centroid = parts.basis[:, free].copy()
    c = equations.centroid_m
    for column in at_centroid.T:
        phi = column[dimension:]
        column[:dimension] += np.cross(phi, c) if dimension == 3 else phi[0] * np.array([-c[1], c[0]])
    at_centroid[dimension:] *= radius
    # A basis of the span in which pure translations stand apart: null space of the rotation part first.
    _, sizes, rows = np.linalg.svd(at_centroid[dimension:])
    rank = int((sizes > 1e-2).sum())
    named = [at_centroid @ row for row in (*rows[rank:], *rows[:rank])]
    directions = []
    for vector in named:
        rho, phi = vector[:dimension], vector[dimension:]
        shift, turn = np.linalg.norm(rho), np.linalg.norm(phi)
        translation = f"translation along {_axis(rho)}"
        rotation = f"rotation about {_axis(phi)}" if dimension == 3 else "rotation"
        if turn < 0.1 * shift:
            words = translation
        elif shift < 0.1 * turn:
            words = rotation
        else:
            words = f"{rotation} with {translation}"
        twist = np.concatenate([rho, phi / radius])
        directions.append(FreeDirection(words, twist / np.linalg.norm(twist)))
    return tuple(directions)


def moved_origin(information: Float64, offset_m: Float64) -> Float64:
    """Return the information (K, K) about the origin of a frame in which this one's origin lies at `offset_m`
    (D,).

    A twist (rho, phi) about the new origin is (rho + phi x offset, phi) about the old one.
    """
    dimension = len(offset_m)
    shift = np.eye(len(information))
    c = offset_m
    if dimension == 3:
        shift[:3, 3:] = np.array([[0, c[2], -c[1]], [-c[2], 0, c[0]], [c[1], -c[0], 0]])
    else:
        shift[:2, 2] = (-c[1], c[0])
    return np.asarray(shift.T @ information @ shift)


def _axis(vector: Float64) -> str:
    unit = vector / max(float(np.linalg.norm(vector)), 1e-300)
    if unit[np.argmax(np.abs(unit))] < 0:
        unit = -unit
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in np.round(unit, 2)) + ")"
