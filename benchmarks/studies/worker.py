"""One registration system in a process of its own: reads requests from stdin, one JSON object a line, and answers so.

    python worker.py scanweld|small_gicp|open3d

It runs in the system's own Python and imports nothing but NumPy and that system. Clouds come as .npy files of (N, 3)
and are kept, so that a request's time holds no reading. Every system gets the same request and does the whole job from
raw points: thinning, normals or covariances, search structure, alignment.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

Answer = dict[str, Any]
NORMAL_NEIGHBOURS = {"small_gicp": 10, "open3d": 20}
"""small_gicp's own number; Open3D's default of 30 would only make it slower."""


class Scanweld:
    """The package itself, at its defaults."""

    candidates = ("point-to-point", "point-to-plane", "symmetric", "gicp")

    def __init__(self, threads: int) -> None:
        import scanweld as sw

        sw.set_num_threads(threads)
        self.sw, self.version = sw, metadata.version("scanweld")
        self.methods = [method for method in self.candidates if self._has(method)]
        if hasattr(sw, "register_global"):
            self.methods.append("global")

    def _has(self, method: str) -> bool:
        try:
            self.sw.IcpConfig(method=method)
        except self.sw.ConfigError:
            return False
        return True

    def icp(self, source: np.ndarray, target: np.ndarray, request: Answer) -> Answer:
        sw = self.sw
        clouds = [sw.PointCloud(points) for points in (source, target)]
        if request["voxel_m"] > 0:
            clouds = [sw.voxel_downsample(cloud, request["voxel_m"]) for cloud in clouds]
        config = sw.IcpConfig(method=request["method"], max_correspondence_distance_m=request["gate_m"])
        return self._answer(sw.icp(*clouds, T_init=request["T_init"], config=config))

    def global_pose(self, source: np.ndarray, target: np.ndarray, request: Answer) -> Answer:
        return self._answer(self.sw.register_global(source, target, **request.get("options", {})))

    @staticmethod
    def _answer(result: Any) -> Answer:
        return {
            "T_target_source": result.T_target_source.tolist(),
            "claimed": result.status.value == "converged",
            "status": result.status.value,
            "iterations": result.num_iterations,
        }


class SmallGicp:
    """small_gicp through its Python functions."""

    methods = ("point-to-point", "point-to-plane", "gicp")

    def __init__(self, threads: int) -> None:
        import small_gicp

        self.sg, self.threads = small_gicp, threads
        self.version = metadata.version("small_gicp")

    def icp(self, source: np.ndarray, target: np.ndarray, request: Answer) -> Answer:
        kind, sg = ("ICP", "PLANE_ICP", "GICP")[self.methods.index(request["method"])], self.sg
        options = {
            "init_T_target_source": np.asarray(request["T_init"]),
            "registration_type": kind,
            "max_correspondence_distance": request["gate_m"],
            "num_threads": self.threads,
            "max_iterations": request.get("max_iterations") or 20,
        }
        if request["voxel_m"] > 0:
            result = sg.align(target, source, downsampling_resolution=request["voxel_m"], **options)
        else:
            clouds = [sg.PointCloud(target), sg.PointCloud(source)]
            tree = sg.KdTree(clouds[0], num_threads=self.threads)
            counts = {"num_neighbors": NORMAL_NEIGHBOURS["small_gicp"], "num_threads": self.threads}
            if kind == "PLANE_ICP":
                sg.estimate_normals(clouds[0], tree, **counts)
            elif kind == "GICP":
                sg.estimate_covariances(clouds[0], tree, **counts)
                sg.estimate_covariances(clouds[1], sg.KdTree(clouds[1], num_threads=self.threads), **counts)
            result = sg.align(clouds[0], clouds[1], tree, **options)
        return {
            "T_target_source": result.T_target_source.tolist(),
            "claimed": bool(result.converged),
            "status": "converged" if result.converged else "not converged",
            "iterations": int(result.iterations),
        }


class Open3d:
    """Open3D's registration pipelines. They have no flag: an answer counts as claimed by its fitness."""

    methods = ("point-to-point", "point-to-plane", "gicp", "global")
    claimed_fitness = 0.3

    def __init__(self, threads: int) -> None:
        import open3d as o3d

        o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
        self.o3d, self.reg = o3d, o3d.pipelines.registration
        self.version = o3d.__version__

    def icp(self, source: np.ndarray, target: np.ndarray, request: Answer) -> Answer:
        clouds = [self._cloud(points, request["voxel_m"]) for points in (source, target)]
        reg, method = self.reg, request["method"]
        if method == "point-to-plane":
            self._normals(clouds[1])
        criteria = reg.ICPConvergenceCriteria()
        if request.get("max_iterations"):
            criteria.max_iteration = request["max_iterations"]
        align, estimation = {
            "point-to-point": (reg.registration_icp, reg.TransformationEstimationPointToPoint),
            "point-to-plane": (reg.registration_icp, reg.TransformationEstimationPointToPlane),
            "gicp": (reg.registration_generalized_icp, reg.TransformationEstimationForGeneralizedICP),
        }[method]
        result = align(*clouds, request["gate_m"], np.asarray(request["T_init"]), estimation(), criteria)
        return self._answer(result)

    def global_pose(self, source: np.ndarray, target: np.ndarray, request: Answer) -> Answer:
        """FPFH and RANSAC, then point-to-plane, with the radii of Open3D's own tutorial."""
        o3d, reg, voxel = self.o3d, self.reg, request["voxel_m"]
        o3d.utility.random.seed(0)
        clouds = [self._cloud(points, voxel) for points in (source, target)]
        features = []
        for cloud in clouds:
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
            search = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
            features.append(reg.compute_fpfh_feature(cloud, search))
        gate = 1.5 * voxel
        checks = [
            reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            reg.CorrespondenceCheckerBasedOnDistance(gate),
        ]
        found = reg.registration_ransac_based_on_feature_matching(
            *clouds, *features, True, gate, reg.TransformationEstimationPointToPoint(False), 3, checks,
            reg.RANSACConvergenceCriteria(100000, 0.999),
        )  # fmt: skip
        plane = reg.TransformationEstimationPointToPlane()
        result = reg.registration_icp(*clouds, gate, found.transformation, plane)
        return self._answer(result, request.get("claimed_fitness", self.claimed_fitness))

    def _cloud(self, points: np.ndarray, voxel_m: float) -> Any:
        cloud = self.o3d.geometry.PointCloud(self.o3d.utility.Vector3dVector(points))
        return cloud.voxel_down_sample(voxel_m) if voxel_m > 0 else cloud

    def _normals(self, cloud: Any) -> None:
        cloud.estimate_normals(self.o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS["open3d"]))

    def _answer(self, result: Any, claimed_fitness: float = claimed_fitness) -> Answer:
        return {
            "T_target_source": np.asarray(result.transformation).tolist(),
            "claimed": result.fitness >= claimed_fitness,
            "status": f"fitness {result.fitness:.2f}",
            "iterations": None,
        }


SYSTEMS: dict[str, Callable[[int], Any]] = {"scanweld": Scanweld, "small_gicp": SmallGicp, "open3d": Open3d}


@lru_cache(maxsize=64)
def load(path: str) -> np.ndarray:
    """Read a cloud once."""
    return np.ascontiguousarray(np.load(path), dtype=np.float64)


def memory_mb(field: str) -> float:
    """Return VmRSS (now) or VmHWM (peak) of this process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) / 1024
    return float("nan")


def forget_peak() -> None:
    """Let VmHWM start again from what is in use."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def serve(system: Any, request: Answer) -> Answer:
    """Answer one request; the clock runs from raw arrays to the transform."""
    if request["do"] == "about":
        return {"version": system.version, "methods": list(system.methods)}
    if request["do"] == "forget":
        load.cache_clear()
        return {}
    source, target = load(request["source"]), load(request["target"])
    before_mb = memory_mb("VmRSS")
    forget_peak()
    run = system.global_pose if request["do"] == "global" else system.icp
    start = time.perf_counter()
    answer: Answer = run(source, target, request)
    answer["seconds"] = time.perf_counter() - start
    return answer | {"before_mb": before_mb, "peak_mb": memory_mb("VmHWM")}


def main() -> None:
    """Serve until stdin ends."""
    # Libraries print to stdout as they please: the answers have a channel of their own.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    system = SYSTEMS[sys.argv[1]](int(sys.argv[2]))
    for line in sys.stdin:
        try:
            answer = serve(system, json.loads(line))
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
