"""Poses in other conventions, and objects of other libraries: there and back."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import scanweld as sw
from scanweld.errors import InvalidInputError, MissingDependencyError
from scanweld.geometry import conventions, se3
from scanweld.geometry.mesh import TriangleMesh
from scanweld.interop.evo import from_evo, to_evo
from scanweld.interop.meshes import from_pyvista, from_trimesh, to_pyvista, to_trimesh
from scanweld.interop.open3d import from_open3d, to_open3d, trajectory_from_open3d, trajectory_to_open3d
from scanweld.io.trajectory_files import read_trajectory, write_kitti, write_redwood_log, write_tum

RNG = np.random.default_rng(5)
POSES = se3.exp(RNG.normal(size=(6, 6)))
TRAJECTORY = sw.Trajectory(np.arange(6) / 30, POSES)
CAMERA = sw.PinholeCamera(105.0, 104.0, 39.5, 29.25, 80, 60)
CLOUD = sw.PointCloud(RNG.normal(size=(20, 3)), RNG.normal(size=(20, 3)), RNG.integers(0, 256, (20, 3), dtype=np.uint8))
MESH = TriangleMesh(
    np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [0.25, 0.25, 2.125]], np.float32),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]),
    colors=np.array([[0, 255, 128], [10, 20, 30], [255, 255, 255], [1, 2, 3]], np.uint8),
).with_normals()
FRAME = sw.Frame(
    0.5,
    RNG.uniform(0, 3, CAMERA.shape).astype(np.float32),
    RNG.integers(0, 256, (*CAMERA.shape, 3), dtype=np.uint8),
    CAMERA,
)

PAIRS = {
    "opengl": (conventions.to_opengl, conventions.from_opengl),
    "opengl view": (conventions.to_opengl_view, conventions.from_opengl_view),
    "extrinsic": (conventions.to_extrinsic, conventions.from_extrinsic),
    "ros body": (conventions.to_ros_body, conventions.from_ros_body),
}


@pytest.mark.parametrize("name", PAIRS)
def test_conventions_there_and_back(name: str) -> None:
    there, back = PAIRS[name]
    assert back(there(POSES)) == pytest.approx(POSES, abs=1e-12)
    assert there(back(POSES)) == pytest.approx(POSES, abs=1e-12)
    assert there(POSES[0]).shape == (4, 4)
    assert np.linalg.det(there(POSES)[:, :3, :3]) == pytest.approx(1)


def point(T: np.ndarray, *p: float) -> list[float]:
    """Where T puts a point, rounded."""
    return np.round(T @ [*p, 1.0], 9)[:3].tolist()


def test_opengl_camera_looks_along_its_negative_z() -> None:
    """A point 2 m in front, 1 m right, 0.5 m below is (1, 0.5, 2) here and (1, -0.5, -2) in OpenGL."""
    T = POSES[0]
    assert point(conventions.to_opengl(T), 1, -0.5, -2) == point(T, 1, 0.5, 2)
    view = conventions.to_opengl_view(T)
    assert point(view, *point(T, 1, 0.5, 2)) == pytest.approx([1, -0.5, -2])


def test_ros_body_looks_along_x_with_z_up() -> None:
    """REP 103: 2 m in front, 1 m right, 0.5 m below the optical centre is (2, -1, -0.5) in the body."""
    assert point(conventions.T_BODY_OPTICAL, 1, 0.5, 2) == [2, -1, -0.5]
    assert pytest.approx(np.eye(4)) == conventions.T_BODY_OPTICAL @ conventions.T_OPTICAL_BODY
    assert conventions.to_ros_body(np.eye(4)) == pytest.approx(np.eye(4))
    forward = se3.exp([0, 0, 3, 0, 0, 0])  # 3 m along the optical axis
    assert conventions.to_ros_body(forward)[:3, 3].tolist() == [3, 0, 0]
    right_turn = se3.exp([0, 0, 0, 0, 0.3, 0])  # about y, which points down: to the right
    assert se3.log(conventions.to_ros_body(right_turn)) == pytest.approx([0, 0, 0, 0, 0, -0.3])


def test_extrinsic_brings_the_camera_to_the_origin() -> None:
    assert point(conventions.to_extrinsic(POSES[2]), *POSES[2][:3, 3]) == pytest.approx([0, 0, 0])


def test_other_shapes_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"expected shape \(\.\.\., 4, 4\), got \(3, 4\)"):
        conventions.to_opengl(np.eye(4)[:3])


@pytest.mark.parametrize(
    ("write", "name"), [(write_tum, "a.txt"), (write_kitti, "b.txt"), (write_redwood_log, "c.log")]
)
def test_trajectory_files_there_and_back(write: object, name: str, tmp_path: Path) -> None:
    write(tmp_path / name, TRAJECTORY)  # type: ignore[operator]
    read = read_trajectory(tmp_path / name)
    assert read.T_world_camera == pytest.approx(POSES, abs=1e-12)
    assert read.timestamps_s == pytest.approx(TRAJECTORY.timestamps_s)


def test_evo_there_and_back() -> None:
    pytest.importorskip("evo")
    evo = to_evo(TRAJECTORY)
    assert np.array(evo.poses_se3) == pytest.approx(POSES, abs=1e-9)
    assert evo.check()[0]
    back = from_evo(evo)
    assert back.T_world_camera == pytest.approx(POSES, abs=1e-9)
    assert back.timestamps_s.tolist() == TRAJECTORY.timestamps_s.tolist()
    with pytest.raises(InvalidInputError, match="no timestamps"):
        from_evo(SimpleNamespace(poses_se3=[]))


def test_evo_measures_the_same_error(tmp_path: Path) -> None:
    """ATE of a noisy copy, aligned, by both."""
    pytest.importorskip("evo")
    from evo.core.metrics import APE, PoseRelation, StatisticsType

    moved = TRAJECTORY.T_world_camera.copy()
    moved[:, :3, 3] += RNG.normal(0, 0.01, (6, 3))
    noisy = sw.Trajectory(TRAJECTORY.timestamps_s, moved)
    truth, estimate = to_evo(TRAJECTORY), to_evo(noisy)
    estimate.align(truth)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((truth, estimate))
    assert metric.get_statistic(StatisticsType.rmse) == pytest.approx(sw.ate(noisy, TRAJECTORY).rmse_m)


def same_cloud(cloud: object, other: sw.PointCloud) -> None:
    assert isinstance(cloud, sw.PointCloud)
    assert cloud.points_m == pytest.approx(other.points_m)
    assert (cloud.normals is None) == (other.normals is None)
    if other.normals is not None:
        assert cloud.normals == pytest.approx(other.normals)
    assert np.array_equal(cloud.colors, other.colors)


def same_mesh(mesh: object, other: TriangleMesh) -> None:
    assert isinstance(mesh, TriangleMesh)
    assert mesh.vertices_m.tolist() == other.vertices_m.tolist()
    assert mesh.triangles.tolist() == other.triangles.tolist()
    assert mesh.normals == pytest.approx(other.normals, abs=1e-6)
    assert np.array_equal(mesh.colors, other.colors)


def test_open3d_there_and_back() -> None:
    o3d = pytest.importorskip("open3d")
    same_cloud(from_open3d(to_open3d(CLOUD)), CLOUD)
    same_cloud(from_open3d(o3d.t.geometry.PointCloud.from_legacy(to_open3d(CLOUD))), CLOUD)
    same_mesh(from_open3d(to_open3d(MESH)), MESH)
    assert from_open3d(to_open3d(CAMERA)) == CAMERA
    back = trajectory_from_open3d(trajectory_to_open3d(TRAJECTORY, CAMERA))
    assert back.T_world_camera == pytest.approx(POSES, abs=1e-9)


def test_open3d_images_there_and_back() -> None:
    """Open3D's own cloud of the image, at its extrinsic, is ours in the world."""
    o3d = pytest.importorskip("open3d")
    image = to_open3d(FRAME)
    back = from_open3d(image, camera=CAMERA, timestamp_s=0.5)
    assert isinstance(back, sw.Frame)
    assert back.depth_m.tolist() == FRAME.depth_m.tolist()
    assert np.array_equal(back.color, FRAME.color)
    cloud = o3d.geometry.PointCloud.create_from_depth_image(
        image.depth, to_open3d(CAMERA), conventions.to_extrinsic(POSES[0]), depth_scale=1.0, depth_trunc=10.0
    )
    valid = FRAME.depth_m > 0
    ours = se3.transform_points(POSES[0], CAMERA.back_project(FRAME.depth_m)[valid])
    assert np.asarray(cloud.points) == pytest.approx(ours, abs=1e-5)
    with pytest.raises(InvalidInputError, match="give camera="):
        from_open3d(image)


def test_open3d_stand_ins() -> None:
    """What is read of Open3D's objects, without it: an intensity image in millimetres, an intrinsic, a trajectory."""
    depth = np.array([[1000, 0], [65000, 250]], np.uint16)
    grey = np.array([[0.0, 0.5], [1.0, 0.25]], np.float32)
    camera = sw.PinholeCamera(2, 2, 0.5, 0.5, 2, 2)
    frame = from_open3d(SimpleNamespace(depth=depth, color=grey), camera=camera, depth_scale=1000.0)
    assert isinstance(frame, sw.Frame)
    assert frame.depth_m.tolist() == [[1, 0], [65, 0.25]]
    assert frame.color[0, 1].tolist() == [128, 128, 128]
    intrinsic = SimpleNamespace(intrinsic_matrix=CAMERA.matrix, width=80, height=60)
    assert from_open3d(intrinsic) == CAMERA
    one = SimpleNamespace(extrinsic=conventions.to_extrinsic(POSES[1]))
    path = from_open3d(SimpleNamespace(parameters=[one]))
    assert path.T_world_camera[0] == pytest.approx(POSES[1])
    with pytest.raises(InvalidInputError, match="has no counterpart"):
        from_open3d(3)


def test_trimesh_there_and_back() -> None:
    pytest.importorskip("trimesh")
    same_mesh(from_trimesh(to_trimesh(MESH)), MESH)
    same_cloud(from_trimesh(to_trimesh(CLOUD)), sw.PointCloud(CLOUD.points_m, colors=CLOUD.colors))
    assert to_trimesh(MESH).is_watertight


def test_trimesh_reads_what_is_written(tmp_path: Path) -> None:
    """PLY, OBJ and GLB by an independent reader; the GLB is turned, so that y is up."""
    trimesh = pytest.importorskip("trimesh")
    from scanweld.io.mesh_files import write_mesh

    for suffix in ("ply", "obj", "glb"):
        write_mesh(tmp_path / f"mesh.{suffix}", MESH)
        read = trimesh.load(tmp_path / f"mesh.{suffix}", process=False)
        mesh = read.to_mesh() if suffix == "glb" else read
        turned = MESH.vertices_m * ([1, -1, -1] if suffix == "glb" else [1, 1, 1])
        assert mesh.vertices == pytest.approx(turned, abs=1e-5)
        assert mesh.faces.tolist() == MESH.triangles.tolist()
        assert mesh.is_watertight


def test_pyvista_there_and_back() -> None:
    pytest.importorskip("pyvista")
    same_mesh(from_pyvista(to_pyvista(MESH)), MESH)
    same_cloud(from_pyvista(to_pyvista(CLOUD)), CLOUD)


def test_pyvista_stand_ins() -> None:
    """Faces are listed as 3 a b c; a quadrilateral is refused."""
    data = {"RGB": MESH.colors, "Normals": MESH.normals}
    faces = np.column_stack([np.full(4, 3), MESH.triangles]).ravel()
    same_mesh(from_pyvista(SimpleNamespace(points=MESH.vertices_m, faces=faces, point_data=data)), MESH)
    cloud = from_pyvista(SimpleNamespace(points=CLOUD.points_m, faces=np.empty(0, int), point_data={}))
    same_cloud(cloud, sw.PointCloud(CLOUD.points_m))
    square = SimpleNamespace(points=MESH.vertices_m, faces=np.array([4, 0, 1, 2, 3]), point_data={})
    with pytest.raises(InvalidInputError, match="triangulate"):
        from_pyvista(square)
    with pytest.raises(InvalidInputError, match="no PolyData"):
        from_pyvista(3)


def test_trimesh_stand_ins() -> None:
    visual = SimpleNamespace(kind="vertex", vertex_colors=np.column_stack([MESH.colors, np.full(4, 255, np.uint8)]))
    mesh = SimpleNamespace(vertices=MESH.vertices_m, faces=MESH.triangles, vertex_normals=MESH.normals, visual=visual)
    same_mesh(from_trimesh(mesh), MESH)
    with pytest.raises(InvalidInputError, match="neither a Trimesh"):
        from_trimesh(3)


@pytest.mark.parametrize(
    ("call", "extra"),
    [
        (lambda: to_open3d(CLOUD), "open3d"),
        (lambda: to_trimesh(MESH), "trimesh"),
        (lambda: to_pyvista(MESH), "pyvista"),
        (lambda: to_evo(TRAJECTORY), "evo"),
    ],
    ids=["open3d", "trimesh", "pyvista", "evo"],
)
def test_a_missing_library_is_named(call: object, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == extra]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, extra, None)  # the import statement raises then
    with pytest.raises(MissingDependencyError, match=rf"pip install 'scanweld\[{extra}\]'"):
        call()  # type: ignore[operator]
