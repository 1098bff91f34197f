"""Draw the figures of docs/registration/ anew: every one is computed by the package, from scenes made here.

python docs/images/draw_registration.py [NAME ...]          # all of them without names
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image

import scanweld as sw
from scanweld.geometry import se3
from scanweld.registration.explain import WORKED_SOURCE, WORKED_TARGET
from scanweld.registration.prior import MotionPrior
from scanweld.registration.robust import Barron, GraduatedNonConvexity, robust_kernel

HERE = Path(__file__).parent / "registration"
LARGEST_BYTES = 150_000
SOURCE, TARGET, GREEN, PURPLE, SKY, YELLOW, INK = (
    "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#22303c",
)  # fmt: skip
METHODS = {"point-to-point": SOURCE, "point-to-plane": TARGET, "symmetric": GREEN, "gicp": PURPLE}


def closed_form(figure: Figure) -> None:
    """Pairs after the alignment, and how E depends on the angle."""
    left, right = figure.subplots(1, 2)
    result = sw.align_closed_form(WORKED_SOURCE, WORKED_TARGET)
    moved = se3.transform_points(result.T_target_source, WORKED_SOURCE)
    for a, b in zip(moved, WORKED_TARGET, strict=True):
        left.plot(*np.array([a, b]).T, color=INK, linewidth=1)
    left.plot(*WORKED_TARGET.T, "o", color=TARGET, label="target")
    left.plot(*moved.T, "D", color=SOURCE, label="source, moved")
    left.set(title="pairs after the alignment", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    left.legend()
    angles = np.linspace(-180, 180, 361)
    for points, partners, name, color in (
        (WORKED_SOURCE, WORKED_TARGET, "the five points", TARGET),
        (WORKED_SOURCE, WORKED_SOURCE.mean(axis=0) + 0 * WORKED_SOURCE, "all partners in one place", SOURCE),
    ):
        a, b = points - points.mean(axis=0), partners - partners.mean(axis=0)
        turned = [a @ np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for t in np.radians(angles)]
        right.plot(angles, [((b - p) ** 2).sum() for p in turned], color=color, label=name)
    right.set(title="error E over the angle", xlabel="angle [deg]", ylabel="E [m²]", ylim=(0, None))
    right.set_xticks(range(-180, 181, 90))
    right.legend()


def point_to_point(figure: Figure) -> None:
    """Two samples of one curve: partners are neighbours, not the same point."""
    left, right = figure.subplots(1, 2, width_ratios=[1.3, 1])
    x = np.linspace(0, 3, 13)
    target = np.column_stack([x, 0.3 * np.sin(2 * x)])
    source = np.column_stack([x + 0.09, 0.3 * np.sin(2 * (x + 0.09)) + 0.12])
    nearest = np.linalg.norm(source[:, None] - target[None], axis=2).argmin(axis=1)
    for i, j in enumerate(nearest):
        left.plot(*np.array([source[i], target[j]]).T, color=INK, linewidth=0.8)
    left.plot(*target.T, "o-", color=TARGET, label="target", linewidth=0.6)
    left.plot(*source.T, "D", color=SOURCE, label="source")
    left.set(title="nearest neighbours", xlabel="x [m]", ylabel="y [m]", aspect="equal", ylim=(-0.45, 0.9))
    left.legend(loc="upper right")
    _draw_convergence(right, ("point-to-point", "point-to-plane"))
    right.set_title("distance from the truth, step by step")


def point_to_plane(figure: Figure) -> None:
    """The residual is the part of the distance along the normal."""
    left, right = figure.subplots(1, 2)
    left.plot([-1.3, 1.6], [0, 0], color=TARGET, linewidth=2)
    left.plot(0, 0, "o", color=TARGET)
    left.plot(1.0, 0.7, "D", color=SOURCE)
    arrow = {"arrowstyle": "->", "color": INK}
    left.annotate("", (0, 0.9), (0, 0), arrowprops=arrow)
    left.plot([1, 0], [0.7, 0], color=INK, linewidth=1, linestyle=":")
    left.plot([1, 1], [0.7, 0], color=SOURCE, linewidth=2)
    for text, place in (
        ("q", (-0.12, -0.16)),
        ("n", (0.05, 0.8)),
        ("p'", (1.06, 0.72)),
        ("r = n·(p' - q)", (1.05, 0.3)),
    ):
        left.text(*place, text, color=INK)
    left.annotate("", (1.55, 0.7), (1.05, 0.7), arrowprops={"arrowstyle": "<->", "color": GREEN})
    left.text(1.02, 0.86, "free to slide", color=GREEN)
    left.set(title="one pair", xlim=(-1.4, 2.1), ylim=(-0.4, 1.2), aspect="equal")
    left.set_axis_off()
    _draw_convergence(right, tuple(METHODS))
    right.set_title("distance from the truth, step by step")


def symmetric(figure: Figure) -> None:
    """Two points of a circle: d is orthogonal to the sum of their normals, wherever they are."""
    left, right = figure.subplots(1, 2)
    angle = np.linspace(0.1, np.pi - 0.1, 100)
    left.plot(np.cos(angle), np.sin(angle), color=TARGET, linewidth=2)
    a, b = (np.array([np.cos(t), np.sin(t)]) for t in (0.75, 1.9))
    left.plot(*np.array([a, b]).T, color=INK, linewidth=1)
    left.text(*(0.5 * (a + b) - [0.05, 0.13]), "d", color=INK)
    middle = 0.5 * (a + b)
    for start, direction, color, text in (
        (b, b, TARGET, "n"),
        (a, a, SOURCE, "m"),
        (middle, 0.5 * (a + b), GREEN, "(n+m)/2"),
    ):
        end = start + 0.45 * direction
        left.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": color})
        left.text(*(end + [0.03, 0.03]), text, color=color)
    left.plot(*b, "o", color=TARGET)
    left.plot(*a, "D", color=SOURCE)
    left.set(title="(n + m) · d = 0 on every circle", aspect="equal", xlim=(-1.2, 1.5), ylim=(0, 1.6))
    left.set_axis_off()
    _draw_convergence(right, ("point-to-plane", "symmetric"))
    right.set_title("distance from the truth, step by step")


def gicp(figure: Figure) -> None:
    """Discs at the points of a corner, and what two of them make of a distance."""
    left, right = figure.subplots(1, 2)
    along = np.linspace(0.08, 1, 6)
    for points, flat, shift, color in (
        (np.column_stack([along, 0 * along]), (0.2, 0.035), 0.0, TARGET),
        (np.column_stack([0 * along, along]), (0.035, 0.2), 0.0, TARGET),
        (np.column_stack([along + 0.05, 0 * along + 0.1]), (0.2, 0.035), 8.0, SOURCE),
        (np.column_stack([0 * along + 0.12, along + 0.1]), (0.035, 0.2), 8.0, SOURCE),
    ):
        for point in points:
            left.add_patch(Ellipse(point, *flat, angle=shift, facecolor=color, alpha=0.5))
        left.plot(*points.T, ".", color=color)
    left.set(title="every point is a flat disc", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    offsets = np.linspace(-1, 1, 201)
    u, v = np.meshgrid(offsets, offsets)
    thickness, n, m = 1e-1, np.array([0.0, 1.0]), np.array([np.sin(0.5), np.cos(0.5)])
    for normals, color in (((n, n), TARGET), ((n, m), SOURCE)):
        discs = sum(np.eye(2) - (1 - thickness) * np.outer(w, w) for w in normals)
        metric = 2 * thickness * np.linalg.inv(discs)
        squares = metric[0, 0] * u * u + 2 * metric[0, 1] * u * v + metric[1, 1] * v * v
        right.contour(u, v, squares, levels=[0.05, 0.2, 0.45], colors=color, linewidths=1)
    right.plot([], [], color=TARGET, label="equal normals")
    right.plot([], [], color=SOURCE, label="normals 29° apart")
    right.set(
        title="distances p' - q of equal cost", xlabel="along the surface [m]", ylabel="across [m]", aspect="equal"
    )
    right.legend()


def coloured(figure: Figure) -> None:
    """A painted wall slid in itself."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (2, 3000, 2))
    clouds = []
    for flat in points:
        grey = 0.5 + 0.25 * np.sin(9 * flat[:, 0] + 3 * np.sin(5 * flat[:, 1])) + 0.2 * np.sin(11 * flat[:, 1])
        colors = np.clip(255 * np.column_stack([grey, 0.8 * grey + 0.1, 1 - grey]), 0, 255).astype(np.uint8)
        clouds.append(sw.PointCloud(np.column_stack([flat, 0.003 * rng.normal(size=len(flat))]), colors=colors))
    target, source = clouds[0], clouds[1].transformed(se3.exp([0.06, -0.04, 0, 0, 0, 0.05]))
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    plain = sw.icp(source, target)
    result = sw.icp(source, target, config=sw.IcpConfig(method="coloured"))
    titles = ["before", *(_verdict(name, r) for name, r in (("point-to-plane", plain), ("coloured", result)))]
    motions = [np.eye(4), plain.T_target_source, result.T_target_source]
    for panel, title, T in zip(panels, titles, motions, strict=True):
        moved = source.transformed(T)
        lower = target.points_m[:, 1] < 0.5
        panel.scatter(*target.points_m[lower, :2].T, s=4, c=target.colors[lower] / 255, linewidths=0)
        upper = moved.points_m[:, 1] >= 0.5
        panel.scatter(*moved.points_m[upper, :2].T, s=4, c=moved.colors[upper] / 255, linewidths=0)
        panel.axhline(0.5, color=INK, linewidth=0.8)
        panel.set(title=title, xlabel="x [m]", aspect="equal")
    panels[0].set_ylabel("y [m]; source above, target below the line")


def similarity(figure: Figure) -> None:
    """The scale that each method finds, where the scans share all and where they share two thirds."""
    panels = figure.subplots(1, 2, sharey=True)
    truths = np.array([0.9, 0.95, 1.0, 1.05, 1.1])
    for panel, share in zip(panels, (1.0, 0.67), strict=True):
        target = _room(5000, 1)
        source = _room(5000, 2)
        low, high = np.quantile(source[:, 0], (0, share)), np.quantile(target[:, 0], (1 - share, 1))
        source, target_part = source[source[:, 0] <= low[1]], target[target[:, 0] >= high[0] - 1e-9]
        for (method, kind), color, mark in (
            (("point-to-point", "symmetric"), SOURCE, "D"),
            (("point-to-plane", "least_squares"), TARGET, "o"),
        ):
            found = []
            for truth in truths:
                config = sw.IcpConfig(method=method, scale=kind)
                center = source.mean(axis=0)
                found.append(sw.icp((source - center) / truth + center, target_part, config=config))
            for result, truth in zip(found, truths, strict=True):
                fill = color if result.status.success else "none"
                panel.plot(truth, 100 * (result.scale / truth - 1), mark, color=color, markerfacecolor=fill)
            panel.plot([], [], mark, color=color, label=f"{method}, {kind.replace('_', ' ')}")
        panel.axhline(0, color=INK, linewidth=0.8)
        panel.set(title=f"{share:.0%} of the room shared", xlabel="true scale")
    panels[0].plot([], [], "o", color=INK, markerfacecolor="none", label="hollow: status not CONVERGED")
    panels[0].set_ylabel("error of the scale [%]")
    panels[0].legend()


def robust(figure: Figure) -> None:
    """Losses and weights of all kernels, with their standard constants."""
    left, right = figure.subplots(1, 2)
    u = np.linspace(-8, 8, 801)
    colors = [INK, SOURCE, TARGET, GREEN, PURPLE, SKY, YELLOW]
    names = ["none", "huber", "cauchy", "geman_mcclure", "tukey", "welsch", "barron"]
    for name, color in zip(names, colors, strict=True):
        kernel = robust_kernel(name)
        label = f"{name} (alpha {Barron().alpha:g})" if name == "barron" else name
        style = "--" if name == "barron" else "-"
        left.plot(u, kernel.loss(u), style, color=color, label=label)
        right.plot(u, kernel.weight(u), style, color=color)
    left.set(title="loss", xlabel="residual / noise", ylabel="ρ(u)", ylim=(0, 10))
    right.set(title="weight ρ'(u) / u", xlabel="residual / noise", ylim=(-0.03, 1.05))
    left.legend(fontsize=7, loc="upper center")


def graduated(figure: Figure) -> None:
    """The weights of graduated non-convexity, and a line through points most of which are wrong."""
    left, right = figure.subplots(1, 2)
    u = np.linspace(0, 12, 601)
    schedule = GraduatedNonConvexity("truncated").schedule(np.array([20.0]))
    shown = schedule[:: max(1, len(schedule) // 6)]
    for k, kernel in enumerate((*shown, schedule[-1])):
        share = k / len(shown)
        left.plot(u, kernel.weight(u), color=(0.84 * share, 0.37 * share + 0.2, 0.7 * (1 - share)))
    left.set(title=f"weights, {len(schedule)} kernels from wide to true", xlabel="residual / noise", ylabel="weight")
    rng = np.random.default_rng(3)
    offset = np.concatenate([rng.normal(0, 0.1, 60), rng.normal(2.5, 0.4, 45)])  # right ones about 0, wrong about 2.5
    right.hist(offset, bins=50, color="#c3ccd5")
    for name, color in (("huber", SOURCE), ("tukey", PURPLE)):
        right.axvline(_location(offset, [robust_kernel(name)] * 40), color=color, label=name)
    start = np.mean(offset)
    kernels = GraduatedNonConvexity("truncated").schedule((offset - start) / 0.1)
    right.axvline(_location(offset, [*kernels, *[kernels[-1]] * 5]), color=GREEN, label="graduated")
    right.axvline(start, color=INK, linestyle=":", label="mean, where all start")
    right.set(title="43 % wrong measurements of one length", xlabel="measured [m]", ylabel="count")
    right.legend()


def _location(values: np.ndarray, kernels: list[Any]) -> float:
    """Robust mean of values with noise 0.1, by one reweighted step with each kernel."""
    place = float(values.mean())
    for kernel in kernels:
        weights = kernel.weight((values - place) / 0.1)
        if weights.sum() > 0:
            place = float(weights @ values / weights.sum())
    return place


def correspondences(figure: Figure) -> None:
    """The same two curves paired in four ways; the source reaches beyond the target."""
    panels = figure.subplots(2, 2, sharex=True, sharey=True).flat
    x = np.linspace(0, 2, 12)
    target = np.column_stack([x, 0.25 * np.sin(2.2 * x)])
    x = np.linspace(0.15, 2.9, 24)
    source = np.column_stack([x, 0.25 * np.sin(2.2 * (x - 0.15)) + 0.28])
    for panel, (title, settings) in zip(
        panels,
        (
            ("nearest", {}),
            ("one-to-one", {"pairing": "one-to-one"}),
            ("mutual", {"pairing": "mutual"}),
            ("nearest, reject_boundary", {"reject_boundary": True}),
        ),
        strict=True,
    ):
        config = sw.IcpConfig(max_iterations=1, max_correspondence_distance_m=1, neighbours=4, **settings)
        step = sw.icp(source, target, config=config, keep_history=True).history[0]
        for i, j in zip(step.pairs.source, step.pairs.target, strict=True):
            panel.plot(*np.array([source[i], target[j]]).T, color=INK, linewidth=0.8)
        panel.plot(*target.T, "o", color=TARGET, markersize=5, label="target")
        panel.plot(*source.T, "D", color=SOURCE, markersize=4, label="source")
        panel.set(title=f"{title}: {len(step.pairs.source)} pairs", aspect="equal")
        panel.set_ylim(-0.4, 0.7)
    figure.axes[0].legend(loc="lower left")
    for panel in figure.axes[2:]:
        panel.set_xlabel("x [m]")


def priors(figure: Figure) -> None:
    """A corridor seen from above: what holds the motion along it."""
    rng = np.random.default_rng(0)

    def corridor() -> np.ndarray:
        points = rng.uniform(0, 1, (30_000, 3)) * [8, 2, 2.4]
        points[0::3, 1], points[1::3, 1], points[2::3, 2] = 0, 2, 0
        return points + 0.005 * rng.normal(size=points.shape)

    target = corridor()
    source = corridor() - [0.6, 0.25, 0]
    odometry = se3.exp([0.5, 0, 0, 0, 0, 0])
    prior = MotionPrior.from_deviations(odometry, translation_m=[0.05, np.inf, np.inf], rotation_rad=np.inf)
    results = {
        "ICP alone": sw.icp(source, target),
        "with a prior of 0.50 ± 0.05 m along x": sw.icp(source, target, prior=prior),
    }
    panels = figure.subplots(3, 1, sharex=True, sharey=True)
    titles = ["before", *(_verdict(name, result) for name, result in results.items())]
    motions = [np.eye(4), *(result.T_target_source for result in results.values())]
    for panel, title, T in zip(panels, titles, motions, strict=True):
        moved = se3.transform_points(T, source)
        for cloud, color, name in ((target, TARGET, "target"), (moved, SOURCE, "source")):
            wall = cloud[np.abs(cloud[:, 2] - 1.2) < 0.3]
            panel.plot(*wall[:, :2].T, ",", color=color)
            panel.plot([], [], "s", color=color, label=name)
            panel.axvline(cloud[:, 0].min(), color=color, linewidth=1)
        panel.set(title=title, ylabel="y [m]", aspect="equal")
    panels[0].legend(loc="center")
    panels[-1].set_xlabel("x [m]; the lines mark where the scans begin")


def laser_2d(figure: Figure) -> None:
    """Two scans of a room with boxes by a turning range finder."""
    rng = np.random.default_rng(1)
    truth = _plane_motion(0.35, -0.25, 0.22)
    target = _laser_scan(np.eye(3), rng)
    source = _laser_scan(truth, rng)
    result = sw.icp(source, target)
    error = se3.inverse(truth) @ result.T_target_source
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    turn = abs(np.degrees(np.arctan2(error[1, 0], error[0, 0])))
    after = f"{1000 * np.linalg.norm(error[:2, 2]):.1f} mm, {turn:.2f}° off"
    for panel, T, title in (
        (left, np.eye(3), "before"),
        (right, result.T_target_source, f"{result.status.value}, {after}"),
    ):
        panel.plot(*target.T, ".", color=TARGET, markersize=4, label="target")
        panel.plot(*se3.transform_points(T, source).T, ".", color=SOURCE, markersize=4, label="source")
        panel.set(title=title, xlabel="x [m]", aspect="equal")
    left.set_ylabel("y [m]")
    left.legend()


def schedule(figure: Figure) -> None:
    """Levels of one run, and how far starts may be with and without other attempts."""
    left, right = figure.subplots(1, 2)
    target, source = _room(6000, 1), _room(6000, 2)
    start = _about(source.mean(axis=0), np.radians(14), [0.25, -0.1, 0.1])
    for coarse, color in ((True, TARGET), (False, SOURCE)):
        config = sw.IcpConfig(coarse_to_fine=coarse, attempts=0)
        history = sw.icp(source, target, T_init=start, config=config, keep_history=True).history
        errors = [_apart(step.T_before, np.eye(4), source) for step in history]
        work = np.cumsum([0, *(len(step.pairs.source) for step in history)])[:-1] / 1000
        left.semilogy(
            work, errors, "o-", color=color, markersize=4, label="coarse to fine" if coarse else "all points at once"
        )
    left.set(title="distance from the truth", xlabel="pairs looked at so far [thousands]", ylabel="[m]")
    left.legend()
    angles = np.arange(0, 91, 15)
    for attempts, color in ((24, TARGET), (0, SOURCE)):
        shares = []
        for angle in angles:
            rng = np.random.default_rng(int(angle))
            solved = 0
            for _ in range(8):
                axis = rng.normal(size=3)
                T = _about(source.mean(axis=0), np.radians(angle) * axis / np.linalg.norm(axis), rng.normal(0, 0.15, 3))
                result = sw.icp(source, target, T_init=T, config=sw.IcpConfig(attempts=attempts))
                solved += result.status.success and _apart(result.T_target_source, np.eye(4), source) < 0.05
            shares.append(100 * solved / 8)
        right.plot(angles, shares, "o-", color=color, label=f"attempts = {attempts}")
    right.set(
        title="solved, of 8 starts around random axes", xlabel="initial angle [deg]", ylabel="[%]", ylim=(-5, 105)
    )
    right.set_xticks(angles)
    right.legend()


def anderson(figure: Figure) -> None:
    """Point-to-point with and without acceleration."""
    left, right = figure.subplots(1, 2, width_ratios=[1.4, 1])
    target, source = _blob(3000, 1), _blob(3000, 2)
    start = _about(np.zeros(3), [0.1, 0.2, 0.15], [0.1, 0.05, -0.05])
    counts = {}
    for depth, color in ((0, SOURCE), (5, TARGET)):
        config = sw.IcpConfig(
            method="point-to-point", anderson=depth, coarse_to_fine=False, tolerance=1e-6, max_iterations=200
        )
        result = sw.icp(source, target, T_init=start, config=config, keep_history=True)
        end = result.T_target_source
        errors = np.array([_apart(step.T_before, end, source) for step in result.history])
        left.semilogy(np.maximum(errors, 1e-9), color=color, label=f"anderson = {depth}")
        counts[str(depth)] = result.num_iterations
    left.set(title="distance from where it ends", xlabel="step", ylabel="[m]")
    left.legend()
    right.bar(list(counts), list(counts.values()), color=[SOURCE, TARGET], width=0.5)
    right.set(title="steps", xlabel="anderson")


def uncertainty(figure: Figure) -> None:
    """Two hundred estimates from fresh noise, and the ellipses that one of them predicts."""
    left, right = figure.subplots(1, 2)
    shape = _room(1500, 1, noise=0)
    rng = np.random.default_rng(0)
    found, covariance = [], None
    config = sw.IcpConfig(coarse_to_fine=False)
    for _ in range(200):
        source, target = (shape + 0.01 * rng.normal(size=shape.shape) for _ in range(2))
        result = sw.icp(source, target, config=config)
        found.append(se3.log(result.T_target_source))
        covariance = result.covariance if covariance is None else covariance
    estimates = np.array(found)
    for panel, pair, unit, names in (
        (left, [0, 2], 1e3, ("x [mm]", "z [mm]")),
        (right, [3, 5], np.degrees(1) * 1e3, ("turn about x [m°]", "turn about z [m°]")),
    ):
        panel.plot(*(unit * estimates[:, pair]).T, ".", color=TARGET, markersize=4)
        values, vectors = np.linalg.eigh(covariance[np.ix_(pair, pair)])
        for sigma in (1, 2, 3):
            axes = 2 * sigma * unit * np.sqrt(values)
            tilt = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
            panel.add_patch(Ellipse((0, 0), *axes, angle=tilt, fill=False, edgecolor=SOURCE))
        panel.set(xlabel=names[0], ylabel=names[1], aspect="equal")
    left.set_title("200 estimates; 1, 2, 3 sigma of the first")
    right.set_title("rotation")


def _draw_convergence(panel: Any, methods: tuple[str, ...]) -> None:
    target, source = _blob(3000, 1), _blob(3000, 2)
    start = _about(np.zeros(3), [0.1, 0.2, 0.15], [0.1, 0.05, -0.05])
    for method in methods:
        config = sw.IcpConfig(method=method, coarse_to_fine=False, attempts=0)
        result = sw.icp(source, target, T_init=start, config=config, keep_history=True)
        motions = [*(step.T_before for step in result.history), result.T_target_source]
        errors = [1000 * _apart(T, np.eye(4), source) for T in motions]
        panel.semilogy(errors, "o-", color=METHODS[method], markersize=3, label=method)
    panel.set(xlabel="step", ylabel="[mm]")
    panel.legend()


def _apart(one: np.ndarray, other: np.ndarray, points: np.ndarray) -> float:
    """Root mean square distance between the places where two motions put points."""
    difference = se3.transform_points(one, points) - se3.transform_points(other, points)
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def _about(center: np.ndarray, phi: Any, shift: Any) -> np.ndarray:
    """(4, 4) that turns about a centre by phi (3,), or by an angle about (1, 1, 1), and shifts."""
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3(np.broadcast_to(phi, 3) / (1 if np.size(phi) == 3 else np.sqrt(3)))
    T[:3, 3] = center - T[:3, :3] @ center + shift
    return T


def _plane_motion(x: float, y: float, angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), x], [np.sin(angle), np.cos(angle), y], [0, 0, 1]])


def _room(count: int, seed: int, noise: float = 0.005) -> np.ndarray:
    """Points on the floor and two walls of a 4 x 3 x 2.5 m room and on a column in it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (count, 3)) * [4, 3, 2.5]
    for axis in range(3):
        points[axis::4, axis] = 0
    angle = rng.uniform(0, 2 * np.pi, len(points[3::4]))
    points[3::4, :2] = np.column_stack([2.5 + 0.4 * np.cos(angle), 1.8 + 0.4 * np.sin(angle)])
    return points + noise * rng.normal(size=points.shape)


def _blob(count: int, seed: int) -> np.ndarray:
    """Points on a smooth body of about two metres."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    radius = 1 + 0.25 * np.sin(3 * u[:, 0]) * np.cos(4 * u[:, 1]) + 0.15 * np.sin(5 * u[:, 2])
    return u * radius[:, None] * [1, 0.8, 0.6] + 0.002 * rng.normal(size=u.shape)


def _laser_scan(T_world_sensor: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ranges to a room of 6 x 4 m with two boxes: (N, 2) in the sensor's frame, every half degree, 5 mm of noise."""
    boxes = [(-3, -2, 3, 2), (1.2, 0.6, 1.9, 1.2), (-1.6, -1.3, -1.0, -0.5)]
    edges = []
    for x0, y0, x1, y1 in boxes:
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)
        edges += [(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    angles = np.radians(np.arange(0, 360, 0.5))
    origin = T_world_sensor[:2, 2]
    points = []
    for angle in angles:
        direction = T_world_sensor[:2, :2] @ [np.cos(angle), np.sin(angle)]
        hits = []
        for a, b in edges:
            system = np.column_stack([direction, a - b])
            if abs(np.linalg.det(system)) > 1e-12:
                t, s = np.linalg.solve(system, a - origin)
                if t > 0 and 0 <= s <= 1:
                    hits.append(t)
        distance = min(hits) + 0.005 * rng.normal()
        points.append([distance * np.cos(angle), distance * np.sin(angle)])
    return np.array(points)


def _verdict(name: str, result: sw.RegistrationResult) -> str:
    return f"{name}: {result.status.value.replace('_', ' ')}"


FIGURES: dict[str, tuple[Callable[[Figure], None], tuple[float, float]]] = {
    "closed_form": (closed_form, (8.4, 3.4)),
    "point_to_point": (point_to_point, (8.4, 3.2)),
    "point_to_plane": (point_to_plane, (8.4, 3.4)),
    "symmetric": (symmetric, (8.4, 3.4)),
    "gicp": (gicp, (8.4, 3.8)),
    "coloured": (coloured, (8.8, 3.4)),
    "similarity": (similarity, (8.4, 3.4)),
    "robust": (robust, (8.4, 3.4)),
    "graduated": (graduated, (8.4, 3.4)),
    "correspondences": (correspondences, (8.4, 4.0)),
    "priors": (priors, (8.4, 6.2)),
    "laser_2d": (laser_2d, (8.4, 3.9)),
    "schedule": (schedule, (8.4, 3.4)),
    "anderson": (anderson, (8.4, 3.2)),
    "uncertainty": (uncertainty, (8.4, 4.2)),
}


def main(names: list[str]) -> None:
    """Draw the figures of these names."""
    HERE.mkdir(exist_ok=True)
    for name in names or FIGURES:
        draw, size = FIGURES[name]
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        for panel in figure.axes:
            panel.set_title(panel.get_title(), loc="left", fontsize=9, color=INK)
            panel.set_title("")
            panel.tick_params(labelsize=8)
            panel.xaxis.label.set_size(8)
            panel.yaxis.label.set_size(8)
            panel.spines[["top", "right"]].set_visible(False)
            if panel.get_legend() is not None:
                for text in panel.get_legend().get_texts():
                    text.set_size(7)
                panel.get_legend().set_frame_on(False)
        save(figure, HERE / f"{name}.png")


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of at most 256 colours."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    image = Image.open(buffer).convert("RGB")
    for colors in (256, 64, 32, 16):
        image.quantize(colors, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size < LARGEST_BYTES:
            break
    print(f"{path}: {image.width}x{image.height}, {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
