"""How far from the truth local methods may start: share of solved cases over a grid of initial errors.

Rendered scans of furnished rooms with Kinect noise, thinned once, the same points for every system. The source is
turned about its centroid around a random axis, and shifted in a random direction. Solved means close to the truth,
whatever the system says; confident and wrong means that it claims success and is not.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rendered_pairs import motion_error, random_offset, rendered_pair
from studies.report import percent, table
from studies.systems import Bench

CONTENDERS = (
    ("scanweld", "point-to-plane"),
    ("scanweld", "gicp"),
    ("small_gicp", "gicp"),
    ("open3d", "point-to-plane"),
)
OVERLAPS = (0.6, 0.75, 0.9)
ANGLES_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
SHIFTS_M = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
VOXEL_M = 0.05
GATE_M = 0.25
"""Of 0.25, 0.5 and 1 m the one with which both peers solve most."""
SOLVED = {"solved": (0.05, 2.0), "solved closely": (0.02, 1.0)}
"""Distance of the source's centroid from the truth [m], and rotation [deg]."""
PAIRS, MAX_ITERATIONS = 9, 100


def run(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """Start every contender from every cell of the grid, once for every pair and round."""
    contenders = bench.contenders(CONTENDERS)
    gate = arguments.gate or GATE_M
    pairs, rounds = arguments.pairs or (3 if arguments.quick else PAIRS), arguments.repeat or 1
    angles, shifts = (ANGLES_DEG[::3], SHIFTS_M[::2]) if arguments.quick else (ANGLES_DEG, SHIFTS_M)
    cases = []
    for k in range(pairs):
        seed = arguments.seed + k
        pair = rendered_pair(seed, OVERLAPS[k % len(OVERLAPS)], scene=arguments.scene, voxel_m=VOXEL_M, moved=False)
        center = pair.source.mean(axis=0)
        request: dict[str, Any] = {"source": bench.put(f"s{k}", pair.source), "target": bench.put(f"t{k}", pair.target)}
        request |= {"voxel_m": 0.0, "gate_m": gate, "max_iterations": MAX_ITERATIONS}
        rng = np.random.default_rng([seed, 7])
        for _, (i, angle), (j, shift) in itertools.product(range(rounds), enumerate(angles), enumerate(shifts)):
            request["T_init"] = random_offset(angle, shift, center, rng).tolist()
            for contender in contenders:
                answer = contender.system.request(do="icp", method=contender.method, **request)
                error = motion_error(np.array(answer["T_target_source"]), np.eye(4), center)
                case = {"name": contender.name, "pair": k, "cell": [i, j], "shift_m": error[0], "turn_deg": error[1]}
                cases.append(case | {key: answer[key] for key in ("claimed", "status", "seconds")})
    settings = {"voxel_m": VOXEL_M, "gate_m": gate, "pairs": pairs, "rounds": rounds, "overlaps": OVERLAPS}
    settings |= {"angles_deg": angles, "shifts_m": shifts, "solved": SOLVED, "scene": arguments.scene}
    return {"settings": settings, "grids": grids([c.name for c in contenders], cases, angles, shifts), "cases": cases}


def grids(
    names: list[str], cases: list[dict[str, Any]], angles: tuple[float, ...], shifts: tuple[float, ...]
) -> dict[str, Any]:
    """Per contender: share of solved and of confident wrong cases (angles, shifts), and the median time."""
    result = {}
    for name in names:
        own = [case for case in cases if case["name"] == name]
        cell = np.array([case["cell"] for case in own])
        claimed, shift, turn = (np.array([case[key] for case in own]) for key in ("claimed", "shift_m", "turn_deg"))
        near = {key: (shift < limit_m) & (turn < limit_deg) for key, (limit_m, limit_deg) in SOLVED.items()}
        hits = near | {"confident and wrong": claimed & ~near["solved"]}
        result[name] = {key: _shares(cell, hit, (len(angles), len(shifts))) for key, hit in hits.items()} | {
            "solved, but not claimed": float((~claimed & near["solved"]).mean()),
            "seconds": float(np.median([case["seconds"] for case in own])),
        }
    return result


def _shares(cell: np.ndarray, hits: np.ndarray, shape: tuple[int, int]) -> list[list[float]]:
    total, found = np.zeros(shape), np.zeros(shape)
    np.add.at(total, tuple(cell.T), 1)
    np.add.at(found, tuple(cell[hits].T), 1)
    shares: list[list[float]] = (found / total).tolist()
    return shares


def text(figures: dict[str, Any]) -> str:
    """Shares by rotation, by translation, and by the radius that holds both; then over all cells."""
    settings, found = figures["settings"], figures["grids"]
    angles, shifts = np.array(settings["angles_deg"]), np.array(settings["shifts_m"])
    radius = np.maximum(angles[:, None] / angles.max(), shifts[None] / shifts.max())
    rings: list[tuple[str, np.ndarray]] = [("all cells", np.full(radius.shape, True))]
    rings += [(f"{a:.0f} deg, any shift", np.repeat((angles == a)[:, None], len(shifts), axis=1)) for a in angles]
    rings += [(f"{s:.1f} m, any turn", np.repeat((shifts == s)[None], len(angles), axis=0)) for s in shifts]
    rings += [
        (f"up to {angles.max() * r:.0f} deg and {shifts.max() * r:.2g} m", radius <= r + 1e-9)
        for r in (1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6, 1.0)
    ]

    def section(key: str) -> str:
        rows = []
        for label, mask in rings:
            if mask.any():
                rows.append([label] + [percent(np.array(found[name][key])[mask].mean()) for name in found])
        return table([key, *found], rows)

    last = [
        ["solved, but not claimed"] + [percent(found[name]["solved, but not claimed"]) for name in found],
        ["median ms"] + [f"{found[name]['seconds'] * 1e3:.0f}" for name in found],
    ]
    cells = len(angles) * len(shifts) * settings["pairs"] * settings["rounds"]
    intro = (
        f"{settings['pairs']} pairs ({settings['scene']}), {cells} starts a method, gate {settings['gate_m']} m, "
        f"voxel {settings['voxel_m']} m; "
        + "; ".join(f"{key}: within {m * 100:.0f} cm and {deg:.0f} deg" for key, (m, deg) in SOLVED.items())
        + "; Open3D has no flag: a fitness of 0.3 counts as a claim"
    )
    return "\n\n".join([intro, *(section(key) for key in (*SOLVED, "confident and wrong")), table(["", *found], last)])


def draw(figures: dict[str, Any], path: Path) -> None:
    """Heat maps: solved above, confident and wrong below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(figures["grids"])
    angles, shifts = figures["settings"]["angles_deg"], figures["settings"]["shifts_m"]
    fig, axes = plt.subplots(
        2,
        len(names),
        figsize=(2.9 * len(names), 6.4),
        dpi=150,
        facecolor="white",
        squeeze=False,
        sharex=True,
        sharey=True,
    )
    kinds: tuple[tuple[str, str, str, Callable[[float], bool]], ...] = (
        ("solved", "solved", "YlGn", lambda share: share > 0.6),
        ("confident and wrong", "claims success, and is wrong", "OrRd", lambda share: share > 0.5),
    )
    for row, (key, title, colors, light) in zip(axes, kinds, strict=True):
        for ax, name in zip(row, names, strict=True):
            shares = np.array(figures["grids"][name][key])
            ax.imshow(shares, origin="lower", cmap=colors, vmin=0, vmax=1, aspect="auto")
            for (i, j), share in np.ndenumerate(shares):
                color = "white" if light(share) else "#333333"
                ax.text(j, i, f"{100 * share:.0f}", ha="center", va="center", fontsize=7.5, color=color)
            ax.set_xticks(range(len(shifts)), [f"{s:.1f}" for s in shifts])
            ax.set_yticks(range(len(angles)), [f"{a:.0f}" for a in angles])
            ax.tick_params(length=0)
            ax.spines[:].set_visible(False)
            ax.set_title(f"{name}\n{title}: {100 * shares.mean():.0f} %", fontsize=9)
        row[0].set_ylabel("initial rotation [deg]")
    for ax in axes[-1]:
        ax.set_xlabel("initial translation [m]")
    fig.suptitle("Share of starts [%]", fontsize=11)
    fig.tight_layout()
    fig.savefig(path)
    plt.close(fig)
