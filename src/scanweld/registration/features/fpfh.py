"""Fast point feature histograms: what the surface around a point looks like, whatever the pose.

Source: R. B. Rusu, N. Blodow, M. Beetz, "Fast point feature histograms (FPFH) for 3D registration", ICRA 2009.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, as_points
from scanweld.errors import InvalidInputError
from scanweld.geometry.neighbours import NeighbourIndex, build_index
from scanweld.parallel import run_ranges
from scanweld.registration.features.kernels import BINS, simplified_histograms, weighted_histograms

FPFH_LENGTH = 3 * BINS
"""Values of a feature: three angles of eleven bins each."""


def compute_fpfh(
    points_m: npt.ArrayLike,
    normals: npt.ArrayLike,
    radius_m: float,
    *,
    oriented: bool = False,
    index: NeighbourIndex | None = None,
) -> Float64:
    """Describe the surface around every point by histograms of the angles between it and its neighbours.

    Counts are shared between neighbouring bins, so a small change of an angle is a small change of the feature.

    Parameters
    ----------
    points_m : (N, 3), finite [m]; about evenly spread, or dense parts outvote the others
    normals : (N, 3), unit; (0, 0, 0) where unknown
    radius_m : of the neighbourhood [m]; larger ones tell more places apart, and overlap less between two scans
    oriented : the normals point to the same side everywhere (the sensor's, the outside): bumps then differ from dents.
        Otherwise the feature does not depend on the sign of any normal
    index : of the same points, where the caller has one

    Returns
    -------
    (N, 33): alpha, phi and theta (Rusu et al. 2009, eq. 1), 11 bins each, each summing to at most 2; zeros where a
    point has no normal or no neighbours

    Raises
    ------
    InvalidInputError
        When shapes do not match, a value is not finite, or the radius is not positive.
    """
    points = as_points(points_m, "points_m", dimensions=(3,))
    directions = as_points(normals, "normals", dimensions=(3,))
    if len(points) != len(directions):
        raise InvalidInputError(f"normals: expected one per point ({len(points)}), got {len(directions)}")
    if not (np.isfinite(points).all() and np.isfinite(directions).all()):
        raise InvalidInputError("features: some points or normals are not finite; drop them first")
    if not (np.isfinite(radius_m) and radius_m > 0):
        raise InvalidInputError(f"radius_m: expected a positive distance [m], got {radius_m}")
    simplified, histograms = np.zeros((len(points), FPFH_LENGTH)), np.zeros((len(points), FPFH_LENGTH))
    if len(points) == 0:
        return histograms
    starts, neighbours = (index or build_index(points)).within(points, radius_m)

    def simplify(start: int, stop: int) -> None:
        simplified_histograms(start, stop, points, directions, oriented, starts, neighbours, simplified)

    def weigh(start: int, stop: int) -> None:
        weighted_histograms(start, stop, points, directions, oriented, starts, neighbours, simplified, histograms)

    run_ranges(len(points), simplify)
    run_ranges(len(points), weigh)
    return histograms
