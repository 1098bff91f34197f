"""Image features with depth: places that can be found again from afar, and the motion that they agree on.

Oriented FAST corners with rotated binary descriptors (ORB), spread evenly over the image, on pixels whose depth is that
of a surface. Most matches are right between near views, few between far ones; those that agree on one motion, and are
more than chance would bring together, give it (:func:`~scanweld.registration.robust_pairs.align_pairs_robustly`).

Source: E. Rublee, V. Rabaud, K. Konolige, G. Bradski, "ORB: an efficient alternative to SIFT or SURF", 2011.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Float32, Float64, Int64, UInt8
from scanweld.config import check_ranges, setting
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.registration.gauss_newton import NormalEquations
from scanweld.registration.residuals import point_equations
from scanweld.registration.result import RegistrationResult, Status
from scanweld.registration.robust_pairs import align_pairs_robustly

_CANDIDATES = 4  # corners that are looked at for each that is kept
_CELLS = 16  # cells along the longer side of the image, among which the corners are spread
_PATCH_PX = 31  # what a descriptor covers on its pyramid level
_MIN_SIDE_PX = 2 * _PATCH_PX
_BOUND_SIGMAS = 3.0  # a right match is no further off than this many standard deviations


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFeatureConfig:
    """How image features are found and matched."""

    count: int = setting(1500, "most features of a frame; raise for far-apart views, costs time", low=10, high=100_000)
    fast_threshold: int = setting(7, "least contrast of a corner [grey levels]; lower for dim images", low=1, high=255)
    levels: int = setting(8, "scales, each 1.2 times coarser; raise for views at different distances", low=1, high=20)
    max_bits: int = setting(80, "largest difference of matched descriptors, of 256 bits", low=0, high=256)
    max_ratio: float = setting(
        0.9, "largest ratio of the difference to that of the next best; lower for repeating patterns", low=0.1, high=1.0
    )
    min_agreeing: int = setting(
        6, "fewer matches that agree on a motion give none; lower for far-apart views, with more wrong ones", low=4
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class FrameFeatures:
    """Features of one frame, N of them.

    Attributes
    ----------
    pixels : (N, 2) float32, (u, v) in the full image
    points_m : (N, 3) float64, camera frame [m]
    sigma_m : (N,) float64, standard deviation of the place: depth noise, and the corner's pixel at its scale [m]
    descriptors : (N, 32) uint8, compared bit by bit
    """

    pixels: Float32
    points_m: Float64
    sigma_m: Float64
    descriptors: UInt8

    def __len__(self) -> int:
        return len(self.pixels)


def detect(pyramid: SurfacePyramid, config: ImageFeatureConfig | None = None) -> FrameFeatures:
    """Find the features of a frame; none where it has no colour, no texture or no depth.

    The same frame gives the same bytes, whatever the number of threads.
    """
    import cv2

    config = config or ImageFeatureConfig()
    color, surface = pyramid.frame.color, pyramid.levels[0].surface
    if color is None or min(color.shape[:2]) < _MIN_SIDE_PX:
        return _no_features()
    detector = cv2.ORB.create(
        nfeatures=_CANDIDATES * config.count,
        nlevels=config.levels,
        edgeThreshold=_PATCH_PX // 2,
        fastThreshold=config.fast_threshold,
    )
    corners, descriptors = detector.detectAndCompute(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), None)
    if not corners:
        return _no_features()
    pixels = np.array([corner.pt for corner in corners], np.float32)
    u, v = np.rint(pixels).astype(np.int64).T
    rows = surface[v, u]
    # A pixel without a normal has no depth, or lies on an edge of it.
    kept = np.flatnonzero(rows[:, 6] > 0)
    responses = np.array([corner.response for corner in corners])
    kept = kept[_spread(pixels[kept], responses[kept], max(color.shape) / _CELLS)[: config.count]]
    rows = rows[kept].astype(np.float64)
    scales = np.array([corner.size for corner in corners])[kept] / _PATCH_PX
    camera = pyramid.frame.camera
    rays = np.stack(
        [(pixels[kept, 0] - camera.cx) / camera.fx, (pixels[kept, 1] - camera.cy) / camera.fy, np.ones(len(kept))],
        axis=1,
    )
    across = rows[:, 2] * scales / camera.fx
    return FrameFeatures(
        pixels[kept], rays * rows[:, 2:3], np.hypot(1 / rows[:, 6], across), np.ascontiguousarray(descriptors[kept])
    )


def match(a: FrameFeatures, b: FrameFeatures, config: ImageFeatureConfig | None = None) -> Int64:
    """Pair features that are each other's nearest and clearly nearer than the next best.

    Returns
    -------
    (M, 2) int64, rows of `a` and `b`, ordered by the rows of `a`.
    """
    import cv2

    config = config or ImageFeatureConfig()
    if min(len(a), len(b)) < 2:
        return np.empty((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = {found.queryIdx: found.trainIdx for found in matcher.match(b.descriptors, a.descriptors)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in matcher.knnMatch(a.descriptors, b.descriptors, k=2)
        if best.distance <= config.max_bits
        and best.distance < config.max_ratio * second.distance
        and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class FeatureAlignment:
    """The motion that the features of two frames agree on.

    Attributes
    ----------
    result : T_target_source (4, 4) and what it is worth: CONVERGED when more matches agree than chance explains
    source_m, target_m : (M, 3) float64, the agreeing pairs, each in its camera's frame [m]; none without an answer
    sigma_m : (M,) float64, standard deviation of a pair's distance at the true motion [m]
    """

    result: RegistrationResult
    source_m: Float64
    target_m: Float64
    sigma_m: Float64

    def share_within(self, T_target_source: Float64) -> float:
        """Return the share of the pairs that a motion brings together within their noise."""
        gaps = np.linalg.norm(se3.transform_points(T_target_source, self.source_m) - self.target_m, axis=1)
        return float((gaps <= _BOUND_SIGMAS * self.sigma_m).mean()) if len(gaps) else 0.0

    def equations(self, T_target_source: Float64) -> NormalEquations:
        """Return the normal equations of the pairs at a motion, weights 1 / sigma^2 [1/m^2]."""
        moved = se3.transform_points(T_target_source, self.source_m)
        return point_equations(moved, self.target_m, self.sigma_m**-2.0)


def align_features(
    source: FrameFeatures, target: FrameFeatures, config: ImageFeatureConfig | None = None
) -> FeatureAlignment:
    """Find the motion between two frames from their features alone; a start for a dense alignment."""
    config = config or ImageFeatureConfig()
    rows_a, rows_b = match(source, target, config).T
    points_a, points_b = source.points_m[rows_a], target.points_m[rows_b]
    sigma = np.hypot(source.sigma_m[rows_a], target.sigma_m[rows_b])
    fit = align_pairs_robustly(points_a, points_b, _BOUND_SIGMAS * sigma)
    result, agreeing = fit.result, fit.inliers
    if result.status.success and agreeing.sum() < config.min_agreeing:
        note = f"{agreeing.sum()} of {len(sigma)} matches agree on a motion, fewer than {config.min_agreeing}"
        result, agreeing = replace(result, status=Status.NO_OVERLAP, note=note), np.zeros_like(agreeing)
    return FeatureAlignment(result, points_a[agreeing], points_b[agreeing], sigma[agreeing])


def _spread(pixels: Float32, strengths: Float64, cell_px: float) -> Int64:
    """Order corners so that any first part is spread over the image: the strongest of every cell come first."""
    cells = np.floor(pixels / cell_px).astype(np.int64) @ np.array([1, 1 << 20])
    order = np.lexsort((-strengths, cells))
    sorted_cells = cells[order]
    first = np.searchsorted(sorted_cells, sorted_cells)
    place_in_cell = np.arange(len(order)) - first
    return np.asarray(order[np.lexsort((-strengths[order], place_in_cell))])


def _no_features() -> FrameFeatures:
    return FrameFeatures(np.empty((0, 2), np.float32), np.empty((0, 3)), np.empty(0), np.empty((0, 32), np.uint8))
