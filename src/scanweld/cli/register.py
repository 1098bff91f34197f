"""`scanweld register`: align two point sets."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanweld.cli.registration.options import Method
from scanweld.cli.sequence_options import SET_FORM

if TYPE_CHECKING:
    from scanweld.arrays import Float64
    from scanweld.geometry.point_cloud import PointCloud
    from scanweld.registration.explain import HornExplanation, IcpExplanation
    from scanweld.registration.icp import IcpConfig

Option = typer.Option


def register(
    source: Annotated[
        Path | None,
        typer.Argument(help="Points to move: PLY, PCD, XYZ, CSV, TXT, NPY, LAS, LAZ or E57.", show_default=False),
    ] = None,
    target: Annotated[Path | None, typer.Argument(help="Points to align to.", show_default=False)] = None,
    method: Annotated[
        Method | None,
        Option(
            help="closed-form pairs row i with row i. Default point-to-plane; with --explain point-to-point, with "
            "--global gicp.",
            show_default=False,
        ),
    ] = None,
    scale: Annotated[bool, Option("--scale", help="Estimate a scale, too.")] = False,
    init: Annotated[Path | None, Option(help="First guess of T_target_source, 4x4 (2-D: 3x3) numbers as text.")] = None,
    use_global: Annotated[
        bool, Option("--global", help="Find the motion without a first guess, from features of the surface (3-D).")
    ] = False,
    voxel: Annotated[
        float | None, Option(help="Average the points within cubes of this side, in metres, first.")
    ] = None,
    max_distance: Annotated[
        float | None,
        Option(
            help="Points further apart are no pair, in metres. Default: 10 times the target's median spacing "
            "(after --voxel), or a tenth of its median distance from its centre if that is more.",
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        Option(
            "--set",
            help="Set one value of IcpConfig, for example kernel=tukey, locks=planar or min_overlap=0.1.",
            callback=SET_FORM,
        ),
    ] = None,
    threads: Annotated[int | None, Option(min=1, help="Default: all cores. The result does not depend on it.")] = None,
    explain: Annotated[
        bool, Option("--explain", help="Print every step of a small set; without files, of the worked example.")
    ] = False,
    plot: Annotated[
        Path | None, Option(help="Draw before and after (with --explain every step): .png, .pdf or .svg.")
    ] = None,
    out: Annotated[Path | None, Option(help="Write the aligned source: .ply, .pcd, .xyz, .npy, .las, ...")] = None,
    json_output: Annotated[bool, Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Align SOURCE to TARGET and say what the answer is worth: x_target = scale R x_source + t.

    Exit code 3 says that there is no trustworthy answer, and the status why.
    """
    from scanweld.cli.registration import alignment, options, report

    overrides = overrides or []
    options.check_outputs(out, plot, inputs=(source, target, init))
    if source is None or target is None:
        if not explain or source is not None:
            raise typer.BadParameter("SOURCE and TARGET are needed (only --explain works without files)")
        odd = (scale, use_global, overrides, method not in (None, Method.POINT_TO_POINT))
        if any(odd) or any(v is not None for v in (init, voxel, max_distance, out)):
            raise typer.BadParameter("without SOURCE and TARGET, --explain takes --plot and --json only")
        return _explain_worked_example(plot, json_output)
    options.check_combination(
        method, use_global=use_global, explain=explain, init=init, voxel=voxel, max_distance=max_distance,
        overrides=overrides,
    )  # fmt: skip
    settings = options.settings(
        method, scale=scale, explain=explain, use_global=use_global, voxel=voxel, max_distance=max_distance,
        overrides=overrides,
    )  # fmt: skip
    if explain:
        options.check_explained(settings)

    from scanweld.io.point_files import read_points

    files, clouds = (source, target), (read_points(source), read_points(target))
    T_init = None if init is None else options.read_init(init, clouds[0].dimension)
    used, icp_settings = clouds, settings.icp
    if explain and icp_settings.voxel_m > 0:  # the tables are those of the thinned points
        used = alignment.thinned(clouds, icp_settings.voxel_m)
        icp_settings = replace(icp_settings, voxel_m=0.0)
    options.check_clouds(used, files, settings.method, explain=explain)
    if settings.search is not None:
        aligner = alignment.global_aligner(icp_settings, settings.search, refined=settings.refined, threads=threads)
    elif settings.method is Method.CLOSED_FORM:
        aligner = alignment.closed_form_aligner(scale)
    else:
        aligner = alignment.local_aligner(icp_settings, T_init, threads)
    result, seconds = alignment.run_timed(aligner, *used)
    steps = _explained(*used, settings.method, icp_settings, scale, T_init) if explain else None
    report.write_files(out, plot, clouds, result, steps)
    if steps is not None:
        typer.echo(steps.text(), err=json_output)
    if json_output:
        typer.echo(json.dumps(report.figures(result, aligner.name, seconds)))
    else:
        typer.echo(report.text(result, aligner.name, seconds, clouds[0], plot, out))
    return 0 if result.status.success else 3


def _explain_worked_example(plot: Path | None, json_output: bool) -> int:
    from scanweld.cli.registration.report import figures
    from scanweld.registration.explain import explain_horn, explain_icp

    horn = explain_horn()
    explain_icp()  # loads the kernels
    started = time.perf_counter()
    steps = explain_icp()
    seconds = time.perf_counter() - started
    if plot is not None:
        from scanweld.registration.pictures import draw_icp

        draw_icp(plot, steps)
    text = f"1. The pairs are known\n\n{horn.text()}\n2. The pairs are unknown\n\n{steps.text()}"
    typer.echo(text, err=json_output)
    if json_output:
        typer.echo(json.dumps(figures(steps.result, "point-to-point", seconds)))
    return 0


def _explained(
    source: PointCloud,
    target: PointCloud,
    method: Method,
    settings: IcpConfig,
    scale: bool,
    T_init: Float64 | None,
) -> HornExplanation | IcpExplanation:
    """Return the steps of the method that gave the result."""
    from scanweld.cli.registration.alignment import with_options
    from scanweld.registration.explain import explain_horn, explain_icp

    source, target = source.finite(), target.finite()
    if method is Method.CLOSED_FORM:
        return explain_horn(source.points_m, target.points_m, scale="symmetric" if scale else "none")
    if method is Method.POINT_TO_POINT:
        source, target = replace(source, normals=None), replace(target, normals=None)
    steps = explain_icp(source, target, T_init=T_init, config=settings)
    return replace(steps, verdict=with_options(steps.verdict))
