"""What the motion between two frames tells of the intrinsics and of the ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64
from scanweld.checkup.evidence import Pair
from scanweld.checkup.findings import Figures, Finding, Judgement, Level
from scanweld.datasets.images import check_depth_unit, likely_depth_scale
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.timestamps import MAX_TIME_DIFFERENCE_S
from scanweld.registration.robust_pairs import align_pairs_robustly
from scanweld.trajectory import Trajectory

FOCAL_FACTORS = (0.6, 0.68, 0.77, 0.88, 1.0, 1.14, 1.3, 1.48, 1.68)
WRONG_FOCAL = 1.15
"""Factor between the stated focal length and the best one from which on it is told."""

LEAST_PAIRS = 3
"""Fewer pairs of views tell nothing."""

_LEAST_TURN_RAD = np.deg2rad(3.0)  # without a turn, any focal length fits
_LEAST_LOSS = 100.0  # that a better focal length saves, in squares of standard deviations
_SIGMAS = 3.0

_AS_IT_IS, _INVERTED = "as it is", "inverted"
_BACKWARDS, _MIRROR = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
READINGS: dict[str, Callable[[Float64], Float64]] = {
    _AS_IT_IS: lambda T: T,
    _INVERTED: se3.inverse,
    "with z backwards and y up, as in OpenGL,": lambda T: T @ _BACKWARDS,
    "mirrored, with y up, as in ICL-NUIM,": lambda T: _MIRROR @ T @ _MIRROR,
}
"""What a true pose (4, 4) may have been meant to be: T_world_camera by how it is read."""

AGREES = 0.35
"""Disagreement of two motions, relative to their size, below which they are the same."""

_AHEAD = np.array([(x, y, 1.0) for x in (-0.5, 0, 0.5) for y in (-0.4, 0, 0.4)]).T
"""Points (3, 9) before the camera, over the image, at a depth of 1."""

WRONG_SCALE = 1.6
"""Factor between measured and true lengths that no error of the features explains."""

_LEAST_MOTION_M, _LEAST_MOTION_RAD = 0.02, np.deg2rad(1.5)


@dataclass(frozen=True, slots=True)
class Motion:
    """How the camera moved between two times, as the images say: T_target_source (4, 4)."""

    source_s: float
    target_s: float
    T_target_source: Float64


def measured_motions(pairs: list[Pair]) -> list[Motion]:
    """Return the motions that the features agree on."""
    motions = []
    for pair in pairs:
        result = align_pairs_robustly(pair.source_m, pair.target_m, _SIGMAS * pair.sigma_m).result
        if result.status.success:
            motions.append(Motion(pair.source_s, pair.target_s, result.T_target_source))
    return motions


def check_focal_length(camera: PinholeCamera, stated: PinholeCamera, pairs: list[Pair]) -> Judgement:
    """Ask which focal length lets the features of turned views agree best.

    Points that are seen from two directions form one rigid thing only with the right focal length.
    """
    losses, num_pairs = np.zeros(len(FOCAL_FACTORS)), 0
    for pair in pairs:
        tried = [_loss(pair, factor) for factor in FOCAL_FACTORS]
        turn = max(turn for _, turn in tried)
        if turn >= _LEAST_TURN_RAD:
            losses += [loss for loss, _ in tried]
            num_pairs += 1
    if num_pairs < LEAST_PAIRS:
        return [], {"focal_factor": None}
    factor = _lowest(losses)
    figures: Figures = {"focal_factor": factor}
    saved = losses[FOCAL_FACTORS.index(1.0)] - losses.min()
    if max(factor, 1 / factor) < WRONG_FOCAL or saved < _LEAST_LOSS:
        return [], figures
    # Where the best one tried is the last, a still better one may lie beyond it.
    beyond = {0: " or less", len(losses) - 1: " or more"}.get(int(losses.argmin()), "")
    seen = (
        f"the same places seen from two directions fit together best with focal lengths {factor:.2f} times those "
        f"given{beyond}, fx {stated.fx:.1f} and fy {stated.fy:.1f}"
    )
    about = f"{factor * stated.fx:.0f},{factor * stated.fy:.0f},{stated.cx:.1f},{stated.cy:.1f}"
    advice = (
        f"pass the intrinsics of these images with --camera FX,FY,CX,CY (about {about}"
        f"{', FX and FY that' + beyond if beyond else ''}), or try --calibrate"
    )
    return [Finding("intrinsics", Level.ERROR, seen, advice)], figures


def _loss(pair: Pair, factor: float) -> tuple[float, float]:
    """Return the truncated squares of a pair's distances at its best motion, and how far that turns [rad]."""
    lens = np.array([1 / factor, 1 / factor, 1.0])
    source, target = pair.source_m * lens, pair.target_m * lens
    result = align_pairs_robustly(source, target, _SIGMAS * pair.sigma_m).result
    if not result.status.success:
        return _SIGMAS**2 * len(source), 0.0
    # Sideways as the stated lens has it: a longer one makes errors smaller, too, and would pass for better.
    gaps = np.linalg.norm((se3.transform_points(result.T_target_source, source) - target) / lens, axis=1) / pair.sigma_m
    return float(np.minimum(gaps**2, _SIGMAS**2).sum()), float(se3.rotation_angle_rad(result.T_target_source))


def _lowest(losses: Float64) -> float:
    """Return the factor of the lowest loss, by a parabola through the lowest three in the logarithm of the factor."""
    at = int(np.clip(np.argmin(losses), 1, len(losses) - 2))
    x = np.log(FOCAL_FACTORS[at - 1 : at + 2])
    a, b, _ = np.polyfit(x, losses[at - 1 : at + 2], 2)
    return float(np.exp(np.clip(-b / (2 * a), x[0], x[2]))) if a > 0 else FOCAL_FACTORS[int(np.argmin(losses))]


def check_truth(
    truth: Trajectory, times_s: Float64, motions: list[Motion], median_depth_m: float, depth_scale: float
) -> Judgement:
    """Compare the true motions between frames with those that the images show."""
    nothing: Figures = {"truth_disagreement": None, "truth_scale": None}
    if truth.timestamps_s[-1] < times_s[0] or truth.timestamps_s[0] > times_s[-1]:
        seen = (
            f"its times are {truth.timestamps_s[0]:.3f} to {truth.timestamps_s[-1]:.3f} s, those of the frames "
            f"{times_s[0]:.3f} to {times_s[-1]:.3f} s"
        )
        return [Finding("truth", Level.WARNING, seen, "write both in seconds of one clock")], nothing
    known = [(motion, _poses(truth, motion)) for motion in motions]
    moved = [(motion, *poses) for motion, poses in known if poses is not None and _moves(motion)]
    if len(moved) < LEAST_PAIRS:
        return [], nothing
    found = {name: _disagreement(moved, read, median_depth_m) for name, read in READINGS.items()}
    wrong, scale = found[_AS_IT_IS]
    figures: Figures = {"truth_disagreement": wrong, "truth_scale": scale}
    if wrong > AGREES:
        best = min(found, key=lambda name: found[name][0])
        return [_misread(best if found[best][0] < min(AGREES, wrong / 2) else "", wrong)], figures
    if max(scale, 1 / scale) < WRONG_SCALE:
        return [], figures
    return [_wrong_scale(scale, median_depth_m, depth_scale)], figures


def _poses(truth: Trajectory, motion: Motion) -> tuple[Float64, Float64] | None:
    """Return the true poses at the two times of a motion, or None where one is not known."""
    found = []
    for time_s in (motion.source_s, motion.target_s):
        at = int(np.argmin(np.abs(truth.timestamps_s - time_s)))
        if abs(truth.timestamps_s[at] - time_s) > MAX_TIME_DIFFERENCE_S:
            return None
        found.append(truth.T_world_camera[at])
    return found[0], found[1]


def _moves(motion: Motion) -> bool:
    T = motion.T_target_source
    return float(np.linalg.norm(T[:3, 3])) > _LEAST_MOTION_M and float(se3.rotation_angle_rad(T)) > _LEAST_MOTION_RAD


def _disagreement(
    moved: list[tuple[Motion, Float64, Float64]], read: Callable[[Float64], Float64], depth_m: float
) -> tuple[float, float]:
    """Return how much measured and true motions differ, relative to their size, and the ratio of their lengths.

    Both are told by what they do to points at the depth of the scene: a shift and a turn that nearly undo each other
    are no contradiction, as features can hardly tell them apart where all is flat.
    """
    measured = np.array([motion.T_target_source for motion, _, _ in moved])
    true = np.array([se3.inverse(read(T_target)) @ read(T_source) for _, T_source, T_target in moved])
    points = depth_m * _AHEAD
    way = (measured[:, :3, :3] - np.eye(3)) @ points + measured[:, :3, 3:]
    turned, shift = (true[:, :3, :3] - np.eye(3)) @ points, true[:, :3, 3:]
    lengths = ((way - turned).mean(axis=2) * shift[..., 0]).sum(axis=1) / np.maximum((shift**2).sum(axis=(1, 2)), 1e-18)
    ratio = max(float(np.median(lengths)), 1e-9)  # a motion the other way round is no length
    apart = np.linalg.norm(way - turned - ratio * shift, axis=(1, 2)) / np.linalg.norm(way, axis=(1, 2))
    return float(np.median(apart)), ratio


def _misread(reading: str, wrong: float) -> Finding:
    seen = f"the motions it tells differ from those that the images show by {wrong:.0%} of their size"
    if reading == _INVERTED:
        fix = "give poses from camera to world: invert each"
        return Finding("truth-inverted", Level.WARNING, f"{seen}; inverted it agrees", fix)
    if reading:
        fix = "give poses of a camera with x right, y down, z forward (docs/conventions.md)"
        return Finding("truth", Level.WARNING, f"{seen}; {reading} it agrees", fix)
    return Finding("truth", Level.WARNING, seen, "is it of this recording, and on the clock of the images?")


def _wrong_scale(scale: float, median_depth_m: float, depth_scale: float) -> Finding:
    """Say whether the truth or the depth has another unit; `scale` is of the measured lengths over the true ones."""
    seen = f"the camera moves {scale:.3g} times as far in the images as in the ground truth"
    right = likely_depth_scale(depth_scale * scale)
    if check_depth_unit(median_depth_m / scale, right) is not None:  # the scene would have no such depth
        factor = float(f"{1 / scale:.1g}")
        return Finding("truth-unit", Level.WARNING, seen, f"write its positions in metres: divide them by {factor:g}")
    fix = f"pass --depth-scale {right:g} (units per metre), if the truth is right"
    return Finding("depth-unit", Level.ERROR, seen, fix)
