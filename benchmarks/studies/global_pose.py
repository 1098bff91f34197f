"""Registration with no initial guess: rendered pairs that share little or nothing, and a car's laser clouds."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import scanweld as sw
from rendered_pairs import motion_error, random_motion, rendered_pair, unrelated_pair
from scanweld.geometry import se3
from studies.report import percent, table
from studies.systems import Bench, Contender

CONTENDERS = (("scanweld", "global"), ("open3d", "global"))
OVERLAP, VOXEL_M, CAR_VOXEL_M = 0.3, 0.05, 0.3
PAIRS, UNRELATED, CAR_POSES = 100, 50, 10
PEER_EVERY = 4
"""RANSAC takes its time: the peer gets every fourth pair."""
SOLVED_M, SOLVED_DEG = 0.05, 2.0
CAR_SOLVED_M, CAR_SOLVED_DEG = 0.3, 3.0
"""The reference of the car's clouds is another library's result, not truth."""
CLAIMS = "Open3D has no flag: a fitness of 0.3 counts as a claim"
STEPS = ((0.02, 1.0), (SOLVED_M, SOLVED_DEG), (0.1, 3.0), (0.3, 15.0))


def run(bench: Bench, arguments: argparse.Namespace) -> dict[str, Any]:
    """Let every contender try every pair; a pair is solved when it is close to the truth and the system says so."""
    contenders = bench.contenders(CONTENDERS)
    pairs = arguments.pairs or (5 if arguments.quick else PAIRS)
    cases: list[dict[str, Any]] = []
    for seed in range(arguments.seed, arguments.seed + pairs):
        pair = rendered_pair(seed, OVERLAP, scene=arguments.scene)
        cases += attempt(bench, contenders, "rendered", seed, pair.source, pair.target, pair.T_target_source, VOXEL_M)
    for seed in range(arguments.seed, arguments.seed + max(1, pairs * UNRELATED // PAIRS)):
        source, target = unrelated_pair(seed)
        cases += attempt(bench, contenders, "unrelated", seed, source, target, None, VOXEL_M)
    cases += cars(bench, arguments, contenders)
    settings = {"overlap": OVERLAP, "voxel_m": VOXEL_M, "pairs": pairs, "solved": [SOLVED_M, SOLVED_DEG]}
    return {"settings": settings | {"scene": arguments.scene}, "cases": cases}


def cars(bench: Bench, arguments: argparse.Namespace, contenders: list[Contender]) -> list[dict[str, Any]]:
    """Two outdoor laser clouds, the source in random poses."""
    folder = arguments.data / "registration" / "car_clouds"
    if not folder.is_dir():
        bench.said.append(f"{folder} is missing: the car's clouds are left out")
        return []
    source, target = (sw.read_points(folder / f"car_cloud{k}.csv").points_m for k in (400, 401))
    T_reference = np.eye(4)
    T_reference[:3] = np.loadtxt(folder / "T_400_to_401_reference.txt")[:3]
    rng = np.random.default_rng([arguments.seed, 8])
    cases: list[dict[str, Any]] = []
    for k in range(2 if arguments.quick else CAR_POSES):
        T_moved = random_motion(rng, 20.0)
        moved = se3.transform_points(T_moved, source)
        T_true = T_reference @ se3.inverse(T_moved)
        cases += attempt(bench, contenders, "car clouds", k, moved, target, T_true, CAR_VOXEL_M)
    return cases


def attempt(
    bench: Bench,
    contenders: list[Contender],
    kind: str,
    seed: int,
    source: np.ndarray,
    target: np.ndarray,
    T_true: np.ndarray | None,
    voxel_m: float,
) -> list[dict[str, Any]]:
    """Give one pair to every contender."""
    request = {"source": bench.put(f"{kind}-{seed}-s", source), "target": bench.put(f"{kind}-{seed}-t", target)}
    cases = []
    for contender in contenders:
        if contender.system.name != "scanweld" and seed % PEER_EVERY:
            continue
        answer = contender.system.request(do="global", voxel_m=voxel_m, **request)
        error: tuple[float, float] | tuple[None, None] = (None, None)
        if T_true is not None:
            error = motion_error(np.array(answer["T_target_source"]), T_true, source.mean(axis=0))
        case = {"name": contender.name, "kind": kind, "seed": seed, "shift_m": error[0], "turn_deg": error[1]}
        cases.append(case | {key: answer[key] for key in ("claimed", "status", "seconds")})
        contender.system.request(do="forget")
    for path in request.values():
        bench.drop(path)
    return cases


def text(figures: dict[str, Any]) -> str:
    """Shares of each kind of pair."""
    names = list(dict.fromkeys(case["name"] for case in figures["cases"]))
    rows: list[list[str]] = []
    for kind in ("rendered", "car clouds", "unrelated"):
        for name in names:
            own = [c for c in figures["cases"] if c["name"] == name and c["kind"] == kind]
            if own:
                rows.append([kind, name, str(len(own)), *_shares(kind, own)])
    near = [f"< {100 * m:.0f} cm, {deg:.0f} deg" for m, deg in STEPS]
    columns = ["pairs", "system", "number", *near, "solved and said so", "wrong and claimed", "median cm", "deg", "s"]
    solved = f"within {SOLVED_M * 100:.0f} cm and {SOLVED_DEG:.0f} deg"
    car = f"{CAR_SOLVED_M * 100:.0f} cm and {CAR_SOLVED_DEG:.0f} deg of the reference"
    return table(columns, rows) + f"\n\nsolved: {solved}; car clouds: {car}; unrelated: every claim is wrong; {CLAIMS}"


def _shares(kind: str, cases: list[dict[str, Any]]) -> list[str]:
    claimed = np.array([case["claimed"] for case in cases])
    seconds = f"{np.median([case['seconds'] for case in cases]):.2f}"
    if kind == "unrelated":
        return ["-"] * (len(STEPS) + 1) + [percent(claimed.mean()), "-", "-", seconds]
    shift, turn = (np.array([case[key] for case in cases]) for key in ("shift_m", "turn_deg"))
    near = [percent(((shift < m) & (turn < deg)).mean()) for m, deg in STEPS]
    limits = (CAR_SOLVED_M, CAR_SOLVED_DEG) if kind == "car clouds" else (SOLVED_M, SOLVED_DEG)
    solved = (shift < limits[0]) & (turn < limits[1])
    right = solved if solved.any() else np.full(len(solved), True)  # the error of the solved, where there are any
    errors = [f"{100 * np.median(shift[right]):.2f}", f"{np.median(turn[right]):.3f}"]
    return [*near, percent((solved & claimed).mean()), percent((~solved & claimed).mean()), *errors, seconds]
