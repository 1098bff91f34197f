"""Pictures of alignments: before and after, and every step of ICP.

Matplotlib is loaded when one is drawn. The ending of the name chooses the format: .png, .pdf or .svg.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Float64, Int64
from scanweld.errors import OutputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.atomic import write_file
from scanweld.registration.explain import HornExplanation, IcpExplanation
from scanweld.registration.result import RegistrationResult, Status

# Vermilion and blue of Okabe and Ito, which people with any kind of colour blindness tell apart.
_SOURCE, _TARGET, _PAIR, _INK = "#d55e00", "#0072b2", "#9aa5b1", "#22303c"
_MOST_DRAWN = 30_000  # points of a cloud, in all panels of a row
_SLICED_FROM = 2000  # points; fewer are seen one by one
_SLICE = 0.03  # of the extent along the view: thin enough to show walls as lines

VERDICTS = {
    Status.CONVERGED: "converged",
    Status.MAX_ITERATIONS: "not converged within the allowed steps",
    Status.TOO_FEW_CORRESPONDENCES: "no answer: too few correspondences",
    Status.DEGENERATE: "degenerate: the data does not determine the whole motion",
    Status.NO_OVERLAP: "no answer: the sets do not overlap",
}
"""What a status means, in words."""

FORMATS = (".png", ".pdf", ".svg")
"""Endings of the pictures that can be written."""


def draw_alignment(
    path: str | os.PathLike[str], source: PointCloud, target: PointCloud, result: RegistrationResult
) -> None:
    """Draw source and target before and after the alignment, seen along the axis in which the target varies least.

    Large clouds in space get a second row: a thin slice, in which surfaces are lines and errors show.

    Raises
    ------
    OutputError
        When the file cannot be written, or its name has another ending than .png, .pdf or .svg.
    """
    moved = source.transformed(result.T_target_source, result.scale)
    view = _View(target.points_m)
    clouds = [cloud.finite().points_m for cloud in (target, source, moved)]
    rows, notes = [clouds], [view.words]
    if view.axis is not None and max(map(len, clouds)) > _SLICED_FROM:
        slab = view.slab(clouds[0], clouds[2])
        rows.append([cloud[view.within(cloud, slab)] for cloud in clouds])
        notes.append(view.slab_words(slab))
    # Before and after share their axes, so both must fit: all of the target and the source at either place.
    low, high = _limits(np.concatenate([view.flatten(_thinned(cloud, _MOST_DRAWN)) for cloud in clouds]))
    titles = [f"{moment}, {note}" for note in notes for moment in ("before", "after")]
    figure, axes = _panels(titles, low, high, columns=2)
    for row, (still, *places) in enumerate(rows):
        for axis, cloud in zip(axes[2 * row :], places, strict=False):
            _scatter(axis, view.flatten(_thinned(still, _MOST_DRAWN)), view.flatten(_thinned(cloud, _MOST_DRAWN)))
    figure.suptitle(_headline(result), x=0.01, ha="left", fontsize=12, color=_INK)
    _finish(path, figure, axes, view)


def _headline(result: RegistrationResult) -> str:
    scale = f", scale {result.scale:.4g}" if result.scale != 1 else ""
    figures = f"rmse {result.rmse_m:.3g} m, overlap {result.overlap:.0%}{scale}"
    return f"{VERDICTS[result.status].capitalize()} ({figures})"


def _scatter(axis: Any, target: Float64, source: Float64) -> None:
    """Draw two clouds so that neither hides the other."""
    points = np.concatenate([target, source])
    colors = np.repeat([_TARGET, _SOURCE], [len(target), len(source)])
    mixed = np.random.default_rng(0).permutation(len(points))
    size = float(np.clip(20_000 / max(len(points), 1), 0.4, 36))
    alpha = 0.8 if size > 2 else 0.55
    axis.scatter(*points[mixed].T, s=size, c=colors[mixed], alpha=alpha, linewidths=0, rasterized=True)
    for label, color in (("target", _TARGET), ("source", _SOURCE)):
        axis.scatter([], [], c=color, label=label)


def draw_horn(path: str | os.PathLike[str], explanation: HornExplanation) -> None:
    """Draw the pairs before and after Horn's method; lines join partners."""
    fit = explanation.fit
    moved = fit.scale * explanation.source @ fit.rotation.T + fit.translation_m
    view = _View(explanation.target)
    places = view.flatten(np.concatenate([explanation.source, explanation.target, moved]))
    figure, axes = _panels(("before", f"after Horn's method: E = {fit.error:.4g}"), *_limits(places))
    rows = np.stack([np.arange(len(moved))] * 2, axis=1)
    for axis, source in zip(axes, (explanation.source, moved), strict=True):
        _draw_pairs(axis, view, source, explanation.target, rows)
    _finish(path, figure, axes, view)


def draw_icp(path: str | os.PathLike[str], explanation: IcpExplanation, most: int = 8) -> None:
    """Draw the pairs of every step: the source moves, the target stays; the last panel is the end."""
    result, view = explanation.result, _View(explanation.target)
    extent = float(np.ptp(explanation.target, axis=0).max())
    settled = bool(result.history) and result.history[-1].displacement_m <= 1e-9 * extent
    steps = (result.history[:-1] if settled else result.history)[: most - 1]
    moved = [
        se3.transform_points(T, explanation.source) for T in (*(s.T_before for s in steps), result.T_target_source)
    ]
    rows = [np.stack([step.pairs.source, step.pairs.target], axis=1) for step in steps]
    rows.append(explanation.steps[-1].pairs if explanation.steps else np.zeros((0, 2), np.int64))
    titles = [f"step {k}: E = {step.fit.error:.4g}" for k, step in enumerate(steps, 1)]
    titles.append(f"the end: {result.status.value.replace('_', ' ')}, rmse {result.rmse_m:.3g} m")
    limits = _limits(view.flatten(np.concatenate([explanation.target, *moved])))
    figure, axes = _panels(titles, *limits)
    for axis, source, pairs in zip(axes, moved, rows, strict=True):
        _draw_pairs(axis, view, source, explanation.target, pairs)
    _finish(path, figure, axes, view)


class _View:
    """Looks at points along the axis in which they vary least; an axis, so that the ticks stay readable."""

    def __init__(self, points: Float64) -> None:
        finite = points[np.isfinite(points).all(axis=1)]
        dimension = points.shape[1]
        self.axis: int | None = None
        keep = [0, 1]
        if dimension == 3:
            self.axis = 2
            if len(finite) > 2:
                self.axis = int(np.abs(np.linalg.eigh(np.cov(finite.T))[1][:, 0]).argmax())
            keep = [k for k in range(3) if k != self.axis]
        self.keep = keep
        self.labels = (f"{'xyz'[keep[0]]} [m]", f"{'xyz'[keep[1]]} [m]")

    @property
    def words(self) -> str:
        """What is seen."""
        return "all points" if self.axis is None else f"all points, seen along {'xyz'[self.axis]}"

    def flatten(self, points: Float64) -> Float64:
        """Points as they are seen, (N, 2)."""
        return points[:, self.keep]

    def slab(self, target: Float64, moved: Float64) -> tuple[float, float]:
        """Bounds along the axis of the slice in which both clouds show most, floors and ceilings aside."""
        low, high = np.percentile(target[:, self.axis], [2, 98])
        left, right = np.percentile(self.flatten(target), [2, 98], axis=0)
        thickness = max(_SLICE * float((right - left).max()), 1e-12)
        starts = np.linspace(low, max(high - thickness, low), 16)
        both = np.array([self._shown(target, moved, (at, at + thickness), thickness) for at in starts])
        # A horizontal surface fills its slice and hides how the walls fit.
        surface = both > 2 * np.median(both[both > 0]) if (both > 0).any() else np.zeros(len(both), np.bool_)
        best = float(starts[np.where(surface, 0, both).argmax()])
        return best, best + thickness

    def within(self, points: Float64, slab: tuple[float, float]) -> npt.NDArray[np.bool_]:
        """Mask of the points within bounds along the axis."""
        heights = points[:, self.axis]
        return np.asarray((heights >= slab[0]) & (heights < slab[1]))

    def slab_words(self, slab: tuple[float, float]) -> str:
        """Where the slice is."""
        assert self.axis is not None
        return f"slice of {slab[1] - slab[0]:.2g} m at {'xyz'[self.axis]} = {sum(slab) / 2:.3g} m"

    def _shown(self, target: Float64, moved: Float64, slab: tuple[float, float], size: float) -> int:
        """Area that the slice shows of the cloud of which it shows less, in squares."""
        flat = (self.flatten(cloud[self.within(cloud, slab)]) for cloud in (target, moved))
        return min(len(np.unique(np.floor(points / size), axis=0)) for points in flat)


def _thinned(points: Float64, most: int) -> Float64:
    return points[:: max(1, -(-len(points) // most))]


def _limits(points: Float64) -> tuple[Float64, Float64]:
    """Corners of what is worth seeing: a few stray points do not shrink the rest."""
    if len(points) == 0:
        return np.zeros(2), np.ones(2)
    share = 1.0 if len(points) > 1000 else 0.0
    low, high = np.percentile(points, [share, 100 - share], axis=0)
    margin = 0.12 * max(float((high - low).max()), 1e-12)
    return low - margin, high + margin


def _panels(titles: Sequence[str], low: Float64, high: Float64, columns: int = 0) -> tuple[Any, list[Any]]:
    """Lay out one panel for each title, shaped like the view from corner `low` to corner `high`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(titles)
    columns = columns or (3 if count == 5 else min(count, 4))
    rows = -(-count // columns)
    width, height = (4.8 if columns == 2 else 3.9) * (high - low) / max(high - low)
    size = (max(width, 3.2) * columns + 0.7, max(height, 1.6) * rows + 0.6 * rows + 0.4)
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).flat)
    for axis in axes[count:]:
        axis.set_visible(False)
    for axis, title in zip(axes, titles, strict=False):
        axis.set_title(title, fontsize=10, color=_INK, loc="left")
        axis.set_aspect("equal", adjustable="box")
        axis.grid(color="#e6eaee", linewidth=0.8)
        axis.set_axisbelow(True)
        axis.tick_params(labelsize=8, colors=_INK, length=0)
        for side in axis.spines.values():
            side.set_visible(False)
    axes[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure, axes[:count]


def _draw_pairs(axis: Any, view: _View, source: Float64, target: Float64, rows: Int64) -> None:
    a, b = view.flatten(source), view.flatten(target)
    for i, j in rows:
        axis.plot(*np.stack([a[i], b[j]]).T, color=_PAIR, linewidth=1.2, zorder=1)
    axis.scatter(*b.T, s=64, c=_TARGET, zorder=2, label="target")
    axis.scatter(*a.T, s=64, c=_SOURCE, zorder=3, marker="D", label="source")
    if len(a) + len(b) <= 40:
        _name(axis, "a", a, _SOURCE, (5, -11))
        _name(axis, "b", b, _TARGET, (5, 5))


def _name(axis: Any, letter: str, points: Float64, color: str, offset: tuple[int, int]) -> None:
    for number, point in enumerate(points, 1):
        axis.annotate(
            f"${letter}_{{{number}}}$",
            point,
            xytext=offset,
            textcoords="offset points",
            fontsize=9,
            color=color,
        )


def _finish(path: str | os.PathLike[str], figure: Any, axes: Sequence[Any], view: _View) -> None:
    for axis in axes:
        axis.set_xlabel(view.labels[0], fontsize=8, color=_INK)
    axes[0].set_ylabel(view.labels[1], fontsize=8, color=_INK)
    legend = axes[0].legend(fontsize=8, frameon=False, loc="best", markerscale=1.0, labelcolor=_INK)
    for handle in legend.legend_handles:
        handle.set_sizes([36])
        handle.set_alpha(1.0)
    target = Path(path)
    if target.suffix.lower() not in FORMATS:
        raise OutputError(f"{target}: a picture's name must end in {' or '.join(FORMATS)}")
    picture = io.BytesIO()
    figure.savefig(picture, format=target.suffix[1:].lower(), facecolor="white")
    write_file(target, picture.getvalue())
