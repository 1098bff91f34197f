"""Surfels as Gaussians: what viewers of 3-D Gaussian splats open.

The attributes are those of the PLY files of B. Kerbl et al., "3D Gaussian splatting for real-time radiance field
rendering", 2023: scales are logarithms, the opacity is a logit, the quaternion is w x y z, and the colour is the
constant term of spherical harmonics. The higher terms (f_rest_*) are left out: a surfel looks the same from all sides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Array, Float32, Float64
from scanweld.errors import InvalidInputError

SH_0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""

SPREAD = 0.7
"""Standard deviation of a Gaussian along its surfel, as a share of the radius: neighbours just leave no gaps."""

THICKNESS = 0.1
"""And across it, as a share of that."""

STABLE_CONFIDENCE = 3.0
"""Opacity is 1 - 1 / e of its most at this confidence."""

MOST_OPACITY = 0.99

SURFEL_COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "radius", "confidence")


@dataclass(frozen=True, slots=True)
class SplatColumns:
    """Columns of a splat file; :func:`scanweld.write_ply` writes them."""

    values: Mapping[str, Array]

    def columns(self) -> dict[str, Array]:
        """Return the columns in file order."""
        return dict(self.values)

    def __len__(self) -> int:
        return len(self.values["x"])


def splats_from_surfels(surfels: Mapping[str, Array], *, least_confidence: float = 0.0) -> SplatColumns:
    """Return a flat Gaussian for each surfel, as wide as covers the surface.

    Parameters
    ----------
    surfels : columns of a map (`map.ply`, or ``SurfelMap.columns()``): x y z nx ny nz red green blue radius confidence
    least_confidence : surfels below it are left out

    Raises
    ------
    InvalidInputError
        When a column is missing, or no surfel is left.
    """
    missing = [name for name in SURFEL_COLUMNS if name not in surfels]
    if missing:
        raise InvalidInputError(f"splats: the surfels have no {', '.join(missing)}; a map.ply of a run has all of them")
    radius = np.asarray(surfels["radius"], np.float64)
    kept = (np.asarray(surfels["confidence"]) >= least_confidence) & (radius > 0)
    if not kept.any():
        raise InvalidInputError(f"splats: none of {len(kept)} surfels has a confidence of {least_confidence:g}")

    def column(name: str) -> Float64:
        return np.asarray(surfels[name], np.float64)[kept]

    opacity = MOST_OPACITY * (1 - np.exp(-np.maximum(column("confidence"), 0.05) / STABLE_CONFIDENCE))
    along = np.log(SPREAD * column("radius"))
    values: dict[str, Array] = {name: column(name) for name in SURFEL_COLUMNS[:6]}
    values |= {f"f_dc_{k}": (column(name) / 255 - 0.5) / SH_0 for k, name in enumerate(("red", "green", "blue"))}
    values["opacity"] = np.log(opacity / (1 - opacity))
    values |= {"scale_0": along, "scale_1": along, "scale_2": along + np.log(THICKNESS)}
    normals = np.stack([column(name) for name in ("nx", "ny", "nz")], axis=1)
    values |= {f"rot_{k}": part for k, part in enumerate(quaternion_wxyz_to_normal(normals).T)}
    return SplatColumns({name: part.astype(np.float32) for name, part in values.items()})


def quaternion_wxyz_to_normal(normals: Float64 | Float32) -> Float64:
    """Return unit quaternions (N, 4), w first, of the shortest turn from the z axis to each unit normal (N, 3)."""
    n = np.asarray(normals, np.float64)
    q = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], axis=1)  # 1 + z.n, z x n
    q[n[:, 2] < -1 + 1e-9] = [0, 1, 0, 0]  # opposite: about x
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))
