"""The hot operation of registration: arrays in, arrays out; see docs/decisions/0016-backends.md."""

from __future__ import annotations

from typing import Protocol

from scanweld.arrays import Float32, Float64, Int64
from scanweld.backends import get_backend
from scanweld.geometry.depth import SurfaceLevel
from scanweld.registration.backends import compiled, reference


class ProjectiveBackend(Protocol):
    """What an implementation has to offer."""

    def point_to_plane_sums(
        self,
        positions_m: Float32,
        normals: Float32,
        T_target_source: Float64,
        target: SurfaceLevel,
        bounds: Int64,
        gate_m: float,
        min_cosine: float,
        robust_sigma: float,
    ) -> Float64:
        """Project source points into a depth image and sum the point-to-plane normal equations, part by part.

        A point matches the surface of the pixel that it lands in (nearest centre) within the gate, where the normals
        agree. The residual n . (p - q) and its Jacobian [n, p x n], for a left perturbation of T_target_source, are in
        units of the depth noise at the pixel; weights are Huber's.

        Parameters
        ----------
        positions_m, normals : (3, N) float32, source frame
        T_target_source : (4, 4)
        target : what is projected into, `surface` and `camera` of it
        bounds : (K + 1,); part k is the points bounds[k] to bounds[k + 1]
        gate_m : largest distance of a match [m]
        min_cosine : of the normals of a match
        robust_sigma : Huber's threshold in standard deviations of the noise

        Returns
        -------
        sums : (K, 32) float64; of each part the 28 weighted products of the columns (J, r), upper triangle row by row,
            then loss, inliers, matched and projected points
        """
        ...


_IMPLEMENTATIONS: dict[str, ProjectiveBackend] = {"numba": compiled, "numpy": reference}


def backend() -> ProjectiveBackend:
    """Return the implementation that is used."""
    return _IMPLEMENTATIONS[get_backend()]
