"""Whether keyframes fit each other: in place, better after a loop was closed than before, across two submaps."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from scanweld.arrays import Float32, Float64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid
from scanweld.loop_closure.keyframes import Keyframe
from scanweld.registration.verification import Agreement, check_against_depth
from scanweld.tracking.appearance import compare_appearance

_NEIGHBOURS = 4  # keyframes to either side of the two of a loop that are asked
_PAIRS = 8  # of keyframes that are compared, at most
_COMPARED = 800  # points that must meet the other view for the comparison to count
_IN_PLACE, _IN_PLACE_CONFLICT = 0.6, 0.03  # agreement and conflict of a keyframe that is where it should be
_LEAST_AGREEMENT, _MOST_CONFLICT = 0.5, 0.12  # on average, of keyframes after a loop was closed

# Joining two maps cannot be undone, and there is no drift of a long way between them that would blur what they share:
# on rendered rooms true joins agree in 0.98 and more, with a correlation of 0.88 and more in every pair of keyframes.
# The two ends of a corridor that differ in their pictures alone agree in 0.85, with a correlation of 0.35 in the worst.
_ACROSS = 12  # keyframes of a submap that are compared with those of another, at most
_FEWEST_ACROSS = 2  # of which so many must see common ground
_AGREE_ACROSS, _CONFLICT_ACROSS = 0.7, 0.05  # on average
_WORST_CONFLICT = 0.12  # of any of them: one that stands in free space is enough to speak against a join
_LEAST_CORRELATION, _WORST_CORRELATION = 0.7, 0.5  # of the textures on common ground: in the median, and of any
_SIDEWAYS_M = 1.0  # a view this far aside is as bad as one that is turned by a radian


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


def fits_together(
    kept: Sequence[Keyframe],
    joined: Sequence[Keyframe],
    T_kept_joined: Float64,
    involved: Collection[int],
    surfaces: SurfaceConfig,
) -> str:
    """Say why the keyframes of two submaps do not fit each other when these are joined so; "" when they do.

    Parameters
    ----------
    kept, joined : the keyframes of both, in the worlds of their submaps
    T_kept_joined : (4, 4), from the world of the second to that of the first
    involved : indices of the keyframes that proposed it; they are not asked
    """
    seen: list[tuple[Agreement, float | None]] = []
    for a, b in _views_alike(kept, joined, T_kept_joined, involved):
        target, source = a.pyramid(surfaces), b.pyramid(surfaces)
        T_a_b = se3.inverse(a.T_world_camera) @ T_kept_joined @ b.T_world_camera
        agreement = _agreement(source, target, T_a_b)
        if agreement.compared < _COMPARED:
            continue
        appearance = compare_appearance(source, target, T_a_b)
        seen.append((agreement, appearance.correlation if appearance.telling else None))
    if len(seen) < _FEWEST_ACROSS:
        return f"only {len(seen)} other keyframes see common ground"
    agree, conflict = np.mean([(a.agree, a.conflict) for a, _ in seen], axis=0)
    worst = max(a.conflict for a, _ in seen)
    if agree < _AGREE_ACROSS or conflict > _CONFLICT_ACROSS or worst > _WORST_CONFLICT:
        return (
            f"{agree:.0%} of what other keyframes saw agrees, {conflict:.0%} would stand in free space, "
            f"in the worst of them {worst:.0%}"
        )
    textures = [correlation for _, correlation in seen if correlation is not None]
    if textures and (np.median(textures) < _LEAST_CORRELATION or min(textures) < _WORST_CORRELATION):
        return (
            f"other keyframes do not look alike: the correlation of their texture is {np.median(textures):.2f}, "
            f"in the worst of them {min(textures):.2f}"
        )
    return ""


def _views_alike(
    kept: Sequence[Keyframe], joined: Sequence[Keyframe], T_kept_joined: Float64, involved: Collection[int]
) -> Iterator[tuple[Keyframe, Keyframe]]:
    """Yield keyframes of one submap, evenly over it, each with the one of the other that looked from nearest by."""
    others = [keyframe for keyframe in kept if keyframe.index not in involved]
    askers = [keyframe for keyframe in joined if keyframe.index not in involved]
    if not others or not askers:
        return
    T_camera_world = se3.inverse(np.stack([keyframe.T_world_camera for keyframe in others]))
    pairs = []
    for asker in askers:
        apart = views_apart(T_camera_world @ T_kept_joined @ asker.T_world_camera)
        pairs.append((float(apart.min()), others[int(apart.argmin())], asker))
    # Those far from everything see no common ground; of the others, an even share.
    near = [(a, b) for apart, a, b in pairs if apart < APART]
    for k in np.unique(np.linspace(0, len(near) - 1, min(_ACROSS, len(near))).astype(int)) if near else ():
        yield near[k]


APART = 1.2
"""Views that are further apart, in metres and radians together, hardly see common ground."""


def views_apart(motions: Float64) -> Float64:
    """Return how far apart (N,) two views are that lie a motion (N, 4, 4) from each other, metres and radians added."""
    apart = np.linalg.norm(motions[..., :3, 3], axis=-1) / _SIDEWAYS_M + se3.rotation_angle_rad(motions)
    return np.asarray(apart)


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
