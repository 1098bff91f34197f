"""Every step of Horn's method and of ICP, as numbers, as text and as a verdict in words.

For small sets: what `scanweld register --explain` prints. The steps are those that the aligners take, not a
second implementation: the tables are made from :class:`~scanweld.registration.closed_form.HornFit` and the
history of :func:`~scanweld.registration.icp.icp`.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64, as_points
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.registration.closed_form import HornFit, align_closed_form, fit_horn
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.result import RegistrationResult

WORKED_SOURCE: Float64 = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (2, 0.5)], dtype=np.float64)
"""The five points of the worked example [m]."""

WORKED_TARGET: Float64 = np.array([(2.10, 2.71), (3.01, 3.72), (1.24, 3.79), (1.79, 4.56), (3.04, 4.63)])
"""The same points turned by 45 degrees, moved by (2, 3), with noise, rounded to 1 cm."""

MOST_POINTS = 200
"""Larger sets are not explained: their tables would not be read."""

_ROWS, _COLUMNS = 12, 9  # what is printed of a table; the rest is counted
_NOT_WORSE = 0.5  # the row-by-row pairs point to a wrong minimum when their rmse is below this share of ICP's


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
        lines += _fit_lines(self.fit, self.source, self.target, self.terms)
        if self.scales:
            a, b = self.fit.source_spread, self.fit.target_spread
            lines += [
                "",
                "  scale, symmetric      sqrt(sum|b'|^2 / sum|a'|^2)",
                f"                        = sqrt({_n(b)} / {_n(a)}) = {_n(self.scales['symmetric'])}",
                "  scale, least squares  trace(D S) / sum|a'|^2",
                f"                        = {_n(self.scales['least_squares'] * a)} / {_n(a)} = "
                f"{_n(self.scales['least_squares'])}",
                f"  scale used here       {_n(self.fit.scale)}",
            ]
        return "\n".join([*lines, "", *_wrapped(self.verdict), ""])


@dataclass(frozen=True, slots=True)
class IcpStepExplanation:
    """One step of point-to-point ICP with the target moved towards the source, T = T_1 T_2 ... T_k.

    Attributes
    ----------
    target : (M, D), the target moved by the inverse of T_1 ... T_(k-1) [m]
    distances_m : (N, M), from every source point to every moved target point
    pairs : (P, 2), rows of source and target
    horn : the closed form of these pairs
    T_step, T_total : (D + 1, D + 1), T_k and T_1 ... T_k
    displacement_m : root mean square motion of the points in this step
    """

    target: Float64
    distances_m: Float64
    pairs: Int64
    horn: HornExplanation
    T_step: Float64
    T_total: Float64
    displacement_m: float

    def text(self, number: int) -> str:
        """Return the step as plain text."""
        lines = [f"Step {number}", "", "  distances |a_i - b_j|, the nearest marked *"]
        lines += _distance_lines(self.distances_m, self.pairs)
        listed = [f"a{i + 1}-b{j + 1}" for i, j in self.pairs[: 2 * _ROWS]]
        more = f" and {len(self.pairs) - len(listed)} more" if len(self.pairs) > len(listed) else ""
        lines += ["", *_wrapped(f"pairs: {'  '.join(listed)}{more}"), ""]
        lines += _fit_lines(self.horn.fit, self.horn.source, self.horn.target, self.horn.terms)
        turn = f"turned by {_n(_angle_deg(self.T_step))} deg, {_n(_angle_deg(self.T_total))} deg in all"
        lines += ["", *_side_by_side({f"T_1 .. T_{number}": self.T_total}), f"  {turn}"]
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class IcpExplanation:
    """Point-to-point ICP step by step.

    Attributes
    ----------
    source, target : (N, D), (M, D) [m]
    steps : the last one repeats the pairs of the one before and moves nothing, where the run settled
    result : what :func:`~scanweld.registration.icp.icp` returned
    verdict : what it is worth, and what would help, in words
    """

    source: Float64
    target: Float64
    steps: tuple[IcpStepExplanation, ...]
    result: RegistrationResult
    verdict: str

    def text(self) -> str:
        """Return all of it as plain text, 80 columns wide."""
        n, d = self.source.shape
        head = [
            f"ICP, point-to-point: {n} source and {len(self.target)} target points in {d}-D, pairs unknown.",
            "Each step moves the target towards the source by its inverse; T = T_1 T_2 ...",
            "",
        ]
        steps = [step.text(number) + "\n" for number, step in enumerate(self.steps, 1)]
        return "\n".join([*head, *steps, *_wrapped(self.verdict), ""])


def explain_horn(
    source: npt.ArrayLike = WORKED_SOURCE, target: npt.ArrayLike = WORKED_TARGET, *, scale: str = "none"
) -> HornExplanation:
    """Explain the closed form of paired points (N, D); the worked example when no points are given.

    Raises
    ------
    InvalidInputError
        When there are no pairs or more than ``MOST_POINTS``, shapes differ, or a value is not finite.
    """
    a, b = _small(source, "source"), _small(target, "target")
    result = align_closed_form(a, b, scale=scale)
    fit = fit_horn(a, b, scale=scale, doubt_noise=True)
    explanation = _horn(a, b, fit)
    correlation = float(np.sum(fit.rotation * fit.W))
    scales = {}
    if fit.source_spread > 0:
        symmetric = float(np.sqrt(fit.target_spread / fit.source_spread))
        scales = {"symmetric": symmetric, "least_squares": correlation / fit.source_spread}
    if result.status.success:
        verdict = (
            f"Verdict: the {len(a)} pairs determine the motion, W has rank {fit.rank}; "
            f"rmse {_n(result.rmse_m)} m, turned by {_n(_angle_deg(result.T_target_source))} deg."
        )
    else:
        verdict = f"Verdict: {result.status.value}. {_sentence(result.note)}"
    return replace(explanation, scales=scales, verdict=verdict)


def explain_icp(
    source: npt.ArrayLike = WORKED_SOURCE,
    target: npt.ArrayLike = WORKED_TARGET,
    *,
    T_init: npt.ArrayLike | None = None,
    config: IcpConfig | None = None,
) -> IcpExplanation:
    """Explain point-to-point ICP of small sets (N, D), (M, D); the worked example when no points are given.

    Raises
    ------
    InvalidInputError
        When there are no points or more than ``MOST_POINTS``, or the method is not plain point-to-point.
    """
    a, b = _small(source, "source"), _small(target, "target")
    settings = config or IcpConfig(method="point-to-point")
    if settings.method != "point-to-point" or settings.scale != "none" or settings.kernel not in ("auto", "none"):
        raise InvalidInputError("only point-to-point ICP without scale and kernel can be explained step by step")
    result = icp(a, b, T_init=T_init, config=settings, keep_history=True)
    steps = []
    for step in result.history:
        moved = se3.transform_points(se3.inverse(step.T_before), b)
        rows = np.stack([step.pairs.source, step.pairs.target], axis=1)
        steps.append(
            IcpStepExplanation(
                target=moved,
                distances_m=np.linalg.norm(a[:, None] - moved[None], axis=2),
                pairs=rows,
                horn=_horn(a[rows[:, 0]], moved[rows[:, 1]], step.fit),
                T_step=se3.inverse(step.T_before) @ step.T_after,
                T_total=step.T_after,
                displacement_m=step.displacement_m,
            )
        )
    return IcpExplanation(a, b, tuple(steps), result, _verdict(a, b, result))


def _small(points: npt.ArrayLike, name: str) -> Float64:
    array = as_points(points, name)
    if not 1 <= len(array) <= MOST_POINTS:
        raise InvalidInputError(f"{name}: only 1 to {MOST_POINTS} points can be explained, got {len(array)}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name}: has values that are not finite; drop those rows first")
    return array


def _horn(a: Float64, b: Float64, fit: HornFit) -> HornExplanation:
    terms = np.einsum("ni,nj->nij", b - fit.mean_target, a - fit.mean_source)
    return HornExplanation(a, b, fit, terms, {}, "")


def _verdict(a: Float64, b: Float64, result: RegistrationResult) -> str:
    """Say what the run is worth, and what would help."""
    turned = f"turned by {_n(_angle_deg(result.T_target_source))} deg"
    if not result.history:
        return f"Verdict: {result.status.value}. {_sentence(result.note)}"
    pairs = result.history[-1].pairs
    words = [
        f"Verdict: {result.status.value} after {result.num_iterations} step{'s' * (result.num_iterations != 1)}; "
        f"{turned}, rmse {_n(result.rmse_m)} m."
    ]
    last = result.history[-1].T_after
    if not np.allclose(last, result.T_target_source, rtol=0, atol=1e-9 * max(1.0, float(np.abs(last).max()))):
        words.append(
            f"The steps ended at {_n(_angle_deg(last))} deg and t = {_vector(last[:-1, -1])}; along the free "
            "directions the motion was then put back to the first guess, because the data does not hold it there."
        )
    if pairs.num_targets < len(pairs):
        left = len(b) - pairs.num_targets
        words.append(
            _sentence(
                f"{_count(len(pairs))} sources share {_count(pairs.num_targets)} targets, "
                f"{_count(left)} of the target's points {'is' if left == 1 else 'are'} left out"
            )
        )
    words += [_sentence(part) for part in result.note.split("; ") if part and " share " not in part]
    if len(a) == len(b):
        paired = align_closed_form(a, b)
        if paired.status.success and paired.rmse_m < _NOT_WORSE * result.rmse_m:
            words.append(
                f"Were row i of the source the partner of row i of the target, Horn's method would turn by "
                f"{_n(_angle_deg(paired.T_target_source))} deg and leave {_n(paired.rmse_m)} m: "
                "this is a wrong local minimum."
            )
    if not result.status.success:
        words.append(
            "What would help: a first guess nearer to the truth (--init), known pairs "
            "(--method closed-form), or more points, so that neighbours are closer together than the "
            "clouds are apart."
        )
    return " ".join(words)


def _count(number: int) -> str:
    names = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    return names[number] if number < len(names) else str(number)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _angle_deg(T: Float64) -> float:
    """Rotation angle of a transform; signed in the plane."""
    if len(T) == 3:
        return float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    return float(np.degrees(se3.rotation_angle_rad(T))) if len(T) == 4 else float("nan")


def _n(value: float) -> str:
    """A number as people write it: four decimals, or four digits where that says nothing."""
    rounded = round(float(value), 4) + 0.0
    return f"{rounded:.4f}" if value == 0 or 1e-3 <= abs(value) < 1e6 or abs(value) < 1e-12 else f"{value:.3e}"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 78, initial_indent="  ", subsequent_indent="  ")


def _fit_lines(fit: HornFit, a: Float64, b: Float64, terms: Float64) -> list[str]:
    dimension = len(fit.mean_source)
    lines = [f"  mean(a) = {_vector(fit.mean_source)}", f"  mean(b) = {_vector(fit.mean_target)}", ""]
    heads = "".join(f"{head:>10}" for head in ("a_i", "b_i", "a'", "b'"))
    lines.append(f"    i {heads}   W_i = b' a'^T")
    for i in range(min(len(a), _ROWS)):
        for row in range(dimension):
            name = str(i + 1) if row == 0 else ""
            values = (
                a[i, row],
                b[i, row],
                a[i, row] - fit.mean_source[row],
                b[i, row] - fit.mean_target[row],
            )
            cells = "".join(f"{_n(v):>10}" for v in values)
            lines.append(f"  {name:>3} {cells} " + "".join(f"{_n(v):>10}" for v in terms[i, row]))
    if len(a) > _ROWS:
        lines.append(f"      and {len(a) - _ROWS} more")
    lines += ["", *_side_by_side({"W = sum W_i = U S V^T": fit.W, "U": fit.U})]
    lines += ["", *_side_by_side({"S": np.diag(fit.singular_values), "V^T": fit.Vt})]
    held = "the rotation is determined" if not fit.free_planes else "the rotation is free, and R = I on the free part"
    lines += ["", f"  rank {fit.rank} of {dimension}: {held}"]
    lines += [
        "",
        *_side_by_side({"R = U D V^T": fit.rotation, "t = mean(b) - s R mean(a)": fit.translation_m[:, None]}),
    ]
    if fit.scale == 1:
        traced = (fit.source_spread + fit.target_spread - fit.error) / 2
        lines += [
            "",
            "  E = sum|a'|^2 + sum|b'|^2 - 2 trace(D S)",
            f"    = {_n(fit.source_spread)} + {_n(fit.target_spread)} - 2 * {_n(traced)} = {_n(fit.error)}",
        ]
    else:
        lines += ["", f"  E = sum|b - s R a - t|^2 = {_n(fit.error)}"]
    return lines


def _vector(values: Float64) -> str:
    return "(" + ", ".join(_n(v) for v in values) + ")"


def _side_by_side(matrices: dict[str, Float64]) -> list[str]:
    blocks = []
    for name, matrix in matrices.items():
        rows = ["".join(f"{_n(v):>10}" for v in row) for row in matrix]
        width = max(len(name) + 2, *(len(row) for row in rows))
        blocks.append([("  " + name).ljust(width), *(row.ljust(width) for row in rows)])
    return ["  " + "    ".join(parts).rstrip() for parts in zip(*blocks, strict=True)]


def _distance_lines(distances: Float64, pairs: Int64) -> list[str]:
    chosen = {(int(i), int(j)) for i, j in pairs}
    rows, columns = min(len(distances), _ROWS), min(distances.shape[1], _COLUMNS)
    lines = ["      " + "".join(f"{'b' + str(j + 1):>8} " for j in range(columns)).rstrip()]
    for i in range(rows):
        cells = (f"{distances[i, j]:>8.3f}{'*' if (i, j) in chosen else ' '}" for j in range(columns))
        lines.append(f"  {'a' + str(i + 1):>4}{''.join(cells)}".rstrip())
    if rows < len(distances) or columns < distances.shape[1]:
        lines.append(f"      (the first {rows} x {columns} of {len(distances)} x {distances.shape[1]})")
    return lines
