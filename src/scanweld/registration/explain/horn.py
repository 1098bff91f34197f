"""Horn's method, explained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64
from scanweld.registration.closed_form import HornFit, align_closed_form, fit_horn
from scanweld.registration.explain.example import WORKED_SOURCE, WORKED_TARGET, as_small_set
from scanweld.registration.explain.text import (
    ROWS,
    angle_deg,
    number_text,
    sentence,
    side_by_side,
    vector_text,
    wrapped,
)


@dataclass(frozen=True, slots=True)
class HornExplanation:
    """Horn's method on paired points.

    Attributes
    ----------
    source, target : (N, D) [m]
    fit : means, W, its singular value decomposition, rotation, translation, scale, error
    terms : (N, D, D), W_i = b'_i a'_i^T [m^2]
    scales : the scale by each definition, {"symmetric": .., "least_squares": ..}; empty where there is none
    verdict : what it is worth, in words
    """

    source: Float64
    target: Float64
    fit: HornFit
    terms: Float64
    scales: dict[str, float]
    verdict: str

    def text(self) -> str:
        """Return all of it as plain text, 80 columns wide."""
        n, d = self.source.shape
        lines = [f"Horn's method: {n} pair{'s' * (n != 1)} in {d}-D, b_i = s R a_i + t", ""]
        lines += fit_lines(self.fit, self.source, self.target, self.terms)
        if self.scales:
            a, b = self.fit.source_spread, self.fit.target_spread
            symmetric, least_squares = self.scales["symmetric"], self.scales["least_squares"]
            lines += [
                "",
                "  scale, symmetric      sqrt(sum|b'|^2 / sum|a'|^2)",
                f"                        = sqrt({number_text(b)} / {number_text(a)}) = {number_text(symmetric)}",
                "  scale, least squares  trace(D S) / sum|a'|^2",
                f"                        = {number_text(least_squares * a)} / {number_text(a)} = "
                f"{number_text(least_squares)}",
                f"  scale used here       {number_text(self.fit.scale)}",
            ]
        return "\n".join([*lines, "", *wrapped(self.verdict), ""])


def explain_horn(
    source: npt.ArrayLike = WORKED_SOURCE, target: npt.ArrayLike = WORKED_TARGET, *, scale: str = "none"
) -> HornExplanation:
    """Explain the closed form of paired points (N, D); the worked example when no points are given.

    Raises
    ------
    InvalidInputError
        When there are no pairs or more than ``MOST_POINTS``, shapes differ, or a value is not finite.
    """
    a, b = as_small_set(source, "source"), as_small_set(target, "target")
    result = align_closed_form(a, b, scale=scale)
    fit = fit_horn(a, b, scale=scale, doubt_noise=True)
    correlation = float(np.sum(fit.rotation * fit.W))
    scales = {}
    if fit.source_spread > 0:
        symmetric = float(np.sqrt(fit.target_spread / fit.source_spread))
        scales = {"symmetric": symmetric, "least_squares": correlation / fit.source_spread}
    if result.status.success:
        verdict = (
            f"Verdict: the {len(a)} pairs determine the motion, W has rank {fit.rank}; "
            f"rmse {number_text(result.rmse_m)} m, turned by {number_text(angle_deg(result.T_target_source))} deg."
        )
    else:
        verdict = f"Verdict: {result.status.value}. {sentence(result.note)}"
    return HornExplanation(a, b, fit, correlation_terms(a, b, fit), scales, verdict)


def correlation_terms(a: Float64, b: Float64, fit: HornFit) -> Float64:
    """Return W_i = b'_i a'_i^T (N, D, D) of pairs (N, D)."""
    return np.asarray(np.einsum("ni,nj->nij", b - fit.mean_target, a - fit.mean_source))


def fit_lines(fit: HornFit, a: Float64, b: Float64, terms: Float64) -> list[str]:
    """Every number of a closed form."""
    dimension = len(fit.mean_source)
    lines = [f"  mean(a) = {vector_text(fit.mean_source)}", f"  mean(b) = {vector_text(fit.mean_target)}", ""]
    heads = "".join(f"{head:>10}" for head in ("a_i", "b_i", "a'", "b'"))
    lines.append(f"    i {heads}   W_i = b' a'^T")
    for i in range(min(len(a), ROWS)):
        for row in range(dimension):
            name = str(i + 1) if row == 0 else ""
            values = (
                a[i, row],
                b[i, row],
                a[i, row] - fit.mean_source[row],
                b[i, row] - fit.mean_target[row],
            )
            cells = "".join(f"{number_text(v):>10}" for v in values)
            lines.append(f"  {name:>3} {cells} " + "".join(f"{number_text(v):>10}" for v in terms[i, row]))
    if len(a) > ROWS:
        lines.append(f"      and {len(a) - ROWS} more")
    lines += ["", *side_by_side({"W = sum W_i = U S V^T": fit.W, "U": fit.U})]
    lines += ["", *side_by_side({"S": np.diag(fit.singular_values), "V^T": fit.Vt})]
    held = "the rotation is determined" if not fit.free_planes else "the rotation is free, and R = I on the free part"
    lines += ["", f"  rank {fit.rank} of {dimension}: {held}"]
    lines += [
        "",
        *side_by_side({"R = U D V^T": fit.rotation, "t = mean(b) - s R mean(a)": fit.translation_m[:, None]}),
    ]
    if fit.scale == 1:
        traced = (fit.source_spread + fit.target_spread - fit.error) / 2
        lines += [
            "",
            "  E = sum|a'|^2 + sum|b'|^2 - 2 trace(D S)",
            f"    = {number_text(fit.source_spread)} + {number_text(fit.target_spread)} - 2 * {number_text(traced)} = "
            f"{number_text(fit.error)}",
        ]
    else:
        lines += ["", f"  s = {number_text(fit.scale)}   E = sum|b - s R a - t|^2 = {number_text(fit.error)}"]
    return lines
