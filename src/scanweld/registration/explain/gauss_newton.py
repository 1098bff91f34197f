"""The steps of the Gauss-Newton methods (point-to-plane, symmetric, GICP, coloured), explained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.registration.explain.text import (
    ROWS,
    angle_deg,
    number_text,
    pair_lines,
    side_by_side,
    vector_text,
    wrapped,
)
from scanweld.registration.gauss_newton import free_directions, solve
from scanweld.registration.local.config import IcpConfig, kernel_of
from scanweld.registration.local.history import IcpStep
from scanweld.registration.local.linearisation import METRICS, estimate_noise, linearise
from scanweld.registration.local.pairing import Pairing
from scanweld.registration.local.problem import Motion, Problem, in_space
from scanweld.registration.local.steps import min_constraint, unlocked_spectrum
from scanweld.registration.residuals import generalised_information, point_to_plane, symmetric

ROWS_OF = {
    "point-to-plane": "r = n . (p' - q), J = n^T [I | -[p']x]",
    "symmetric": "r = (n + m)/2 . (p' - q), J = (n + m)^T/2 [I | -[(p' + q)/2]x]",
    "gicp": "r^2 = d^T (C_q + C_p')^-1 d, d = p' - q, three rows a pair",
    "coloured": "r = n . (p' - q), J = n^T [I | -[p']x], and a row of intensity a pair",
}
"""What a pair contributes to the normal equations."""


@dataclass(frozen=True, slots=True)
class GaussNewtonStepExplanation:
    """One step T <- exp(xi) T, H xi = -g; all about the target's centre.

    Attributes
    ----------
    center_m : (D,), the target's centre
    pairs : (P, 2), rows of source and target
    moved, partners, normals : (P, D), the pairs' source points before the step, their partners [m], and the partners'
        normals
    residuals_m : (P,)
    noise_m : standard deviation of the residuals, as their median tells
    weights : (P,), of the robust kernel
    information, gradient : (K, K) H and (K,) g, translation [m] first, rotation [rad] second
    slopes : (K,) ascending, mean squared slope of the residuals along each direction that is not locked
    free : directions along which the step is zero, in words
    xi : (K,)
    T_total, scale : the motion after the step
    rmse_m : weighted, before the step
    displacement_m : root mean square motion of the points in this step
    """

    center_m: Float64
    pairs: Int64
    moved: Float64
    partners: Float64
    normals: Float64
    residuals_m: Float64
    noise_m: float
    weights: Float64
    information: Float64
    gradient: Float64
    slopes: Float64
    free: tuple[str, ...]
    xi: Float64
    T_total: Float64
    rmse_m: float
    displacement_m: float

    def text(self, number: int) -> str:
        """Return the step as plain text."""
        lines = [f"Step {number}", "", *pair_lines(self.pairs), "", *self._table(), ""]
        lines += wrapped(
            f"noise: 1.4826 median|r| = {number_text(self.noise_m)} m, no less than 0.02 spacings; "
            f"rmse before the step {number_text(self.rmse_m)} m"
        )
        lines += ["", *side_by_side({"H = sum w J^T J": self.information, "g": self.gradient[:, None]})]
        slopes = " ".join(number_text(value) for value in self.slopes)
        lines += ["", *wrapped(f"mean squared slopes along the principal directions: {slopes}")]
        for words in self.free:
            lines += wrapped(f"free, no step along it: {words}")
        d = len(self.center_m)
        lines += [
            "",
            *wrapped(f"xi = -H^-1 g: rho = {vector_text(self.xi[:d])} m, phi = {vector_text(self.xi[d:])} rad"),
        ]
        turn = f"turned by {number_text(angle_deg(self.T_total))} deg in all"
        lines += ["", *side_by_side({f"T after step {number}": self.T_total}), f"  {turn}"]
        return "\n".join(lines)

    def _table(self) -> list[str]:
        d, moved, normal = len(self.center_m), "p'", "n"
        lines = [f"  {'pair':<9}{moved:>{8 * d}}  {normal:>{7 * d}}{'r':>11}{'w':>7}"]
        for k in range(min(len(self.pairs), ROWS)):
            name = f"a{self.pairs[k, 0] + 1}-b{self.pairs[k, 1] + 1}"
            place = "".join(f"{v:8.3f}" for v in self.moved[k].round(3) + 0.0)
            direction = "".join(f"{v:7.3f}" for v in self.normals[k].round(3) + 0.0)
            residual = number_text(self.residuals_m[k])
            lines.append(f"  {name:<9}{place}  {direction}{residual:>11}{self.weights[k]:7.3f}")
        if len(self.pairs) > ROWS:
            lines.append(f"      and {len(self.pairs) - ROWS} more")
        return lines


def explain_gauss_newton(
    problem: Problem, config: IcpConfig, history: Sequence[IcpStep]
) -> tuple[GaussNewtonStepExplanation, ...]:
    """Take every step of a run again, and keep what led to it."""
    place_of_source, place_of_target = np.argsort(problem.source_rows), np.argsort(problem.target_rows)
    pairs = Pairing(problem, config)
    steps = []
    for step in history:
        motion = _centred(problem, step.T_before, step.scale_before)
        pairs.find(motion)
        pairs.partner = np.full(len(problem.source), -1, np.int32)
        pairs.partner[place_of_source[step.pairs.source]] = place_of_target[step.pairs.target]
        steps.append(_explained(problem, config, step, pairs, motion))
    return tuple(steps)


def _explained(
    problem: Problem, config: IcpConfig, step: IcpStep, pairs: Pairing, motion: Motion
) -> GaussNewtonStepExplanation:
    metric, kernel, d = METRICS[config.method], kernel_of(config), problem.dimension
    noise, sample = estimate_noise(problem, metric, pairs, motion, config.kernel_scale_m)
    sums = linearise(problem, metric, pairs, motion, noise, kernel, sample)
    parts = unlocked_spectrum(sums.equations, problem, min_constraint(problem))
    rows = np.argsort(problem.source_rows)
    rows = rows[pairs.partner[rows] >= 0]
    partner = pairs.partner[rows]
    moved, target, normals = pairs.moved[rows, :d], problem.target[partner, :d], problem.normals[partner, :d]
    own = problem.source_normals[rows, :d] @ motion.T[:d, :d].T if len(problem.source_normals) else normals
    residuals = _residuals(config.method, moved, target, normals, own, problem.thickness)
    return GaussNewtonStepExplanation(
        center_m=problem.target_center[:d],
        pairs=np.stack([step.pairs.source, step.pairs.target], axis=1),
        moved=moved,
        partners=target,
        normals=normals,
        residuals_m=residuals,
        noise_m=noise.geometric,
        weights=kernel.weight(residuals / noise.geometric),
        information=sums.equations.information,
        gradient=sums.equations.gradient,
        slopes=parts.values,
        free=tuple(direction.words for direction in free_directions(sums.equations, parts)),
        xi=solve(sums.equations, parts),
        T_total=step.T_after,
        rmse_m=sums.rmse_m,
        displacement_m=step.displacement_m,
    )


def _residuals(
    method: str, moved: Float64, target: Float64, normals: Float64, own: Float64, thickness: float
) -> Float64:
    """Signed where the metric has one row a pair."""
    if method == "symmetric":
        return symmetric(moved, target, normals, own)[0]
    if method == "gicp":
        apart = moved - target
        metric = generalised_information(normals, own, thickness)
        return np.asarray(np.sqrt(np.einsum("na,nab,nb->n", apart, metric, apart)))
    return point_to_plane(moved, target, normals)[0]


def _centred(problem: Problem, T_target_source: Float64, scale: float) -> Motion:
    """The motion between the centred clouds; what `Problem.uncentred` undoes."""
    T = in_space(T_target_source) if problem.dimension == 2 else T_target_source.copy()
    T[:3, 3] += scale * T[:3, :3] @ problem.source_center - problem.target_center
    return Motion(T, scale)
