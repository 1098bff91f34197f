"""Turns between two scans, from the few directions that most of their surfaces face.

Floors, walls and the sides of furniture face a handful of directions. Two of them in one scan, brought onto two of the
other that are as far apart, make a turn; all such turns are few enough to try each of them. No feature is asked for,
so it works where little but bare surfaces is shared.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np

from scanweld.arrays import Float64

_MOST = 8  # directions of a scan
_LEAST_SHARE = 0.02  # of the points that must face a direction
_TOGETHER = np.cos(np.deg2rad(12.0))  # normals within it face one direction
_APART = np.cos(np.deg2rad(25.0))  # normals beyond it may face another
_TRIED = 400  # normals that are tried as the middle of a direction
_SHIFTS = 5  # of the mean of a direction
_NARROW, _WIDE = np.deg2rad(25.0), np.deg2rad(155.0)  # angles between two directions that tell a turn
_MATCH = np.deg2rad(7.0)  # difference of such angles between the scans
_SQUARE = np.sin(np.deg2rad(10.0))  # directions this close to a right angle are completed to a box
_FIT = np.cos(np.deg2rad(10.0))  # directions this close after a turn are the same
_SAME = np.cos(np.deg2rad(5.0))  # turns this close are one
_MOST_TURNS = 60


def dominant_directions(normals: Float64) -> tuple[Float64, Float64]:
    """Return the directions (K, 3) that most of the normals (N, 3) face, and the share (K,) of the normals of each."""
    normals = normals[normals.any(axis=1)]  # points on a line or in one place have none
    left = np.ones(len(normals), dtype=bool)
    directions: list[Float64] = []
    shares: list[float] = []
    while len(directions) < _MOST and left.any():
        rows = np.flatnonzero(left)
        tried = normals[rows[:: -(-len(rows) // _TRIED)]]
        seed = direction = tried[(tried @ normals[rows].T > _TOGETHER).sum(axis=1).argmax()]
        for _ in range(_SHIFTS):
            mean = normals[normals @ direction > _TOGETHER].sum(axis=0)
            direction = mean / np.linalg.norm(mean)
        share = float((normals @ direction > _TOGETHER).mean())
        if share < _LEAST_SHARE:
            break
        # The mean may have moved away from where it began, which must not be begun with again.
        left &= (normals @ direction < _APART) & (normals @ seed < _TOGETHER)
        if all(direction @ other < _APART for other in directions):
            directions.append(direction)
            shares.append(share)
    return np.reshape(directions, (-1, 3)), np.array(shares)


def turns(source: Float64, target: Float64, *, oriented: bool) -> Float64:
    """Return rotations (R, 3, 3) that bring directions of the source onto those of the target, the best first.

    Parameters
    ----------
    source, target : (N, 3), (M, 3), normals of two scans
    oriented : whether the signs of the normals mean something; without, both are tried
    """
    (a, share_a), (b, share_b) = (_completed(*dominant_directions(_both_ways(n, oriented))) for n in (source, target))
    pairs_a = [(i, j) for i, j in combinations(range(len(a)), 2) if share_a[i] + share_a[j] > 0]
    pairs_b = list(permutations(range(len(b)), 2))
    angles_a, angles_b = _angles(a, pairs_a), _angles(b, pairs_b)
    tells = (angles_a > _NARROW) & (angles_a < _WIDE)
    rows, columns = np.nonzero(tells[:, None] & (np.abs(angles_a[:, None] - angles_b) < _MATCH))
    if len(rows) == 0:
        return np.empty((0, 3, 3))
    frames_a, frames_b = _frames(a, pairs_a), _frames(b, pairs_b)
    rotations = frames_b[columns] @ np.swapaxes(frames_a[rows], 1, 2)
    for _ in range(2):
        rotations, scores = _settled(rotations, a, share_a, b, share_b)
    kept: list[int] = []
    for n in np.argsort(-np.round(scores, 9), kind="stable"):
        # trace(A^T B) = 1 + 2 cos(angle)
        if (np.einsum("kij,ij->k", rotations[kept], rotations[n]) < 1 + 2 * _SAME).all():
            kept.append(int(n))
        if len(kept) == _MOST_TURNS:
            break
    return rotations[kept]


def _both_ways(normals: Float64, oriented: bool) -> Float64:
    return normals if oriented else np.concatenate([normals, -normals])


def _completed(directions: Float64, shares: Float64) -> tuple[Float64, Float64]:
    """Add the missing sides of the box of the two strongest directions at a right angle, with a share of none.

    One scan sees a wall that the other does not, but rooms have right angles.
    """
    for i, j in combinations(range(len(directions)), 2):
        if abs(directions[i] @ directions[j]) < _SQUARE:
            across = np.cross(directions[i], directions[j])
            box = np.stack([directions[i], across, np.cross(across, directions[i])])
            missing = [side for side in (*box, *-box) if (directions @ side).max() < _APART]
            return np.concatenate([directions, np.reshape(missing, (-1, 3))]), np.append(shares, np.zeros(len(missing)))
    return directions, shares


def _angles(directions: Float64, pairs: list[tuple[int, int]]) -> Float64:
    one, other = directions[np.reshape(np.array(pairs, np.int64), (-1, 2)).T]
    return np.asarray(np.arccos(np.clip((one * other).sum(axis=1), -1, 1)))


def _frames(directions: Float64, pairs: list[tuple[int, int]]) -> Float64:
    """Return right-handed frames (P, 3, 3), axes in columns, that treat both directions of a pair alike."""
    one, other = directions[np.reshape(np.array(pairs, np.int64), (-1, 2)).T]
    across, middle = np.cross(one, other), one + other
    # Opposite directions make no frame; their angle tells no turn, either.
    across, middle = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12) for v in (across, middle))
    return np.stack([middle, np.cross(across, middle), across], axis=2)


def _settled(rotations: Float64, a: Float64, share_a: Float64, b: Float64, share_b: Float64) -> tuple[Float64, Float64]:
    """Fit turns (R, 3, 3) to all directions that they bring together; return them and how much of the scans (R,)."""
    cosines = a @ np.swapaxes(rotations, 1, 2) @ b.T
    partner = cosines.argmax(axis=2)
    fits = np.take_along_axis(cosines, partner[..., None], axis=2)[..., 0] > _FIT
    weights = fits * np.sqrt(share_a * share_b[partner])
    # The missing sides of a box have no share, but count a little: two directions are needed.
    moments = np.einsum("rk,rki,kj->rij", weights + 1e-3 * fits, b[partner], a)
    u, _, vt = np.linalg.svd(moments)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt, weights.sum(axis=1)
