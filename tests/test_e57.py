"""E57: every scan in the frame of the file, whatever its coordinates are stored as; damage named."""

from __future__ import annotations

import struct
import sys
import time

import numpy as np
import pytest

from scanweld.errors import FileFormatError, MissingDependencyError
from scanweld.io.e57 import read_e57, read_e57_scans
from scanweld.io.point_files import read_points

libe57 = pytest.importorskip("pye57", reason="needs the extra: pip install 'scanweld[e57]'").libe57

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(40, 3)) * 10
COLORS = RNG.integers(0, 256, (40, 3)).astype(np.uint8)
NORMALS_URI = "http://www.libe57.org/E57_EXT_surface_normals.txt"


def cartesian(points):
    return {f"cartesian{axis}": ("double", values) for axis, values in zip("XYZ", points.T, strict=True)}


def colored(colors):
    return {f"color{name}": ("byte", values) for name, values in zip(("Red", "Green", "Blue"), colors.T, strict=True)}


def structure(image, **values):
    node = libe57.StructureNode(image)
    for name, value in values.items():
        node.set(name, structure(image, **value) if isinstance(value, dict) else libe57.FloatNode(image, value))
    return node


def write(path, *scans):
    """Write scans, each fields {name: (kind, values)} with perhaps `pose` and `limits`, through the reference library.

    Kinds are "double", "float", "byte", and "scaled": integers of a tenth of a millimetre.
    """
    image = libe57.ImageFile(str(path), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    image.extensionsAdd("nor", NORMALS_URI)
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    data = libe57.VectorNode(image, True)
    root.set("data3D", data)
    kinds = {
        "double": lambda: libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9),
        "float": lambda: libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1e9, 1e9),
        "byte": lambda: libe57.IntegerNode(image, 0, 0, 255),
        "scaled": lambda: libe57.ScaledIntegerNode(image, 0, -(2**30), 2**30, 1e-4, 500_000.0),
        "constant": lambda: libe57.IntegerNode(image, 5, 5, 5),
    }
    for scan in scans:
        fields = {name: value for name, value in scan.items() if name not in ("pose", "limits")}
        prototype = libe57.StructureNode(image)
        for name, (kind, _) in fields.items():
            prototype.set(name, kinds[kind]())
        node = libe57.StructureNode(image)
        if "pose" in scan:
            node.set("pose", structure(image, **scan["pose"]))
        if "limits" in scan:
            node.set("colorLimits", structure(image, colorRedMaximum=scan["limits"]))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        node.set("points", points)
        data.append(node)
        arrays = {name: np.array(values, dtype=np.float64) for name, (_, values) in fields.items()}
        buffers = libe57.VectorSourceDestBuffer()
        for name, values in arrays.items():
            buffers.append(libe57.SourceDestBuffer(image, name, values, len(values), True, True))
        writer = points.writer(buffers)
        writer.write(len(next(iter(arrays.values()))))
        writer.close()
    image.close()
    return path


def test_a_scan_without_a_pose(tmp_path):
    file = write(tmp_path / "a.e57", cartesian(POINTS) | colored(COLORS) | {"intensity": ("float", POINTS[:, 0])})
    cloud = read_points(file)
    np.testing.assert_array_equal(cloud.points_m, POINTS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.normals is None


def test_scaled_integers_of_a_map_projection(tmp_path):
    """Ten thousandths of a metre around 500 km, as the file says: value = raw scale + offset."""
    whole = RNG.integers(-(10**6), 10**6, (40, 3))
    stored = whole * 1e-4 + 500_000.0
    fields = {f"cartesian{axis}": ("scaled", values) for axis, values in zip("XYZ", stored.T, strict=True)}
    np.testing.assert_allclose(read_e57(write(tmp_path / "a.e57", fields)).points_m, stored, rtol=0, atol=1e-10)


def test_scans_are_moved_by_their_poses(tmp_path):
    """A quarter turn about z, q = (cos 45, 0, 0, sin 45): x goes to y, y to -x; then (1, 2, 3) is added."""
    half = np.sqrt(0.5)
    pose = {"rotation": {"w": half, "x": 0.0, "y": 0.0, "z": half}, "translation": {"x": 1.0, "y": 2.0, "z": 3.0}}
    normals = {f"nor:normal{axis}": ("float", np.full(2, float(axis == "X"))) for axis in "XYZ"}
    first = cartesian(np.array([[1.0, 0, 0], [0, 2, 5]])) | normals | {"pose": pose}
    second = cartesian(np.array([[7.0, 8, 9]])) | {"pose": {"translation": {"x": 1.0, "y": 0.0, "z": 0.0}}}
    scans = read_e57_scans(write(tmp_path / "a.e57", first, second))
    np.testing.assert_allclose(scans[0].points_m, [[1, 3, 3], [-1, 2, 8]], atol=1e-15)
    np.testing.assert_allclose(scans[0].normals, [[0, 1, 0], [0, 1, 0]], atol=1e-7)
    np.testing.assert_array_equal(scans[1].points_m, [[8, 8, 9]])
    merged = read_e57(tmp_path / "a.e57")
    np.testing.assert_array_equal(merged.points_m, np.concatenate([scan.points_m for scan in scans]))
    assert merged.normals is None  # the second scan has none


def test_spherical_coordinates(tmp_path):
    """Range 2, azimuth 90 degrees, elevation 30: (0, 2 cos 30, 2 sin 30) = (0, sqrt 3, 1)."""
    fields = {
        "sphericalRange": ("double", [2.0, 5.0]),
        "sphericalAzimuth": ("double", [np.pi / 2, 0.0]),
        "sphericalElevation": ("double", [np.pi / 6, 0.0]),
    }
    cloud = read_e57(write(tmp_path / "a.e57", fields))
    np.testing.assert_allclose(cloud.points_m, [[0, np.sqrt(3), 1], [5, 0, 0]], atol=1e-15)


def test_points_that_the_scanner_marked_are_dropped_and_counted(tmp_path, caplog):
    """States: 0 valid, 1 only the direction is, 2 nothing is."""
    fields = cartesian(POINTS[:3]) | {"cartesianInvalidState": ("byte", [0, 1, 2])}
    file = write(tmp_path / "a.e57", fields)
    with caplog.at_level("WARNING"):
        np.testing.assert_array_equal(read_e57(file).points_m, POINTS[:1])
    assert "2 of 3 points" in caplog.text


def test_colours_in_other_limits(tmp_path):
    channels = {
        f"color{n}": ("float", v) for n, v in (("Red", [0.0, 1.0]), ("Green", [0.5, 0.0]), ("Blue", [1.0, 0.0]))
    }
    file = write(tmp_path / "a.e57", cartesian(POINTS[:2]) | channels | {"limits": 1.0})
    np.testing.assert_array_equal(read_e57(file).colors, [[0, 128, 255], [255, 0, 0]])


def test_no_points_and_no_scans(tmp_path):
    assert len(read_e57(write(tmp_path / "a.e57", cartesian(np.empty((0, 3)))))) == 0
    with pytest.raises(FileFormatError, match="holds no scan"):
        read_e57(write(tmp_path / "b.e57"))


def test_coordinates_of_another_kind(tmp_path):
    with pytest.raises(FileFormatError, match="without cartesian or spherical coordinates"):
        read_e57(write(tmp_path / "a.e57", {"intensity": ("float", [1.0])}))


def test_a_pose_that_is_none(tmp_path):
    zero = {"w": 0.0, "x": 0.0, "y": 0.0, "z": 0.0}
    with pytest.raises(FileFormatError, match="no rigid transform"):
        read_e57(write(tmp_path / "a.e57", cartesian(POINTS) | {"pose": {"rotation": zero}}))


def crc32c(data):
    """Checksum of Castagnoli: polynomial 0x1EDC6F41, reflected."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


def altered(content, old, new):
    """Replace bytes of an E57 file, of equal length, and renew the checksums that end its pages of 1024 bytes."""
    assert len(old) == len(new)
    pages = b"".join(content[i : i + 1020] for i in range(0, len(content), 1024))
    assert pages.count(old) == 1
    pages = pages.replace(old, new)
    cut = [pages[i : i + 1020] for i in range(0, len(pages), 1020)]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in cut)


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    return write(tmp_path_factory.mktemp("e57") / "a.e57", cartesian(POINTS)).read_bytes()


def check_refused(file, words):
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match=rf"{file.name}.*({words})") as caught:
        read_e57(file)
    assert time.perf_counter() - start < 1
    assert len(str(caught.value).splitlines()) == 1


def test_a_header_that_promises_too_many_points(tmp_path, intact):
    """The text of the scan is altered, its checksums are right."""
    for old, new in ((b'recordCount="40"', b'recordCount="99"'), (b' recordCount="40"', b'recordCount="999"')):
        (tmp_path / "a.e57").write_bytes(altered(intact, old, new.rjust(len(old))))
        check_refused(tmp_path / "a.e57", "promises|not a readable")


def test_points_that_take_no_room_are_limited_by_the_file(tmp_path):
    """Coordinates with one possible value take no bits: a count alone could ask for any amount of memory."""
    fields = {f"cartesian{axis}": ("constant", np.full(9, 5)) for axis in "XYZ"}
    content = write(tmp_path / "a.e57", fields).read_bytes()
    old = b'type="CompressedVector" fileOffset="48" recordCount="9"'
    new = b'type="CompressedVector" fileOffset="48" recordCount="' + b"9" * 12 + b'"'
    # Room for the longer number: the declaration that begins the text is optional.
    declaration = b'<?xml version="1.0" encoding="UTF-8"?>\n'
    pages = b"".join(content[i : i + 1020] for i in range(0, len(content), 1024))
    start = pages.index(declaration)
    end = pages.index(old) + len(old)
    text = pages[start + len(declaration) : end].replace(old, new)
    (tmp_path / "b.e57").write_bytes(altered(content, pages[start:end], text.rjust(end - start)))
    check_refused(tmp_path / "b.e57", "promises 999999999999 points of 0 bits")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.02, 0.5, 0.99])
def test_truncated_files(tmp_path, intact, share):
    (tmp_path / "a.e57").write_bytes(intact[: int(share * len(intact))])
    check_refused(tmp_path / "a.e57", "not an E57 file|not a readable E57 file")


def test_damaged_files(tmp_path, intact):
    """Every byte is under a checksum, so any change shows, also in what is not read."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        data = bytearray(intact)
        data[rng.integers(0, 1020)] ^= 1 << rng.integers(0, 8)
        (tmp_path / "a.e57").write_bytes(data)
        check_refused(tmp_path / "a.e57", "not an E57 file|not a readable E57 file")


def test_damage_under_right_checksums(tmp_path, intact):
    rng = np.random.default_rng(0)
    pages = b"".join(intact[i : i + 1020] for i in range(0, len(intact), 1024))
    refused = 0
    for _ in range(60):
        data = bytearray(pages)
        place = int(rng.integers(48, 2000))
        data[place : place + 2] = (b"\xff\xff", b"99", b"-1", b"<<", b"\0\0")[rng.integers(5)]
        (tmp_path / "a.e57").write_bytes(altered(intact, pages, bytes(data)))
        try:
            assert np.isfinite(read_e57(tmp_path / "a.e57").points_m).all()
        except FileFormatError:
            refused += 1
    assert refused > 10


def test_a_missing_file(tmp_path):
    with pytest.raises(FileFormatError, match="No such file"):
        read_e57(tmp_path / "none.e57")


def test_without_the_extra(tmp_path, monkeypatch, intact):
    (tmp_path / "a.e57").write_bytes(intact)
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(MissingDependencyError, match=r"pye57.*pip install 'scanweld\[e57\]'"):
        read_points(tmp_path / "a.e57")
