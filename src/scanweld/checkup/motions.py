"""What the motion between two frames tells of the intrinsics and of the ground truth."""

from __future__ import annotations

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

_LEAST_TURN_RAD = np.deg2rad(3.0)  # without a turn, any focal length fits
LEAST_PAIRS = 3
"""Fewer pairs of views tell nothing."""

_LEAST_LOSS = 100.0  # that a better focal length saves, in squares of standard deviations
_SIGMAS = 3.0

AXIS_FLIPS = {"z backwards and y up, as in OpenGL": np.diag([1.0, -1.0, -1.0, 1.0])}
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
AGREES = 0.35
"""Disagreement of two motions, relative to their size, below which they are the same."""

WRONG_SCALE = 1.6
_MILLIMETRES, _NEAR = 1000.0, 1.5
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
    seen = (
        f"the same places seen from two directions fit together best with focal lengths {factor:.2f} times those "
        f"given, fx {stated.fx:.1f} and fy {stated.fy:.1f}"
    )
    advice = (
        f"pass the intrinsics of these images with --camera FX,FY,CX,CY (about {factor * stated.fx:.0f},"
        f"{factor * stated.fy:.0f},{stated.cx:.1f},{stated.cy:.1f}), or try --calibrate"
    )
    return [Finding("intrinsics", Level.ERROR, seen, advice)], figures


def _loss(pair: Pair, factor: float) -> tuple[float, float]:
    """Return the truncated squares of a pair's distances at its best motion, and how far that turns [rad]."""
    lens = np.array([1 / factor, 1 / factor, 1.0])
    source, target = pair.source_m * lens, pair.target_m * lens
    result = align_pairs_robustly(source, target, _SIGMAS * pair.sigma_m).result
    if not result.status.success:
        return _SIGMAS**2 * len(source), 0.0
    gaps = np.linalg.norm(se3.transform_points(result.T_target_source, source) - target, axis=1) / pair.sigma_m
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
    readings = {"as it is": _disagreement(moved, np.eye(4), inverted=False)}
    readings["inverted"] = _disagreement(moved, np.eye(4), inverted=True)
    for name, flip in AXIS_FLIPS.items():
        readings[name] = _disagreement(moved, flip, inverted=False)
    readings["mirrored, y up, as in ICL-NUIM"] = _disagreement(moved, _MIRROR, inverted=False, mirrored=True)
    wrong, scale = readings["as it is"]
    figures: Figures = {"truth_disagreement": wrong, "truth_scale": scale}
    best = min(readings, key=lambda name: readings[name][0])
    if wrong > AGREES:
        return [_misread(best if readings[best][0] < min(AGREES, wrong / 2) else "", wrong)], figures
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
    moved: list[tuple[Motion, Float64, Float64]], flip: Float64, *, inverted: bool, mirrored: bool = False
) -> tuple[float, float]:
    """Return how much measured and true motions differ, relative to their size, and the ratio of their lengths.

    The true pose is read as it is or inverted, with camera axes (and, mirrored, world axes) turned by `flip`.
    """
    measured = np.array([motion.T_target_source for motion, _, _ in moved])
    true = []
    for _, *poses in moved:
        T_source, T_target = (_read(T, flip, inverted=inverted, mirrored=mirrored) for T in poses)
        true.append(se3.inverse(T_target) @ T_source)
    claimed = np.array(true)
    lengths = np.linalg.norm(claimed[:, :3, 3], axis=1)
    ratio = float(np.median(np.linalg.norm(measured[:, :3, 3], axis=1) / np.maximum(lengths, 1e-9)))
    turn = se3.rotation_angle_rad(se3.inverse(claimed) @ measured) / se3.rotation_angle_rad(measured)
    shift = np.linalg.norm(measured[:, :3, 3] - ratio * claimed[:, :3, 3], axis=1) / np.linalg.norm(
        measured[:, :3, 3], axis=1
    )
    return float(np.median(turn) + np.median(shift)) / 2, ratio


def _read(T: Float64, flip: Float64, *, inverted: bool, mirrored: bool) -> Float64:
    T_world_camera = se3.inverse(T) if inverted else T
    return flip @ T_world_camera @ flip if mirrored else T_world_camera @ flip


def _misread(reading: str, wrong: float) -> Finding:
    seen = f"the motions it tells differ from those that the images show by {wrong:.0%} of their size"
    if reading == "inverted":
        fix = "give poses from camera to world: invert each"
        return Finding("truth-inverted", Level.WARNING, f"{seen}; inverted it agrees", fix)
    if reading:
        fix = "give poses of a camera with x right, y down, z forward (docs/conventions.md)"
        return Finding("truth", Level.WARNING, f"{seen}; with its axes {reading}, it agrees", fix)
    return Finding("truth", Level.WARNING, seen, "is it of this recording, and on the clock of the images?")


def _wrong_scale(scale: float, median_depth_m: float, depth_scale: float) -> Finding:
    """Say whether the truth or the depth has another unit; `scale` is measured over true lengths."""
    seen = f"the camera moves {scale:.3g} times as far in the images as in the ground truth"
    plausible = check_depth_unit(median_depth_m, depth_scale) is None
    if plausible and 1 / _NEAR < scale * _MILLIMETRES < _NEAR:
        return Finding("truth-unit", Level.WARNING, f"{seen}: that is in millimetres", "divide its positions by 1000")
    right = likely_depth_scale(depth_scale * scale)
    return Finding(
        "depth-unit", Level.ERROR, seen, f"pass --depth-scale {right:g} (units per metre), if the truth is right"
    )
