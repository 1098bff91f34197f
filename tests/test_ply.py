"""PLY: what is written comes back exactly, and what cannot be true is refused at once."""

from __future__ import annotations

import os
import struct
import time

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n", "no vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\none two\n",
         "line 7: expected 2 numbers, got 'one two'"),
        (b"ply\nformat morse 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 22222222\n",
         "line 2 of the PLY header is wrong: 'format morse 1.0'"),
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


LISTS = [
    ("element face 3", "property list uchar int vertex_indices"),
    (
        "element vertex 3",
        "property double x",
        "property list int double seen_from",
        "property float y",
        "property short z",
    ),
]


@pytest.mark.parametrize(("encoding", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_lists_before_and_among_the_vertices(tmp_path, encoding, order):
    """Rows of different length, in an element before the vertices and in the vertices themselves."""
    header = "\n".join(["ply", f"format {encoding} 1.0", *LISTS[0], *LISTS[1], "end_header", ""]).encode()
    faces = struct.pack(order + "B3iBB2i", 3, 0, 1, 1, 0, 2, 2, 0)
    vertices = struct.pack(order + "difh", 1e6 + 0.1, 0, 2, 3) + struct.pack(order + "di3dfh", 4, 3, 7, 8, 9, 5, 6)
    (tmp_path / "a.ply").write_bytes(header + faces + vertices + struct.pack(order + "didfh", 7, 1, 1, 8, 9))
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points_m, [[1e6 + 0.1, 2, 3], [4, 5, 6], [7, 8, 9]])


def test_lists_in_text(tmp_path):
    body = "3 0 1 1\n0\n\n2 2 0\n1000000.1 0 2 3\n4 3 7 8 9 5 6\n\n7 1 1 8 9\n"
    (tmp_path / "a.ply").write_text("\n".join(["ply", "format ascii 1.0", *LISTS[0], *LISTS[1], "end_header", body]))
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points_m, [[1e6 + 0.1, 2, 3], [4, 5, 6], [7, 8, 9]])


def test_what_follows_the_vertices_is_not_looked_at(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "1 2\nnot a face\nnor this\n")
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points_m, [[1, 2]])


@pytest.mark.parametrize("newline", ["\r\n", "\r"])
def test_other_ends_of_line(tmp_path, newline):
    """The first byte of a binary body may look like the second half of an end of line."""
    lines = ["ply", "format binary_big_endian 1.0", "element vertex 1", "property uchar x", "property uchar y"]
    content = newline.join([*lines, "end_header", ""]).encode() + b"\x0a\x0d"
    (tmp_path / "a.ply").write_bytes(content)
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points_m, [[10, 13]])
    text = newline.join(["ply", "format ascii 1.0", *lines[2:], "end_header", "1 2", ""])
    (tmp_path / "b.ply").write_bytes(text.encode())
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").points_m, [[1, 2]])


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_no_vertices_at_all(tmp_path, encoding):
    lines = ["ply", f"format {encoding} 1.0", "element vertex 0", *(f"property float {a}" for a in "xyz"), "end_header"]
    (tmp_path / "a.ply").write_text("\n".join([*lines, ""]))
    assert read_ply(tmp_path / "a.ply").points_m.shape == (0, 3)


VERTEX = "ply\nformat {} 1.0\nelement vertex 2\nproperty list {} int around\n"
VERTEX += "property uchar x\nproperty uchar y\nend_header\n"


@pytest.mark.parametrize(
    ("kind", "body", "words"),
    [
        ("uint", struct.pack("<I", 2**32 - 1) + bytes(60), "ends after 0"),
        ("int", struct.pack("<i", -1) + bytes(60), "the list 'around' of vertex 0 has -1 entries"),
        ("uchar", b"\x00\x01\x02" + b"\x03" + bytes(12) + b"\x01", "ends after 1"),
        ("uchar", b"\x01" + bytes(4) + b"\x01\x02" + b"\x02", "ends after 1"),
    ],
)
def test_lists_that_lie(tmp_path, kind, body, words):
    (tmp_path / "a.ply").write_bytes(VERTEX.format("binary_little_endian", kind).encode() + body)
    with pytest.raises(FileFormatError, match=rf"a\.ply.*{words}"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("2 0 0 1 2\n3 0 0 1 2\n", "line 9: not a vertex"),
        ("2 0 0 1 2\n-1 0 0 1 2\n", "line 9: not a vertex"),
        ("0 1 2\n\n0 1 256\n", "'y' has values outside 0..255"),
        ("0 1 2\n\n0 1 y\n", "line 10: expected 2 numbers"),
        ("12 1 2 3 4 5 6 7 8 9 10 11 12 13 14\n", "ends after 1"),
    ],
)
def test_text_that_does_not_fit_its_header(tmp_path, body, words):
    (tmp_path / "a.ply").write_text(VERTEX.format("ascii", "uchar") + body)
    with pytest.raises(FileFormatError, match=rf"a\.ply.*{words}"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["element vertex 1_0", "property float x"], "line 3"),
        (["element vertex 99999999999999999999999", "property float x"], "line 3"),
        (["element vertex 1", "property list float int a"], "line 4"),
        (["element vertex 1", "property float"], "line 4"),
        (["element vertex 1", "property float x", "property float x"], "two properties of one name"),
        (["element vertex 1000000000000"], "no properties"),
        (["element camera 1000000000000", "element vertex 0", "property float x"], "no properties"),
    ],
)
def test_headers_that_make_no_sense(tmp_path, lines, words):
    content = "\n".join(["ply", "format ascii 1.0", *lines, "end_header", "1 2", ""])
    for text in (content, content.replace("ascii", "binary_little_endian")):
        (tmp_path / "a.ply").write_text(text)
        with pytest.raises(FileFormatError, match=rf"a\.ply.*{words}"):
            read_ply(tmp_path / "a.ply")


def test_garbage_and_other_encodings_of_text(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nend_header\n"
    for content in (text.encode("utf-16"), b"ply" + bytes(range(256)) * 300, bytes(5000), b"ply\n" + bytes(200_000)):
        (tmp_path / "a.ply").write_bytes(content)
        with pytest.raises(FileFormatError, match=r"a\.ply"):
            read_ply(tmp_path / "a.ply")


@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from(["=", "<", ">"]), st.integers(0, 12))
def test_what_another_program_writes_is_read(tmp_path_factory, seed, with_lists, byte_order, count):
    """plyfile writes the same table in text or either byte order; coordinates are eighths, exact in every type.

    Not lists with big-endian: plyfile 1.1 writes the single values of such rows in the machine's order.
    """
    with_lists = with_lists and byte_order != ">"
    rng = np.random.default_rng(seed)
    dtype = [("a", "i2"), ("x", "f8"), ("y", "f4"), ("z", "f8"), *([("l", "O")] if with_lists else []), ("red", "u1"),
             ("green", "u1"), ("blue", "u1")]  # fmt: skip
    table = np.zeros(count, dtype)
    for axis in "xyz":
        table[axis] = rng.integers(-1000, 1000, count) / 8
    for name in ("red", "green", "blue"):
        table[name] = rng.integers(0, 256, count)
    if with_lists:
        table["l"] = [rng.integers(0, 9, k % 4).astype("i4") for k in range(count)]
    element = plyfile.PlyElement.describe(table, "vertex", val_types={"l": "i4"}, len_types={"l": "u2"})
    file = tmp_path_factory.mktemp("ply") / "a.ply"
    plyfile.PlyData([element], text=byte_order == "=", byte_order=byte_order).write(str(file))
    cloud = read_ply(file)
    np.testing.assert_array_equal(cloud.points_m, np.stack([table[axis] for axis in "xyz"], axis=1))
    np.testing.assert_array_equal(cloud.colors, np.stack([table[name] for name in ("red", "green", "blue")], axis=1))
