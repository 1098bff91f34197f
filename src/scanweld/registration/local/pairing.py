"""Which target point each moved source point belongs to, and which pairs do not count."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanweld.arrays import Bool, Float64, Int32
from scanweld.geometry.neighbours import NeighbourIndex, build_index
from scanweld.geometry.neighbours.grid import HashGrid
from scanweld.parallel import run_ranges
from scanweld.registration.local import kernels
from scanweld.registration.local.config import IcpConfig
from scanweld.registration.local.problem import Motion, Problem, neighbours_of

_CHUNK = 4096
_GRAIN, _FOLLOWED_GRAIN = 1500, 8000  # points that are worth a thread; most that are followed keep their partner
_SLACK = 0.2  # spacings that steps move points near the end; partners that cannot change so soon are not sought again
_RIM_GAP_RAD = np.pi / 2  # neighbours that leave so wide a gap around a point: it is on the rim


class Pairing:
    """Finds the pairs of a problem at a motion; keeps its buffers, and the last partners as hints for the next.

    Attributes
    ----------
    moved : (N, 3), the source at the last motion
    partner : (N,) int32, row of the target, -1 where there is none
    squared : (N,), squared distance to the partner [m^2]
    """

    def __init__(self, problem: Problem, config: IcpConfig) -> None:
        count = len(problem.source)
        self.moved: Float64 = np.empty((count, 3))
        self.partner: Int32 = np.full(count, -1, np.int32)
        self.squared: Float64 = np.full(count, np.inf)
        self._hint: Int32 = np.full(count, -1, np.int32)
        self._anchors: Float64 = np.zeros((count, 4))
        self._followed = False
        self._problem = problem
        self._rejections = _rejections(problem, config)

    def find(self, motion: Motion) -> int:
        """Pair every source point at `motion`; returns the number of pairs."""
        problem, matrix = self._problem, motion.matrix

        def body(start: int, stop: int) -> None:
            kernels.move_points(start, stop, problem.source, matrix, self.moved)
            places = self.moved if problem.dimension == 3 else problem.in_dimension(self.moved)
            if isinstance(problem.index, HashGrid):
                problem.index.follow_into(
                    places, start, stop, problem.gate, self._hint, self.squared, self._anchors, _SLACK * problem.spacing
                )
            else:
                problem.index.nearest_into(places, start, stop, problem.gate, self._hint, self.squared)

        run_ranges(len(self.moved), body, grain=_FOLLOWED_GRAIN if self._followed else _GRAIN)
        self._followed = isinstance(problem.index, HashGrid)
        if not self._rejections:
            self.partner = self._hint
        else:
            self.partner = self._hint.copy()
            for reject in self._rejections:
                self.partner[reject(self, motion)] = -1
        return int(np.count_nonzero(self.partner >= 0))


Rejection = Callable[[Pairing, Motion], Bool]
"""Returns the mask (N,) of the source points whose pairs do not count."""


def _rejections(problem: Problem, config: IcpConfig) -> list[Rejection]:
    rejections: list[Rejection] = []
    if len(problem.normals) and not problem.normals.any(axis=1).all():
        unknown = np.append(~problem.normals.any(axis=1), False)  # the last entry serves the partner -1
        rejections.append(lambda pairs, _: unknown[pairs.partner])
    if config.min_normal_cosine > 0 and len(problem.source_normals):
        rejections.append(lambda pairs, motion: _disagree(problem, pairs, motion, config.min_normal_cosine))
    if config.reject_boundary:
        rim = np.append(rim_points(problem, neighbours_of(config, len(problem.target), problem.dimension)), False)
        rejections.append(lambda pairs, _: rim[pairs.partner])
    if config.pairing == "mutual":
        back = build_index(problem.in_dimension(problem.source))
        rejections.append(lambda pairs, motion: _not_mutual(problem, back, pairs, motion))
    if config.pairing == "one-to-one":
        rejections.append(lambda pairs, _: _not_first(pairs))
    return rejections


def _disagree(problem: Problem, pairs: Pairing, motion: Motion, min_cosine: float) -> Bool:
    """Normals more than an angle apart; their signs mean nothing where they were estimated."""
    turned = problem.source_normals @ motion.T[:3, :3].T
    cosine = np.abs(np.einsum("nd,nd->n", turned, problem.normals[pairs.partner]))
    return np.asarray(cosine < min_cosine)


def _not_mutual(problem: Problem, back: NeighbourIndex, pairs: Pairing, motion: Motion) -> Bool:
    """The partner's nearest source point is another one, and a nearer one."""
    used, inverse = np.unique(pairs.partner, return_inverse=True)
    R = motion.T[:3, :3]
    places = (problem.target[used] - motion.T[:3, 3]) @ R / motion.scale
    distances, _ = back.nearest(problem.in_dimension(places), np.inf)
    nearest = motion.scale * distances[inverse]
    return np.asarray(nearest < np.sqrt(pairs.squared) * (1 - 1e-9))


def _not_first(pairs: Pairing) -> Bool:
    """A target keeps its nearest source, the first of them where several are as near."""
    order = np.lexsort((pairs.squared, pairs.partner))
    sorted_partner = pairs.partner[order]
    later = np.concatenate([[False], sorted_partner[1:] == sorted_partner[:-1]])
    mask = np.zeros(len(order), np.bool_)
    mask[order] = later
    return mask


def rim_points(problem: Problem, neighbours: int) -> Bool:
    """Mask (M,) of the target's points whose neighbours leave a gap of more than a quarter turn around them.

    In the plane the rim is where all neighbours lie on one side.
    """
    points, normals = problem.target, problem.normals
    rim = np.zeros(len(points), np.bool_)
    if len(normals) == 0:
        return rim

    def look(start: int, stop: int) -> None:
        for first in range(start * _CHUNK, min(stop * _CHUNK, len(points)), _CHUNK):
            rows = slice(first, min(first + _CHUNK, stop * _CHUNK, len(points)))
            _, near = problem.index.k_nearest(problem.in_dimension(points[rows]), min(neighbours, len(points)))
            arms = points[near[:, 1:]] - points[rows, None, :]
            rim[rows] = _one_sided(arms, normals[rows]) if problem.dimension == 2 else _gapped(arms, normals[rows])

    run_ranges(-(-len(points) // _CHUNK), look)
    return rim


def _one_sided(arms: Float64, normals: Float64) -> Bool:
    tangents = np.stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    along = np.einsum("nkd,nd->nk", arms, tangents)
    return np.asarray((along >= 0).all(axis=1) | (along <= 0).all(axis=1))


def _gapped(arms: Float64, normals: Float64) -> Bool:
    helper = np.eye(3)[np.abs(normals).argmin(axis=1)]
    u = np.cross(normals, helper)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
    v = np.cross(normals, u)
    angles = np.sort(np.arctan2(np.einsum("nkd,nd->nk", arms, v), np.einsum("nkd,nd->nk", arms, u)), axis=1)
    gaps = np.diff(np.concatenate([angles, angles[:, :1] + 2 * np.pi], axis=1), axis=1)
    return np.asarray(gaps.max(axis=1) > _RIM_GAP_RAD)
