"""PLY: what is written comes back exactly, and what cannot be true is refused at once."""

from __future__ import annotations

import os
import struct
import time

import numpy as np
import plyfile
import pytest

from scanweld.errors import FileFormatError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.ply import read_ply, write_ply

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(50, 3)) + 1e6
NORMALS = np.float32(RNG.normal(size=(50, 3))).astype(np.float64)
COLORS = RNG.integers(0, 256, (50, 3)).astype(np.uint8)


class Surfels:
    """Something else with columns."""

    def columns(self):
        values = np.arange(4, dtype=np.float32)
        return {"x": values, "y": values, "z": values, "nx": values, "ny": values, "nz": values,
                "red": np.arange(4, dtype=np.uint8), "green": np.arange(4, dtype=np.uint8),
                "blue": np.arange(4, dtype=np.uint8), "radius": values, "confidence": values}  # fmt: skip


def test_a_cloud_comes_back_exactly(tmp_path):
    write_ply(tmp_path / "a.ply", PointCloud(POINTS, NORMALS, COLORS))
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points_m, POINTS)
    np.testing.assert_array_equal(cloud.normals, NORMALS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_the_file_is_what_other_readers_expect(tmp_path):
    write_ply(str(tmp_path / "map.ply"), Surfels())
    data = plyfile.PlyData.read(str(tmp_path / "map.ply"))
    assert not data.text
    assert data.byte_order == "<"
    vertex = data["vertex"]
    assert [p.name for p in vertex.properties] == list(Surfels().columns())
    assert vertex["confidence"].dtype == np.float32
    assert vertex["red"].dtype == np.uint8
    np.testing.assert_array_equal(vertex["radius"], [0, 1, 2, 3])
    size = (tmp_path / "map.ply").read_bytes()
    assert len(size) - (size.index(b"end_header\n") + 11) == 4 * (8 * 4 + 3)


def test_a_cloud_of_the_plane_is_written_with_z_zero(tmp_path):
    write_ply(tmp_path / "a.ply", PointCloud(POINTS[:, :2], NORMALS[:, :2]))
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points_m[:, 2], 0)
    np.testing.assert_array_equal(cloud.normals[:, :2], NORMALS[:, :2])


def test_files_are_readable_by_others_as_the_umask_says(tmp_path):
    mask = os.umask(0o022)
    try:
        write_ply(tmp_path / "a.ply", PointCloud(POINTS))
    finally:
        os.umask(mask)
    assert (tmp_path / "a.ply").stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, "<"), (False, ">")])
def test_every_encoding_is_read(tmp_path, text, byte_order):
    table = np.array(
        [(1.5, 2.5, 3.5, 10, 20, 30, 7), (-1, 0, 1, 255, 0, 128, 8)],
        dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("scalar", "i4")],
    )
    faces = np.array([([0, 1, 1],)], dtype=[("vertex_indices", "O")])
    elements = [plyfile.PlyElement.describe(table, "vertex"), plyfile.PlyElement.describe(faces, "face")]
    plyfile.PlyData(elements, text=text, byte_order=byte_order).write(str(tmp_path / "a.ply"))
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points_m, [[1.5, 2.5, 3.5], [-1, 0, 1]])
    np.testing.assert_array_equal(cloud.colors, [[10, 20, 30], [255, 0, 128]])
    assert cloud.normals is None


def ascii_ply(path, body, *properties, count=None):
    lines = body.strip().splitlines()
    header = ["ply", "format ascii 1.0", f"element vertex {len(lines) if count is None else count}"]
    path.write_text("\n".join([*header, *(f"property {p}" for p in properties), "end_header", *lines, ""]))
    return path


def test_colours_as_fractions(tmp_path):
    names = ("float x", "float y", "float z", "float red", "float green", "float blue")
    cloud = read_ply(ascii_ply(tmp_path / "a.ply", "0 0 0 0 0.5 1", *names))
    np.testing.assert_array_equal(cloud.colors, [[0, 128, 255]])


def test_rows_that_are_not_finite_are_dropped_and_counted(tmp_path, caplog):
    file = ascii_ply(tmp_path / "a.ply", "0 0 0\nnan 1 1\n2 2 inf\n3 3 3", "float x", "float y", "float z")
    with caplog.at_level("WARNING"):
        cloud = read_ply(file)
    np.testing.assert_array_equal(cloud.points_m, [[0, 0, 0], [3, 3, 3]])
    assert "2 of 4 points" in caplog.text


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_header_that_promises_a_million_million_points(tmp_path, encoding):
    file = tmp_path / "big.ply"
    header = (
        f"ply\nformat {encoding} 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\nend_header\n"
    )
    file.write_bytes(header.encode() + struct.pack("<2f", 1, 2))
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match="1000000000000"):
        read_ply(file)
    assert time.perf_counter() - start < 1


@pytest.mark.parametrize("keep", [0, 3, 40, 150, -1, -500])
def test_truncated_files(tmp_path, keep):
    write_ply(tmp_path / "a.ply", PointCloud(POINTS, NORMALS))
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(content[:keep])
    with pytest.raises(FileFormatError, match=r"b\.ply"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"solid stl", "begin with 'ply'"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nelement vertex -4\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n1\n", "line 4"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n", "no x and y"),
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n", "not a readable PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\none two\n",
         "not a readable PLY"),
        (b"ply\nformat morse 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 22222222\n",
         "not a readable PLY"),
    ],
)  # fmt: skip
def test_files_that_are_no_ply(tmp_path, content, words):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(FileFormatError, match=words):
        read_ply(tmp_path / "a.ply")


def test_a_missing_file(tmp_path):
    with pytest.raises(FileFormatError, match="No such file"):
        read_ply(tmp_path / "none.ply")


class Bad:
    def __init__(self, **columns):
        self.values = columns

    def columns(self):
        return self.values


@pytest.mark.parametrize(
    ("columns", "words"),
    [({"x": np.zeros(3), "y": np.zeros(2)}, "one length"), ({"x": np.zeros(3, np.int64)}, "int64")],
)
def test_columns_that_cannot_be_written(tmp_path, columns, words):
    with pytest.raises(OutputError, match=words):
        write_ply(tmp_path / "a.ply", Bad(**columns))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_does_not_exist(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        write_ply(tmp_path / "no" / "a.ply", PointCloud(POINTS))
