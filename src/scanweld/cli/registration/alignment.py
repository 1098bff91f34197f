"""Run an aligner and measure its time: preprocessing and alignment, without files, imports and compilation."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from scanweld.errors import InvalidInputError, ScanweldError

if TYPE_CHECKING:
    from scanweld.arrays import Float64
    from scanweld.geometry.point_cloud import PointCloud
    from scanweld.registration.global_registration import GlobalConfig
    from scanweld.registration.icp import IcpConfig
    from scanweld.registration.result import RegistrationResult

_Align = Callable[["PointCloud", "PointCloud"], "RegistrationResult"]


@dataclass(frozen=True)
class Aligner:
    """What aligns two clouds.

    Attributes
    ----------
    name : for the report
    align : the alignment that is asked for
    warm : the same where the clouds are alike; it passes through every kernel
    sample : points that this takes
    """

    name: str
    align: _Align
    warm: _Align
    sample: int = 5000


_OPTIONS = {
    "raise max_correspondence_distance_m": "raise --max-distance",
    "raise max_iterations, or look at the initial guess": "raise --set max_iterations=N, or start nearer with --init",
    "try point-to-point": "try --method point-to-point",
}
"""What a note of the API advises, and the option that does it."""


def local_aligner(settings: IcpConfig, T_init: Float64 | None, threads: int | None) -> Aligner:
    """ICP with given settings."""
    from scanweld.registration.icp import icp

    def aligned(source: PointCloud, target: PointCloud, T: Float64 | None) -> RegistrationResult:
        if settings.method == "point-to-point":  # without their normals: points are paired with points
            source, target = replace(source, normals=None), replace(target, normals=None)
        return icp(source, target, T_init=T, config=settings, num_threads=threads)

    return Aligner(settings.method, lambda a, b: aligned(a, b, T_init), lambda a, b: aligned(a, b, None))


def global_aligner(settings: IcpConfig, search: GlobalConfig, *, refined: bool, threads: int | None) -> Aligner:
    """The search without a first guess; refined by ICP with given settings, or as the search does by itself."""
    from scanweld.registration.global_registration import register_global
    from scanweld.registration.icp import icp

    scaled = settings.scale != "none"

    def align(source: PointCloud, target: PointCloud) -> RegistrationResult:
        found = register_global(source, target, scale=scaled, config=search, num_threads=threads)
        if not (refined and found.status.success):
            return found
        # The scale so far goes into the source: ICP starts at 1.
        near = replace(source, points_m=found.scale * source.points_m)
        result = icp(near, target, T_init=found.T_target_source, config=settings, num_threads=threads)
        return replace(result, scale=found.scale * result.scale, scale_std=found.scale * result.scale_std)

    return Aligner(f"global, then {settings.method}", align, align, sample=1500)


def closed_form_aligner(scale: bool) -> Aligner:
    """Horn's method, row i with row i."""
    from scanweld.registration.closed_form import align_closed_form

    def align(source: PointCloud, target: PointCloud) -> RegistrationResult:
        return align_closed_form(source.points_m, target.points_m, scale="symmetric" if scale else "none")

    return Aligner("closed-form", align, align)


def run_timed(aligner: Aligner, source: PointCloud, target: PointCloud) -> tuple[RegistrationResult, float]:
    """Return the result, its note in terms of the options, and the seconds it took, kernels being loaded."""
    _load_kernels(aligner, source, target)
    started = time.perf_counter()
    try:
        result = aligner.align(source, target)
    except InvalidInputError as error:
        raise InvalidInputError(with_options(str(error))) from None
    seconds = time.perf_counter() - started
    return replace(result, note=with_options(result.note)), seconds


def thinned(clouds: tuple[PointCloud, PointCloud], voxel_m: float) -> tuple[PointCloud, PointCloud]:
    """Both clouds with one point a voxel."""
    from scanweld.geometry.point_cloud import voxel_downsample

    try:
        source, target = (voxel_downsample(cloud, voxel_m) for cloud in clouds)
    except InvalidInputError as error:
        raise InvalidInputError(with_options(str(error))) from None
    return source, target


def with_options(text: str) -> str:
    """Text of the API in words of the command line."""
    for words, option in _OPTIONS.items():
        text = text.replace(words, option)
    return f"--{text}" if text.startswith("voxel: ") else text


def _load_kernels(aligner: Aligner, source: PointCloud, target: PointCloud) -> None:
    """Align a sample of the target with itself: what is compiled or loaded then costs no time later."""
    from scanweld.parallel import kernels_are_cached

    cloud = target.finite()
    if len(cloud) == 0:
        return
    group = f"register-{aligner.name.replace(', then ', '-')}-{cloud.dimension}d"
    if not kernels_are_cached(group):
        print("compiling, once for this machine and method", file=sys.stderr, flush=True)
    some = cloud.select(np.arange(0, len(cloud), -(-len(cloud) // aligner.sample)))
    # As the source will come: without normals they are estimated, which is a kernel, too.
    moved = some if source.normals is not None else replace(some, normals=None)
    try:
        aligner.warm(moved, some)
    except ScanweldError:
        return  # the clouds themselves will say it better
    kernels_are_cached(group, now=True)
