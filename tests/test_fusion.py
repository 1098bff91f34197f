"""Point-based fusion against the equations of Keller et al. 2013; against plain NumPy it is in test_backends."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial import cKDTree

import scanweld as sw
from rendered import CAMERA, frame_of, plane_depth, rendered
from scanweld.geometry import se3
from scanweld.mapping.fusion import FusionConfig, radial_weight, tidy

SMALL = sw.PinholeCamera(40.0, 41.0, 19.3, 14.8, 40, 30)
ALL = ("positions_m", "normals", "colors", "radii_m", "confidences", "created", "last_seen", "anchors")


def wall(
    depth_m: float = 1.5, normal: tuple[float, ...] = (0, 0, 1), camera: sw.PinholeCamera = SMALL, color: int = 90
) -> sw.SurfacePyramid:
    frame = frame_of(plane_depth(normal, depth_m, camera), camera=camera)
    return sw.build_pyramid(replace(frame, color=np.full((*camera.shape, 3), color, np.uint8)))


def mapper_with(*pyramids: sw.SurfacePyramid, **settings: float) -> sw.SurfelMapper:
    mapper = sw.SurfelMapper(FusionConfig(**settings))
    for pyramid in pyramids:
        mapper.fuse(pyramid, np.eye(4))
    return mapper


def content(surfels: sw.SurfelMap) -> bytes:
    return b"".join(np.array(getattr(surfels, name)).tobytes() for name in ALL)


def values_of(surfels: sw.SurfelMap) -> dict[str, np.ndarray]:
    """What the map holds, colours with their fractions."""
    values = {name: np.array(getattr(surfels, name)).astype(np.float64) for name in ALL}
    return values | {"colors": surfels.table()["colors"].astype(np.float64)}


def matched(
    values: dict[str, np.ndarray], expected: dict[str, np.ndarray], within_m: float = 1e-4
) -> dict[str, np.ndarray]:
    """Put surfels into the order of the expected ones, which lie this near to them."""
    distance, order = cKDTree(values["positions_m"].T).query(expected["positions_m"].T)
    assert distance.max(initial=0) < within_m
    assert len(np.unique(order)) == len(order)
    return {name: column[..., order] for name, column in values.items()}


class TestWeight:
    @pytest.mark.parametrize("depth_m", [0.3, 1.0, 3.0, 7.5])
    def test_new_surfel_on_the_optical_axis_weighs_one_at_any_depth(self, depth_m: float) -> None:
        """gamma = 0 there, so alpha = exp(0) = 1 (golden 3; one known library has 3.7e-6 at 3 m)."""
        camera = sw.PinholeCamera(40, 40, 20.0, 15.0, 41, 31)
        surfels = mapper_with(wall(depth_m, camera=camera)).map
        axis = np.argmin(np.abs(surfels.positions_m[:2]).sum(axis=0))
        assert surfels.confidences[axis] == 1.0
        assert surfels.confidences.max() == 1.0

    def test_corner_weight(self) -> None:
        """The furthest pixel has gamma = 1: alpha = exp(-1 / (2 * 0.6^2)) = exp(-1.3889) = 0.24935."""
        camera = sw.PinholeCamera(500, 480, 300.3, 250.7, 640, 480)
        weight = radial_weight(camera)
        assert not weight.flags.writeable  # every frame of the camera gets this one
        assert weight.min() == pytest.approx(0.24935, abs=1e-5)
        assert np.unravel_index(weight.argmin(), weight.shape) == (0, 639)
        corner = np.hypot(639 - 300.3, 250.7)
        for v, u in ((0, 0), (251, 300), (100, 500), (479, 639)):
            gamma = np.hypot(u - 300.3, v - 250.7) / corner
            assert weight[v, u] == pytest.approx(np.exp(-(gamma**2) / (2 * 0.36)), rel=1e-6)


class TestMerging:
    @settings(max_examples=30)
    @given(
        a=st.floats(-0.002, 0.002), b=st.floats(-0.002, 0.002), tilt=st.floats(-0.1, 0.1),
        colors=st.tuples(st.integers(0, 255), st.integers(0, 255)),
    )  # fmt: skip
    def test_two_measurements_of_equal_weight_give_the_mean_in_either_order(
        self, a: float, b: float, tilt: float, colors: tuple[int, int]
    ) -> None:
        first, second = wall(1.5 + a, color=colors[0]), wall(1.5 + b, (0.1 * tilt, 0, 1), color=colors[1])
        forth, back = mapper_with(first, second).map, mapper_with(second, first).map
        if len(forth) != len(back):  # the walls are more than a gate apart at the side: surfels were added
            return
        forth, back = values_of(forth), matched(values_of(back), values_of(forth))
        np.testing.assert_allclose(forth["positions_m"], back["positions_m"], atol=2e-6)
        np.testing.assert_allclose(forth["normals"], back["normals"], atol=2e-6)
        np.testing.assert_allclose(forth["confidences"], back["confidences"], rtol=1e-6)
        single = values_of(mapper_with(first).map)
        if len(single["radii_m"]) == len(forth["radii_m"]):
            assert forth["confidences"].sum() == pytest.approx(2 * single["confidences"].sum(), rel=1e-5)
            # Pixels are 37 mm apart; the two walls at most 20 mm, and the mean of both half of that from each.
            one = matched(single, forth, within_m=0.015)["positions_m"]
            other = matched(values_of(mapper_with(second).map), forth, within_m=0.015)["positions_m"]
            np.testing.assert_allclose(forth["positions_m"], (one + other) / 2, atol=2e-6)
            assert np.abs(forth["colors"] - (colors[0] + colors[1]) / 2).max() <= 0.51

    def test_mean_of_many_and_normals_stay_unit(self) -> None:
        """Ten walls within the gate: the map is at their mean, the confidence ten times the first."""
        depths = 1.5 + 0.002 * np.random.default_rng(1).standard_normal(10)
        mapper = mapper_with(*(wall(d) for d in depths))
        single = mapper_with(wall(1.5)).map
        assert len(mapper.map) == len(single)
        np.testing.assert_allclose(mapper.map.positions_m[2], depths.mean(), atol=1e-5)
        np.testing.assert_allclose(mapper.map.confidences, 10 * single.confidences, rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(mapper.map.normals, axis=0), 1, atol=1e-6)
        assert (mapper.map.created == 0).all()
        assert (mapper.map.last_seen == 9).all()

    def test_confidence_is_capped(self) -> None:
        mapper = mapper_with(*[wall()] * 6, max_confidence=3.0)
        assert mapper.map.confidences.max() == 3.0

    def test_same_view_again_appends_nothing(self) -> None:
        pyramid = sw.build_pyramid(rendered(count=40).frames[0])
        mapper = mapper_with(pyramid)
        seen = int((pyramid.levels[0].surface[..., 6] > 0).sum())
        assert len(mapper.map) == seen
        counts = mapper.fuse(pyramid, np.eye(4))
        assert counts.appended < 0.01 * seen

    def test_frame_without_depth_changes_nothing(self) -> None:
        mapper = mapper_with(wall())
        before = content(mapper.map)
        counts = mapper.fuse(sw.build_pyramid(frame_of(np.zeros(SMALL.shape), camera=SMALL)), np.eye(4))
        assert (counts.appended, counts.removed) == (0, 0)
        assert content(mapper.map) == before

    def test_opposite_faces_are_two_surfaces(self) -> None:
        """The front and the back of a thin board must not merge, however near they are."""
        mapper = mapper_with(wall(1.5))
        front = len(mapper.map)
        behind = se3.exp([0, 0, 3.001, 0, np.pi, 0])
        behind[:3, 3] = [0, 0, 3.001]
        mapper.fuse(wall(1.5), behind)
        assert len(mapper.map) == pytest.approx(2 * front, rel=0.05)
        assert (mapper.map.confidences <= 1).all()

    def test_moving_the_world_frame_moves_the_map(self) -> None:
        sequence = rendered(count=40)
        T = se3.exp([0.5, -1, 2, 0.4, -0.8, 0.3])
        plain, moved = sw.SurfelMapper(), sw.SurfelMapper()
        for k in range(3):
            pyramid, pose = sw.build_pyramid(sequence.frames[k]), sequence.ground_truth.T_world_camera[k]
            plain.fuse(pyramid, pose)
            moved.fuse(pyramid, T @ pose)
        assert len(moved.map) == pytest.approx(len(plain.map), rel=2e-3)
        a = T[:3, :3] @ plain.map.positions_m + T[:3, 3:]
        for axis in range(3):
            np.testing.assert_allclose(
                np.percentile(a[axis], [1, 25, 50, 75, 99]),
                np.percentile(moved.map.positions_m[axis], [1, 25, 50, 75, 99]), atol=5e-3,
            )  # fmt: skip

    @pytest.mark.parametrize("layout", ["view of BGR", "columns first", "read-only"])
    def test_any_memory_layout_of_the_image(self, layout: str) -> None:
        """Views of BGR images and read-only buffers give the same map, without compiling the kernels anew."""
        from scanweld.mapping import kernels

        frame = rendered(count=40).frames[0]
        expected = mapper_with(sw.build_pyramid(frame)).map
        compiled = len(kernels.new_surfels.signatures), len(kernels.merge_pages.signatures)
        color, depth = frame.color.copy(), frame.depth_m.copy()
        if layout == "read-only":
            color.flags.writeable = depth.flags.writeable = False
        elif layout == "columns first":
            color, depth = np.asfortranarray(color), np.asfortranarray(depth)
        else:
            color = color[..., ::-1].copy()[..., ::-1]
        mapper = mapper_with(*[sw.build_pyramid(replace(frame, color=color, depth_m=depth))] * 2)
        np.testing.assert_array_equal(mapper.map.colors, expected.colors)
        assert (len(kernels.new_surfels.signatures), len(kernels.merge_pages.signatures)) == compiled

    def test_frame_without_colour_is_grey(self) -> None:
        frame = replace(rendered(count=40).frames[0], color=None)
        assert np.unique(mapper_with(sw.build_pyramid(frame)).map.colors).tolist() == [160]

    def test_pose_far_from_the_last_view_does_not_double_the_map(self) -> None:
        """`view` remembers what was near; a frame that is fused elsewhere must still meet the whole map."""
        camera = sw.PinholeCamera(300, 300, 79.5, 59.5, 160, 120)
        pyramid = wall(1.5, camera=camera)
        mapper = mapper_with(pyramid)
        before = len(mapper.map)
        elsewhere = se3.exp([0, 0, 0, 0, np.radians(30), 0])
        assert len(mapper.view(elsewhere, camera)) < before / 2
        assert mapper.fuse(pyramid, np.eye(4)).appended < 0.01 * before


def test_view_reaches_further_than_anything_was_measured() -> None:
    """From 12 m on it is one and a half times the largest depth; what is further away is not even looked at."""
    mapper = sw.SurfelMapper()
    far = np.array([[0.0], [0.0], [13.0]], np.float32)
    mapper.map.append(far, -far / 13, np.zeros((3, 1)), np.ones(1, np.float32), np.ones(1, np.float32), 0)
    assert len(mapper.view(np.eye(4), SMALL)) == 0
    frame = frame_of(plane_depth((0, 0, 1), 9.0, SMALL), camera=SMALL)
    mapper.fuse(sw.build_pyramid(frame, sw.SurfaceConfig(max_depth_m=20.0)), np.eye(4))
    axis = mapper.view(se3.exp([0, 0, -0.4, 0, 0, 0]), SMALL)
    assert (axis.positions_m[2] > 12).sum() == 0  # hidden by the wall
    mapper.map.remove(mapper.map.positions_m[2] < 10)
    assert len(mapper.view(se3.exp([0, 0, -0.4, 0, 0, 0]), SMALL)) == 1


class TestFreeSpace:
    def test_surfel_that_is_looked_through_loses_the_weight_of_the_pixel(self) -> None:
        mapper = mapper_with(wall(1.0), wall(1.0), wall(1.0))
        before = mapper.map.confidences.copy()
        count = len(mapper.map)
        mapper.fuse(wall(1.5), np.eye(4))
        old = mapper.map.created < 3
        u, v = (np.rint(SMALL.project(mapper.map.positions_m[:, old].T)[0]).astype(int)).T
        inner = (u > 2) & (u < SMALL.width - 3) & (v > 1) & (v < SMALL.height - 2)
        lost = (before - mapper.map.confidences[old])[inner]
        np.testing.assert_allclose(lost, radial_weight(SMALL)[v, u][inner], rtol=1e-5)
        assert len(mapper.map) > 1.9 * count  # the wall behind is there too

    def test_margin_keeps_what_is_hardly_in_front(self) -> None:
        """At 1.5 m the gate is 3 (0.0012 + 0.0019 * 1.21) = 10.5 mm, so the margin of 5 cm rules: 4 cm stay."""
        mapper = mapper_with(wall(1.46))
        before = mapper.map.confidences.copy()
        mapper.fuse(wall(1.5), np.eye(4))
        assert (mapper.map.confidences[mapper.map.created < 1] >= before).all()

    def test_hidden_surfels_keep_their_confidence(self) -> None:
        mapper = mapper_with(wall(2.0))
        before = mapper.map.confidences.copy()
        mapper.fuse(wall(1.0), np.eye(4))
        np.testing.assert_array_equal(mapper.map.confidences[mapper.map.created < 1], before)

    def test_object_that_left_is_removed(self) -> None:
        """A box before a wall, seen three times, then gone: after as many looks and a cleaning it has left the map."""
        with_box = plane_depth((0, 0, 1), 2.0, SMALL)
        with_box[10:20, 14:26] = 1.2
        box, bare = sw.build_pyramid(frame_of(with_box, camera=SMALL)), wall(2.0)
        mapper = mapper_with(*[box] * 3)
        assert (mapper.map.positions_m[2] < 1.5).sum() > 40
        for _ in range(13):
            mapper.fuse(bare, np.eye(4))
        assert (mapper.map.positions_m[2] < 1.5).sum() == 0
        assert (mapper.map.positions_m[2] > 1.9).sum() > 900

    def test_what_was_looked_through_can_be_confirmed_again(self) -> None:
        """A flickering measurement must not throw a surfel about: its weight never becomes negative."""
        near, far = wall(1.0), wall(1.5)
        mapper = mapper_with(near, clean_interval=1000)
        for pyramid in (far, far, near):
            mapper.fuse(pyramid, np.eye(4))
        assert (mapper.map.confidences >= 0).all()
        np.testing.assert_allclose(mapper.map.positions_m[2, mapper.map.created < 1], 1.0, atol=1e-4)
        assert np.isfinite(mapper.map.positions_m).all()


class TestRemoval:
    def test_only_pages_with_a_reason_are_looked_at(self) -> None:
        """Of two cells with a surfel that has nothing left, the one that fusion marked is cleaned."""
        surfels = sw.SurfelMap()
        vectors = np.array([[0.1, 0.1, 9.0, 9.0]] * 3, np.float32)
        confidence = np.array([9, 0, 9, 0], np.float32)
        surfels.append(vectors, vectors, vectors, confidence + 1, confidence, 0)
        pages = surfels.pages
        pages.probation[pages.live] = 0x7FFFFFFF
        pages.dirty[pages.live[1]] = 1
        assert tidy(surfels, 1, FusionConfig(clean_interval=8)) == 0
        assert tidy(surfels, 8, FusionConfig(clean_interval=8)) == 1
        np.testing.assert_array_equal(surfels.positions_m[0][surfels.confidences == 0], np.float32([0.1]))

    def test_unstable_surfels_go_after_their_time_and_stable_ones_stay(self) -> None:
        config = FusionConfig(stable_confidence=2.0, unstable_frames=10, clean_interval=1)
        surfels = sw.SurfelMap()
        confidence = np.array([1.9, 2.0, 1.0, 0.0, 50.0], np.float32)
        vectors = np.zeros((3, 5), np.float32)
        surfels.append(vectors, vectors, vectors, confidence, confidence, 0)
        assert tidy(surfels, 10, config) == 0  # not yet
        assert tidy(surfels, 11, config) == 3
        np.testing.assert_array_equal(surfels.confidences, [2.0, 50.0])

    def test_a_speck_is_gone_after_the_time_of_grace(self) -> None:
        """Seen once, then out of view: removed at the first cleaning after `unstable_frames`."""
        mapper = mapper_with(wall(), unstable_frames=5, clean_interval=4, stable_confidence=3.0)
        away = se3.exp([0, 0, 0, 0, np.pi, 0])
        sizes = []
        for _ in range(9):
            mapper.fuse(sw.build_pyramid(frame_of(np.zeros(SMALL.shape), camera=SMALL)), away)
            sizes.append(len(mapper.map))
        assert sizes[:7] == [sizes[0]] * 7  # frames 1 to 7; frame 4 is a cleaning, but too early
        assert sizes[7] == 0


def test_fused_wall_lies_where_it_is() -> None:
    """Poses and depth exact: every surfel of 30 frames of the room is on a surface that was seen."""
    sequence = rendered(count=40)
    mapper = sw.SurfelMapper()
    for k in range(0, 40, 4):
        mapper.fuse(sw.build_pyramid(sequence.frames[k]), sequence.ground_truth.T_world_camera[k])
    last = sequence.frames[20]
    pose = sequence.ground_truth.T_world_camera[20]
    surface = sw.build_pyramid(last).levels[0].surface
    points = se3.transform_points(se3.inverse(pose), mapper.map.positions_m.T)
    pixels, inside = CAMERA.project(points)
    u, v = np.rint(pixels[inside]).astype(int).T
    offset = np.abs(((points[inside] - surface[v, u, :3]) * surface[v, u, 3:6]).sum(axis=1))
    visible = (surface[v, u, 6] > 0) & (np.abs(points[inside][:, 2] - surface[v, u, 2]) < 0.05)
    assert visible.sum() > 8000
    assert np.median(offset[visible]) < 5e-4
    assert np.percentile(offset[visible], 90) < 5e-3


def test_weight_of_an_image_of_one_pixel_is_one() -> None:
    np.testing.assert_array_equal(radial_weight(sw.PinholeCamera(10, 10, 0, 0, 1, 1)), [[1.0]])
