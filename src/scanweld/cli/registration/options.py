"""From the options of `scanweld register` to settings; what can be refused is refused before any work."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from scanweld.arrays import Float64
    from scanweld.geometry.point_cloud import PointCloud
    from scanweld.registration.global_registration import GlobalConfig
    from scanweld.registration.icp import IcpConfig


class Method(StrEnum):
    """How to align."""

    POINT_TO_POINT = "point-to-point"
    POINT_TO_PLANE = "point-to-plane"
    SYMMETRIC = "symmetric"
    GICP = "gicp"
    COLOURED = "coloured"
    CLOSED_FORM = "closed-form"


@dataclass(frozen=True)
class Settings:
    """What the options come to.

    Attributes
    ----------
    method : of the result
    icp : of the local method
    search : of the global search, or None
    refined : whether the answer of the search is refined by the local method as set, not as the search would by itself
    """

    method: Method
    icp: IcpConfig
    search: GlobalConfig | None
    refined: bool


def settings(
    method: Method | None,
    *,
    scale: bool,
    explain: bool,
    use_global: bool,
    voxel: float | None,
    max_distance: float | None,
    overrides: list[str],
) -> Settings:
    """Return the settings: defaults < `--set` < options.

    `--explain` changes the default method to point-to-point, the one that is followed on paper; `--global` to GICP, as
    the search itself refines, which then trusts where it starts. A scale is the one that the method minimises:
    symmetric with point-to-point, least squares with the others.
    """
    from scanweld.config import from_mapping, merge, parse_override
    from scanweld.registration.icp import IcpConfig

    check_positive("--voxel", voxel, most=math.nextafter(math.inf, 0))
    check_positive("--max-distance", max_distance, most=math.inf)
    values: dict[str, Any] = {}
    for text in overrides:
        values = merge(values, parse_override(text))
    search = None
    if use_global:
        from scanweld.registration.global_registration import GlobalConfig

        search = from_mapping(GlobalConfig, values.pop("global", {}), "--set", "global.")
    chosen = {} if method in (None, Method.CLOSED_FORM) else {"method": method.value}
    given = {"voxel_m": voxel, "max_correspondence_distance_m": max_distance}
    values |= chosen | {name: value for name, value in given.items() if value is not None}
    refined = use_global and bool(values)
    if use_global:
        values = {"method": Method.GICP.value, "min_overlap": 0.0, "attempts": 0} | values
    elif explain:
        values.setdefault("method", Method.POINT_TO_POINT.value)
    if scale and values.get("scale", "none") == "none":
        values["scale"] = "symmetric" if values.get("method") == Method.POINT_TO_POINT else "least_squares"
    icp = from_mapping(IcpConfig, values, "--set")
    return Settings(method or Method(icp.method), icp, search, refined)


def check_combination(
    method: Method | None,
    *,
    use_global: bool,
    explain: bool,
    init: Path | None,
    voxel: float | None,
    max_distance: float | None,
    overrides: list[str],
) -> None:
    """Refuse options that contradict each other."""
    if method is Method.CLOSED_FORM:
        given = [name for name, value in (("--init", init), ("--voxel", voxel), ("--max-distance", max_distance),
                                          ("--set", overrides or None)) if value is not None]  # fmt: skip
        if given or use_global:
            raise typer.BadParameter(
                f"closed-form pairs row i with row i: it takes no {given[0] if given else '--global'}"
            )
    if use_global and init is not None:
        raise typer.BadParameter("--global needs no first guess: leave out --init, or --global")
    if use_global and explain:
        raise typer.BadParameter("--explain shows the steps of a local method: leave out --global")


def check_positive(option: str, value: float | None, most: float) -> None:
    """Refuse what is no length."""
    if value is not None and not 0 < value <= most:
        raise typer.BadParameter(f"{option}: expected a positive number of metres, got {value:g}")


def check_outputs(out: Path | None, plot: Path | None, inputs: tuple[Path | None, ...]) -> None:
    """Raise OutputError before any work when an output would replace an input, or cannot be written."""
    if out is None and plot is None:
        return
    from scanweld.cli.outputs import check_file
    from scanweld.errors import OutputError
    from scanweld.io.point_files import FORMATS as POINT_FORMATS
    from scanweld.registration.pictures import FORMATS as PICTURES

    writable = tuple(ending for ending, known in POINT_FORMATS.items() if known.write is not None)
    for option, path, endings in (("--out", out, writable), ("--plot", plot, PICTURES)):
        if path is None:
            continue
        if any(file is not None and file.exists() and path.exists() and path.samefile(file) for file in inputs):
            raise OutputError(
                f"{option} {path}: is one of the inputs, which are never overwritten; choose another name"
            )
        check_file(option, path, endings)
    if out is not None and out.suffix.lower() in (".las", ".laz"):
        _check_laspy()


def _check_laspy() -> None:
    from importlib.util import find_spec

    from scanweld.errors import MissingDependencyError

    if find_spec("laspy") is None:
        raise MissingDependencyError("laspy", "las")


def check_explained(chosen: Settings) -> None:
    """Refuse settings whose steps the tables do not show."""
    from scanweld.errors import InvalidInputError
    from scanweld.registration.explain import check_explainable

    if chosen.method is Method.CLOSED_FORM:
        return
    try:
        check_explainable(replace(chosen.icp, voxel_m=0.0))  # the points are thinned before
    except InvalidInputError as error:
        raise InvalidInputError(f"--explain: {error}") from None


def check_clouds(
    clouds: tuple[PointCloud, PointCloud], files: tuple[Path, Path], method: Method, *, explain: bool
) -> None:
    """Refuse clouds that do not go together, or not with the method."""
    from scanweld.errors import InvalidInputError
    from scanweld.registration.explain import MOST_POINTS

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
    for cloud, file in zip(clouds, files, strict=True):
        if method is Method.COLOURED and cloud.colors is None:
            raise InvalidInputError(f"{file}: has no colours, which --method coloured needs; try point-to-plane")
        if explain and not 1 <= len(cloud) <= MOST_POINTS:
            raise InvalidInputError(f"{file}: --explain takes 1 to {MOST_POINTS} points, got {len(cloud)}")


def read_init(file: Path, dimension: int) -> Float64:
    """Read the first guess of the motion."""
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
