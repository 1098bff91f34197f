"""What is known about a motion before the points are looked at: priors and locks on degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.errors import ConfigError, InvalidInputError

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_NAMED = {"planar": ("z", "roll", "pitch"), "gravity": ("roll", "pitch")}


def parse_locks(text: str) -> tuple[int, ...]:
    """Return the indices (of x, y, z, roll, pitch, yaw) of words separated by commas; planar and gravity are known.

    Raises
    ------
    ConfigError
        On an unknown word.
    """
    indices: set[int] = set()
    for word in filter(None, (part.strip().lower() for part in text.split(","))):
        names = _NAMED.get(word, (word,))
        if names[0] not in AXES:
            raise ConfigError(f"locks = {text!r}: '{word}' is none of {', '.join([*AXES, *_NAMED])}")
        indices |= {AXES.index(name) for name in names}
    return tuple(sorted(indices))


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """A guess of T_target_source and how far to trust it.

    Attributes
    ----------
    T_target_source : (4, 4); the error of the guess is the left perturbation exp(xi) T, xi = (rho [m], phi [rad])
    information : (6, 6) inverse covariance of xi; zero rows say nothing about a direction

    Raises
    ------
    InvalidInputError
        When the information is not symmetric and positive semidefinite.
    """

    T_target_source: Float64
    information: Float64

    def __post_init__(self) -> None:
        T = np.asarray(self.T_target_source, dtype=np.float64)
        information = np.asarray(self.information, dtype=np.float64)
        if T.shape != (4, 4):
            raise InvalidInputError(f"prior: expected a transform (4, 4), got {T.shape}")
        if information.shape != (6, 6) or not np.isfinite(information).all():
            raise InvalidInputError(f"prior: expected a finite information matrix (6, 6), got {information.shape}")
        size = float(np.abs(information).max())
        if np.abs(information - information.T).max() > 1e-9 * size or np.linalg.eigvalsh(information)[0] < -1e-9 * size:
            raise InvalidInputError("prior: the information must be symmetric and positive semidefinite")
        object.__setattr__(self, "T_target_source", T)
        object.__setattr__(self, "information", information)

    @classmethod
    def from_deviations(
        cls, T_target_source: npt.ArrayLike, *, translation_m: npt.ArrayLike, rotation_rad: npt.ArrayLike
    ) -> MotionPrior:
        """Build a prior from standard deviations, one number or one for each axis; infinity says nothing.

        Raises
        ------
        InvalidInputError
            When a standard deviation is not positive.
        """
        sigma = np.concatenate([np.broadcast_to(translation_m, 3), np.broadcast_to(rotation_rad, 3)]).astype(float)
        if not (sigma > 0).all():
            raise InvalidInputError(f"prior: standard deviations must be positive, got {sigma}")
        return cls(np.asarray(T_target_source, dtype=np.float64), np.diag(1 / sigma**2))
