"""Whether keyframes fit each other: where they are thought to be, and better after a loop was closed than before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid
from scanweld.loop_closure.keyframes import Keyframe
from scanweld.registration.verification import Agreement, check_against_depth

_NEIGHBOURS = 4  # keyframes to either side of the two of a loop that are asked
_PAIRS = 8  # of keyframes that are compared, at most
_COMPARED = 800  # points that must meet the other view for the comparison to count
_IN_PLACE, _IN_PLACE_CONFLICT = 0.6, 0.03  # agreement and conflict of a keyframe that is where it should be
_LEAST_AGREEMENT, _MOST_CONFLICT = 0.5, 0.12  # on average, of keyframes after a loop was closed


def fits_in_place(
    pyramid: SurfacePyramid, keyframe: Keyframe, T_keyframe_frame: Float64, surfaces: SurfaceConfig
) -> bool:
    """Whether a frame agrees with the depth of a keyframe at a motion, or hardly sees it."""
    agreement = _agreement(pyramid, keyframe.pyramid(surfaces), T_keyframe_frame)
    if agreement.compared < _COMPARED:
        return False
    return agreement.agree >= _IN_PLACE and agreement.conflict <= _IN_PLACE_CONFLICT


def fits_better(
    keyframes: Sequence[Keyframe], old: Float64, new: Float64, i: int, j: int, surfaces: SurfaceConfig
) -> bool:
    """Whether keyframes around i and j, but not these two, agree with each other's depth better at the new poses.

    Parameters
    ----------
    old, new : (K, 4, 4), poses of all keyframes
    i, j : the keyframes that a loop connects
    """
    gains, after = [], []
    for a, b in _pairs(len(keyframes), i, j):
        target, source = keyframes[a].pyramid(surfaces), keyframes[b].pyramid(surfaces)
        then = _agreement(source, target, se3.inverse(new[a]) @ new[b])
        if then.compared < _COMPARED:
            continue
        before = _agreement(source, target, se3.inverse(old[a]) @ old[b])
        after.append((then.agree, then.conflict))
        # What did not meet before had nothing to say.
        unmet = before.compared < _COMPARED
        gains.append(then.agree - then.conflict - (0.0 if unmet else before.agree - before.conflict))
        if len(gains) == _PAIRS:
            break
    if not gains:
        return False
    agree, conflict = np.mean(after, axis=0)
    return bool(np.mean(gains) > 0 and agree >= _LEAST_AGREEMENT and conflict <= _MOST_CONFLICT)


def _pairs(count: int, i: int, j: int) -> Iterator[tuple[int, int]]:
    """Yield pairs of keyframes, one near i and one near j, nearest first; neither is i or j."""
    steps = [step for size in range(1, _NEIGHBOURS + 1) for step in (-size, size)]
    reach = sorted((abs(a) + abs(b), a, b) for a in steps for b in steps)
    for _, a, b in reach:
        if 0 <= i + a < count and 0 <= j + b < count and i + a != j and j + b != i and i + a != j + b:
            yield i + a, j + b


def _agreement(source: SurfacePyramid, target: SurfacePyramid, T_target_source: Float64) -> Agreement:
    """Compare the surfaces of one view with the depth of another."""
    positions, normals = _points(source)
    return check_against_depth(positions, normals, T_target_source, target.levels[0])


def _points(pyramid: SurfacePyramid) -> tuple[Float32, Float32]:
    """Return the points and normals (3, N) of a view, its own frame."""
    surface = pyramid.levels[0].surface.reshape(-1, pyramid.levels[0].surface.shape[-1])
    rows = surface[surface[:, 6] > 0]
    return np.ascontiguousarray(rows[:, :3].T), np.ascontiguousarray(rows[:, 3:6].T)
