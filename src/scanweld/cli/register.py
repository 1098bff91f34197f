"""`scanweld register`: align two point sets."""

from __future__ import annotations

import json
import math
import tempfile
import time
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from scanweld.arrays import Float64
    from scanweld.geometry.point_cloud import PointCloud
    from scanweld.registration.explain import HornExplanation, IcpExplanation
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

_OPTIONS = {
    "raise max_correspondence_distance_m": "raise --max-distance",
    "raise max_iterations, or look at the initial guess": "start nearer with --init",
    "try point-to-point": "try --method point-to-point",
}
"""What a note of the API advises, and the option that does it."""


def register(
    source: Annotated[
        Path | None, typer.Argument(help="Points to move: PLY, XYZ, CSV, TXT or NPY.", show_default=False)
    ] = None,
    target: Annotated[Path | None, typer.Argument(help="Points to align to.", show_default=False)] = None,
    method: Annotated[
        Method | None,
        typer.Option(
            help="closed-form pairs row i with row i. Default point-to-plane, with --scale or --explain "
            "point-to-point.",
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
    plot: Annotated[
        Path | None, typer.Option(help="Draw before and after (with --explain every step): .png, .pdf or .svg.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the aligned source: .ply.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Align SOURCE to TARGET and say what the answer is worth: x_target = scale R x_source + t."""
    _check_outputs(out, plot, inputs=(source, target, init))
    if source is None or target is None:
        if not explain or source is not None:
            raise typer.BadParameter("SOURCE and TARGET are needed (only --explain works without files)")
        if scale or method is Method.POINT_TO_PLANE or any(v is not None for v in (init, voxel, max_distance, out)):
            raise typer.BadParameter("without SOURCE and TARGET, --explain takes --plot and --json only")
        return _explain_worked_example(plot, json_output)
    chosen = method or (Method.POINT_TO_POINT if scale or explain else Method.POINT_TO_PLANE)
    if scale and chosen is Method.POINT_TO_PLANE:
        raise typer.BadParameter("--scale works with --method closed-form or point-to-point")
    if chosen is Method.CLOSED_FORM and any(v is not None for v in (init, voxel, max_distance)):
        raise typer.BadParameter("closed-form pairs row i with row i: it takes no --init, --voxel or --max-distance")
    _check_positive("--voxel", voxel, most=math.nextafter(math.inf, 0))
    _check_positive("--max-distance", max_distance, most=math.inf)

    from scanweld.io.point_files import read_points

    files, clouds = (source, target), (read_points(source), read_points(target))
    _check_shapes(clouds, files, chosen)
    T_init = None if init is None else _read_init(init, clouds[0].dimension)
    started = time.perf_counter()
    used = clouds if voxel is None else (_thinned(clouds[0], voxel), _thinned(clouds[1], voxel))
    seconds = time.perf_counter() - started
    if explain:
        _check_explainable(used, files)
    result, seconds_aligning = _align(*used, chosen, scale, T_init, max_distance, threads)
    if explain:
        steps = _explained(*used, chosen, scale, T_init, max_distance)
        introduction = _introduction(chosen, scale)
        _write(out, plot, clouds, result, steps)
        typer.echo(introduction + steps.text(), err=json_output)
    else:
        _write(out, plot, clouds, result, None)
    seconds += seconds_aligning
    typer.echo(json.dumps(_figures(result, seconds)) if json_output else _report(result, chosen, seconds, plot, out))
    return 0 if result.status.success else 3


def _check_outputs(out: Path | None, plot: Path | None, inputs: tuple[Path | None, ...]) -> None:
    """Raise OutputError before any work when an output would replace an input, or cannot be written."""
    if out is None and plot is None:
        return
    from scanweld.errors import OutputError
    from scanweld.registration.pictures import FORMATS

    for option, path, endings in (("--out", out, (".ply",)), ("--plot", plot, FORMATS)):
        if path is None:
            continue
        if any(file is not None and file.exists() and path.exists() and path.samefile(file) for file in inputs):
            raise OutputError(
                f"{option} {path}: is one of the inputs, which are never overwritten; choose another name"
            )
        if path.suffix.lower() not in endings:
            got = f"got '{path.suffix}'" if path.suffix else "got a name without ending"
            raise OutputError(f"{option} {path}: the name must end in {' or '.join(endings)}, {got}")
        if path.is_dir():
            raise OutputError(f"{option} {path}: cannot be written: is a folder")
        try:
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise OutputError(f"{option} {path}: cannot be written: {path.parent}: {error.strerror or error}") from None


def _check_positive(option: str, value: float | None, most: float) -> None:
    from scanweld.errors import InvalidInputError

    if value is not None and not 0 < value <= most:
        raise InvalidInputError(f"{option}: expected a positive number of metres, got {value:g}")


def _check_shapes(clouds: tuple[PointCloud, PointCloud], files: tuple[Path, Path], method: Method) -> None:
    from scanweld.errors import InvalidInputError

    (source, target), (source_file, target_file) = clouds, files
    if source.dimension != target.dimension:
        raise InvalidInputError(
            f"{source_file} is {source.dimension}-D and {target_file} is {target.dimension}-D; "
            "both must have as many coordinates"
        )
    if method is Method.CLOSED_FORM and len(source) != len(target):
        raise InvalidInputError(
            f"{source_file} holds {len(source)} and {target_file} {len(target)} points, but --method closed-form "
            "pairs row i with row i; where the pairs are unknown use --method point-to-plane or point-to-point"
        )


def _check_explainable(clouds: tuple[PointCloud, PointCloud], files: tuple[Path, Path]) -> None:
    from scanweld.errors import InvalidInputError
    from scanweld.registration.explain import MOST_POINTS

    for cloud, file in zip(clouds, files, strict=True):
        if not 1 <= len(cloud) <= MOST_POINTS:
            raise InvalidInputError(f"{file}: --explain takes 1 to {MOST_POINTS} points, got {len(cloud)}")


def _read_init(file: Path, dimension: int) -> Float64:
    from scanweld.errors import FileFormatError
    from scanweld.io.point_files import read_transform

    try:
        T = read_transform(file)
    except FileFormatError as error:
        raise FileFormatError(f"--init {error}") from None
    size = dimension + 1
    if len(T) != size:
        raise FileFormatError(
            f"--init {file}: {dimension}-D points need a {size}x{size} transform, got {len(T)}x{len(T)}"
        )
    return T


def _thinned(cloud: PointCloud, voxel: float) -> PointCloud:
    from scanweld.errors import InvalidInputError
    from scanweld.geometry.point_cloud import voxel_downsample

    try:
        return voxel_downsample(cloud, voxel)
    except InvalidInputError as error:
        raise InvalidInputError(f"--{error}") from None  # its message starts with "voxel"


def _align(
    source: PointCloud,
    target: PointCloud,
    method: Method,
    scale: bool,
    T_init: Float64 | None,
    max_distance: float | None,
    threads: int | None,
) -> tuple[RegistrationResult, float]:
    """Return the result, its note in terms of the options, and the seconds of the alignment, imports not counted."""
    from scanweld.registration.closed_form import align_closed_form
    from scanweld.registration.icp import IcpConfig, icp

    kind = "symmetric" if scale else "none"
    started = time.perf_counter()
    if method is Method.CLOSED_FORM:
        result = align_closed_form(source.points_m, target.points_m, scale=kind)
    else:
        config = IcpConfig(method=method.value, scale=kind, max_correspondence_distance_m=max_distance or 0.0)
        # Without their normals: points are paired with points.
        points = (source.points_m, target.points_m) if method is Method.POINT_TO_POINT else (source, target)
        result = icp(*points, T_init=T_init, config=config, num_threads=threads)
    seconds = time.perf_counter() - started
    return replace(result, note=_with_options(result.note)), seconds


def _with_options(text: str) -> str:
    for words, option in _OPTIONS.items():
        text = text.replace(words, option)
    return text


def _explain_worked_example(plot: Path | None, json_output: bool) -> int:
    from scanweld.registration.explain import explain_horn, explain_icp

    horn = explain_horn()
    started = time.perf_counter()
    steps = explain_icp()
    seconds = time.perf_counter() - started
    if plot is not None:
        from scanweld.registration.pictures import draw_icp

        draw_icp(plot, steps)
    text = f"1. The pairs are known\n\n{horn.text()}\n2. The pairs are unknown\n\n{steps.text()}"
    typer.echo(text, err=json_output)
    if json_output:
        typer.echo(json.dumps(_figures(steps.result, seconds)))
    return 0


def _explained(
    source: PointCloud,
    target: PointCloud,
    method: Method,
    scale: bool,
    T_init: Float64 | None,
    max_distance: float | None,
) -> HornExplanation | IcpExplanation:
    """Return the steps; ICP is explained by its point-to-point variant, which is what fits on paper."""
    from scanweld.registration.explain import explain_horn, explain_icp
    from scanweld.registration.icp import IcpConfig

    if method is Method.CLOSED_FORM:
        return explain_horn(source.points_m, target.points_m, scale="symmetric" if scale else "none")
    config = IcpConfig(method="point-to-point", max_correspondence_distance_m=max_distance or 0.0)
    steps = explain_icp(source.finite().points_m, target.finite().points_m, T_init=T_init, config=config)
    return replace(steps, verdict=_with_options(steps.verdict))


def _introduction(method: Method, scale: bool) -> str:
    """Say in one line when the steps shown are not those of the result."""
    if method is Method.POINT_TO_PLANE:
        return "The steps shown are those of point-to-point, the result is that of point-to-plane.\n\n"
    if method is Method.POINT_TO_POINT and scale:
        return "The steps shown are those without a scale, the result is the one with it.\n\n"
    return ""


def _write(
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
        from scanweld.io.ply import write_ply

        write_ply(out, clouds[0].transformed(result.T_target_source, result.scale))


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
    # The free directions have their own rows, so the part of the note that lists them is left out.
    free = [direction.words for direction in result.unobservable]
    parts = [part for part in result.note.split("; ") if not free or not all(words in part for words in free)]
    note = "; ".join(parts)
    rows = [
        ("status", _VERDICTS[result.status.value]),
        ("", note),
        *(("left free" if k == 0 else "", words) for k, words in enumerate(free)),
        ("method", f"{method.value}, {_counted(result.num_iterations, 'iteration')}, {seconds:.3f} s"),
        ("T_target_source", matrix[0]),
        *(("", row) for row in matrix[1:]),
        ("scale", f"{result.scale:.6g}" if result.scale != 1 else ""),
        ("rmse", f"{result.rmse_m:.4g} m over {_counted(result.num_inliers, 'pair')}"),
        ("overlap", f"{result.overlap:.1%} of the source"),
        ("aligned source", "" if out is None else str(out)),
        ("plot", "" if plot is None else str(plot)),
    ]
    return "\n".join(f"{name:<16} {value}".rstrip() for name, value in rows if value)


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
