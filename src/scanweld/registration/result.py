"""The one result type of every aligner, from Horn to the tracker."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from scanweld.arrays import Float64
from scanweld.notebook import BAD, DOUBTFUL, GOOD, card


class Status(Enum):
    """Whether an alignment can be trusted. Only CONVERGED is a success."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"
    TOO_FEW_CORRESPONDENCES = "too_few_correspondences"
    DEGENERATE = "degenerate"
    NO_OVERLAP = "no_overlap"

    @property
    def success(self) -> bool:
        """Whether the transform may be used without looking further."""
        return self is Status.CONVERGED

    @property
    def has_pose(self) -> bool:
        """Whether the transform fits the data, be it unfinished or free in some directions."""
        return self in (Status.CONVERGED, Status.MAX_ITERATIONS, Status.DEGENERATE)

    @property
    def rank(self) -> int:
        """Higher is more of an answer; for choosing among attempts."""
        order = ("TOO_FEW_CORRESPONDENCES", "NO_OVERLAP", "DEGENERATE", "MAX_ITERATIONS", "CONVERGED")
        return order.index(self.name)


@dataclass(frozen=True, slots=True)
class FreeDirection:
    """A motion that the data does not constrain.

    Attributes
    ----------
    words : what a person would call it, e.g. "translation along (0.00, 1.00, 0.00)"
    vector : the unit twist; (6,) = (rho, phi) in 3-D, (3,) = (rho, phi) in 2-D, about the points' centroid; zero for
        a free "scale", which is no rigid motion
    """

    words: str
    vector: Float64


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationResult:
    """An alignment and what it is worth.

    Attributes
    ----------
    T_target_source : (D + 1, D + 1), maps source points to the target frame: x_target = scale R x + t
    status : see :class:`Status`
    scale : 1 unless scale was estimated; never hidden in the matrix
    scale_std : standard deviation of the scale; 0 where it is not estimated
    num_iterations : iterations done
    num_inliers : correspondences that the last step used
    overlap : share of the source points with an accepted correspondence, 0..1
    rmse_m : root mean square residual of the inliers, in the metric that was minimised [m]
    loss : mean robust loss of the correspondences at the last step, residuals in units of their noise (where the
        aligner has a noise model, else 0)
    information : (6, 6) in 3-D, (3, 3) in 2-D; Gauss-Newton Hessian of the metric that was minimised, translation [m]
        first, rotation [rad] second, left perturbation at the target's origin
    covariance : of the estimate, in the order, perturbation and origin of `information`, from its scores;
        free directions have no finite variance: they are zero here and named in `unobservable`. None where the aligner
        makes no claim
    unobservable : directions that the data leaves free; they stay at the initial guess, but for what faint brightness
        tells of them, whose little worth is in `information`
    note : one sentence for a person: why the status is not CONVERGED, and what was dropped; "" where nothing is amiss
    history : the steps, where asked for
    """

    T_target_source: Float64
    status: Status
    information: Float64
    scale: float = 1.0
    scale_std: float = 0.0
    num_iterations: int = 0
    num_inliers: int = 0
    overlap: float = 0.0
    rmse_m: float = 0.0
    loss: float = 0.0
    covariance: Float64 | None = None
    unobservable: tuple[FreeDirection, ...] = ()
    note: str = ""
    history: tuple[Any, ...] = ()

    def __repr__(self) -> str:
        about = [self.status.name]
        if self.status.has_pose:
            about += [self._motion(), f"overlap {self.overlap:.0%}", f"rmse {self.rmse_m:.3g} m"]
        return f"<RegistrationResult {', '.join(about)}>"

    def _repr_html_(self) -> str:
        """Show the result in a notebook."""
        answered = self.status.has_pose
        mark = GOOD if self.status.success else DOUBTFUL if answered else BAD
        rows = [
            ("", self.note),
            ("motion", self._motion() if answered else ""),
            ("scale", f"{self.scale:.6g}" if self.scale != 1 else ""),
            ("overlap", f"{self.overlap:.1%}, {self.num_inliers:,} pairs"),
            ("rmse", f"{self.rmse_m:.4g} m" if answered else ""),
            *(("left free", free.words) for free in self.unobservable if free.words not in self.note),
            ("iterations", str(self.num_iterations)),
        ]
        matrix = self.T_target_source if answered else None
        return card(f"Registration: {self.status.name}", rows, mark=mark, matrix=matrix)

    def _motion(self) -> str:
        rotation, shift_m = self.T_target_source[:-1, :-1], self.T_target_source[:-1, -1]
        words = f"{np.linalg.norm(shift_m):.4g} m"
        if len(rotation) > 3:
            return words  # has no single angle
        # |R - I|^2 = 8 sin^2(angle / 2) in the plane and in space alike; precise for small angles, too.
        angle_rad = 2 * np.arcsin(min(1.0, np.linalg.norm(rotation - np.eye(len(rotation))) / np.sqrt(8)))
        return f"{words}, {np.degrees(angle_rad):.3g} deg"
