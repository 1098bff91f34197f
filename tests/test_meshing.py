"""Grids of distances, the triangles in them, and the mesh of a run."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

import scanweld as sw
from rendered import CAMERA, rendered, write_tum_folder
from scanweld.cli.app import run as run_command
from scanweld.errors import FileFormatError, InvalidInputError, OutputError
from scanweld.geometry import se3
from scanweld.geometry.mesh import TriangleMesh
from scanweld.io.mesh_files import write_mesh
from scanweld.io.trajectory_files import write_tum
from scanweld.meshing import kernels
from scanweld.meshing.cleaning import border_loops, with_small_holes_filled, without_small_pieces
from scanweld.meshing.config import MeshConfig
from scanweld.meshing.extraction import extract_mesh
from scanweld.meshing.extraction.cases import MOST_CORNERS, case_table, ends
from scanweld.meshing.fuse import frames_with_news, mesh_from_frames, voxel_for
from scanweld.meshing.rendering import render_mesh
from scanweld.meshing.splats import SH_0, quaternion_wxyz_to_normal, splats_from_surfels
from scanweld.meshing.volume import GridTooLargeError, TsdfVolume
from scanweld.parallel import limited_threads
from scanweld.runs.mesh import mesh_run
from scanweld.runs.reopen import reopen_sequence
from written_runs import Columns, corner, write_frames

ALL = MeshConfig(least_component=0)


def volume_of(distance: Callable[[np.ndarray], np.ndarray], blocks: int, voxel_m: float = 0.05) -> TsdfVolume:
    """A grid of blocks^3 blocks about the origin, with a distance that is a function of the places (N, 3)."""
    volume = TsdfVolume(voxel_m, MeshConfig(deepest=1e9))
    side_m = kernels.SIDE * voxel_m
    middles = (np.stack(np.meshgrid(*[np.arange(blocks)] * 3), axis=-1).reshape(-1, 3) + 0.5 - blocks // 2) * side_m
    reach = np.full(len(middles), 0.4 * side_m)
    volume._enter(lambda table, keys, count: kernels.mark_balls(middles, reach, side_m, table, keys, count))
    assert volume.num_blocks == blocks**3
    shifts = [2 * kernels.KEY_BITS, kernels.KEY_BITS, 0]
    corners = np.stack([(volume.keys >> s) & (2 * kernels.HALF - 1) for s in shifts], axis=1) - kernels.HALF
    inside = np.stack(np.meshgrid(*[np.arange(kernels.SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = voxel_m * (kernels.SIDE * corners[:, None] + inside)
    volume.distances_m[:] = distance(places.reshape(-1, 3)).reshape(-1, kernels.SAMPLES)
    volume.weights[:] = 1
    return volume


def directed_edges(mesh: TriangleMesh) -> np.ndarray:
    """Edges (3 M, 2) as the triangles run along them."""
    return np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])


def wall_frame(depth_m: np.ndarray | float, color: tuple[int, int, int] = (200, 100, 50)) -> sw.Frame:
    """A frame with depth (H, W) of one colour."""
    depth = np.broadcast_to(np.float32(depth_m), CAMERA.shape).astype(np.float32)
    return sw.Frame(0.0, depth, np.full((*CAMERA.shape, 3), color, np.uint8), CAMERA)


def plane_depth(normal: np.ndarray, offset_m: float, T_world_camera: np.ndarray) -> np.ndarray:
    """Depth (H, W) of the plane n x = offset in the world."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    return ((offset_m - normal @ T_world_camera[:3, 3]) / (rays @ normal)).astype(np.float32)


def test_cases_use_every_edge_across_the_surface_and_no_other() -> None:
    """Of 256 cases, the first and the last have none; a cell has five triangles at most, as in the table of 1987."""
    table = case_table()
    assert table[0, 0] == table[255, 0] == 0
    assert table[:, 0].max() == MOST_CORNERS
    for case in range(256):
        across = {e for e in range(24) if len(set(ends(e))) == 2 and ends(e)[0] < ends(e)[1] < 8}
        across = {e for e in across if (case >> ends(e)[0] & 1) != (case >> ends(e)[1] & 1)}
        assert set(table[case, 1 : 1 + table[case, 0]].tolist()) == across


def test_a_corner_inside_is_cut_off_by_one_triangle_that_looks_outwards() -> None:
    """Case 1: corner 0 inside; its edges 0, 1, 2 lie on x, y, z. Outwards is (1, 1, 1): x, y, z go anticlockwise."""
    _, *corners = case_table()[1, :4].tolist()
    assert corners in ([0, 1, 2], [1, 2, 0], [2, 0, 1])


def test_sphere_is_closed_round_and_looks_outwards() -> None:
    """4^3 blocks, radius 0.6 m, voxel 5 cm: off the sphere by at most h^2 / (8 r) = 0.52 mm along an edge of the grid.

    A closed surface without handles has V - E + F = 2.
    """
    mesh = extract_mesh(volume_of(lambda p: np.linalg.norm(p - 0.013, axis=1) - 0.6, 4))
    edges = directed_edges(mesh)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(e) for e in edges.tolist()} == {tuple(e) for e in edges[:, ::-1].tolist()}
    assert len(mesh.vertices_m) - len(edges) // 2 + len(mesh) == 2
    radii = np.linalg.norm(mesh.vertices_m - 0.013, axis=1)
    assert np.abs(radii - 0.6).max() < 0.00055
    assert mesh.area_m2 == pytest.approx(4 * np.pi * 0.36, rel=0.005)
    outwards = np.einsum("nd,nd->n", mesh.with_normals().normals, mesh.vertices_m - 0.013) / radii
    assert outwards.min() > 0.98
    assert np.linalg.norm(mesh.doubled_areas, axis=1).min() > 0


def test_any_signs_give_a_surface_that_is_open_only_at_the_end_of_the_grid() -> None:
    """Random distances have every case and every ambiguous face: still two triangles at an inner edge, one each way."""
    rng = np.random.default_rng(3)
    mesh = extract_mesh(volume_of(lambda p: rng.uniform(-1, 1, len(p)), 2))
    edges = directed_edges(mesh)
    assert len(np.unique(edges, axis=0)) == len(edges)
    forward = {tuple(e) for e in edges.tolist()}
    alone = np.array([e for e in forward if e[::-1] not in forward])
    middles = mesh.vertices_m[alone].mean(axis=1)
    low, high = -8 * 0.05, 7 * 0.05  # no cell begins at the last samples
    at_the_end = np.isclose(middles, low, atol=1e-6) | np.isclose(middles, high, atol=1e-6)
    assert len(alone)
    assert at_the_end.any(axis=1).all()


def test_plane_seen_at_an_angle_is_where_it_is() -> None:
    """Exact depth of a plane at 45 degrees and more, from three places: everything within 0.1 mm (a voxel has 20)."""
    normal = np.array([0.6, 0.0, -0.8])
    poses = [se3.exp(xi) for xi in ([0, 0, 0, 0, 0, 0], [0.2, 0.1, 0, 0, -0.2, 0], [-0.1, 0, 0.1, 0.1, 0.1, 0.3])]
    frames = [(wall_frame(plane_depth(normal, -1.6, T)), T) for T in poses]
    mesh = mesh_from_frames(frames, voxel_m=0.02, config=ALL)
    assert np.abs(mesh.vertices_m @ normal + 1.6).max() < 1e-4
    towards_the_cameras = mesh.normals @ normal
    assert towards_the_cameras.min() > 0
    assert np.mean(towards_the_cameras > 0.999) > 0.99  # but for slivers
    assert np.abs(mesh.colors.astype(int) - [200, 100, 50]).max() <= 1


def test_wall_has_one_side_and_the_size_that_was_seen() -> None:
    """At 1.5 m the image spans 160 / 131.25 * 1.5 = 1.83 m by 1.37 m; two pixels at the border have no normal."""
    mesh = mesh_from_frames([(wall_frame(1.5), np.eye(4))], voxel_m=0.02, config=ALL)
    seen = (156 / 131.25 * 1.5) * (116 / 131.25 * 1.5)
    assert mesh.area_m2 == pytest.approx(seen, rel=0.05)
    assert np.abs(mesh.vertices_m[:, 2] - 1.5).max() < 1e-5


def test_fusing_averages_noise() -> None:
    """Sixteen noisy frames are about four times as near as one."""
    rng = np.random.default_rng(0)
    noisy = [wall_frame(1.5 + rng.normal(0, 0.004, CAMERA.shape)) for _ in range(16)]

    def error(frames: list[sw.Frame]) -> float:
        mesh = mesh_from_frames([(frame, np.eye(4)) for frame in frames], voxel_m=0.02, config=ALL)
        return float(np.sqrt(np.mean((mesh.vertices_m[:, 2] - 1.5) ** 2)))

    assert error(noisy) < 0.4 * error(noisy[:1])


def test_what_is_seen_through_is_carved() -> None:
    """A box in front of the wall in one frame of eight: afterwards nothing is left of it."""
    boxed = np.full(CAMERA.shape, 1.5, np.float32)
    boxed[40:80, 60:100] = 1.0
    with_box = [(wall_frame(boxed), np.eye(4))]
    without = [(wall_frame(1.5), np.eye(4))] * 7
    seen = mesh_from_frames(with_box, voxel_m=0.02, config=ALL)
    assert (seen.vertices_m[:, 2] < 1.2).sum() > 100
    mesh = mesh_from_frames(with_box + without, voxel_m=0.02, config=ALL)
    assert mesh.vertices_m[:, 2].min() > 1.45


def test_holes_stay_holes_unless_small_ones_are_to_be_filled() -> None:
    """An unseen square of 30 pixels: no vertex within it. Its border is some 1.4 m long, that of the wall 6 m."""
    depth = np.full(CAMERA.shape, 1.5, np.float32)
    depth[45:75, 65:95] = 0
    frames = [(wall_frame(depth), np.eye(4))]
    mesh = mesh_from_frames(frames, voxel_m=0.02, config=ALL)
    middle = np.abs(mesh.vertices_m[:, :2]).max(axis=1) < 0.12
    assert not middle.any()
    borders = border_loops(mesh)
    assert len(borders) == 2
    filled = mesh_from_frames(frames, voxel_m=0.02, config=MeshConfig(least_component=0, fill_holes_m=2.0))
    assert len(border_loops(filled)) == 1
    assert filled.area_m2 == pytest.approx(mesh.area_m2 + (31 / 131.25 * 1.5) ** 2, rel=0.03)
    assert (filled.normals[:, 2] < -0.99).all()  # the filling looks the same way


def test_small_pieces_are_left_out() -> None:
    triangles = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]])
    mesh = TriangleMesh(np.random.default_rng(0).random((7, 3)), triangles)
    kept = without_small_pieces(mesh, 2)
    assert kept.triangles.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert len(kept.vertices_m) == 4
    assert len(without_small_pieces(mesh, 1)) == 3


def test_holes_of_three_and_four_corners_are_filled() -> None:
    """A pyramid without its base, and a tetrahedron without one side."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]], np.float32)
    sides = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    closed = with_small_holes_filled(TriangleMesh(square, np.array(sides)), 4.1)
    assert len(closed) == 8
    assert border_loops(closed) == []
    open_mesh = TriangleMesh(square[[0, 1, 3, 4]], np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    assert len(with_small_holes_filled(open_mesh, 4.0)) == 4


@pytest.mark.parametrize("num_threads", [1, 3])
def test_same_mesh_at_any_number_of_threads(num_threads: int, two_frames: list[tuple[sw.Frame, np.ndarray]]) -> None:
    with limited_threads(num_threads):
        mesh = mesh_from_frames(two_frames, voxel_m=0.03)
    reference = mesh_from_frames(two_frames, voxel_m=0.03)
    assert mesh.vertices_m.tobytes() == reference.vertices_m.tobytes()
    assert mesh.triangles.tobytes() == reference.triangles.tobytes()
    assert mesh.colors.tobytes() == reference.colors.tobytes()


@pytest.fixture(scope="module")
def two_frames() -> list[tuple[sw.Frame, np.ndarray]]:
    sequence = rendered(noise="kinect")
    return [(sequence.frames[i], sequence.ground_truth.T_world_camera[i]) for i in (0, 8)]


def test_a_grid_that_grows_is_the_one_that_had_room(
    two_frames: list[tuple[sw.Frame, np.ndarray]], monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = mesh_from_frames(two_frames, voxel_m=0.02)
    monkeypatch.setattr("scanweld.meshing.volume._FIRST_BLOCKS", 16)
    mesh = mesh_from_frames(two_frames, voxel_m=0.02)
    for name in ("vertices_m", "triangles", "normals", "colors"):
        assert getattr(mesh, name).tobytes() == getattr(reference, name).tobytes()


def test_pieces_are_kept_where_all_of_them_are_small(caplog: pytest.LogCaptureFixture) -> None:
    frames = [(wall_frame(1.0), np.eye(4))]
    mesh = mesh_from_frames(frames, voxel_m=0.02, config=MeshConfig(least_component=10**6))
    assert len(mesh) == len(mesh_from_frames(frames, voxel_m=0.02, config=ALL)) > 0
    assert "the mesh is all pieces of fewer than 1000000 triangles" in caplog.text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vertices_m": np.zeros((4, 2))}, r"expected vertices \(N, 3\) and triangles \(M, 3\), got \(4, 2\)"),
        ({"triangles": np.zeros((2, 4))}, r"got \(4, 3\) and \(2, 4\)"),
        ({"triangles": np.array([[0, 1, 4]])}, r"a triangle names a vertex outside 0\.\.3"),
        ({"triangles": np.array([[-1, 1, 2]])}, "a triangle names a vertex outside"),
        ({"normals": np.zeros((3, 3))}, r"normals: expected \(4, 3\) float32, got \(3, 3\)"),
        ({"colors": np.zeros((4, 3))}, r"colors: expected \(4, 3\) uint8, got \(4, 3\) float64"),
    ],
)
def test_what_is_no_mesh_is_refused(changes: dict[str, np.ndarray], words: str) -> None:
    with pytest.raises(InvalidInputError, match=words):
        TriangleMesh(**{"vertices_m": np.eye(4, 3), "triangles": np.array([[0, 1, 2]]), **changes})


def test_a_moved_mesh_keeps_its_triangles(tetrahedron: TriangleMesh) -> None:
    """A quarter turn about z, and 1 m along x: (x, y, z) becomes (1 - y, x, z), and normals turn alone."""
    T = np.array([[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    moved = tetrahedron.transformed(T)
    x, y, z = tetrahedron.vertices_m.T
    np.testing.assert_allclose(moved.vertices_m, np.stack([1 - y, x, z], axis=1), atol=1e-6)
    nx, ny, nz = tetrahedron.normals.T
    np.testing.assert_allclose(moved.normals, np.stack([-ny, nx, nz], axis=1), atol=1e-6)
    np.testing.assert_array_equal(moved.triangles, tetrahedron.triangles)
    np.testing.assert_array_equal(moved.colors, tetrahedron.colors)


def test_grid_takes_no_more_memory_than_it_may(two_frames: list[tuple[sw.Frame, np.ndarray]]) -> None:
    volume = TsdfVolume(0.004, MeshConfig(max_memory_mb=16))
    with pytest.raises(GridTooLargeError, match=r"more than 16 MB at a voxel of 0\.004 m; raise the voxel"):
        volume.integrate(*two_frames[0])
    assert volume.memory_mb <= 16


def test_nothing_to_mesh_is_an_error() -> None:
    with pytest.raises(InvalidInputError, match="there is no surface to mesh"):
        mesh_from_frames([(wall_frame(0.0), np.eye(4))], voxel_m=0.02)
    with pytest.raises(InvalidInputError, match="voxel"):
        TsdfVolume(0.0)


def test_spacing_and_frames_are_chosen_by_hand_calculation() -> None:
    """Two pixels of f = 131.25 at 1.5 m are 22.9 mm; the noise there, 1.2 + 1.9 * 1.1^2 = 3.5 mm, is less.

    With twenty times the pixels across, two are 1.1 mm, and half the noise, 1.75 mm, is more.
    Steps of 4 mm and 0.26 deg: every second is new when 7.5 mm or 0.5 deg is.
    """
    assert voxel_for([wall_frame(1.5), wall_frame(0.0)], sw.SurfaceConfig()) == 0.023
    fine = sw.PinholeCamera(2625, 2625, 79.5, 59.5, 160, 120)
    assert voxel_for([sw.Frame(0.0, wall_frame(1.5).depth_m, None, fine)], sw.SurfaceConfig()) == 0.0017
    shifts = np.stack([se3.exp([0.004 * k, 0, 0, 0, 0, 0]) for k in range(5)])
    assert frames_with_news(shifts, 1.5).tolist() == [0, 2, 4]
    turns = np.stack([se3.exp([0, 0, 0, 0, np.radians(0.26) * k, 0]) for k in range(5)])
    assert frames_with_news(turns, 1.5).tolist() == [0, 2, 4]


def test_surfels_become_a_mesh_on_their_planes() -> None:
    """The hand-made corner: walls at z = 3 and x = -2, a floor at y = 1."""
    volume = TsdfVolume(0.05)
    volume.integrate_surfels(corner())
    mesh = extract_mesh(volume)
    off = np.min(np.abs(mesh.vertices_m - [-2, 1, 3]), axis=1)
    assert np.percentile(off, 80) < 0.01  # where they meet they are round
    assert mesh.area_m2 == pytest.approx(4 * 2 + 3 * 2 + 4 * 3, rel=0.15)


def test_rendered_triangle_by_hand() -> None:
    """The plane z = 2.5 + x / 2: at the pixel (cx + k, cy), x / z = k / f, so z = 2.5 / (1 - k / 2 f)."""
    x = np.array([-4.0, 4.0, 0.0])
    y = np.array([-3.0, -3.0, 5.0])
    mesh = TriangleMesh(np.column_stack([x, y, 2.5 + x / 2]), np.array([[0, 1, 2]]), colors=np.eye(3, dtype=np.uint8))
    camera = sw.PinholeCamera(100, 100, 50, 40, 101, 81)
    view = render_mesh(mesh, np.eye(4), camera)
    k = np.arange(101) - 50
    assert view.depth_m[40] == pytest.approx(2.5 / (1 - k / 200), rel=1e-5)
    assert (view.triangle[40] == 0).all()
    away = render_mesh(mesh, se3.exp([0, 0, 0, 0, np.pi, 0]), camera)
    assert not away.depth_m.any()
    assert (away.shaded() == 255).all()


# --- files


@pytest.fixture
def tetrahedron() -> TriangleMesh:
    vertices = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [0.25, 0.25, 2.125]], np.float32)
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    colors = np.array([[0, 255, 128], [10, 20, 30], [255, 255, 255], [0, 0, 0]], np.uint8)
    return TriangleMesh(vertices, triangles, colors=colors).with_normals()


def test_ply_holds_the_mesh(tmp_path: Path, tetrahedron: TriangleMesh) -> None:
    write_mesh(tmp_path / "mesh.ply", tetrahedron)
    read = PlyData.read(str(tmp_path / "mesh.ply"))
    for name, values in tetrahedron.columns().items():
        assert read["vertex"][name].tolist() == values.tolist()
    assert np.vstack(read["face"]["vertex_indices"]).tolist() == tetrahedron.triangles.tolist()
    assert sw.read_ply(tmp_path / "mesh.ply").points_m.tolist() == tetrahedron.vertices_m.tolist()


def test_obj_holds_the_mesh(tmp_path: Path, tetrahedron: TriangleMesh) -> None:
    write_mesh(tmp_path / "mesh.obj", tetrahedron)
    lines = [line.split() for line in (tmp_path / "mesh.obj").read_text().splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
    assert vertices[:, :3] == pytest.approx(tetrahedron.vertices_m, abs=1e-5)
    assert vertices[:, 3:] * 255 == pytest.approx(tetrahedron.colors, abs=0.02)
    faces = [[int(word.split("//")[0]) - 1 for word in line[1:]] for line in lines if line[0] == "f"]
    assert faces == tetrahedron.triangles.tolist()
    assert sum(line[0] == "vn" for line in lines) == 4


def test_glb_holds_the_mesh(tmp_path: Path, tetrahedron: TriangleMesh) -> None:
    """Read by the letter of glTF 2.0. Mid grey 128 is 0.2158 in linear light."""
    write_mesh(tmp_path / "mesh.glb", tetrahedron)
    data = (tmp_path / "mesh.glb").read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    document = json.loads(data[20 : 20 + size])
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, length) == (b"BIN\0", document["buffers"][0]["byteLength"])
    body = data[28 + size :]
    primitive = document["meshes"][0]["primitives"][0]

    def values(accessor: int) -> np.ndarray:
        a = document["accessors"][accessor]
        view = document["bufferViews"][a["bufferView"]]
        dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[a["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a["type"]]
        return np.frombuffer(body, dtype, a["count"] * width, view["byteOffset"]).reshape(-1, width)

    places = values(primitive["attributes"]["POSITION"])
    assert places.tolist() == tetrahedron.vertices_m.tolist()
    assert document["accessors"][primitive["attributes"]["POSITION"]]["max"] == [1, 1, 2.125]
    assert values(primitive["indices"]).reshape(-1, 3).tolist() == tetrahedron.triangles.tolist()
    assert values(primitive["attributes"]["COLOR_0"])[0] / 65535 == pytest.approx([0, 1, 0.2158, 1], abs=1e-3)
    assert document["nodes"][0]["rotation"] == [1, 0, 0, 0]  # half a turn about x: y up


def test_other_kinds_of_files_are_refused(tmp_path: Path, tetrahedron: TriangleMesh) -> None:
    with pytest.raises(OutputError, match=r"cannot write a mesh as '\.stl' \(known: PLY, OBJ, GLB\)"):
        write_mesh(tmp_path / "mesh.stl", tetrahedron)


def test_splats_by_hand() -> None:
    """Radius 2 cm (0.7 of it is 1.4 cm), confidence 3: opacity 0.99 (1 - 1 / e). White is 0.5 / 0.282 = 1.772."""
    columns = {name: np.array(values, np.float32) for name, values in {
        "x": [1, 2, 0], "y": [0, 0, 0], "z": [3, 3, 0], "nx": [0, 1, 0], "ny": [0, 0, 0], "nz": [-1, 0, 1],
        "red": [255, 0, 0], "green": [255, 0, 0], "blue": [255, 0, 0], "radius": [0.02, 0.02, 0.02],
        "confidence": [3, 30, 1],
    }.items()}  # fmt: skip
    splats = splats_from_surfels(columns, least_confidence=2).columns()
    assert " ".join(splats) == (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    )
    assert splats["f_dc_1"] == pytest.approx([0.5 / SH_0, -0.5 / SH_0])
    assert 1 / (1 + np.exp(-splats["opacity"])) == pytest.approx([0.99 * (1 - np.exp(-1)), 0.99], abs=1e-4)
    assert np.exp(splats["scale_0"]) == pytest.approx([0.014, 0.014])
    assert np.exp(splats["scale_2"]) == pytest.approx([0.0014, 0.0014])
    assert np.stack([splats[f"rot_{k}"] for k in range(4)], axis=1) == pytest.approx(
        np.array([[0, 1, 0, 0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0]]), abs=1e-6
    )
    with pytest.raises(InvalidInputError, match="have no radius"):
        splats_from_surfels({name: values for name, values in columns.items() if name != "radius"})


def test_quaternions_turn_z_to_the_normal() -> None:
    normals = np.random.default_rng(1).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wxyz = quaternion_wxyz_to_normal(normals)
    T = se3.from_quaternion_xyzw(np.roll(wxyz, -1, axis=1), np.zeros((50, 3)))
    assert T[:, :3, 2] == pytest.approx(normals, abs=1e-12)


# --- runs


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of eight frames at their true poses, of which one was lost; its map is the hand-made corner."""
    place = tmp_path_factory.mktemp("runs")
    sequence = rendered(count=40).part(0, 8)
    write_tum_folder(place / "room", sequence)
    folder = place / "run"
    folder.mkdir()
    truth = sw.Trajectory(sequence.timestamps_s, sequence.ground_truth.T_world_camera[:8])
    write_tum(folder / "trajectory.txt", truth)
    table = [
        {"frame": i, "timestamp": repr(float(t)), "status": "lost" if i == 5 else "tracking", "alignment": "converged"}
        for i, t in enumerate(sequence.timestamps_s)
    ]
    write_frames(folder, table)
    sw.write_ply(folder / "map.ply", Columns(corner()))
    (folder / "run.json").write_text(json.dumps({"input": str(place / "room"), "format": "auto", "scale": 1.0}))
    return folder


def test_mesh_of_a_run_is_near_the_true_surface(finished_run: Path) -> None:
    """Rendered without noise (rounded to 0.2 mm) at true poses: drawn again, the mesh has the depth that was seen.

    Two of these pixels are 5 cm apart at 3.3 m: edges are rounded by as much, and beside them something is missing.
    """
    done: list[tuple[int, int]] = []
    made = mesh_run(finished_run, frames="0:8", progress=lambda *counts: done.append(counts))
    assert (made.path, made.num_frames) == (finished_run / "mesh.ply", 7)  # not the lost one
    assert done[-1] == (7, 7)
    sequence = rendered(count=40)
    for i in (1, 6):
        view = render_mesh(made.mesh, sequence.ground_truth.T_world_camera[i], CAMERA)
        level = sw.build_pyramid(sequence.frames[i]).levels[0]
        both = level.normals.any(axis=2) & (view.depth_m > 0)
        off = np.einsum("hwd,hwd->hw", CAMERA.back_project(view.depth_m) - level.vertices_m, level.normals)[both]
        assert both.sum() > 0.85 * level.normals.any(axis=2).sum()
        assert np.median(np.abs(off)) < 0.0003
        assert np.mean(np.minimum(np.abs(off), 0.05)) < 0.004
        seen = view.color[both].astype(float) - sequence.frames[i].color[both]
        assert np.median(np.abs(seen)) < 6
    assert sw.read_ply(made.path).points_m.shape == made.mesh.vertices_m.shape


def test_frames_and_memory_are_what_was_asked_for(
    finished_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    part = mesh_run(finished_run, out=tmp_path / "a.obj", frames="2:8:3")
    assert part.num_frames == 1  # 2, and 5 is lost
    small = mesh_run(finished_run, out=tmp_path / "b.ply", config=MeshConfig(max_memory_mb=1), frames="0:2")
    assert small.memory_mb <= 1
    assert small.voxel_m > part.voxel_m
    assert "it is made coarser" in caplog.text
    with pytest.raises(InvalidInputError, match="no frames with a measured pose in 5:6"):
        mesh_run(finished_run, frames="5:6")
    with pytest.raises(GridTooLargeError):
        mesh_run(finished_run, config=MeshConfig(max_memory_mb=16, voxel_m=0.004), frames="0:2")


def test_without_the_sequence_the_surfels_are_meshed(
    finished_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("frames.csv", "trajectory.txt"):
        (tmp_path / name).write_bytes((finished_run / name).read_bytes())
    surfels = corner()
    surfels["x"][7], surfels["radius"][8], surfels["nz"][0] = np.nan, np.inf, 0  # the first ones are of the wall
    sw.write_ply(tmp_path / "map.ply", Columns(surfels))
    (tmp_path / "run.json").write_text(json.dumps({"input": str(tmp_path / "gone")}))
    made = mesh_run(tmp_path)
    assert "the sequence of the run is not there any more" in caplog.text
    assert "the mesh is made of the surfels in map.ply" in caplog.text
    assert made.num_frames == 0
    assert made.mesh.area_m2 == pytest.approx(26, rel=0.15)


def test_a_sequence_is_opened_as_it_was_for_the_run(finished_run: Path) -> None:
    """A demo's is rendered again; a calibrated one has the calibration: 1 / z' = 1 / z + b, so 2 m become 1 / 0.6 m."""
    render = {"scene": "room", "path": "orbit", "frames": 3, "width": 64, "height": 48, "noise": "kinect"}
    again = reopen_sequence({"input": "rendered room", "render": render})
    assert len(again) == 3
    assert np.array_equal(again.read(1).depth_m, sw.SyntheticSequence(sw.RenderConfig(**render)).read(1).depth_m)
    run = json.loads((finished_run / "run.json").read_text())
    intrinsics = {"fx": 130.0, "fy": 130.0, "cx": 80.0, "cy": 60.0, "width": 160, "height": 120}
    found = {"intrinsics": intrinsics, "inverse_depth_offset_per_m": 0.1}
    plain = reopen_sequence({**run, "frames": "2:6"}).read(0)
    frame = reopen_sequence({**run, "frames": "2:6", "calibrated": True, "refinements": [found]}).read(0)
    assert frame.camera == sw.PinholeCamera(**intrinsics)
    valid = plain.depth_m > 0
    assert 1 / frame.depth_m[valid] == pytest.approx(1 / plain.depth_m[valid] + 0.1, rel=1e-5)
    with pytest.raises(FileFormatError, match="calibration of the run is not readable"):
        reopen_sequence({**run, "calibrated": True, "refinements": [{}]})


def test_a_folder_that_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"not a run folder \(no run.json\)"):
        mesh_run(tmp_path)


@pytest.mark.parametrize("arguments", [["nowhere"], ["RUN", "--out", "mesh.stl"]])
def test_faults_are_told_before_anything_is_compiled(
    finished_run: Path, arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scanweld.parallel.kernels_are_cached", lambda group, now=False: False)
    assert run_command(["mesh", *(str(finished_run) if word == "RUN" else word for word in arguments)]) == 1
    assert capsys.readouterr().err.startswith("error: ")


def test_command_line(finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mesh.glb"
    assert run_command(["mesh", str(finished_run), "--out", str(out), "--voxel", "0.05", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["triangles"] > 1000
    assert figures["voxel_m"] == 0.05
    assert out.read_bytes().startswith(b"glTF")
    assert run_command(["mesh", str(finished_run), "--splat", "--out", str(tmp_path / "splats.ply")]) == 0
    count = PlyData.read(str(tmp_path / "splats.ply"))["vertex"].count
    assert count > 1000
    assert f"splats   {count:,}\n" in capsys.readouterr().out
    options = ["--splat", "--json", "--out", str(tmp_path / "splats.ply")]
    assert run_command(["mesh", str(finished_run), *options]) == 0
    assert json.loads(capsys.readouterr().out)["splats"] == count
    options = [
        "--depth-max",
        "2.5",
        "--memory",
        "400",
        "--threads",
        "1",
        "--voxel",
        "0.05",
        "--out",
        str(out),
        "--json",
    ]
    assert run_command(["mesh", str(finished_run), *options]) == 0
    assert 0 < json.loads(capsys.readouterr().out)["triangles"] < figures["triangles"]  # of what is near
    assert run_command(["mesh", str(finished_run), "--out", str(tmp_path / "mesh.stl")]) == 1
    assert "known: PLY, OBJ, GLB" in capsys.readouterr().err


def test_recorded_room_is_within_two_millimetres(shared_data: Path) -> None:
    """Every tenth frame at true poses; measured at frames that took no part, to the nearest measured point.

    The mean includes the spacing of the reference, half of which (some 2 mm at 2 m) is the least that it can be
    across the grid of pixels; perpendicular to the surface the median is 0.2 mm.
    """
    sequence = sw.open_sequence(shared_data / "livingroom1")
    poses = sequence.ground_truth.T_world_camera
    frames = [(sequence.read(i), poses[i]) for i in range(0, len(sequence), 10)]
    mesh = mesh_from_frames(frames, voxel_m=0.008)
    camera = sequence.camera
    for i in (25, 155):
        level = sw.build_pyramid(sequence.read(i)).levels[0]
        view = render_mesh(mesh, poses[i], camera)
        both = level.normals.any(axis=2) & (view.depth_m > 0)
        off = np.einsum("hwd,hwd->hw", camera.back_project(view.depth_m) - level.vertices_m, level.normals)[both]
        assert np.mean(np.minimum(np.abs(off), 0.02)) < 0.002
        assert np.median(np.abs(off)) < 0.0005


@pytest.mark.parametrize("page", ["meshing.md", "interop.md"])
def test_programs_of_the_documentation_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).parents[1] / "docs" / page).read_text(encoding="utf-8")
    programs = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert programs
    variables: dict[str, object] = {}
    for program in programs:
        exec(compile(program, page, "exec"), variables)
    for name in set(re.findall(r"`(scanweld\.[\w.]+)`", text)):
        module, _, attribute = name.rpartition(".")
        assert hasattr(import_module(module), attribute), name
