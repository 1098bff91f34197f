"""Register point sets and build dense 3-D maps from RGB-D video.

The public names are loaded when they are first used, so that `import scanweld` is quick: Numba, OpenCV and SciPy
come with the first call that needs them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanweld.backends import set_backend
    from scanweld.checkup.examine import examine
    from scanweld.checkup.findings import Checkup, Finding
    from scanweld.config import from_mapping, to_toml
    from scanweld.datasets.base import RgbdSequence
    from scanweld.datasets.gyroscope import Gyroscope
    from scanweld.datasets.open import open_sequence
    from scanweld.datasets.stream import stream
    from scanweld.datasets.synthetic import RenderConfig, SyntheticSequence, render_sequence
    from scanweld.errors import (
        ConfigError,
        DatasetError,
        FileFormatError,
        InvalidInputError,
        MissingDependencyError,
        OutputError,
        ScanweldError,
        UnreadableFrameError,
    )
    from scanweld.evaluation.doubled_surfaces import doubled_surfaces
    from scanweld.evaluation.surface_metrics import (
        compression_ratio,
        depth_completeness,
        surface_accuracy,
        surface_completeness,
    )
    from scanweld.evaluation.trajectory_metrics import ate, rpe
    from scanweld.geometry import se3
    from scanweld.geometry.camera import PinholeCamera
    from scanweld.geometry.depth import SurfaceConfig, SurfacePyramid, build_pyramid
    from scanweld.geometry.foreign import as_cloud
    from scanweld.geometry.frame import Frame
    from scanweld.geometry.mesh import TriangleMesh
    from scanweld.geometry.normals import estimate_normals
    from scanweld.geometry.point_cloud import PointCloud, voxel_downsample
    from scanweld.geometry.views import MapCorrection, ModelView
    from scanweld.io.mesh_files import write_mesh
    from scanweld.io.ply import read_ply, write_ply
    from scanweld.io.point_files import read_points, write_points
    from scanweld.io.trajectory_files import read_trajectory, write_tum
    from scanweld.loop_closure.loop_closer import KeyframeLoopCloser, LoopClosingConfig, NoLoopCloser
    from scanweld.mapping.fusion import FusionConfig
    from scanweld.mapping.mapper import SurfelMapper
    from scanweld.mapping.merging import MergingConfig
    from scanweld.mapping.rendering import render_picture
    from scanweld.mapping.surfel_map import SurfelMap
    from scanweld.meshing.config import MeshConfig
    from scanweld.meshing.fuse import mesh_from_frames
    from scanweld.meshing.rendering import render_mesh
    from scanweld.parallel import set_num_threads
    from scanweld.refinement.calibration import DepthCorrection
    from scanweld.refinement.config import RefinementConfig
    from scanweld.refinement.refine import Refinement, RefinementStatus, refine_keyframes
    from scanweld.registration.closed_form import (
        ClosedFormBatch,
        align_closed_form,
        align_closed_form_batch,
        pair_residuals,
    )
    from scanweld.registration.explain import explain_horn, explain_icp
    from scanweld.registration.global_registration import GlobalConfig, register_global
    from scanweld.registration.icp import IcpConfig, icp
    from scanweld.registration.many import ManyConfig, ManyResult, ScanPair, register_many
    from scanweld.registration.pose_graph import PoseGraph, PoseGraphConfig, PoseGraphResult, edge_information
    from scanweld.registration.prior import MotionPrior
    from scanweld.registration.projective import ProjectiveConfig
    from scanweld.registration.result import RegistrationResult, Status
    from scanweld.registration.robust_pairs import RobustAlignment, align_pairs_robustly
    from scanweld.registration.uncertainty import point_covariances
    from scanweld.runs.fragments.run import run_fragments
    from scanweld.runs.mesh import mesh_run
    from scanweld.runs.run import RunSummary, run_sequence
    from scanweld.slam.config import SlamConfig
    from scanweld.slam.health import HealthConfig
    from scanweld.slam.submaps import SubmapConfig
    from scanweld.slam.system import Slam, build_slam
    from scanweld.tracking.dynamics import DynamicsConfig
    from scanweld.tracking.tracker import FrameToModelTracker, TrackingConfig
    from scanweld.tracking.two_frames import TwoFrameConfig, align_frames
    from scanweld.trajectory import FrameResult, FrameState, Trajectory

_HOME = {
    "backends": ("set_backend",),
    "checkup.examine": ("examine",),
    "checkup.findings": ("Checkup", "Finding"),
    "config": ("from_mapping", "to_toml"),
    "datasets.base": ("RgbdSequence",),
    "datasets.open": ("open_sequence",),
    "datasets.stream": ("stream",),
    "datasets.synthetic": ("RenderConfig", "SyntheticSequence", "render_sequence"),
    "errors": (
        "ConfigError", "DatasetError", "FileFormatError", "InvalidInputError", "MissingDependencyError", "OutputError",
        "ScanweldError", "UnreadableFrameError",
    ),
    "evaluation.surface_metrics": (
        "compression_ratio", "depth_completeness", "surface_accuracy", "surface_completeness",
    ),
    "evaluation.trajectory_metrics": ("ate", "rpe"),
    "geometry": ("se3",),
    "geometry.camera": ("PinholeCamera",),
    "geometry.depth": ("SurfaceConfig", "SurfacePyramid", "build_pyramid"),
    "geometry.foreign": ("as_cloud",),
    "geometry.frame": ("Frame",),
    "geometry.normals": ("estimate_normals",),
    "geometry.point_cloud": ("PointCloud", "voxel_downsample"),
    "geometry.views": ("MapCorrection", "ModelView"),
    "io.ply": ("read_ply", "write_ply"),
    "io.point_files": ("read_points", "write_points"),
    "io.trajectory_files": ("read_trajectory", "write_tum"),
    "loop_closure.loop_closer": ("KeyframeLoopCloser", "LoopClosingConfig", "NoLoopCloser"),
    "mapping.fusion": ("FusionConfig",),
    "mapping.mapper": ("SurfelMapper",),
    "mapping.rendering": ("render_picture",),
    "mapping.surfel_map": ("SurfelMap",),
    "parallel": ("set_num_threads",),
    "registration.closed_form": (
        "ClosedFormBatch", "align_closed_form", "align_closed_form_batch", "pair_residuals",
    ),
    "registration.explain": ("explain_horn", "explain_icp"),
    "registration.icp": ("IcpConfig", "icp"),
    "registration.prior": ("MotionPrior",),
    "registration.projective": ("ProjectiveConfig",),
    "registration.result": ("RegistrationResult", "Status"),
    "registration.global_registration": ("GlobalConfig", "register_global"),
    "registration.many": ("ManyConfig", "ManyResult", "ScanPair", "register_many"),
    "registration.pose_graph": ("PoseGraph", "PoseGraphConfig", "PoseGraphResult", "edge_information"),
    "registration.robust_pairs": ("RobustAlignment", "align_pairs_robustly"),
    "registration.uncertainty": ("point_covariances",),
    "runs.fragments.run": ("run_fragments",),
    "runs.run": ("RunSummary", "run_sequence"),
    "slam.health": ("HealthConfig",),
    "slam.config": ("SlamConfig",),
    "slam.system": ("Slam", "build_slam"),
    "tracking.dynamics": ("DynamicsConfig",),
    "tracking.tracker": ("FrameToModelTracker", "TrackingConfig"),
    "tracking.two_frames": ("TwoFrameConfig", "align_frames"),
    "datasets.gyroscope": ("Gyroscope",),
    "evaluation.doubled_surfaces": ("doubled_surfaces",),
    "mapping.merging": ("MergingConfig",),
    "refinement.calibration": ("DepthCorrection",),
    "refinement.config": ("RefinementConfig",),
    "refinement.refine": ("Refinement", "RefinementStatus", "refine_keyframes"),
    "slam.submaps": ("SubmapConfig",),
    "geometry.mesh": ("TriangleMesh",),
    "io.mesh_files": ("write_mesh",),
    "runs.mesh": ("mesh_run",),
    "meshing.fuse": ("mesh_from_frames",),
    "meshing.config": ("MeshConfig",),
    "meshing.rendering": ("render_mesh",),
    "trajectory": ("FrameResult", "FrameState", "Trajectory"),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Checkup",
    "ClosedFormBatch",
    "ConfigError",
    "DatasetError",
    "DepthCorrection",
    "DynamicsConfig",
    "FileFormatError",
    "Finding",
    "Frame",
    "FrameResult",
    "FrameState",
    "FrameToModelTracker",
    "FusionConfig",
    "GlobalConfig",
    "Gyroscope",
    "HealthConfig",
    "IcpConfig",
    "InvalidInputError",
    "KeyframeLoopCloser",
    "LoopClosingConfig",
    "ManyConfig",
    "ManyResult",
    "MapCorrection",
    "MergingConfig",
    "MeshConfig",
    "MissingDependencyError",
    "ModelView",
    "MotionPrior",
    "NoLoopCloser",
    "OutputError",
    "PinholeCamera",
    "PointCloud",
    "PoseGraph",
    "PoseGraphConfig",
    "PoseGraphResult",
    "ProjectiveConfig",
    "Refinement",
    "RefinementConfig",
    "RefinementStatus",
    "RegistrationResult",
    "RenderConfig",
    "RgbdSequence",
    "RobustAlignment",
    "RunSummary",
    "ScanPair",
    "ScanweldError",
    "Slam",
    "SlamConfig",
    "Status",
    "SubmapConfig",
    "SurfaceConfig",
    "SurfacePyramid",
    "SurfelMap",
    "SurfelMapper",
    "SyntheticSequence",
    "TrackingConfig",
    "Trajectory",
    "TriangleMesh",
    "TwoFrameConfig",
    "UnreadableFrameError",
    "align_closed_form",
    "align_closed_form_batch",
    "align_frames",
    "align_pairs_robustly",
    "as_cloud",
    "ate",
    "build_pyramid",
    "build_slam",
    "compression_ratio",
    "depth_completeness",
    "doubled_surfaces",
    "edge_information",
    "estimate_normals",
    "examine",
    "explain_horn",
    "explain_icp",
    "from_mapping",
    "icp",
    "mesh_from_frames",
    "mesh_run",
    "open_sequence",
    "pair_residuals",
    "point_covariances",
    "read_ply",
    "read_points",
    "read_trajectory",
    "refine_keyframes",
    "register_global",
    "register_many",
    "render_mesh",
    "render_picture",
    "render_sequence",
    "rpe",
    "run_fragments",
    "run_sequence",
    "se3",
    "set_backend",
    "set_num_threads",
    "stream",
    "surface_accuracy",
    "surface_completeness",
    "to_toml",
    "voxel_downsample",
    "write_mesh",
    "write_ply",
    "write_points",
    "write_tum",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("scanweld")
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'scanweld' has no attribute {name!r}")
    # A submodule is itself the value; anything else is in its module.
    value = (
        import_module(f"scanweld.{module}.{name}")
        if name == "se3"
        else getattr(import_module(f"scanweld.{module}"), name)
    )
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
