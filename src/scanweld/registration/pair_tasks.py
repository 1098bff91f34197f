"""Pairs of scans aligned one after the other in this process, or each in a task of an executor."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.errors import InvalidInputError
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.point_cloud import PointCloud, voxel_downsample
from scanweld.io.point_files import read_points
from scanweld.parallel import limited_threads
from scanweld.registration.result import RegistrationResult

Cloud: TypeAlias = npt.ArrayLike | PointCloud
Scan: TypeAlias = Cloud | str | os.PathLike[str] | Callable[[], Cloud]
"""A scan, a file that holds it, or a function that returns it."""

PairAligner = Callable[[Any, Any, Float64 | None], RegistrationResult]
"""Aligns a prepared source to a prepared target, from a guess of T_target_source where there is one."""

LEAST_POINTS = 10
"""Scans of fewer points are not aligned."""

_RADII_PER_VOXEL = 0.05  # of the samples that tell the overlap
_VOXELS_PER_GATE = 1.5


@dataclass(frozen=True, slots=True)
class Aligner:
    """What aligns a pair, and what is done with each scan before."""

    align: PairAligner
    prepare: Callable[[PointCloud], Any] | None = None

    def prepared(self, scan: PointCloud) -> Any:
        """Return what `align` takes of a scan."""
        return self.prepare(scan) if self.prepare else scan


@dataclass(frozen=True, slots=True)
class ScanFacts:
    """What is to be known of a scan without its points.

    Attributes
    ----------
    num_points : of the scan
    centroid_m : (3,)
    radius_m : root mean square distance from there
    reach_m : the largest distance of the sample from there
    sample_m : (M, 3), the scan thinned; empty where there are hardly any points
    gate_m : how near a point must be to lie on the scan
    """

    num_points: int
    centroid_m: Float64
    radius_m: float
    reach_m: float
    sample_m: Float64
    gate_m: float


class InProcess:
    """All scans in memory, each prepared once."""

    def __init__(self, scans: Sequence[Scan], aligner: Aligner) -> None:
        self._scans = [open_scan(scan, f"scan {k}") for k, scan in enumerate(scans)]
        self._aligner = aligner
        self._prepared = [aligner.prepared(scan) if len(scan) >= LEAST_POINTS else None for scan in self._scans]

    def describe(self) -> list[ScanFacts]:
        """Return the facts of every scan."""
        return [facts_of(scan) for scan in self._scans]

    def align(self, pairs: Sequence[tuple[int, int]], guesses: Sequence[Float64 | None]) -> list[RegistrationResult]:
        """Align pairs one after the other."""
        return [
            self._aligner.align(self._prepared[j], self._prepared[i], guess)
            for (i, j), guess in zip(pairs, guesses, strict=True)
        ]


class Distributed:
    """Scans where they are: each task is handed those that it is about."""

    def __init__(self, scans: Sequence[Scan], aligner: Aligner, executor: Executor, num_threads: int | None) -> None:
        self._scans, self._aligner, self._executor, self._num_threads = scans, aligner, executor, num_threads

    def describe(self) -> list[ScanFacts]:
        """Return the facts of every scan."""
        return self._results([(_described, scan, f"scan {k}") for k, scan in enumerate(self._scans)])

    def align(self, pairs: Sequence[tuple[int, int]], guesses: Sequence[Float64 | None]) -> list[RegistrationResult]:
        """Align each pair in a task."""
        return self._results([
            (_aligned, self._scans[j], self._scans[i], guess, self._aligner, self._num_threads)
            for (i, j), guess in zip(pairs, guesses, strict=True)
        ])  # fmt: skip

    def _results(self, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return what calls return, in their order; where one raises, the others are taken back."""
        futures = [self._executor.submit(*call) for call in calls]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()


PairTasks: TypeAlias = InProcess | Distributed
"""Looks at scans, and aligns pairs (target, source) of them, from guesses of T_target_source where there are some."""


def open_scan(scan: Scan, name: str) -> PointCloud:
    """Return the finite points of a scan, wherever it is.

    Raises
    ------
    InvalidInputError
        When it is not 3-D.
    FileFormatError
        When its file cannot be read.
    """
    if isinstance(scan, str | os.PathLike):
        scan = read_points(scan)
    elif callable(scan):
        scan = scan()
    cloud = as_cloud(scan, name).finite()
    if cloud.dimension != 3:
        raise InvalidInputError(f"{name}: expected points in 3-D, got {cloud.dimension}-D")
    return cloud


def facts_of(scan: PointCloud) -> ScanFacts:
    """Return what is to be known of a scan without its points."""
    points = scan.points_m
    if len(points) < LEAST_POINTS:
        return ScanFacts(len(points), np.zeros(3), 0.0, 0.0, np.empty((0, 3)), 0.0)
    centroid = points.mean(axis=0)
    typical = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    voxel = max(_RADII_PER_VOXEL * typical, 1e-9)
    sample = voxel_downsample(PointCloud(points), voxel).points_m
    radius = float(np.sqrt(((points - centroid) ** 2).sum(axis=1).mean()))
    reach = float(np.linalg.norm(sample - centroid, axis=1).max())
    return ScanFacts(len(points), centroid, radius, reach, sample, _VOXELS_PER_GATE * voxel)


def align_by_default(source: PointCloud, target: PointCloud, T_init: Float64 | None) -> RegistrationResult:
    """Align two scans without a guess, or by GICP where there is one that leads somewhere."""
    from scanweld.registration.global_registration import register_global
    from scanweld.registration.icp import IcpConfig, icp

    if T_init is not None:
        near = icp(source, target, T_init=T_init, config=IcpConfig(method="gicp"))
        if near.status.success:
            return near
    return register_global(source, target)


def _described(scan: Scan, name: str) -> ScanFacts:
    return facts_of(open_scan(scan, name))


def _aligned(
    source: Scan, target: Scan, guess: Float64 | None, aligner: Aligner, num_threads: int | None
) -> RegistrationResult:
    with limited_threads(num_threads):
        near, far = (aligner.prepared(open_scan(scan, name)) for scan, name in ((source, "source"), (target, "target")))
        return aligner.align(near, far, guess)
