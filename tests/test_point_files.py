"""Point files by extension, and transforms as text."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import FileFormatError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.ply import write_ply
from scanweld.io.point_files import read_points, read_transform


def written(tmp_path, text, name="a.xyz"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n",
        "1,2,3\n4,5,6",
        "1;2;3\r\n4;5;6\r\n",
        "  1 , 2 ,\t3\n\n4 5,6\n",
        "x,y,z\n1,2,3\n4,5,6\n",
        "# a comment\n1 2 3 # another\n// and one more\n4 5 6\n",
        '"X" "Y" "Z"\n1e0 2.0 +3\n4 5 6\n',
        "\ufeff1 2 3\n4 5 6\n",
    ],
)
@pytest.mark.parametrize("name", ["a.xyz", "a.csv", "a.TXT"])
def test_three_columns_in_every_dress(tmp_path, text, name):
    np.testing.assert_array_equal(read_points(written(tmp_path, text, name)).points_m, [[1, 2, 3], [4, 5, 6]])


def test_two_columns_are_the_plane(tmp_path):
    cloud = read_points(written(tmp_path, "0.5 , 1\n-2 , 3\n", "scan.csv"))
    np.testing.assert_array_equal(cloud.points_m, [[0.5, 1], [-2, 3]])
    assert cloud.normals is None


def test_six_columns_are_normals_or_colours(tmp_path):
    normals = read_points(written(tmp_path, "0 0 0 0.6 0 0.8\n1 1 1 0 0 1.00001\n"))
    np.testing.assert_allclose(normals.normals, [[0.6, 0, 0.8], [0, 0, 1]])
    colors = read_points(written(tmp_path, "0 0 0 255 128 0\n1 1 1 1 2 3\n"))
    np.testing.assert_array_equal(colors.colors, [[255, 128, 0], [1, 2, 3]])
    assert colors.normals is None
    named = read_points(written(tmp_path, "x y z red green blue\n0 0 0 0 0 1\n"))
    np.testing.assert_array_equal(named.colors, [[0, 0, 1]])
    scaled = read_points(written(tmp_path, "x,y,z,nx,ny,nz\n0,0,0,0,0,5\n"))
    np.testing.assert_array_equal(scaled.normals, [[0, 0, 1]])
    with pytest.raises(FileFormatError, match="neither unit normals nor colours"):
        read_points(written(tmp_path, "0 0 0 0.1 7.5 300\n"))


def test_rows_that_are_not_finite_are_dropped_and_counted(tmp_path, caplog):
    with caplog.at_level("WARNING"):
        cloud = read_points(written(tmp_path, "1 2 3\nnan 0 0\n4 5 inf\n6 7 8\n"))
    assert len(cloud) == 2
    assert "2 of 4 rows" in caplog.text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no points"),
        ("# nothing\nx y z\n", "holds no points"),
        ("1 2 3\n4 5\n", "line 2: expected 3 columns as in line 1, got 2"),
        ("x y z\n1 2 3\n\n4 five 6\n", "line 4: expected 3 numbers"),
        ("1 2 3 4\n", "got 4"),
        ("1\n2\n", "got 1"),
        ("one two three\nfour five six\n", "line 2"),
    ],
)
def test_malformed_text_names_the_line(tmp_path, text, words):
    with pytest.raises(FileFormatError, match=rf"a\.xyz.*{words}"):
        read_points(written(tmp_path, text))


def test_bytes_that_are_no_text(tmp_path):
    (tmp_path / "a.csv").write_bytes(bytes(range(128, 256)))
    with pytest.raises(FileFormatError, match="not a readable text file"):
        read_points(tmp_path / "a.csv")


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
def test_npy(tmp_path, dtype):
    points = np.array([[1, 2, 3], [4, 5, 6]], dtype=dtype)
    np.save(tmp_path / "a.npy", points)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy").points_m, points)


@pytest.mark.parametrize("array", [np.zeros(3), np.zeros((2, 4)), np.zeros((2, 3, 1)), np.array([["a", "b"]])])
def test_npy_of_another_shape(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(FileFormatError, match=r"a\.npy"):
        read_points(tmp_path / "a.npy")


def test_npy_that_would_run_code_or_promises_too_much(tmp_path):
    np.save(tmp_path / "object.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }"
    header += b" " * (128 - 10 - len(header) - 1) + b"\n"
    (tmp_path / "big.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(48))
    (tmp_path / "empty.npy").write_bytes(b"")
    for name in ("object.npy", "big.npy", "empty.npy"):
        with pytest.raises(FileFormatError, match=name):
            read_points(tmp_path / name)


def test_ply_goes_to_its_reader(tmp_path):
    write_ply(tmp_path / "a.PLY", PointCloud(np.eye(3)))
    np.testing.assert_array_equal(read_points(tmp_path / "a.PLY").points_m, np.eye(3))


def test_unknown_kinds_name_the_known_ones(tmp_path):
    for name in ("a.pcd", "a"):
        with pytest.raises(FileFormatError, match="PLY, XYZ, CSV, TXT, NPY"):
            read_points(written(tmp_path, "1 2 3", name))
    with pytest.raises(FileFormatError, match="no such file"):
        read_points(tmp_path / "none.xyz")
    with pytest.raises(FileFormatError, match="is a folder"):
        read_points(tmp_path)


def test_transforms(tmp_path):
    square = "1 0 0 5\n0 0 -1 6\n0 1 0 7\n"
    expected = [[1, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]]
    for text in (square, square + "0 0 0 1\n"):
        np.testing.assert_array_equal(read_transform(written(tmp_path, text, "T.txt")), expected)
    plane = written(tmp_path, "0 -1 2\n1 0 3\n0 0 1\n")
    np.testing.assert_array_equal(read_transform(plane), [[0, -1, 2], [1, 0, 3], [0, 0, 1]])


@pytest.mark.parametrize("text", ["1 2 3\n", "2 0 0\n0 2 0\n0 0 1\n", "1 0 0\n0 -1 0\n0 0 1", "1 0 0\n0 1 0\n0 1 1"])
def test_what_is_no_rigid_transform(tmp_path, text):
    with pytest.raises(FileFormatError, match=r"T\.txt"):
        read_transform(written(tmp_path, text, "T.txt"))
    with pytest.raises(FileFormatError, match="no such file"):
        read_transform(tmp_path / "none.txt")
