"""PCD: every encoding comes back exactly, and what cannot be true is refused at once."""

from __future__ import annotations

import struct
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.errors import FileFormatError, InvalidInputError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.kernels import BEFORE_START, TOO_LONG, TOO_SHORT, TRUNCATED, decode_lzf, encode_lzf
from scanweld.io.pcd import read_pcd, write_pcd

ENCODINGS = ("ascii", "binary", "binary_compressed")
RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(50, 3)) + [5e5, 5.4e6, 100]
NORMALS = np.float32(RNG.normal(size=(50, 3))).astype(np.float64)
COLORS = RNG.integers(0, 256, (50, 3)).astype(np.uint8)


def header(fields="x y z", size="4 4 4", kind="F F F", count="1 1 1", points=1, data="ascii", **entries):
    """Return the header of a PCD file as bytes; an entry that is None is left out."""
    lines = {
        "VERSION": "0.7", "FIELDS": fields, "SIZE": size, "TYPE": kind, "COUNT": count, "WIDTH": points, "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": points, "DATA": data,
    } | entries  # fmt: skip
    return ("# .PCD v0.7\n" + "".join(f"{k} {v}\n" for k, v in lines.items() if v is not None)).encode()


def saved(tmp_path, content):
    (tmp_path / "a.pcd").write_bytes(content)
    return tmp_path / "a.pcd"


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_cloud_comes_back_exactly(tmp_path, encoding):
    write_pcd(tmp_path / "a.pcd", PointCloud(POINTS, NORMALS, COLORS), encoding=encoding)
    cloud = read_pcd(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points_m, POINTS)
    np.testing.assert_array_equal(cloud.normals, NORMALS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert [p.name for p in tmp_path.iterdir()] == ["a.pcd"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_no_points_at_all(tmp_path, encoding):
    write_pcd(tmp_path / "a.pcd", PointCloud(np.empty((0, 3))), encoding=encoding)
    assert read_pcd(tmp_path / "a.pcd").points_m.shape == (0, 3)


def test_coordinates_are_narrow_where_that_moves_nothing(tmp_path):
    """float32 has 24 bits: half a unit in the last place is 2^-17 m = 7.6e-6 m up to 256 m, and twice that beyond."""
    write_pcd(tmp_path / "a.pcd", PointCloud([[255.1, -255.9, np.nan], [0, 0, 0]]))
    assert b"\nSIZE 4 4 4\n" in (tmp_path / "a.pcd").read_bytes()
    write_pcd(tmp_path / "b.pcd", PointCloud([[256 + 2.0**-16, 0, 0]]))
    assert b"\nSIZE 8 8 8\n" in (tmp_path / "b.pcd").read_bytes()
    write_pcd(tmp_path / "c.pcd", PointCloud([[1e300, 0, 0]]))
    assert b"\nSIZE 8 8 8\n" in (tmp_path / "c.pcd").read_bytes()


def test_a_cloud_of_the_plane_is_written_with_z_zero(tmp_path):
    write_pcd(tmp_path / "a.pcd", PointCloud(POINTS[:, :2], NORMALS[:, :2]))
    cloud = read_pcd(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points_m, np.column_stack([POINTS[:, :2], np.zeros(50)]))


def test_the_example_of_the_format_s_description(tmp_path):
    """Two points from the tutorial, whose colour is the bits of a float printed in decimal.

    4210800 = 2^22 (1 + 16496 / 2^22): exponent 127 + 22 = 0x95, mantissa 16496 x 2 = 0x0080E0, together
    0x4A8080E0; red 0x80 = 128, green 0x80 = 128, blue 0xE0 = 224.
    """
    body = b"0.93773 0.33763 0 4.2108e+06\n0.90805 0.35641 0 4.2108e+06\n"
    content = header("x y z rgb", "4 4 4 4", "F F F F", "1 1 1 1", 2) + body
    cloud = read_pcd(saved(tmp_path, content))
    np.testing.assert_array_equal(cloud.points_m, [[0.93773, 0.33763, 0], [0.90805, 0.35641, 0]])
    np.testing.assert_array_equal(cloud.colors, [[128, 128, 224], [128, 128, 224]])


@pytest.mark.parametrize(("kind", "name"), [("F", "rgb"), ("U", "rgb"), ("U", "rgba"), ("I", "rgba")])
def test_packed_colours_of_every_kind(tmp_path, kind, name):
    """0xFF804020 as a float is a NaN, whose bits must survive: red 128, green 64, blue 32."""
    body = struct.pack("<fffI", 1, 2, 3, 0xFF804020)
    content = header(f"x y z {name}", "4 4 4 4", f"F F F {kind}", "1 1 1 1", data="binary") + body
    cloud = read_pcd(saved(tmp_path, content))
    np.testing.assert_array_equal(cloud.points_m, [[1, 2, 3]])
    np.testing.assert_array_equal(cloud.colors, [[128, 64, 32]])


def test_padding_descriptors_and_intensity_are_passed_over(tmp_path):
    """A point of 4 + 2x1 + 4 + 3x4 + 8 + 2x1 bytes, coordinates of three types."""
    body = b"".join(struct.pack("<f2Bf3fd2B", i, 9, 9, 0.5, 7, 7, 7, -i, 8, 8) for i in range(3))
    fields = ("x _ intensity histogram y _", "4 1 4 4 8 1", "F U F F F U", "1 2 1 3 1 2")
    cloud = read_pcd(saved(tmp_path, header(*fields, points=3, data="binary") + body))
    np.testing.assert_array_equal(cloud.points_m, [[0, 0], [1, -1], [2, -2]])
    text = b"".join(b"%d 9 9 0.5 7 7 7 %d 8 8\n" % (i, -i) for i in range(3))
    cloud = read_pcd(saved(tmp_path, header(*fields, points=3) + text))
    np.testing.assert_array_equal(cloud.points_m, [[0, 0], [1, -1], [2, -2]])


def test_compressed_fields_follow_one_another(tmp_path):
    """All x, then all y, then all z; 24 literals after one control byte, 23."""
    plain = struct.pack("<6f", 1, 2, 3, 4, 5, 6)
    content = header(points=2, data="binary_compressed") + struct.pack("<II", 25, 24) + b"\x17" + plain
    np.testing.assert_array_equal(read_pcd(saved(tmp_path, content)).points_m, [[1, 3, 5], [2, 4, 6]])


def test_organised_clouds_lose_what_was_not_measured(tmp_path, caplog):
    body = b"0 0 1\nnan nan nan\n1 0 1\n1 inf 1\n"
    file = saved(tmp_path, header(points=4, WIDTH=2, HEIGHT=2) + body)
    with caplog.at_level("WARNING"):
        cloud = read_pcd(file)
    np.testing.assert_array_equal(cloud.points_m, [[0, 0, 1], [1, 0, 1]])
    assert "2 of 4 points" in caplog.text


@pytest.mark.parametrize(
    "content",
    [
        header() + b"1 2 3",
        (header() + b"1 2 3\n").replace(b"\n", b"\r\n"),
        b"\xef\xbb\xbf" + header() + b"1 2 3\n",
        header(COUNT=None, POINTS=None, VIEWPOINT=None, VERSION=None) + b"1 2 3\n",
        header(WIDTH=None, HEIGHT=None) + b"\n\n1 2 3\n\n",
        header(FIELDS=None, COLUMNS="x y z").replace(b"DATA ascii\n", b"") + b"DATA ascii\n1 2 3\n",
    ],
)
def test_variants_of_the_header(tmp_path, content):
    np.testing.assert_array_equal(read_pcd(saved(tmp_path, content)).points_m, [[1, 2, 3]])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_header_that_promises_a_million_million_points(tmp_path, encoding):
    sizes = struct.pack("<II", 4, 4_000_000_000) if encoding == "binary_compressed" else b""
    file = saved(tmp_path, header(points=10**12, data=encoding) + sizes + b"1 2 3\n")
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match=r"a\.pcd: the header promises"):
        read_pcd(file)
    assert time.perf_counter() - start < 1


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("share", [0, 0.01, 0.3, 0.6, 0.9])
def test_truncated_files(tmp_path, encoding, share):
    write_pcd(tmp_path / "a.pcd", PointCloud(POINTS, NORMALS), encoding=encoding)
    content = (tmp_path / "a.pcd").read_bytes()
    with pytest.raises(FileFormatError, match=r"a\.pcd"):
        read_pcd(saved(tmp_path, content[: int(share * len(content))]))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"ply\nformat", "not a PCD file"),
        (bytes(range(256)) * 20, "not a PCD file"),
        ((header() + b"1 2 3\n").decode().encode("utf-16"), "not a PCD file"),
        (header(FIELDS=None), "names no FIELDS"),
        (header("a b c") + b"1 2 3\n", "no x and y"),
        (header("x y x") + b"1 2 3\n", "one name"),
        (header(size="4 4"), "3 FIELDS, 2 SIZE"),
        (header(size="4 4 -4"), "whole number"),
        (header(size="4 4 3"), "TYPE F SIZE 3"),
        (header(kind="F F Q"), "TYPE Q"),
        (header(count="1 1 0"), "COUNT 0"),
        (header(count="1 1 999999999999"), "COUNT 999999999999"),
        (header(points=-1), "whole number"),
        (header(points="1_0"), "whole number"),
        (header(points=3, WIDTH=2, HEIGHT=2), "POINTS 3, but WIDTH x HEIGHT is 4"),
        (header(WIDTH=None, POINTS=None), "neither POINTS nor WIDTH"),
        (header(data="morse"), "DATA: expected ascii"),
        (header(points=2) + b"1 2 3\n10 20\n", "line 13: expected 3 columns"),
        (header(points=2) + b"1 2 3\n\n1 two 3\n", "line 14: expected 3 numbers"),
        (header(points=1) + b"1 2 3 4\n", "expected 3 numbers as the header says, got 4"),
        (header(points=2) + b"1.00000 2.00000 3.0000\n", "ends after 1"),
        (header("x y rgb", kind="F F U") + b"1 2 -3\n", "outside 0..4294967295"),
        (header() .replace(b"SIZE", b"SHAPE"), "line 4 of the PCD header"),
    ],
)  # fmt: skip
def test_files_that_are_no_pcd(tmp_path, content, words):
    with pytest.raises(FileFormatError, match=rf"a\.pcd.*{words}"):
        read_pcd(saved(tmp_path, content))


@pytest.mark.parametrize(
    ("sizes", "data", "words"),
    [
        ((25, 25), b"\x17" + bytes(24), "promises 24 bytes of points, the compressed data 25"),
        ((26, 24), b"\x17" + bytes(24), "promises 26 compressed bytes, has 25"),
        ((2**32 - 1, 24), b"\x17" + bytes(24), "promises 4294967295 compressed bytes"),
        ((0, 24), b"", "cannot hold 24"),
        ((24, 24), b"\x17" + bytes(24), "end in the middle"),
        ((24, 24), b"\x16" + bytes(23), "hold less than the 24 bytes"),
        ((26, 24), b"\x18" + bytes(25), "hold more than the 24 bytes"),
        ((2, 24), b"\x20\x00", "refer to before their beginning"),
        ((4, 24), b"\x00\x07\x20\x01", "refer to before their beginning"),
        ((3, 24), b"\x00\x07\xe0", "end in the middle"),
        ((5, 24), b"\x00\x07\xe0\xff\x00", "hold more than the 24 bytes"),
    ],
)
def test_compressed_data_that_lie(tmp_path, sizes, data, words):
    content = header(points=2, data="binary_compressed") + struct.pack("<II", *sizes) + data
    with pytest.raises(FileFormatError, match=rf"a\.pcd.*{words}"):
        read_pcd(saved(tmp_path, content))


def test_lzf_by_hand():
    """Literals a b c; a copy of 3 + 6 from distance 3 (overlapping itself); a long copy of 7 + 2 + 1 from distance 12.

    0x02: three literals. 9 - 2 = 7 asks for a length byte: 0xE0, 0, distance - 1 = 2. Length 10 likewise: 0xE0, 1, 11.
    """
    source = np.frombuffer(b"\x02abc\xe0\x00\x02\xe0\x01\x0b", np.uint8)
    target = np.zeros(22, np.uint8)
    assert decode_lzf(source, target) == 0
    assert target.tobytes() == b"abcabcabcabc" + b"abcabcabca"
    assert decode_lzf(source, np.zeros(21, np.uint8)) == TOO_LONG
    assert decode_lzf(source, np.zeros(23, np.uint8)) == TOO_SHORT
    assert decode_lzf(source[:-1], target) == TRUNCATED
    assert decode_lzf(source[4:], target) == BEFORE_START


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=40), st.integers(1, 300)), max_size=30), st.integers(0, 9000))
def test_what_is_compressed_comes_back(runs, gap):
    """Repetitions, short and long, some further apart than the 8192 bytes that a copy can reach."""
    plain = b"".join(piece * times for piece, times in runs)
    plain += np.random.default_rng(gap).bytes(gap) + plain
    source = np.frombuffer(plain, np.uint8)
    room = np.zeros(len(source) + len(source) // 32 + 4, np.uint8)
    size = encode_lzf(source, room)
    back = np.zeros(len(source), np.uint8)
    assert decode_lzf(room[:size], back) == 0
    assert back.tobytes() == plain


def test_compression_compresses():
    """264 bytes are the longest copy, of two or three bytes: zeros shrink about 88 times."""
    room = np.zeros(70000, np.uint8)
    assert encode_lzf(np.zeros(65536, np.uint8), room) < 65536 / 80


@given(st.binary(max_size=200), st.integers(0, 400))
def test_no_compressed_bytes_write_outside(data, size):
    """The array behind the target keeps its bytes, whatever is decoded."""
    memory = np.full(size + 600, 77, np.uint8)
    decode_lzf(np.frombuffer(data, np.uint8), memory[300 : 300 + size])
    assert (memory[:300] == 77).all()
    assert (memory[300 + size :] == 77).all()


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.lists(st.tuples(finite, finite, finite), max_size=20),
    st.sampled_from(ENCODINGS),
)
def test_any_coordinates_come_back_within_a_hundredth_of_a_millimetre(tmp_path_factory, rows, encoding):
    points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    file = tmp_path_factory.mktemp("pcd") / "a.pcd"
    write_pcd(file, PointCloud(points), encoding=encoding)
    np.testing.assert_allclose(read_pcd(file).points_m, points, rtol=0, atol=1e-5)


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(InvalidInputError, match="expected one of ascii, binary, binary_compressed, got 'zip'"):
        write_pcd(tmp_path / "a.pcd", PointCloud(POINTS), encoding="zip")
    with pytest.raises(OutputError, match="cannot be written"):
        write_pcd(tmp_path / "no" / "a.pcd", PointCloud(POINTS))


def test_a_missing_file(tmp_path):
    with pytest.raises(FileFormatError, match="No such file"):
        read_pcd(tmp_path / "none.pcd")
