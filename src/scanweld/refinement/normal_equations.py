"""One Gauss-Newton step on all poses and the camera at once, the surfels eliminated.

A surfel has three unknowns of its own: its offset along its normal and the two brightness differences that it really
has. They appear in no residual but its own, so the Schur complement removes them surfel by surfel (3x3), and what is
left ties the keyframes that see the same surfel. That is the minimum that alternating between surfels and poses creeps
towards, in one step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from scanweld.arrays import Array, Bool, Float32, Float64, Int32, Int64
from scanweld.geometry import se3
from scanweld.parallel import run_ranges
from scanweld.refinement import kernels
from scanweld.refinement.observations import Observations, bounds_of

POSE, CAMERA = slice(0, 6), slice(6, 11)
OFFSET, RESIDUAL, WEIGHT = 11, 12, 13

LEAST_INFORMATION = 1e-6
"""Of a parameter of the camera: a standard deviation of a thousand pixels, or inverse metres, is none."""

BANDS = 8
"""Bands of the image whose scores say how much the residuals overstate what they know."""

DAMPING = 1e-6
"""Share of the diagonal that is added to it: what nothing determines stays where it is."""


@dataclass(frozen=True, slots=True)
class MotionEdges:
    """What tracking measured of the motion from each keyframe to the next: K - 1 edges.

    Attributes
    ----------
    T_i_j : (K - 1, 4, 4), maps the camera frame of keyframe k + 1 to that of keyframe k
    sigma_m, sigma_rad : (K - 1,)
    """

    T_i_j: Float64
    sigma_m: Float64
    sigma_rad: Float64

    @classmethod
    def between(cls, T_camera_world: Float64, drift: float, loosened: float = 1.0) -> MotionEdges:
        """Take the motions of the given poses (K, 4, 4), known up to `drift` of their length, times `loosened`."""
        first, second = T_camera_world[:-1], T_camera_world[1:]
        T = np.stack([a @ se3.inverse(b) for a, b in zip(first, second, strict=True)])
        length = np.linalg.norm(T[:, :3, 3], axis=1)
        turn = np.array([se3.rotation_angle_rad(t) for t in T])
        sigma_m = LEAST_SIGMA_M + drift * length
        sigma_rad = LEAST_SIGMA_RAD + drift * turn + 0.5 * drift * length
        return cls(T, loosened * sigma_m, loosened * sigma_rad)


LEAST_SIGMA_M, LEAST_SIGMA_RAD = 2e-3, 1e-3
"""Of the motion between two keyframes, however short."""


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """The reduced system: poses of keyframes 1..K - 1 (the first one stays), and the camera.

    Attributes
    ----------
    poses : (6 (K - 1), 6 (K - 1)) sparse
    across : (6 (K - 1), 5)
    camera : (5, 5)
    pose_gradient, camera_gradient : (6 (K - 1),), (5,)
    """

    poses: sp.csc_matrix
    across: Float64
    camera: Float64
    pose_gradient: Float64
    camera_gradient: Float64

    def in_terms_of(self, slopes: Float64) -> NormalEquations:
        """Change the unknowns of the camera to others, y: x = slopes @ y, slopes (5, 5)."""
        return replace(
            self,
            across=self.across @ slopes,
            camera=slopes.T @ self.camera @ slopes,
            camera_gradient=slopes.T @ self.camera_gradient,
        )


@dataclass(frozen=True, slots=True)
class Step:
    """A solution.

    Attributes
    ----------
    poses : (K, 6), twists, left perturbation of T_camera_world; the first is zero
    camera : (5,), zero where held
    information : (5, 5), of the parameters of the camera, poses and surfels free
    """

    poses: Float64
    camera: Float64
    information: Float64


def assemble(
    observations: Observations, T_camera_world: Float64, num_surfels: int, edges: MotionEdges
) -> NormalEquations:
    """Sum the normal equations of the weighted rows, eliminate the surfels, and add the motion edges."""
    rows = observations.rows
    count, surfel = len(T_camera_world), observations.surfel
    bounds = bounds_of(observations.keyframe, count)
    mixed, tied, left = _eliminated(rows, surfel, num_surfels)
    blocks = np.zeros((count, 6, 6))
    across, gradient = np.zeros((count, 6, 5)), np.zeros((count, 6))
    camera, camera_gradient = np.zeros((5, 5)), np.zeros(5)
    for k in range(count):
        part = slice(bounds[k], bounds[k + 1])
        some = rows[part].reshape(-1, rows.shape[2]).astype(np.float64)
        weighted = some[:, :11] * some[:, WEIGHT, None]
        full = weighted.T @ some[:, :11]
        score = weighted.T @ some[:, RESIDUAL]
        C, owner = mixed[part].astype(np.float64), surfel[part]
        flat = C[:, POSE].transpose(1, 0, 2).reshape(6, -1)
        blocks[k] = full[POSE, POSE] - flat @ flat.T
        across[k] = full[POSE, CAMERA] - flat @ tied[owner].transpose(0, 2, 1).reshape(-1, 5)
        gradient[k] = score[POSE] - flat @ left[owner].reshape(-1)
        camera += full[CAMERA, CAMERA]
        camera_gradient += score[CAMERA]
    flat = tied.transpose(1, 0, 2).reshape(5, -1)
    camera -= flat @ flat.T
    camera_gradient -= flat @ left.reshape(-1)
    first, second, ties = _ties(observations, num_surfels, bounds, mixed)
    _add_edges(edges, T_camera_world, blocks, gradient, edge_blocks := np.zeros((max(count - 1, 0), 6, 6)))
    before = np.arange(count - 1)
    matrix = _sparse(
        count,
        np.concatenate([first, before]),
        np.concatenate([second, before + 1]),
        np.concatenate([ties, edge_blocks]),
        blocks,
    )
    return NormalEquations(matrix, across[1:].reshape(-1, 5), camera, gradient[1:].ravel(), camera_gradient)


def solve(equations: NormalEquations, active: Bool, most: Float64 | None = None) -> Step:
    """Return the Gauss-Newton step of the poses and of the `active` (5,) parameters of the camera.

    `most` : (5,) the largest step of each parameter; a longer one is shortened as a whole, and the poses follow that.
    """
    diagonal = equations.poses.diagonal()
    damped = equations.poses + sp.diags(DAMPING * diagonal + 1e-9)
    factors = splu(damped.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = factors.solve(np.column_stack([-equations.pose_gradient, equations.across]))
    poses, follow = solved[:, 0], solved[:, 1:]
    information = equations.camera - equations.across.T @ follow
    camera = np.zeros(5)
    if active.any():
        gradient = equations.camera_gradient + equations.across.T @ poses
        camera[active] = -covariance_of(information[np.ix_(active, active)]) @ gradient[active]
        if most is not None:
            camera /= max(1.0, float(np.abs(camera / most).max()))
        poses = poses - follow @ camera
    return Step(np.concatenate([np.zeros((1, 6)), poses.reshape(-1, 6)]), camera, information)


def covariance_of(information: Float64) -> Float64:
    """Return the inverse (A, A); what is hardly known gets a large variance, not an infinite one."""
    # In units in which the diagonal is one: pixels and inverse metres do not compare.
    unit = 1 / np.sqrt(np.maximum(np.diag(information), LEAST_INFORMATION))
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    return np.asarray(vectors / np.maximum(values, 1e-14) @ vectors.T * np.outer(unit, unit))


def dispersion(observations: Observations, height: int, width: int, channels: slice) -> float:
    """Say by how much the variance of the scores of some residuals differs from their information.

    Neighbouring pixels share errors, so 10 000 residuals know less than 10 000 independent ones would. The scores of
    bands of the image scatter accordingly: their covariance over the information, mean over keyframes and motions.
    """
    rows = observations.rows[:, channels]
    band = observations.pixel // width * BANDS // height
    count = int(observations.keyframe.max(initial=0)) + 1
    weighted = rows[:, :, POSE] * rows[:, :, WEIGHT, None]
    scores = (weighted * rows[:, :, RESIDUAL, None]).sum(axis=1)
    place = observations.keyframe * BANDS + band
    sums = np.stack([np.bincount(place, scores[:, a], count * BANDS) for a in range(6)], axis=1)
    sums = sums.reshape(count, BANDS, 6)
    bounds = bounds_of(observations.keyframe, count)
    ratios = []
    for k in range(count):
        part = slice(bounds[k], bounds[k + 1])
        if bounds[k + 1] - bounds[k] < MIN_SEEN:
            continue
        columns = rows[part][:, :, POSE].reshape(-1, 6).astype(np.float64)
        information = weighted[part].reshape(-1, 6).astype(np.float64).T @ columns
        centred = sums[k] - sums[k].mean(axis=0)
        inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
        ratios.append(np.einsum("bi,ij,bj->", centred, inverse, centred) / 6 * BANDS / (BANDS - 1))
    return float(max(LEAST_DISPERSION, np.mean(ratios))) if ratios else 1.0


LEAST_DISPERSION = 0.02
"""Depth without noise is that much better than a sensor, but not perfect: it is sampled at pixels."""

MIN_SEEN = 200
"""Surfels that a keyframe must see to be asked."""


def _eliminated(rows: Float32, surfel: Int32, num_surfels: int) -> tuple[Float32, Float64, Float64]:
    """Return what the elimination of the surfels takes.

    C (M, 11, 3) float32: the columns of each observation mixed with its surfel's unknowns, over the square root of the
    surfel's information; the sums of the camera's part of it over each surfel (S, 5, 3); and the surfels' own scores
    over that root (S, 3). A product of two of them is what the Schur complement takes away.
    """
    slope, residual = rows[:, :, OFFSET].astype(np.float64), rows[:, :, RESIDUAL].astype(np.float64)
    weight = rows[:, :, WEIGHT].astype(np.float64)

    def total(values: Array) -> Float64:
        return np.asarray(np.bincount(surfel, values, num_surfels), np.float64)

    information = np.zeros((num_surfels, 3, 3))
    score = np.zeros((num_surfels, 3))
    information[:, 0, 0] = total((weight * slope**2).sum(axis=1))
    score[:, 0] = total((weight * slope * residual).sum(axis=1))
    for c in (1, 2):
        information[:, 0, c] = information[:, c, 0] = -total(weight[:, c] * slope[:, c])
        information[:, c, c] = total(weight[:, c])
        score[:, c] = -total(weight[:, c] * residual[:, c])
    information[:, range(3), range(3)] += 1e-6 * information[:, range(3), range(3)] + 1e-9
    root = np.linalg.inv(np.linalg.cholesky(information))  # (S, 3, 3)
    weighted = rows[:, :, :11] * rows[:, :, WEIGHT, None]  # (M, 3, 11)
    mixed = np.empty((len(rows), 11, 3), np.float32)
    mixed[:, :, 0] = (weighted * rows[:, :, OFFSET, None]).sum(axis=1)
    mixed[:, :, 1], mixed[:, :, 2] = -weighted[:, 1], -weighted[:, 2]
    mixed = mixed @ root[surfel].transpose(0, 2, 1).astype(np.float32)
    tied = np.stack([total(mixed[:, 6 + a, c]) for a in range(5) for c in range(3)], axis=1).reshape(-1, 5, 3)
    return mixed, tied, np.einsum("sij,sj->si", root, score)


def _ties(observations: Observations, num_surfels: int, bounds: Int64, mixed: Float32) -> tuple[Int64, Int64, Float64]:
    """Return the pairs i < j of keyframes that see the same surfels, and their blocks (P, 6, 6)."""
    count = len(bounds) - 1
    surfel, keyframe = observations.surfel, observations.keyframe
    order = np.argsort(surfel, kind="stable").astype(np.int64)
    run_bounds = np.searchsorted(surfel[order], np.arange(num_surfels + 1)).astype(np.int64)
    sees = sp.csr_matrix((np.ones(len(surfel), np.int32), (keyframe, surfel)), shape=(count, num_surfels))
    together = sp.triu(sees @ sees.T, k=1).tocoo()
    pair_of = np.zeros((count, count), np.int32)
    pair_of[together.row, together.col] = np.arange(together.nnz)
    blocks = np.zeros((together.nnz, 6, 6))
    poses = np.ascontiguousarray(mixed[:, POSE])

    def body(start: int, stop: int) -> None:
        kernels.pair_blocks(start, stop, bounds, surfel, keyframe, poses, run_bounds, order, pair_of, blocks)

    run_ranges(count, body)
    return together.row.astype(np.int64), together.col.astype(np.int64), blocks


def _add_edges(
    edges: MotionEdges, T_camera_world: Float64, blocks: Float64, gradient: Float64, across: Float64
) -> None:
    """Add the motion edges to the diagonal blocks and the gradient, and write their blocks across.

    e = log(T_i_j T_measured^-1), with T_i_j = T_i T_j^-1 -> exp(xi_i) T_i_j exp(-xi_j): e + xi_i - Ad(T_i_j) xi_j.
    """
    for k in range(len(T_camera_world) - 1):
        T = T_camera_world[k] @ se3.inverse(T_camera_world[k + 1])
        error = se3.log(T @ se3.inverse(edges.T_i_j[k]))
        W = np.diag(np.repeat([edges.sigma_m[k], edges.sigma_rad[k]], 3) ** -2.0)
        second = -se3.adjoint(T)
        blocks[k] += W
        blocks[k + 1] += second.T @ W @ second
        across[k] = W @ second
        gradient[k] += W @ error
        gradient[k + 1] += second.T @ W @ error


def _sparse(count: int, first: Int64, second: Int64, across: Float64, diagonal: Float64) -> sp.csc_matrix:
    """Put blocks (i, j), their transposes and the diagonal together, without the first keyframe."""
    nodes = np.arange(1, count)
    free = (first > 0) & (second > 0)
    first, second, across = first[free], second[free], across[free]
    rows = np.concatenate([first, second, nodes]) - 1
    columns = np.concatenate([second, first, nodes]) - 1
    values = np.concatenate([across, across.transpose(0, 2, 1), diagonal[1:]])
    inner = np.arange(6)
    i = np.broadcast_to((rows[:, None] * 6 + inner)[:, :, None], values.shape)
    j = np.broadcast_to((columns[:, None] * 6 + inner)[:, None, :], values.shape)
    size = 6 * (count - 1)
    return sp.coo_matrix((values.ravel(), (i.ravel(), j.ravel())), shape=(size, size)).tocsc()
