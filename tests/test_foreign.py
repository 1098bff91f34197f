"""Clouds of other libraries, by stand-ins with exactly the attributes that the real ones have."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from scanweld.errors import InvalidInputError
from scanweld.geometry.foreign import as_cloud
from scanweld.geometry.point_cloud import PointCloud

POINTS = np.arange(12.0).reshape(4, 3) / 8
NORMALS = np.eye(3)[[0, 1, 2, 0]]
COLORS = np.array([[0, 51, 255], [255, 0, 0], [102, 102, 102], [0, 0, 0]], np.uint8)
NOTHING = np.empty((0, 3))


class Vector3dVector:
    """Open3D's list of vectors: offers its memory to NumPy, a length, and nothing else."""

    def __init__(self, values):
        self._values = values

    def __len__(self):
        return len(self._values)

    def __array__(self, dtype=None, copy=None):
        return np.array(self._values, dtype=dtype)


class Open3dCloud:
    def __init__(self, points, normals=NOTHING, colors=NOTHING):
        self.points, self.normals, self.colors = (Vector3dVector(v) for v in (points, normals, colors))


class Tensor:
    """On a device: NumPy gets at it only after `cpu()`."""

    def __init__(self, values, on_host=False):
        self._values, self._on_host = values, on_host

    def cpu(self):
        return Tensor(self._values, on_host=True)

    def numpy(self):
        assert self._on_host
        return self._values

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("a tensor on a device is no array")


class TensorMap:
    """Has `in` and [ ], and is no Mapping."""

    def __init__(self, **tensors):
        self._tensors = {name: Tensor(values) for name, values in tensors.items()}

    def __contains__(self, name):
        return name in self._tensors

    def __getitem__(self, name):
        return self._tensors[name]


class Open3dTensorCloud:
    def __init__(self, **tensors):
        self.point = TensorMap(**tensors)


class TensorMesh:
    def __init__(self, **tensors):
        self.vertex = TensorMap(**tensors)


class TrackedArray(np.ndarray):
    """trimesh's array that notices changes."""


class TrimeshCloud:
    """Colours are RGBA, or an empty array of one dimension."""

    def __init__(self, vertices, colors=None):
        self.vertices = vertices.view(TrackedArray)
        self.colors = np.empty(0) if colors is None else colors


class Trimesh:
    def __init__(self, vertices, vertex_normals):
        self.vertices, self.vertex_normals = vertices.view(TrackedArray), vertex_normals


class Open3dMesh:
    def __init__(self, vertices, vertex_normals=NOTHING):
        self.vertices, self.vertex_normals = Vector3dVector(vertices), Vector3dVector(vertex_normals)
        self.vertex_colors = Vector3dVector(NOTHING)


class Scene:
    def __init__(self):
        self.geometry = {}


def check(cloud, normals=None, colors=None):
    assert type(cloud) is PointCloud
    assert type(cloud.points_m) is np.ndarray
    assert cloud.points_m.dtype == np.float64
    np.testing.assert_array_equal(cloud.points_m, POINTS)
    for got, expected in ((cloud.normals, normals), (cloud.colors, colors)):
        assert (got is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(got, expected)


def test_a_cloud_is_returned_as_it_is():
    cloud = PointCloud(POINTS, NORMALS, COLORS)
    assert as_cloud(cloud) is cloud


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4", np.int8, np.int64, np.uint16])
@pytest.mark.parametrize("columns", [2, 3])
def test_arrays_of_every_real_type(dtype, columns):
    points = np.arange(4 * columns).reshape(4, columns).astype(dtype)
    before = points.copy()
    np.testing.assert_array_equal(as_cloud(points).points_m, before)
    np.testing.assert_array_equal(as_cloud(points.tolist()).points_m, before)
    assert points.tobytes() == before.tobytes()


def test_open3d():
    check(as_cloud(Open3dCloud(POINTS)))
    check(as_cloud(Open3dCloud(POINTS, NORMALS, COLORS / 255)), NORMALS, COLORS)
    assert len(as_cloud(Open3dCloud(NOTHING))) == 0


@pytest.mark.parametrize("colors", [COLORS, np.float32(COLORS / 255), COLORS.astype(np.uint16) * 257])
def test_open3d_tensors(colors):
    check(as_cloud(Open3dTensorCloud(positions=np.float32(POINTS))))
    tensors = Open3dTensorCloud(positions=POINTS, normals=np.float32(NORMALS), colors=colors)
    check(as_cloud(tensors), NORMALS, COLORS)
    check(as_cloud(TensorMesh(positions=POINTS)))
    check(as_cloud(Tensor(POINTS)))


def test_trimesh():
    check(as_cloud(TrimeshCloud(POINTS)))
    rgba = np.column_stack([COLORS, np.full(4, 128, np.uint8)])
    check(as_cloud(TrimeshCloud(POINTS, rgba)), None, COLORS)


def test_meshes_are_their_vertices():
    check(as_cloud(Trimesh(POINTS, NORMALS)), NORMALS)
    check(as_cloud(Open3dMesh(POINTS)))
    check(as_cloud(Open3dMesh(POINTS, NORMALS)), NORMALS)


def test_rows_that_are_not_finite_are_the_callers():
    points = POINTS.copy()
    points[1, 2] = np.nan
    assert len(as_cloud(Open3dCloud(points))) == 4


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (None, "scan: expected real numbers, got None$"),
        ("scan.ply", r"scan: .*read_points\(path\)$"),
        (POINTS.T, r"scan: .*did you mean scan[.]T\?$"),
        (Scene(), "scan: expected real numbers, got one Scene$"),
        (object(), "scan: expected real numbers, got one object$"),
        (Tensor(POINTS[0]), r"scan: expected shape .*got \(3,\); a single point is scan\[None\]$"),
        ([Tensor(POINTS[0])], "scan: .*a tensor on a device is no array"),
        (Open3dTensorCloud(), "scan: the point cloud has no positions$"),
        (Open3dCloud(POINTS, NORMALS[:2]), r"expected one per point \(4\), got 2$"),
        (Open3dCloud(POINTS, NORMALS, COLORS[:2]), r"colors: expected shape \(4, 3\)"),
        (Open3dCloud(POINTS[:, :1]), r"scan: expected shape \(N, 2 or 3\), got \(4, 1\)$"),
        (Open3dTensorCloud(positions=POINTS[None]), r"scan: expected shape"),
        (TrimeshCloud(POINTS, np.array(["red"] * 4)), r"scan[.]colors: expected numbers"),
        ([POINTS, POINTS[:2]], "scan: not a rectangular array"),
    ],
)
def test_what_is_no_cloud(thing, words):
    with pytest.raises(InvalidInputError, match=words) as caught:
        as_cloud(thing, "scan")
    assert len(str(caught.value).splitlines()) == 1


def test_no_other_library_is_imported():
    assert {"open3d", "trimesh"}.isdisjoint(sys.modules)
