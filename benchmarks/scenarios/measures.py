"""Measures of what a run did, against the exact scene.

Poses of a run and its map are in the world of its first frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

import scanweld as sw
from scanweld.datasets.synthetic.crossing import CrossedSequence
from scanweld.geometry import se3
from scenarios.runs import POSED, Array, Run

NEAR_M = 0.05
"""A place is mapped where the map has a surfel so near."""
RIGHT_M, RIGHT_DEG = 0.05, 3.0
"""A pose is right within this of the truth: well below the distance to any other place that looks alike."""


@dataclass(frozen=True)
class Recovery:
    """What a kidnap came to.

    Attributes
    ----------
    frames_until_lost : frames of blackness before the first LOST one, None if there was none
    mapped_from : first frame after the blackness that saw mapped surfaces, None if none did
    frames_until_recovered : from there to the first frame with a right pose, None if there was none
    wrong_poses : frames after the blackness that had a pose, and a wrong one
    """

    frames_until_lost: int | None
    mapped_from: int | None
    frames_until_recovered: int | None
    wrong_poses: int


def recovery(run: Run, sequence: sw.SyntheticSequence, at: int, blind: int, *, mapped_share: float = 0.5) -> Recovery:
    """Measure how a run took a blackout of `blind` frames from `at`; it kept the map of frame `at` - 1.

    Mapped surfaces are in view when `mapped_share` of the true depth is within 5 cm of the map as it was.
    """
    lost = run.lost
    lost = lost[(lost >= at) & (lost < at + blind)]
    T_truth_run = run.T_truth_run(at - 1)
    tree = cKDTree(se3.transform_points(T_truth_run, run.maps[at - 1]))
    looks = coarse(sequence)
    mapped = next((k for k in range(at + blind, len(looks)) if _mapped_share(looks, k, tree) >= mapped_share), None)
    posed = [k for k in range(at + blind, len(sequence)) if run.results[k].state in POSED]
    right = [k for k in posed if _is_right(T_truth_run @ run.results[k].T_world_camera, run.truth.T_world_camera[k])]
    recovered = None if mapped is None else next((k for k in right if k >= mapped), None)
    return Recovery(
        frames_until_lost=int(lost[0]) - at if len(lost) else None,
        mapped_from=mapped,
        frames_until_recovered=None if recovered is None or mapped is None else recovered - mapped,
        wrong_poses=len(posed) - len(right),
    )


def _mapped_share(sequence: sw.SyntheticSequence, index: int, tree: cKDTree) -> float:
    points = true_points(sequence, index)
    return float((tree.query(points, distance_upper_bound=NEAR_M)[0] < NEAR_M).mean())


def coarse(sequence: sw.SyntheticSequence) -> sw.SyntheticSequence:
    """Return the same views with 40x30 pixels: enough to know what is in view."""
    config = replace(sequence.config, width=40, height=30, path="", path_frame="cv", frames=0)
    return sw.SyntheticSequence(config, trajectory=sequence.ground_truth)


def true_points(sequence: sw.SyntheticSequence, index: int) -> Array:
    """Points (N, 3) of the exact depth of a frame, true world [m]."""
    _, depth_m = sequence.exact(index)
    points = sequence.camera.back_project(depth_m)[depth_m > 0]
    return np.asarray(se3.transform_points(sequence.ground_truth.T_world_camera[index], points.astype(np.float64)))


def _is_right(T: Array, T_true: Array) -> bool:
    error = se3.inverse(T_true) @ T
    return bool(np.linalg.norm(error[:3, 3]) < RIGHT_M and se3.rotation_angle_rad(error) < np.deg2rad(RIGHT_DEG))


def motion_error(run: Run, a: int, b: int) -> float:
    """Length [m] of the error of the motion from frame `a` to `b`, as the poses were given when the frames came."""
    estimated = se3.inverse(run.results[a].T_world_camera) @ run.results[b].T_world_camera
    return _motion_error(run, a, b, estimated)


def motion_model_error(run: Run, a: int, b: int) -> float:
    """The same for a camera that goes on as the run saw it move over the third of a second before `a`."""
    t = run.truth.timestamps_s
    back = int(np.searchsorted(t, t[a] - 0.3))
    step = se3.inverse(run.results[back].T_world_camera) @ run.results[a].T_world_camera
    return _motion_error(run, a, b, se3.exp(se3.log(step) * (t[b] - t[a]) / (t[a] - t[back])))


def _motion_error(run: Run, a: int, b: int, estimated: Array) -> float:
    T = run.truth.T_world_camera
    true = se3.inverse(T[a]) @ T[b]
    return float(np.linalg.norm((se3.inverse(true) @ estimated)[:3, 3]))


def flat_frames(sequence: sw.SyntheticSequence) -> Array:
    """Frames that see nothing but the wall ahead, a plane of constant z."""
    flat = []
    looks = coarse(sequence)
    for index in range(len(looks)):
        z = true_points(looks, index)[:, 2]
        if z.max() - z.min() < 1e-3:
            flat.append(index)
    return np.array(flat, dtype=np.int64)


def first_stretch(frames: Array) -> tuple[int, int]:
    """First and last of the first consecutive frames."""
    ends = np.flatnonzero(np.diff(frames) > 1)
    return int(frames[0]), int(frames[ends[0]] if len(ends) else frames[-1])


def left_in_map(run: Run, sequence: CrossedSequence, still: sw.SyntheticSequence) -> tuple[float, int, int]:
    """Share of the person's surfels left in the map: how many, over those of one copy of the person.

    A surfel is the person's when the person has been there and no true surface of the room is within 5 cm along the
    line of sight. One copy has as many as its largest picture has pixels.

    Returns
    -------
    share, surfels of the person in the map, surfels of one copy
    """
    points = se3.transform_points(run.T_truth_map, run.points_m)
    points = points[sequence.in_object(points)]
    alone = np.ones(len(points), dtype=np.bool_)
    frames = range(0, len(still), max(1, len(still) // 30))
    for index in frames:
        alone &= ~_on_surface(still, index, points)
    walk = range(sequence.walk.start, sequence.walk.start + len(sequence.walk.T_world_object))
    one_copy = max(int(sequence.object_mask(index).sum()) for index in walk)
    return float(alone.sum() / one_copy), int(alone.sum()), one_copy


def _on_surface(sequence: sw.SyntheticSequence, index: int, points: Array) -> Array:
    """Which points (N, 3) a frame sees within 5 cm of the surface behind their pixel."""
    _, depth_m = sequence.exact(index)
    in_camera = se3.transform_points(se3.inverse(sequence.ground_truth.T_world_camera[index]), points)
    pixels, inside = sequence.camera.project(in_camera)
    u, v = np.rint(np.where(inside[:, None], pixels, 0)).astype(np.int64).T
    u, v = np.clip(u, 0, sequence.camera.width - 1), np.clip(v, 0, sequence.camera.height - 1)
    near = np.abs(depth_m[v, u] - in_camera[:, 2]) < NEAR_M
    return np.asarray(inside & near)


def surface_error(run: Run, sequence: sw.SyntheticSequence, *, every: int, cap_m: float = 0.1) -> tuple[float, float]:
    """Mean distance [m] of the surfels to the true surface, along its normal, and the share that was measured.

    Each surfel is compared with the plane of the true depth at its pixel, in every `every`-th frame, and the least is
    taken. Surfels that are off every surface count as `cap_m`; those that no frame can see are left out.
    """
    points = se3.transform_points(run.T_truth_map, run.points_m)
    best, looked_at = np.full(len(points), cap_m), np.zeros(len(points), dtype=np.bool_)
    for index in range(0, len(sequence), every):
        color, depth_m = sequence.exact(index)
        surface = sw.build_pyramid(sw.Frame(0.0, depth_m, color, sequence.camera)).levels[0].surface
        in_camera = se3.transform_points(se3.inverse(sequence.ground_truth.T_world_camera[index]), points)
        pixels, inside = sequence.camera.project(in_camera)
        rows = np.flatnonzero(inside)
        u, v = np.clip(np.rint(pixels[rows]).astype(np.int64), 0, np.array(sequence.camera.shape[::-1]) - 1).T
        there = surface[v, u]
        offset = in_camera[rows] - there[:, :3]
        facing = (there[:, 6] > 0) & (np.linalg.norm(offset, axis=1) < cap_m)
        looked_at[rows] |= (there[:, 6] > 0) & (offset[:, 2] < cap_m)  # not hidden behind the surface
        distance = np.abs((offset * there[:, 3:6]).sum(axis=1))
        best[rows[facing]] = np.minimum(best[rows[facing]], distance[facing])
    if not looked_at.any():
        return float("nan"), 0.0
    return float(best[looked_at].mean()), float(looked_at.mean())
