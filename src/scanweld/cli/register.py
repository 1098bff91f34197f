"""`scanweld register`: align two point sets."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from scanweld.arrays import Float64
    from scanweld.geometry.point_cloud import PointCloud
    from scanweld.registration.result import RegistrationResult


class Method(StrEnum):
    """How to align."""

    POINT_TO_POINT = "point-to-point"
    POINT_TO_PLANE = "point-to-plane"
    CLOSED_FORM = "closed-form"


_VERDICTS = {
    "converged": "converged",
    "max_iterations": "not converged within the allowed steps",
    "too_few_correspondences": "no answer: too few correspondences",
    "degenerate": "degenerate: the data does not determine the whole motion",
    "no_overlap": "no answer: the sets do not overlap",
}


def register(
    source: Annotated[
        Path | None, typer.Argument(help="Points to move: PLY, XYZ, CSV, TXT or NPY.", show_default=False)
    ] = None,
    target: Annotated[Path | None, typer.Argument(help="Points to align to.", show_default=False)] = None,
    method: Annotated[
        Method | None,
        typer.Option(
            help="closed-form pairs row i with row i. Default point-to-plane, with --scale point-to-point.",
            show_default=False,
        ),
    ] = None,
    scale: Annotated[bool, typer.Option("--scale", help="Estimate a (symmetric) scale, too.")] = False,
    init: Annotated[
        Path | None, typer.Option(help="First guess of T_target_source, 4x4 (2-D: 3x3) numbers as text.")
    ] = None,
    voxel: Annotated[
        float | None, typer.Option(help="Average the points within cubes of this side, in metres, first.")
    ] = None,
    max_distance: Annotated[
        float | None,
        typer.Option(
            help="Points further apart are no pair, in metres. Default: 10 times the target's median spacing "
            "(after --voxel), or a tenth of its median distance from its centre if that is more.",
            show_default=False,
        ),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Default: all cores. The result does not depend on it.")
    ] = None,
    explain: Annotated[
        bool,
        typer.Option("--explain", help="Print every step of a small set; without files, of the worked example."),
    ] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw before and after (with --explain every step), PNG.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the aligned source, PLY.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Align SOURCE to TARGET and say what the answer is worth: x_target = scale R x_source + t."""
    if source is None or target is None:
        if not explain or source is not None:
            raise typer.BadParameter("SOURCE and TARGET are needed (only --explain works without files)")
        return _explain_worked_example(plot)
    chosen = method or (Method.POINT_TO_POINT if scale else Method.POINT_TO_PLANE)
    if scale and chosen is Method.POINT_TO_PLANE:
        raise typer.BadParameter("--scale works with --method closed-form or point-to-point")
    if chosen is Method.CLOSED_FORM and (init or voxel or max_distance):
        raise typer.BadParameter("closed-form pairs row i with row i: it takes no --init, --voxel or --max-distance")

    from scanweld.io.point_files import read_points, read_transform

    source_cloud, target_cloud = read_points(source), read_points(target)
    _same_dimension(source_cloud, target_cloud, source, target)
    T_init = None if init is None else read_transform(init)
    result, seconds = _align(source_cloud, target_cloud, chosen, scale, T_init, voxel, max_distance, threads)
    if explain:
        _explain(source_cloud, target_cloud, chosen, scale, T_init, plot, to_stderr=json_output)
    elif plot is not None:
        from scanweld.registration.pictures import draw_alignment

        draw_alignment(plot, source_cloud, target_cloud, result)
    if out is not None:
        from scanweld.io.ply import write_ply

        write_ply(out, source_cloud.transformed(result.T_target_source, result.scale))
    typer.echo(json.dumps(_figures(result, seconds)) if json_output else _report(result, chosen, seconds, plot, out))
    return 0 if result.status.success else 3


def _align(
    source: PointCloud,
    target: PointCloud,
    method: Method,
    scale: bool,
    T_init: Float64 | None,
    voxel: float | None,
    max_distance: float | None,
    threads: int | None,
) -> tuple[RegistrationResult, float]:
    """Return the result and the seconds of preprocessing and alignment, imports not counted."""
    from scanweld.geometry.point_cloud import voxel_downsample
    from scanweld.registration.closed_form import align_closed_form
    from scanweld.registration.icp import IcpConfig, icp

    kind = "symmetric" if scale else "none"
    started = time.perf_counter()
    if method is Method.CLOSED_FORM:
        result = align_closed_form(source.points_m, target.points_m, scale=kind)
    else:
        if voxel is not None:
            source, target = voxel_downsample(source, voxel), voxel_downsample(target, voxel)
        config = IcpConfig(method=method.value, scale=kind)
        if max_distance is not None:
            config = replace(config, max_correspondence_distance_m=max_distance)
        result = icp(source, target, T_init=T_init, config=config, num_threads=threads)
    return result, time.perf_counter() - started


def _same_dimension(source: PointCloud, target: PointCloud, source_file: Path, target_file: Path) -> None:
    from scanweld.errors import InvalidInputError

    if source.dimension != target.dimension:
        raise InvalidInputError(
            f"{source_file} is {source.dimension}-D and {target_file} is {target.dimension}-D; "
            "both must have as many coordinates"
        )


def _explain_worked_example(plot: Path | None) -> int:
    from scanweld.registration.explain import explain_horn, explain_icp

    horn, steps = explain_horn(), explain_icp()
    typer.echo(f"1. The pairs are known\n\n{horn.text()}\n2. The pairs are unknown\n\n{steps.text()}")
    if plot is not None:
        from scanweld.registration.pictures import draw_icp

        draw_icp(plot, steps)
    return 0


def _explain(
    source: PointCloud,
    target: PointCloud,
    method: Method,
    scale: bool,
    T_init: Float64 | None,
    plot: Path | None,
    *,
    to_stderr: bool,
) -> None:
    """Print the steps; ICP is explained by its point-to-point variant, which is what fits on paper."""
    from scanweld.registration.explain import explain_horn, explain_icp
    from scanweld.registration.pictures import draw_horn, draw_icp

    if method is Method.CLOSED_FORM:
        horn = explain_horn(source.points_m, target.points_m, scale="symmetric" if scale else "none")
        typer.echo(horn.text(), err=to_stderr)
        if plot is not None:
            draw_horn(plot, horn)
        return
    steps = explain_icp(source.points_m, target.points_m, T_init=T_init)
    typer.echo(steps.text(), err=to_stderr)
    if plot is not None:
        draw_icp(plot, steps)


def _figures(result: RegistrationResult, seconds: float) -> dict[str, Any]:
    return {
        "status": result.status.value,
        "T_target_source": result.T_target_source.tolist(),
        "scale": result.scale,
        "rmse_m": result.rmse_m,
        "overlap": result.overlap,
        "num_inliers": result.num_inliers,
        "num_iterations": result.num_iterations,
        "information": result.information.tolist(),
        "unobservable": [direction.words for direction in result.unobservable],
        "note": result.note,
        "seconds": seconds,
    }


def _report(result: RegistrationResult, method: Method, seconds: float, plot: Path | None, out: Path | None) -> str:
    matrix = ["  ".join(f"{value + 0.0:12.6f}" for value in row) for row in result.T_target_source.round(9)]
    rows = [
        ("status", _VERDICTS[result.status.value]),
        ("", result.note),
        *(("left free" if k == 0 else "", direction.words) for k, direction in enumerate(result.unobservable)),
        ("method", f"{method.value}, {result.num_iterations} iterations, {seconds:.3f} s"),
        ("T_target_source", matrix[0]),
        *(("", row) for row in matrix[1:]),
        ("scale", f"{result.scale:.6g}" if result.scale != 1 else ""),
        ("rmse", f"{result.rmse_m:.4g} m over {result.num_inliers} pairs"),
        ("overlap", f"{result.overlap:.1%} of the source"),
        ("aligned source", "" if out is None else str(out)),
        ("plot", "" if plot is None else str(plot)),
    ]
    return "\n".join(f"{name:<16} {value}".rstrip() for name, value in rows if value)
