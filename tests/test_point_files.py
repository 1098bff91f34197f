"""Point files by extension, and transforms as text."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.errors import FileFormatError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.ply import write_ply
from scanweld.io.point_files import FORMATS, read_points, read_transform, write_points


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
    assert "2 of 4 points" in caplog.text


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
        ("1 2 3\r\n4 5\r\n", "line 2: expected 3 columns as in line 1, got 2"),
        ("x y z\r1 2 3\r4 5 six\r", "line 3: expected 3 numbers"),
        ("# a comment\n1,2,3\n4,,6\n", "line 3: expected 3 columns as in line 2, got 2"),
        ("1 2 3\n1_0 2 3\n", "line 2: expected 3 numbers"),
        ("1 2 3\n4 5 \u0663\u00bd\n", "line 2: expected 3 numbers"),
        ("1,5;2,5;3,0\n", "holds both ',' and ';': write numbers with decimal points"),
        ("1 2 3\n\0\n", "zero bytes"),
    ],
)
def test_malformed_text_names_the_line(tmp_path, text, words):
    with pytest.raises(FileFormatError, match=rf"a\.xyz.*{words}"):
        read_points(written(tmp_path, text))


def test_columns_that_a_header_names(tmp_path):
    """In any order and case, between others; colours as fractions, or as integers even if all are 0 and 1."""
    text = 'Intensity,"Z",Y,X,R,G,B\n7,3,2,1,0.5,0,1\n8,6,5,4,0,0,1\n'
    cloud = read_points(written(tmp_path, text, "a.csv"))
    np.testing.assert_array_equal(cloud.points_m, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.colors, [[128, 0, 255], [0, 0, 255]])
    plane = read_points(written(tmp_path, "y x nx ny\n1 2 0 -3\n", "a.txt"))
    np.testing.assert_array_equal(plane.points_m, [[2, 1]])
    np.testing.assert_array_equal(plane.normals, [[0, -1]])
    assert read_points(written(tmp_path, "x y z reflectance\n1 2 3 4\n")).colors is None


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-16-le"])
def test_text_of_two_bytes_a_letter(tmp_path, encoding):
    (tmp_path / "a.csv").write_bytes("1 2 3\n4 5 6\n".encode(encoding))
    with pytest.raises(FileFormatError, match=r"a\.csv: not a readable text file: .*UTF-16"):
        read_points(tmp_path / "a.csv")


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


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-3, 3), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (9223372036854775807, 3), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (4611686018427387904, 4611686018427387904), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (3, 3.0), }",
        b"{'descr': '<c16', 'fortran_order': False, 'shape': (3, 3), }",
        b"{'descr': 'x' * 10**9, 'fortran_order': False, 'shape': (1, 3), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1, 3",
        b"(" * 3000,
        b"\xff" * 100,
    ],
)
def test_npy_headers_that_lie(tmp_path, header):
    content = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n" + bytes(72)
    (tmp_path / "a.npy").write_bytes(content)
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match=r"a\.npy") as caught:
        read_points(tmp_path / "a.npy")
    assert time.perf_counter() - start < 1
    assert len(str(caught.value).splitlines()) == 1


def test_an_npy_of_no_rows(tmp_path):
    np.save(tmp_path / "a.npy", np.empty((0, 3)))
    assert read_points(tmp_path / "a.npy").points_m.shape == (0, 3)


def test_ply_goes_to_its_reader(tmp_path):
    write_ply(tmp_path / "a.PLY", PointCloud(np.eye(3)))
    np.testing.assert_array_equal(read_points(tmp_path / "a.PLY").points_m, np.eye(3))


def test_unknown_kinds_name_the_known_ones(tmp_path):
    for name in ("a.obj", "a"):
        with pytest.raises(FileFormatError, match="PLY, PCD, XYZ, CSV, TXT, NPY, LAS, LAZ, E57"):
            read_points(written(tmp_path, "1 2 3", name))
    with pytest.raises(FileFormatError, match="no such file"):
        read_points(tmp_path / "none.xyz")
    with pytest.raises(FileFormatError, match="is a folder"):
        read_points(tmp_path)


def test_half_a_million_rows_take_no_coffee(tmp_path):
    """Parsed by compiled code, not row by row: the limit is some ten times what it takes."""
    row = "123456.789012,-0.000012345,3.1415926535\n"
    file = written(tmp_path, row * 500_000, "a.csv")
    start = time.perf_counter()
    cloud = read_points(file)
    assert time.perf_counter() - start < 10
    assert cloud.points_m.shape == (500_000, 3)
    np.testing.assert_array_equal(cloud.points_m[-1], [123456.789012, -0.000012345, 3.1415926535])


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.lists(st.tuples(finite, finite, finite), min_size=1, max_size=20),
    st.sampled_from(["csv", "xyz", "txt", "npy", "ply"]),
)
def test_points_come_back_to_the_bit(tmp_path_factory, rows, kind):
    points = np.array(rows)
    file = tmp_path_factory.mktemp("points") / f"a.{kind}"
    write_points(file, PointCloud(points))
    assert read_points(file).points_m.tobytes() == points.tobytes()


@pytest.mark.parametrize("kind", ["csv", "XYZ", "txt", "ply", "pcd"])
def test_normals_and_colours_come_back(tmp_path, kind):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[3] = 0
    cloud = PointCloud(rng.normal(size=(30, 3)), normals, rng.integers(0, 2, (30, 3)).astype(np.uint8))
    write_points(tmp_path / f"a.{kind}", cloud)
    back = read_points(tmp_path / f"a.{kind}")
    np.testing.assert_allclose(back.points_m, cloud.points_m, rtol=0, atol=1e-5 if kind == "pcd" else 0)
    np.testing.assert_array_equal(back.normals, np.float32(normals))
    np.testing.assert_array_equal(back.colors, cloud.colors)


def test_npy_keeps_normals_and_says_that_it_leaves_colours_out(tmp_path, caplog):
    normals = np.eye(3)[[0, 1, 2, 0]]
    cloud = PointCloud(np.arange(12.0).reshape(4, 3), normals, np.zeros((4, 3), np.uint8))
    with caplog.at_level("WARNING"):
        write_points(tmp_path / "a.npy", cloud)
    assert "colours left out" in caplog.text
    back = read_points(tmp_path / "a.npy")
    np.testing.assert_array_equal(back.normals, normals)
    assert back.colors is None


@pytest.mark.parametrize("name", ["a.e57", "a.obj", "a"])
def test_what_nothing_writes(tmp_path, name):
    with pytest.raises(OutputError, match=r"cannot write .* \(known: PLY, PCD, XYZ, CSV, TXT, NPY, LAS, LAZ\)"):
        write_points(tmp_path / name, PointCloud(np.eye(3)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", sorted(FORMATS))
@pytest.mark.parametrize(
    "content", [b"", b"\n", bytes(3000), bytes(range(256)) * 20, "x y z\n1 2 3\n".encode("utf-16")]
)
def test_no_reader_stumbles_over_garbage(tmp_path, suffix, content):
    for extra, package in ((".las", "laspy"), (".laz", "laspy"), (".e57", "pye57")):
        if suffix == extra:
            pytest.importorskip(package)
    (tmp_path / f"a{suffix}").write_bytes(content)
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match=rf"a\{suffix}") as caught:
        read_points(tmp_path / f"a{suffix}")
    assert time.perf_counter() - start < 1
    assert len(str(caught.value).splitlines()) == 1


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
