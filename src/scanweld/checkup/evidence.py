"""What is measured on the frames that are looked at: few, in short bursts spread evenly over the recording.

A burst is a run of consecutive frames: what must be compared from frame to frame is compared within it, and colour of
one moment with depth of another. Images wider than ``WIDTH`` are made smaller before: what is looked for is no finer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.checkup.brims import Brim, color_edges, depth_brim
from scanweld.checkup.pictures import edge_spread
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.selection import ResizedSequence
from scanweld.errors import UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfaceConfig, build_pyramid
from scanweld.geometry.frame import Frame
from scanweld.tracking.image_features import FrameFeatures, ImageFeatureConfig, detect, match

WIDTH = 320
BURSTS, REACH = 8, 5
"""Number of bursts, and of frames on either side of a burst's middle."""

PARTNER = 20
"""Frames from the middle of a burst to one that has turned enough to tell of the focal length."""

_FEATURES = ImageFeatureConfig(count=600)
_LEAST_MATCHES = 12
_ASIDE = 2  # frames from the middle of a burst to others whose depth is compared with colour
_PATCH_PX = 2  # half the side of the patch whose brightness is compared


@dataclass(frozen=True, slots=True)
class Step:
    """Two consecutive frames.

    Attributes
    ----------
    index : of the first
    displacement : median way of the features, as a share of the width; NaN without features
    gain : median ratio of the brightness of features, second to first; NaN without features
    same_depth, same_color : the images are equal
    """

    index: int
    displacement: float
    gain: float
    same_depth: bool
    same_color: bool


@dataclass(frozen=True, slots=True)
class Pair:
    """Matched features of two frames that are some way apart.

    Attributes
    ----------
    source_s, target_s : times of the frames [s]
    source_m, target_m : (M, 3), in the frame of each camera [m]
    sigma_m : (M,), standard deviation of their distance after the right motion [m]
    """

    source_s: float
    target_s: float
    source_m: Float64
    target_m: Float64
    sigma_m: Float64


@dataclass(slots=True)
class Evidence:
    """All that was measured.

    Attributes
    ----------
    camera : of the images as they were looked at
    steps, pairs, brims : see there
    medians_m : median depth of each frame that has any [m]
    shares : share of the pixels of each frame that have depth
    spreads_px : how far edges of each picture spread [pixels]; NaN without edges
    looked_at, unreadable : indices of the frames that were looked at, and of those in vain
    """

    camera: PinholeCamera
    steps: list[Step] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)
    brims: list[Brim] = field(default_factory=list)
    medians_m: list[float] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)
    spreads_px: list[float] = field(default_factory=list)
    looked_at: set[int] = field(default_factory=set)
    unreadable: set[int] = field(default_factory=set)

    @property
    def median_depth_m(self) -> float:
        """Median of the median depths [m]; 0 where no frame has depth."""
        return float(np.median(self.medians_m)) if self.medians_m else 0.0


@dataclass(frozen=True, slots=True)
class Burst:
    """Frames that are looked at together: `first` to before `stop`, their middle, and a later one."""

    first: int
    middle: int
    stop: int
    partner: int | None


def plan_bursts(count: int) -> list[Burst]:
    """Return bursts spread evenly over `count` frames; a short recording has fewer, a very short one is all in one."""
    length = 2 * REACH + 1
    if count <= length:
        return [Burst(0, count // 2, count, None)]
    last = max(REACH, count - 1 - PARTNER)
    middles = np.linspace(REACH, last, min(BURSTS, count // length)).astype(int).tolist()
    return [Burst(m - REACH, m, m + REACH + 1, m + PARTNER if m + PARTNER < count else None) for m in middles]


def gather(sequence: RgbdSequence, bursts: list[Burst]) -> Evidence:
    """Read the frames of some bursts, one burst in memory at a time, and measure them."""
    scale = WIDTH / sequence.camera.width
    small = ResizedSequence(sequence, scale) if scale < 0.75 else sequence
    evidence = Evidence(small.camera)
    usual_s = float(np.median(np.diff(sequence.timestamps_s))) if len(sequence) > 1 else np.inf
    for burst in bursts:
        looks = {look.index: look for look in _looks(small, range(burst.first, burst.stop), evidence)}
        for index, look in looks.items():
            after = looks.get(index + 1)
            if after is not None and after.frame.timestamp_s - look.frame.timestamp_s < 1.5 * usual_s:
                evidence.steps.append(_compare(look, after))
        ends = [looks.get(burst.first), looks.get(burst.stop - 1)]
        if burst.partner is not None:
            ends += [looks.get(burst.middle), *_looks(small, range(burst.partner, burst.partner + 1), evidence)]
        evidence.pairs += [
            pair for a, b in zip(ends[::2], ends[1::2], strict=False) if a and b and (pair := _pair(a, b)) is not None
        ]
        evidence.brims += _brims(looks, burst.middle)
    return evidence


@dataclass(frozen=True, slots=True)
class _Look:
    """One frame, and what is made of it."""

    index: int
    frame: Frame
    features: FrameFeatures
    edges: Float32 | None


def _looks(sequence: RgbdSequence, indices: range, evidence: Evidence) -> Iterator[_Look]:
    """Read and measure frames; unreadable ones are counted."""
    for index in indices:
        evidence.looked_at.add(index)
        try:
            frame = sequence.read(index)
        except UnreadableFrameError:
            evidence.unreadable.add(index)
            continue
        valid = frame.depth_m[frame.depth_m > 0]
        evidence.shares.append(valid.size / frame.depth_m.size)
        if valid.size:
            evidence.medians_m.append(float(np.median(valid)))
        edges = None
        if frame.color is not None:
            gray = _gray(frame.color)
            edges = color_edges(gray)
            evidence.spreads_px.append(edge_spread(gray))
        yield _Look(index, frame, detect(build_pyramid(frame, SurfaceConfig()), _FEATURES), edges)


def _gray(color: UInt8) -> UInt8:
    import cv2

    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)


def _compare(a: _Look, b: _Look) -> Step:
    matches = match(a.features, b.features, _FEATURES)
    displacement = gain = np.nan
    if len(matches) >= _LEAST_MATCHES and a.frame.color is not None and b.frame.color is not None:
        from_px, to_px = a.features.pixels[matches[:, 0]], b.features.pixels[matches[:, 1]]
        displacement = float(np.median(np.linalg.norm(to_px - from_px, axis=1))) / a.frame.camera.width
        ratios = _brightness(b.frame.color, to_px) / _brightness(a.frame.color, from_px)
        gain = float(np.median(ratios))
    same_color = (
        a.frame.color is not None and b.frame.color is not None and np.array_equal(a.frame.color, b.frame.color)
    )
    return Step(a.index, displacement, gain, np.array_equal(a.frame.depth_m, b.frame.depth_m), same_color)


def _brightness(color: UInt8, pixels: Float32) -> Float64:
    """Mean brightness about pixels (M, 2); never 0."""
    import cv2

    mean = cv2.blur(_gray(color), (2 * _PATCH_PX + 1, 2 * _PATCH_PX + 1))
    u, v = np.rint(pixels).astype(np.int64).T
    return np.asarray(np.maximum(mean[v, u], 1), np.float64)


def _pair(a: _Look, b: _Look) -> Pair | None:
    matches = match(a.features, b.features, _FEATURES)
    if len(matches) < _LEAST_MATCHES:
        return None
    rows_a, rows_b = matches.T
    return Pair(
        a.frame.timestamp_s,
        b.frame.timestamp_s,
        a.features.points_m[rows_a],
        b.features.points_m[rows_b],
        np.hypot(a.features.sigma_m[rows_a], b.features.sigma_m[rows_b]),
    )


def _brims(looks: Mapping[int, _Look], middle: int) -> list[Brim]:
    """Return the brims about the middle of a burst, where there is colour of before and after."""
    edges = {index: look.edges for index, look in looks.items() if look.edges is not None}
    brims = []
    for index in sorted({middle - _ASIDE, middle, middle + _ASIDE} & set(edges)):
        points = depth_brim(looks[index].frame.depth_m)
        if len(points):
            brims.append(Brim(points, {other - index: there for other, there in edges.items()}))
    return brims
