"""LAS and LAZ: read without loss, written as finely as 32 bits allow, damage named."""

from __future__ import annotations

import io
import struct
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.errors import FileFormatError, MissingDependencyError, OutputError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.las import read_las, write_las
from scanweld.io.point_files import read_points

laspy = pytest.importorskip("laspy", reason="needs the extra: pip install 'scanweld[las]'")
pytest.importorskip("lazrs", reason="needs the extra: pip install 'scanweld[las]'")

RNG = np.random.default_rng(0)
COUNT = 3000
WHOLE = RNG.integers(-(10**6), 10**6, (COUNT, 3), dtype=np.int32)
COLORS = RNG.integers(0, 256, (COUNT, 3)).astype(np.uint8)
OFFSETS = np.array([448_000.0, 5_411_000.0, 250.0])
# Where the fields of the header are (LAS 1.4, tables 3 and 4).
START_OF_POINTS, NUM_RECORDS, ROW_LENGTH, NUM_POINTS, SCALES, NUM_POINTS_1_4 = 96, 100, 105, 107, 131, 247


def las_bytes(compressed, *, point_format=2, version="1.2", colors=None, count=COUNT):
    """Return a file as laspy writes it."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), OFFSETS
    data = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(count, header=header))
    for i, name in enumerate("XYZ"):
        data[name] = WHOLE[:count, i]
    if colors is not None:
        for i, name in enumerate(("red", "green", "blue")):
            data[name] = colors[:count, i]
    buffer = io.BytesIO()
    data.write(buffer, do_compress=compressed)
    return buffer.getvalue()


def saved(tmp_path, content, name="a.las"):
    (tmp_path / name).write_bytes(content)
    return tmp_path / name


def changed(content, position, kind, value):
    data = bytearray(content)
    struct.pack_into(kind, data, position, value)
    return bytes(data)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("point_format", "version"), [(2, "1.2"), (3, "1.3"), (7, "1.4")])
def test_coordinates_of_a_map_projection_lose_nothing(tmp_path, compressed, point_format, version):
    """x = X scale + offset in float64, as the specification says; colours of 16 bits are 257 times those of 8."""
    content = las_bytes(compressed, point_format=point_format, version=version, colors=COLORS.astype(np.uint16) * 257)
    cloud = read_las(saved(tmp_path, content))
    np.testing.assert_array_equal(cloud.points_m, WHOLE * 0.001 + OFFSETS)
    np.testing.assert_array_equal(cloud.colors, COLORS)


def test_colours_of_eight_bits_and_none(tmp_path):
    np.testing.assert_array_equal(read_las(saved(tmp_path, las_bytes(False, colors=COLORS))).colors, COLORS)
    assert read_las(saved(tmp_path, las_bytes(False, point_format=0))).colors is None


@pytest.mark.parametrize("compressed", [False, True])
def test_no_points_at_all(tmp_path, compressed):
    assert read_las(saved(tmp_path, las_bytes(compressed, count=0))).points_m.shape == (0, 3)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 1e3, 1e5]), st.booleans(), st.integers(0, 30))
def test_what_is_written_comes_back(tmp_path_factory, suffix, seed, extent_m, colored, count):
    """Half a step of 1e-6 m, or of the power of ten above extent / 2^31; plus float64 rounding at 5e6 m, 1e-9 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, extent_m, (count, 3)) + [5e5, 5e6, -100]
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8) if colored else None
    file = tmp_path_factory.mktemp("las") / f"a{suffix}"
    write_las(file, PointCloud(points, None, colors))
    cloud = read_points(file)
    step = {1e-3: 1e-6, 1.0: 1e-6, 1e3: 1e-6, 1e5: 1e-4}[extent_m]
    np.testing.assert_allclose(cloud.points_m, points, rtol=0, atol=step / 2 + 3e-9)
    assert (cloud.colors is not None) == colored
    if colored:
        np.testing.assert_array_equal(cloud.colors, colors)


def test_what_las_has_no_place_for(tmp_path, caplog):
    points = np.array([[0, 0, 0], [1, np.nan, 1], [2, 2, 2.0]])
    with caplog.at_level("WARNING"):
        write_las(tmp_path / "a.las", PointCloud(points, np.eye(3)))
    assert "normals left out" in caplog.text
    assert "1 of 3 points" in caplog.text
    np.testing.assert_array_equal(read_las(tmp_path / "a.las").points_m, points[[0, 2]])
    write_las(tmp_path / "b.las", PointCloud(points[[0, 2], :2]))
    np.testing.assert_array_equal(read_las(tmp_path / "b.las").points_m, points[[0, 2]] * [1, 1, 0])
    with pytest.raises(OutputError, match="beyond"):
        write_las(tmp_path / "c.las", PointCloud([[1e300, 0, 0]]))
    with pytest.raises(OutputError, match="cannot be written"):
        write_las(tmp_path / "no" / "c.las", PointCloud(points))


LAS, LAZ = las_bytes(False, colors=COLORS), las_bytes(True, colors=COLORS)
LAZ_1_4 = las_bytes(True, point_format=7, version="1.4")
(LAZ_START,), (LAZ_1_4_START,) = (struct.unpack_from("<I", data, START_OF_POINTS) for data in (LAZ, LAZ_1_4))
(LAZ_TABLE,) = struct.unpack_from("<q", LAZ, LAZ_START)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "begin with 'LASF'"),
        (b"PK\x03\x04" + bytes(500), "begin with 'LASF'"),
        (LAS[:100], "ends within the LAS header"),
        (LAS[:227], "LAS version|promises"),
        (LAS[: len(LAS) // 2], "truncated"),
        (LAS[:-1], "truncated"),
        (changed(LAS, 25, "<B", 9), "LAS version 1.9"),
        (changed(LAS, NUM_POINTS, "<I", 2**32 - 1), "promises 4294967295 points"),
        (
            changed(las_bytes(False, point_format=7, version="1.4"), NUM_POINTS_1_4, "<Q", 10**12),
            "1000000000000 points",
        ),
        (changed(LAS, NUM_RECORDS, "<I", 2**32 - 1), "promises 4294967295 records"),
        (changed(LAS, START_OF_POINTS, "<I", 2**32 - 1), "points from byte 4294967295"),
        (changed(LAS, START_OF_POINTS, "<I", 10), "LAS"),
        (changed(LAS, ROW_LENGTH, "<H", 0), "points of 0 bytes"),
        (changed(LAS, ROW_LENGTH, "<H", 3), "not a readable LAS file"),
        (changed(LAS, SCALES + 8, "<d", np.nan), "not finite"),
        (changed(LAS, SCALES + 24, "<d", np.inf), "not finite"),
        (changed(LAS, 104, "<B", 77), "LAS"),
        (LAZ[: len(LAZ) // 2], "truncated"),
        (changed(LAZ, NUM_POINTS, "<I", 2**32 - 1), "not a readable LAS file"),
        (changed(LAZ, LAZ_START, "<q", 10**15), "compressed chunks are wrong"),
        (changed(LAZ, LAZ_START, "<q", -7), "compressed chunks are wrong"),
        (changed(LAZ, LAZ_START, "<q", -1), "compressed chunks are wrong"),
        (changed(LAZ, LAZ_START, "<q", LAZ_START + 50), "compressed chunks are wrong"),
        (changed(LAZ, LAZ_TABLE + 4, "<I", 2**32 - 1), "compressed chunks are wrong"),
        (changed(LAZ_1_4, LAZ_1_4_START + 8 + 36 + 4, "<I", 2**32 - 1), "compressed chunks are wrong"),
    ],
)
def test_files_that_lie(tmp_path, content, words):
    """Some of these end the process, or take gigabytes, when the libraries below are given them unseen."""
    file = saved(tmp_path, content)
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match=rf"a\.las.*({words})") as caught:
        read_las(file)
    assert time.perf_counter() - start < 1
    assert len(str(caught.value).splitlines()) == 1


def test_damage_gives_points_or_an_error(tmp_path):
    """Flipped bytes, 300 times: never another exception, never a coordinate that is not finite."""
    rng = np.random.default_rng(1)
    refused = 0
    for i in range(300):
        data = bytearray((LAS, LAZ)[i % 2])
        for _ in range(3):
            data[rng.integers(0, 700)] = rng.integers(0, 256)
        try:
            assert np.isfinite(read_las(saved(tmp_path, bytes(data))).points_m).all()
        except FileFormatError:
            refused += 1
    assert 50 < refused < 300


def test_a_missing_file(tmp_path):
    with pytest.raises(FileFormatError, match="No such file"):
        read_las(tmp_path / "none.las")


def test_without_the_extra(tmp_path, monkeypatch):
    file = saved(tmp_path, LAS)
    monkeypatch.setitem(sys.modules, "laspy", None)
    for call in (lambda: read_points(file), lambda: write_las(tmp_path / "b.laz", PointCloud(np.eye(3)))):
        with pytest.raises(MissingDependencyError, match=r"laspy.*pip install 'scanweld\[las\]'"):
            call()


def test_without_the_decompressor(tmp_path, monkeypatch):
    monkeypatch.setattr("laspy.compression.LazBackend.is_available", lambda self: False)
    assert len(read_las(saved(tmp_path, LAS))) == COUNT
    for call in (lambda: read_las(saved(tmp_path, LAZ)), lambda: write_las(tmp_path / "b.laz", PointCloud(np.eye(3)))):
        with pytest.raises(MissingDependencyError, match=r"lazrs.*pip install 'scanweld\[las\]'"):
            call()
