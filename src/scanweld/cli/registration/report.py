"""What `scanweld register` says about a result: as JSON, as text, and as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanweld.geometry.point_cloud import PointCloud
    from scanweld.registration.explain import HornExplanation, IcpExplanation
    from scanweld.registration.result import RegistrationResult


def figures(result: RegistrationResult, method: str, seconds: float) -> dict[str, Any]:
    """Return the result as `--json` prints it."""
    return {
        "status": result.status.value,
        "T_target_source": result.T_target_source.tolist(),
        "scale": result.scale,
        "scale_std": result.scale_std,
        "rmse_m": result.rmse_m,
        "overlap": result.overlap,
        "num_inliers": result.num_inliers,
        "num_iterations": result.num_iterations,
        "information": result.information.tolist(),
        "covariance": None if result.covariance is None else result.covariance.tolist(),
        "unobservable": [direction.words for direction in result.unobservable],
        "method": method,
        "note": result.note,
        "seconds": seconds,
    }


def text(
    result: RegistrationResult, method: str, seconds: float, source: PointCloud, plot: Path | None, out: Path | None
) -> str:
    """Return the result as lines for a person."""
    from scanweld.registration.pictures import VERDICTS

    answered = result.status.has_pose
    matrix = ["  ".join(f"{value + 0.0:12.6f}" for value in row) for row in result.T_target_source.round(9)]
    # The free directions have their own rows, so the part of the note that lists them is left out.
    free = [direction.words for direction in result.unobservable]
    parts = [part for part in result.note.split("; ") if not free or not all(words in part for words in free)]
    scale = f"{result.scale:.6g}" + (f" +- {result.scale_std:.2g}" if result.scale_std > 0 else "")
    rows = [
        ("status", VERDICTS[result.status]),
        ("", "; ".join(parts)),
        *(("left free" if k == 0 else "", words) for k, words in enumerate(free)),
        ("method", f"{method}, {_counted(result.num_iterations, 'iteration')}, {seconds:.3f} s"),
        *(("" if k else "T_target_source", row) for k, row in enumerate(matrix if answered else ())),
        ("scale", scale if result.scale != 1 else ""),
        ("uncertainty", _uncertainty(result, source)),
        ("rmse", "" if not answered else f"{result.rmse_m:.4g} m over {_counted(result.num_inliers, 'pair')}"),
        ("overlap", f"{result.overlap:.1%} of the source"),
        ("aligned source", "" if out is None else str(out)),
        ("plot", "" if plot is None else str(plot)),
    ]
    return "\n".join(f"{name:<16} {value}".rstrip() for name, value in rows if value)


def write_files(
    out: Path | None,
    plot: Path | None,
    clouds: tuple[PointCloud, PointCloud],
    result: RegistrationResult,
    steps: HornExplanation | IcpExplanation | None,
) -> None:
    """Write the picture and the aligned source, each complete or not at all."""
    if plot is not None:
        from scanweld.registration.explain import HornExplanation
        from scanweld.registration.pictures import draw_alignment, draw_horn, draw_icp

        if steps is None:
            draw_alignment(plot, *clouds, result)
        elif isinstance(steps, HornExplanation):
            draw_horn(plot, steps)
        else:
            draw_icp(plot, steps)
    if out is not None:
        from scanweld.io.point_files import write_points

        write_points(out, clouds[0].transformed(result.T_target_source, result.scale))


def _uncertainty(result: RegistrationResult, source: PointCloud) -> str:
    """Standard deviations at the source's centre, where they mean most."""
    if result.covariance is None or not result.status.success:
        return ""
    import numpy as np

    from scanweld.registration.uncertainty import point_covariances

    center = source.finite().points_m.mean(axis=0)
    place = float(np.sqrt(np.trace(point_covariances(result, center[None])[0])))
    turn = float(np.degrees(np.sqrt(np.trace(result.covariance[source.dimension :, source.dimension :]))))
    return f"{place:.2g} m and {turn:.2g} deg (one sigma, at the source's centre)"


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
