"""ICP step by step, explained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.point_cloud import PointCloud, median_spacing
from scanweld.registration.closed_form import align_closed_form
from scanweld.registration.explain.example import WORKED_SOURCE, WORKED_TARGET, as_small_set
from scanweld.registration.explain.gauss_newton import ROWS_OF, GaussNewtonStepExplanation, explain_gauss_newton
from scanweld.registration.explain.horn import HornExplanation, correlation_terms, fit_lines
from scanweld.registration.explain.text import (
    angle_deg,
    count_text,
    distance_lines,
    number_text,
    pair_lines,
    sentence,
    side_by_side,
    vector_text,
    wrapped,
)
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.local.history import IcpStep
from scanweld.registration.local.problem import Problem, prepare_problem
from scanweld.registration.result import RegistrationResult

_NOT_WORSE = 0.5  # the row-by-row pairs point to a wrong minimum when their rmse is below this share of ICP's ...
_ELSEWHERE = 0.1  # ... and the two put a point so many spacings apart


@dataclass(frozen=True, slots=True)
class IcpStepExplanation:
    """One step of point-to-point ICP with the target moved towards the source, T = T_1 T_2 ... T_k.

    Attributes
    ----------
    target : (M, D), the target moved by the inverse of T_1 ... T_(k-1) [m]
    distances_m : (N, M), from every source point to every moved target point
    pairs : (P, 2), rows of source and target
    horn : the closed form of these pairs
    T_step, T_total : (D + 1, D + 1), T_k and T_1 ... T_k; the scale of T_k is that of `horn`
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
        lines += distance_lines(self.distances_m, self.pairs)
        lines += ["", *pair_lines(self.pairs), ""]
        lines += fit_lines(self.horn.fit, self.horn.source, self.horn.target, self.horn.terms)
        turn = f"turned by {number_text(angle_deg(self.T_step))} deg, {number_text(angle_deg(self.T_total))} deg in all"
        lines += ["", *side_by_side({f"T_1 .. T_{number}": self.T_total}), f"  {turn}"]
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class IcpExplanation:
    """ICP step by step.

    Attributes
    ----------
    method : as in :class:`~scanweld.registration.icp.IcpConfig`
    source, target : (N, D), (M, D) [m]
    steps : closed forms of point-to-point, or Gauss-Newton steps; the last one repeats the pairs of the one before and
        moves nothing, where the run settled
    result : what :func:`~scanweld.registration.icp.icp` returned
    verdict : what it is worth, and what would help, in words
    """

    method: str
    source: Float64
    target: Float64
    steps: tuple[IcpStepExplanation | GaussNewtonStepExplanation, ...]
    result: RegistrationResult
    verdict: str

    def text(self) -> str:
        """Return all of it as plain text, 80 columns wide."""
        n, d = self.source.shape
        lines = [f"ICP, {self.method}: {n} source and {len(self.target)} target points in {d}-D, pairs unknown."]
        if self.method == "point-to-point":
            lines.append("Each step moves the target towards the source by its inverse; T = T_1 T_2 ...")
        else:
            lines += [
                "Each step moves the source, p' = T a, by T <- exp(xi) T, xi = (rho, phi), with",
                "H xi = -g, H = sum w J^T J and g = sum w J^T r over the pairs;",
                f"{ROWS_OF[self.method]}{self._origin()}.",
            ]
        steps = [step.text(number) + "\n" for number, step in enumerate(self.steps, 1)]
        return "\n".join([*lines, "", *steps, *wrapped(self.verdict), ""])

    def _origin(self) -> str:
        first = self.steps[0] if self.steps else None
        if not isinstance(first, GaussNewtonStepExplanation):
            return ""
        return f";\ncoordinates are about the target's centre {vector_text(first.center_m)}"


def explain_icp(
    source: npt.ArrayLike | PointCloud = WORKED_SOURCE,
    target: npt.ArrayLike | PointCloud = WORKED_TARGET,
    *,
    T_init: npt.ArrayLike | None = None,
    config: IcpConfig | None = None,
) -> IcpExplanation:
    """Explain ICP of small sets (N, D), (M, D) or clouds; the worked example when no points are given.

    Parameters
    ----------
    T_init : as in :func:`~scanweld.registration.icp.icp`
    config : point-to-point when None

    Raises
    ------
    InvalidInputError
        When there are no points or more than ``MOST_POINTS``, or a setting changes the steps in a way that the tables
        do not show: Anderson acceleration, graduated kernels, a voxel; point-to-point with a robust kernel, the others
        with a scale.
    """
    settings = config or IcpConfig(method="point-to-point")
    check_explainable(settings)
    cloud_a, cloud_b = as_cloud(source, "source"), as_cloud(target, "target")
    a, b = as_small_set(cloud_a.points_m, "source"), as_small_set(cloud_b.points_m, "target")
    result = icp(cloud_a, cloud_b, T_init=T_init, config=settings, keep_history=True)
    steps: tuple[IcpStepExplanation | GaussNewtonStepExplanation, ...]
    if settings.method == "point-to-point":
        steps = tuple(_closed_form_step(a, b, step) for step in result.history)
    else:
        problem = prepare_problem(cloud_a, cloud_b, weights=None, T_init=T_init, prior=None, config=settings)
        steps = explain_gauss_newton(problem, settings, result.history) if isinstance(problem, Problem) else ()
    return IcpExplanation(settings.method, a, b, steps, result, _verdict(a, b, result))


def check_explainable(config: IcpConfig) -> None:
    """Raise InvalidInputError when a setting changes the steps in a way that the tables do not show."""
    plain = config.method == "point-to-point"
    for setting, odd in (
        ("anderson", config.anderson > 0),
        ("graduated", config.graduated),
        ("voxel_m", config.voxel_m > 0),
        ("scale", config.scale != "none" and not plain),
        ("kernel", config.kernel not in ("auto", "none") and plain),
    ):
        if odd:
            value = getattr(config, setting)
            raise InvalidInputError(f"{setting} = {value!r} with {config.method} cannot be explained step by step")


def _closed_form_step(a: Float64, b: Float64, step: IcpStep) -> IcpStepExplanation:
    assert step.fit is not None  # point-to-point has one
    moved = se3.transform_points(se3.inverse(step.T_before), b) / step.scale_before
    rows = np.stack([step.pairs.source, step.pairs.target], axis=1)
    partners = moved[rows[:, 1]]
    T_step = se3.inverse(step.T_before) @ step.T_after
    T_step[:-1, -1] /= step.scale_before
    return IcpStepExplanation(
        target=moved,
        distances_m=np.linalg.norm(a[:, None] - moved[None], axis=2),
        pairs=rows,
        horn=HornExplanation(
            a[rows[:, 0]], partners, step.fit, correlation_terms(a[rows[:, 0]], partners, step.fit), {}, ""
        ),
        T_step=T_step,
        T_total=step.T_after,
        displacement_m=step.displacement_m,
    )


def _verdict(a: Float64, b: Float64, result: RegistrationResult) -> str:
    """Say what the run is worth, and what would help."""
    turned = f"turned by {number_text(angle_deg(result.T_target_source))} deg"
    if not result.history:
        return f"Verdict: {result.status.value}. {sentence(result.note)}"
    pairs = result.history[-1].pairs
    scaled = f"scaled by {number_text(result.scale)}, " if result.scale != 1 else ""
    words = [
        f"Verdict: {result.status.value} after {result.num_iterations} step{'s' * (result.num_iterations != 1)}; "
        f"{scaled}{turned}, rmse {number_text(result.rmse_m)} m."
    ]
    last = result.history[-1].T_after
    if not np.allclose(last, result.T_target_source, rtol=0, atol=1e-9 * max(1.0, float(np.abs(last).max()))):
        words.append(
            f"The steps ended at {number_text(angle_deg(last))} deg and t = {vector_text(last[:-1, -1])}; along the "
            "free directions the motion was then put back to the first guess, because the data does not hold it there."
        )
    if pairs.num_targets < len(pairs):
        left = len(b) - pairs.num_targets
        words.append(
            sentence(
                f"{count_text(len(pairs))} sources share {count_text(pairs.num_targets)} targets, "
                f"{count_text(left)} of the target's points {'is' if left == 1 else 'are'} left out"
            )
        )
    words += [sentence(part) for part in result.note.split("; ") if part and " share " not in part]
    if len(a) == len(b) and result.scale == 1:
        paired = align_closed_form(a, b)
        apart = (se3.transform_points(T, a) for T in (paired.T_target_source, result.T_target_source))
        elsewhere = np.linalg.norm(np.subtract(*apart), axis=1).max() > _ELSEWHERE * median_spacing(b)
        if paired.status.success and elsewhere and paired.rmse_m < _NOT_WORSE * result.rmse_m:
            words.append(
                f"Were row i of the source the partner of row i of the target, Horn's method would turn by "
                f"{number_text(angle_deg(paired.T_target_source))} deg and leave {number_text(paired.rmse_m)} m: "
                "this is a wrong local minimum."
            )
    if not result.status.success:
        words.append(
            "What would help: a first guess nearer to the truth (--init), known pairs "
            "(--method closed-form), or more points, so that neighbours are closer together than the "
            "clouds are apart."
        )
    return " ".join(words)
