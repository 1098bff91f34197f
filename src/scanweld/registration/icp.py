"""Iterative closest point: pair every source point with its nearest target point, align the pairs, repeat.

One loop serves the whole family; the methods differ in the rows that a pair contributes (registration/local).

Sources: P. J. Besl, N. D. McKay, "A method for registration of 3-D shapes", 1992 (point-to-point). Y. Chen, G. Medioni,
"Object modelling by registration of multiple range images", 1992 (point-to-plane). A. Segal, D. Haehnel, S. Thrun,
"Generalized-ICP", 2009. S. Rusinkiewicz, "A symmetric objective function for ICP", 2019. J. Park, Q.-Y. Zhou,
V. Koltun, "Colored point cloud registration revisited", 2017.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import as_points
from scanweld.errors import InvalidInputError
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.point_cloud import PointCloud
from scanweld.parallel import limited_threads
from scanweld.registration.local.config import IcpConfig
from scanweld.registration.local.descent import descend
from scanweld.registration.local.history import IcpStep
from scanweld.registration.local.judgement import judge
from scanweld.registration.local.problem import Motion, Problem, prepare_problem
from scanweld.registration.prior import MotionPrior
from scanweld.registration.result import RegistrationResult

__all__ = ["IcpConfig", "IcpStep", "icp"]


def icp(
    source: npt.ArrayLike | PointCloud,
    target: npt.ArrayLike | PointCloud,
    *,
    target_normals: npt.ArrayLike | None = None,
    source_normals: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    T_init: npt.ArrayLike | None = None,
    prior: MotionPrior | None = None,
    config: IcpConfig | None = None,
    num_threads: int | None = None,
    keep_history: bool = False,
) -> RegistrationResult:
    """Align `source` to `target`, both (N, D) points or clouds, D = 2 or 3, pairs unknown.

    Parameters
    ----------
    source, target : [m]; rows with a value that is not finite are dropped, and counted in the note
    target_normals, source_normals : (M, D), (N, D) unit normals; those of the clouds, or estimated, where absent and
        where the method needs them
    weights : (N,) of the source's points, not negative; None counts all alike
    T_init : (D + 1, D + 1), the initial T_target_source; identity when None
    prior : what is known about the motion besides, see :class:`~.prior.MotionPrior`
    config : see :class:`IcpConfig`
    num_threads : all cores when None; the result does not depend on it
    keep_history : keep an :class:`IcpStep` of every iteration

    Returns
    -------
    CONVERGED when the steps became small, every direction is held by the data, and the fit is better than
    that of unrelated points. DEGENERATE names the free directions, which stay where `T_init` put them.
    NO_OVERLAP where the clouds do not show the same thing, TOO_FEW_CORRESPONDENCES where there are hardly any
    points.

    Raises
    ------
    InvalidInputError
        When shapes do not match or `T_init` is no rigid transform.
    """
    settings = config or IcpConfig()
    with limited_threads(num_threads):
        clouds = _cloud(source, source_normals, "source"), _cloud(target, target_normals, "target")
        problem = prepare_problem(*clouds, weights=weights, T_init=T_init, prior=prior, config=settings)
        if isinstance(problem, RegistrationResult):
            return problem
        steps: list[IcpStep] | None = [] if keep_history else None
        start = _evened_start(problem, *clouds, T_init, prior, settings) if problem.uneven else None
        result = judge(descend(problem, settings, steps, start), settings)
        return replace(result, history=tuple(steps or ()))


_VOXELS_PER_GATE = 4.0
"""Clouds of uneven density are first thinned to so many voxels a gate."""


def _evened_start(
    problem: Problem,
    source: PointCloud,
    target: PointCloud,
    T_init: npt.ArrayLike | None,
    prior: MotionPrior | None,
    config: IcpConfig,
) -> Motion | None:
    """Align clouds of uneven density by points of even density first.

    The rings of a LiDAR lie alike on the floor wherever it stands: pairs by the thousand that ask it not to move.
    """
    if not config.coarse_to_fine or not np.isfinite(problem.gate):
        return None
    voxel = problem.gate / _VOXELS_PER_GATE
    even = replace(config, voxel_m=voxel, max_correspondence_distance_m=problem.gate)
    thinned = prepare_problem(source, target, weights=None, T_init=T_init, prior=prior, config=even)
    if isinstance(thinned, RegistrationResult):
        return None
    end = descend(thinned, even)
    return problem.centred(end.problem.uncentred_in_space(end.motion), end.motion.scale) if end.settled else None


def _cloud(points: npt.ArrayLike | PointCloud, normals: npt.ArrayLike | None, name: str) -> PointCloud:
    cloud = as_cloud(points, name)
    if normals is None:
        return cloud
    n = as_points(normals, f"{name}_normals", dimensions=(cloud.dimension,))
    if len(n) != len(cloud):
        raise InvalidInputError(f"{name}_normals: expected one per point ({len(cloud)}), got {len(n)}")
    return replace(cloud, normals=n)
